"""Frames that a stage leaves far from their keypoints take the pose of a near frame.

Where the motion terms have heavy tails, a pose that jumps away for a few frames and returns costs little. Such frames
may stay in a wrong local minimum. The next stage continues from the poses of this module.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxfit.fitting.problem import Problem, Program
from jaxfit.fitting.solve import report
from jaxfit.model.pose import Pose

__all__ = ["take_near_poses"]

OFFSETS = (-1, 1, -2, 2, -4, 4, -8, 8)
"""Distances of the near frames, in frames."""
FAR_PX = 6.0
"""Frames with a smaller keypoint error keep their pose, in pixels of a 256-pixel crop."""
OUTLIER_PX = 32.0
"""A keypoint has at most this error, so that a few outliers do not decide."""
RATIO = 0.7
"""The keypoint error must fall below this multiple of the error before."""


def take_near_poses(program: Program, problems: Problem, pose: Pose) -> Pose:
    """Return the poses after a stage, with the poses of near frames where the keypoints are much closer to them.

    The keypoint error of a frame is the mean distance of the detected keypoints, weighted by their confidence. Only
    frames with the bird give and take poses. The constants were chosen on simulated scenes (docs/configs.md).

    Args:
        program: the program of the stage.
        problems: B problems of the stage, with windows of T frames.
        pose: their poses after the stage.
    """
    present = np.asarray(problems.targets.present)
    frames = np.broadcast_to(np.arange(present.shape[1]), present.shape)
    source, before = frames, _keypoint_error(program, problems, pose)
    limit = np.where(before > FAR_PX, RATIO * before, 0.0)
    for offset in OFFSETS:
        near = np.clip(frames + offset, 0, frames.shape[1] - 1)
        error = _keypoint_error(program, problems, _poses_at(pose, near))
        better = present & np.take_along_axis(present, near, axis=1) & (error < limit)
        source, limit = np.where(better, near, source), np.where(better, error, limit)
    return _poses_at(pose, source) if (source != frames).any() else pose


def _poses_at(pose: Pose, source: Int[np.ndarray, "B T"]) -> Pose:
    """Return poses whose frame t has the pose of frame `source[..., t]`; sizes and shapes do not change."""
    rows = np.arange(len(source))[:, None]
    changed = {name: getattr(pose, name)[rows, source] for name in ("global_orient", "body_pose", "transl")}
    return replace(pose, **changed)


def _keypoint_error(program: Program, problems: Problem, pose: Pose) -> Float[np.ndarray, "B T"]:
    """Return the mean distance of the detected keypoints in crop pixels; NaN without a keypoint."""
    weight = problems.targets.confidence * problems.hyperparameters.keypoints_on[:, None]
    shift_px = report(program, problems, pose).keypoints_px - problems.targets.keypoints_px
    distance_px = jnp.minimum(jnp.linalg.norm(shift_px, axis=-1), OUTLIER_PX)
    return np.asarray((weight * distance_px).sum(-1) / weight.sum(-1))
