"""Tracks that are skipped: short tracks, and tracks of birds with low scores."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxfit.data.observations import Observations

__all__ = ["drop_low_scores", "drop_short_tracks", "mean_scores"]


def drop_short_tracks(observations: Observations, min_track_frames: int) -> Observations:
    """Exclude the tracks that have detections in fewer than `min_track_frames` frames.

    Only frames with a detection of the bird count, not the frames in between. The frames of the video and the
    identities of the other tracks do not change.
    """
    return observations.select(tracks=observations.present.sum(1) >= min_track_frames)


def drop_low_scores(observations: Observations, min_track_score: float) -> Observations:
    """Exclude the tracks whose mean score is below `min_track_score`; observations without scores do not change."""
    return observations.select(tracks=~(mean_scores(observations) < min_track_score))


def mean_scores(observations: Observations) -> Float[np.ndarray, "N"]:
    """Return the mean score of the detections of every track; NaN without scores or without detections."""
    if observations.score is None:
        return np.full(observations.num_tracks, np.nan)
    total = np.where(observations.present, observations.score, 0).sum(1)
    count = observations.present.sum(1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
