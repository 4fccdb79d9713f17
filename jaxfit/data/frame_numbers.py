"""The numbers of the frames of a file: their step, and which frames are consecutive."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool

__all__ = ["consecutive", "frame_step"]


def frame_step(frame_index: Any) -> int:
    """Return the step between the frame numbers of a file.

    step = gcd_t (frame_index_t+1 − frame_index_t)

    The step is 1 for a file of every frame and n for a file of every n-th frame, also where the file has gaps.

    Args:
        frame_index: (T,) increasing frame numbers.

    Returns:
        The step, 1 or more; 1 for fewer than two frames.
    """
    numbers = np.asarray(frame_index)
    return max(int(np.gcd.reduce(np.diff(numbers))), 1) if len(numbers) > 1 else 1


def consecutive(frame_index: Any) -> Bool[np.ndarray, "pairs"]:
    """Return whether frame t + 1 is the next frame of the file after frame t: their numbers differ by `frame_step`.

    Args:
        frame_index: (T,) increasing frame numbers.

    Returns:
        (T − 1,), one value for each pair of neighbours.
    """
    return np.diff(np.asarray(frame_index)) == frame_step(frame_index)
