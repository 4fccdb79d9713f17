"""Time stamps, frame rate and footage of observations from their video."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np

from jaxfit.data.footage import read_footage
from jaxfit.data.observations import Observations
from jaxfit.video.packets import frame_times
from jaxfit.video.reader import probe_video

__all__ = ["add_times"]


def add_times(observations: Observations, video: Path | None) -> Observations:
    """Return observations with the time stamps, the frame rate and the identity of their video, if they have no times.

    The packets of the video are read up to the last frame, and only the first picture is decoded. A folder of pictures
    has no times.

    Args:
        observations: the observations, with frame numbers of the video.
        video: the video. None or a folder of pictures returns the observations unchanged.

    Raises:
        InputError: the file is not a readable video.
    """
    known = observations.fps is not None or np.isfinite(cast(np.ndarray, observations.timestamp_s)).any()
    if known or observations.own_images or not observations.num_frames or video is None or video.is_dir():
        return observations
    numbers = observations.frame_index
    times = frame_times(video, int(numbers[-1]) + 1)
    inside = numbers < len(times)
    timestamp_s = np.full(len(numbers), np.nan)
    timestamp_s[inside] = times[numbers[inside]]
    info = probe_video(video)
    footage = read_footage(video, info.frames)
    return replace(observations, timestamp_s=timestamp_s, fps=info.fps, footage=footage)
