"""Which tracks to trust: figures that need no truth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit.data.frame_numbers import consecutive, frame_step
from jaxfit.data.observations import Observations

__all__ = ["TrackQuality", "track_quality"]


class TrackQuality(NamedTuple):
    """What the observations themselves say about one track: how much of it there is, and how steady it is."""

    track_id: int
    first_frame: int
    """Number of the first frame in which the bird was detected."""
    last_frame: int
    """Number of the last one."""
    frames: int
    """In how many it was detected."""
    gaps: int
    """How often it was missed for a time, between the first and the last."""
    coverage: float
    """Share of the frames from the first to the last in which it was detected; those that the file lacks count too."""
    mean_confidence: float
    """Of all keypoints over the frames with a detection; 0 for a keypoint that was missed."""
    jitter: float | None
    """Median of |p(t−1) − 2 p(t) + p(t+1)| over the longer side of the box at t, where a keypoint's position p is known
    in three consecutive frames with confidence of ½ or more; None where there is no such place. White noise of
    standard deviation σ in x and y gives 2.88 σ; steady motion gives nothing."""


CONFIDENT = 0.5


def track_quality(observations: Observations) -> list[TrackQuality]:
    """Quality figures of every track that is present somewhere, in the order of the tracks.

    Frames are consecutive where their numbers differ by the file's own step, the greatest that divides all differences.
    """
    numbers = observations.frame_index
    step = frame_step(numbers)
    jitter = _second_differences(observations)
    found = []
    for n in range(observations.num_tracks):
        at = np.flatnonzero(observations.present[n])
        if not len(at):
            continue
        first, last = int(numbers[at[0]]), int(numbers[at[-1]])
        own = jitter[n][np.isfinite(jitter[n])]
        found.append(
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
    return found


def _second_differences(observations: Observations) -> Float[np.ndarray, "N M K"]:
    """Length of the second difference at each of the M = T − 2 inner frames, in longer sides of the box; NaN where it
    is not known."""
    points = observations.keypoints_px.astype(np.float64)
    known = observations.confidence >= CONFIDENT
    side = observations.box_px[:, 1:-1, 2:].max(-1)
    beside = consecutive(observations.frame_index)[None, :, None]
    known = known[:, :-2] & known[:, 1:-1] & known[:, 2:] & beside[:, :-1] & beside[:, 1:] & (side > 0)[..., None]
    bent = np.linalg.norm(points[:, :-2] - 2 * points[:, 1:-1] + points[:, 2:], axis=-1)
    return np.where(known, bent / np.where(side > 0, side, 1)[..., None], np.nan)
