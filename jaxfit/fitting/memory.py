"""Memory of a fit, estimated before it is taken."""

from __future__ import annotations

from collections.abc import Sequence

from jaxfit.config.fit import FitConfig
from jaxfit.data.observations import Observations
from jaxfit.data.tables import check_memory, observations_bytes
from jaxfit.fitting.batch import bytes_per_frame
from jaxfit.limits import TABLE_GB, WINDOW_GB
from jaxfit.model.bird import Bird

__all__ = ["check_fit_memory"]


def check_fit_memory(observations: Observations, bird: Bird, configs: Sequence[FitConfig], source: object) -> None:
    """Check that the tables of a fit, and one window, fit into memory.

    Args:
        observations: N tracks over T frames.
        bird: the model.
        configs: configs that share one compiled program.
        source: name of the observations in messages.

    Raises:
        InputError: the tables of poses, or one window, need more memory than `limits.TABLE_GB` or `limits.WINDOW_GB`,
            and more than `memory_gb`.
    """
    config, N, T = configs[0], observations.num_tracks, observations.num_frames
    bones, K = bird.num_joints - 1, bird.num_keypoints
    # numbers of a pose, of its keypoints and of its crop; the validation of a solution copies them
    pose_bytes = 2 * 4 * (4 * bones + 5 * K + bird.num_shapes + 16)
    held = 2 * N * T * (26 + 13 * K)  # the observations as read, and with the keypoints in the order of the model
    needed = observations_bytes(N, T, K) + held + N * T * len(configs) * pose_bytes
    runs = f" in {len(configs)} runs" if len(configs) > 1 else ""
    remedy = "split the file into parts with fewer frames or tracks, or raise `memory_gb` in the config"
    tables = f"the poses of {N:,} tracks over {T:,} frames{runs}"
    check_memory(source, tables, needed, remedy, max(TABLE_GB, config.memory_gb))

    search = config.initialise
    orientations = search.turns * search.directions if search.method == "so3" else search.turns
    candidates = min(search.candidates, orientations)
    # the search compares every orientation with the keypoints, and every candidate with those of the next frame
    search_bytes = 450 * orientations + 12 * candidates**2
    needed = config.window * (search.hypotheses * bytes_per_frame(bird, config) + search_bytes)
    window = f"the arrays of a window of {config.window:,} frames"
    remedy = "lower `window`, `crop.size_px` or the numbers of `initialise`, or raise `memory_gb`"
    check_memory("config", window, needed, remedy, max(WINDOW_GB, config.memory_gb))
