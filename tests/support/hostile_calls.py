"""Calls of readers whose arguments JSON cannot represent, for `support.hostile.Isolated`."""

from types import SimpleNamespace

import numpy as np

from jaxfit.fitting.initial_poses import load_initial_poses


def read_initial_poses(path: str) -> None:
    """Read initial poses of tracks 4 and 9 in frames 10 to 14, for a bird of 8 joints and 2 shape coefficients."""
    observations = SimpleNamespace(
        track_id=np.array([4, 9]), frame_index=np.arange(10, 15), present=np.arange(10).reshape(2, 5) != 7
    )
    load_initial_poses(path, observations, SimpleNamespace(num_joints=8, num_shapes=2))
