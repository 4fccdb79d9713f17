"""The numbers of the frames of a file: their step, their interval, and which frames are consecutive."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool

from jaxfit.limits import FRAMES_PER_S, SECONDS_PER_FRAME

__all__ = ["UNKNOWN_FPS", "assumed_interval_s", "consecutive", "frame_interval_s", "frame_step"]

UNKNOWN_FPS = 25.0
"""Assumed frame rate of a video whose rate is not known, in frames per second."""


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


def frame_interval_s(frame_index: Any, timestamp_s: Any = None, fps: float | None = None) -> float | None:
    """Return the time between consecutive frames of a file, in seconds: frame_step / fps.

    If the frame rate is not known, the interval is the median difference of the time stamps of consecutive frames.

    Args:
        frame_index: (T,) increasing frame numbers of the video.
        timestamp_s: (T,) presentation times of the frames in seconds, NaN where unknown; or None.
        fps: frame rate of the video, frames per second; or None.

    Returns:
        The interval; None if neither the rate nor the time stamps are known, or if the time stamps do not increase.
    """
    if fps is not None:
        interval = frame_step(frame_index) / fps
    else:
        times = np.full(len(frame_index), np.nan) if timestamp_s is None else np.asarray(timestamp_s, np.float64)
        between = np.diff(times)[consecutive(frame_index)]
        between = between[np.isfinite(between)]
        interval = float(np.median(between)) if len(between) else 0.0
    return min(max(interval, 1 / FRAMES_PER_S), SECONDS_PER_FRAME) if interval > 0 else None


def assumed_interval_s(frame_index: Any) -> float:
    """Return the time in seconds between consecutive frames of a file whose frame rate is unknown.

    Args:
        frame_index: (T,) increasing frame numbers.
    """
    return frame_step(frame_index) / UNKNOWN_FPS
