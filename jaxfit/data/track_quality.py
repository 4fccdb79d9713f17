"""Quality metrics of tracks, computed from the observations alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit.data.frame_numbers import consecutive, frame_step
from jaxfit.data.observations import Observations

__all__ = ["TrackQuality", "second_differences", "track_quality"]


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
    """Mean confidence of all keypoints over the frames with a detection; a missing keypoint counts as 0."""
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
    jitter = second_differences(observations)
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
                mean_confidence=float(observations.confidence[n, at].mean()) if observations.num_keypoints else 0.0,
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
