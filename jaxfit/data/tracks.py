"""Frame numbers, also from the names of pictures; coverage, confidence and jitter of tracks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.data.observations import Observations, mean_confidence
from jaxfit.foundation.errors import InputError

_NUMBERED = re.compile(r"(.*?)(\d{1,15})$", re.ASCII)
_UPLOADED = re.compile(r"^[0-9a-f]{8}-")
"""Text that Label Studio puts before the name of an uploaded picture."""


def frame_numbers(pictures: Sequence[str], video: Path | None = None) -> list[int] | None:
    """Return the frame numbers of the pictures of one video, or None for photographs.

    Pictures of one folder whose names differ only in the number at the end are frames of one video. If `video` is a
    folder that holds all pictures, the number of a frame is the position of the picture in this folder, as everywhere
    in jaxfit.

    Args:
        pictures: names of pictures, with their folders.
        video: the video or the folder of pictures, if it is known.

    Raises:
        InputError: the folder has no pictures.
    """
    paths = [PurePosixPath(picture.replace("\\", "/")) for picture in pictures]
    if len({path.parent for path in paths}) > 1:
        return None
    if video is not None and video.is_dir():
        from jaxfit.video.pictures import image_files  # imports the video libraries

        place = {file.name: i for i, file in enumerate(image_files(video))}
        found = [place.get(path.name, -1) for path in paths]
        if min(found, default=0) >= 0 and len(set(found)) == len(found):
            return found
        if max(found, default=0) >= 0:
            lacking = paths[found.index(-1)].name if -1 in found else paths[0].name
            raise InputError(video, f"lacks the picture {lacking}", "give the folder that holds all labelled pictures")
    matches = [_NUMBERED.fullmatch(_UPLOADED.sub("", path.stem)) for path in paths]
    named = [match for match in matches if match]
    if len(named) < len(paths) or len({match[1] for match in named}) > 1:
        return None
    numbers = [int(match[2]) for match in named]
    return numbers if len(set(numbers)) == len(numbers) else None


def positions_in(numbers: Int[np.ndarray, "A"], sequence: Int[np.ndarray, "B"]) -> Int[np.ndarray, "A"]:
    """Return the position of each number in a sequence of different numbers, or −1 if the sequence lacks it."""
    position = {int(number): i for i, number in enumerate(sequence)}
    return np.array([position.get(int(number), -1) for number in numbers], int)


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
    return min(max(interval, 1e-5), 1e5) if interval > 0 else None


def assumed_interval_s(frame_index: Any) -> float:
    """Return the time in seconds between consecutive frames of a file whose frame rate is unknown.

    Args:
        frame_index: (T,) increasing frame numbers.
    """
    return frame_step(frame_index) / UNKNOWN_FPS


class TrackQuality(NamedTuple):
    """Quality of one track: completeness, confidence and steadiness."""

    track_id: int
    first_frame: int
    """Number of the first frame in which the bird was detected."""
    last_frame: int
    """Number of the last frame in which the bird was detected."""
    frames: int
    """How many frames have a detection of the bird."""
    gaps: int
    """Number of interruptions of the detections between the first and the last frame."""
    coverage: float
    """Fraction of the frames from the first to the last with a detection; frames missing in the file count too."""
    mean_confidence: float
    """Mean confidence of all keypoints over the frames with a detection; a missing keypoint counts as 0, unless no bird
    has it."""
    jitter: float | None
    """Median of |p(t−1) − 2 p(t) + p(t+1)| / (longer side of the box at t), where the position p of a keypoint has a
    confidence of at least ½ in three consecutive frames; None without three such frames. White noise of standard
    deviation σ in x and y gives 2.88 σ; motion of constant velocity gives 0."""


CONFIDENT = 0.5
"""Least confidence of a keypoint that counts for the jitter."""


def track_quality(observations: Observations) -> list[TrackQuality]:
    """Return the quality of every track with a detection, in the order of the tracks.

    Frames are consecutive where their numbers differ by the step of the file (`frame_step`).
    """
    numbers = observations.frame_index
    step = frame_step(numbers)
    confidence, jitter = mean_confidence(observations.confidence), second_differences(observations)
    qualities = []
    for n in range(observations.num_tracks):
        at = np.flatnonzero(observations.present[n])
        if not len(at):
            continue
        first, last = int(numbers[at[0]]), int(numbers[at[-1]])
        own = jitter[n][np.isfinite(jitter[n])]
        qualities.append(
            TrackQuality(
                track_id=int(observations.track_id[n]),
                first_frame=first,
                last_frame=last,
                frames=len(at),
                gaps=int((np.diff(numbers[at]) > step).sum()),
                coverage=len(at) / ((last - first) // step + 1),
                mean_confidence=float(confidence[n, at].mean()),
                jitter=float(np.median(own)) if len(own) else None,
            )
        )
    return qualities


def second_differences(observations: Observations) -> Float[np.ndarray, "N M K"]:
    """Return |p(t−1) − 2 p(t) + p(t+1)| / (longer side of the box) at the M = T − 2 inner frames; NaN where unknown."""
    points = observations.keypoints_px.astype(np.float64)
    known = observations.confidence >= CONFIDENT
    side = observations.box_px[:, 1:-1, 2:].max(-1)
    next_to = consecutive(observations.frame_index)[None, :, None]
    known = known[:, :-2] & known[:, 1:-1] & known[:, 2:] & next_to[:, :-1] & next_to[:, 1:] & (side > 0)[..., None]
    difference = np.linalg.norm(points[:, :-2] - 2 * points[:, 1:-1] + points[:, 2:], axis=-1)
    return np.where(known, difference / np.where(side > 0, side, 1)[..., None], np.nan)
