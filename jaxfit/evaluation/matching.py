"""Which bird and frame of a result is which of the truth's: by the track's id and the frame's number."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int

from jaxfit.fitting.solution import Solution

__all__ = ["match"]


def match(
    solution: Solution, track_id: Int[np.ndarray, "M"], frame_index: Int[np.ndarray, "L"]
) -> tuple[Int[np.ndarray, "N 1"], Int[np.ndarray, "T"], Bool[np.ndarray, "N T"]]:
    """Positions in the truth of a result's tracks and frames.

    Returns:
        Positions of the tracks and of the frames, which together index an (M, L, …) array of the truth as
        (N, T, …), and whether the truth knows both; elsewhere the positions mean nothing.
    """
    rows = {int(track): n for n, track in enumerate(track_id)}
    columns = {int(frame): t for t, frame in enumerate(frame_index)}
    n_truth = np.array([rows.get(int(track), -1) for track in solution.track_id], int)
    t_truth = np.array([columns.get(int(frame), -1) for frame in solution.frame_index], int)
    return n_truth[:, None], t_truth, (n_truth >= 0)[:, None] & (t_truth >= 0)
