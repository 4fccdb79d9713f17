"""Tracks too short to be birds that one can learn from."""

from __future__ import annotations

from jaxfit.data.observations import Observations

__all__ = ["drop_short_tracks"]


def drop_short_tracks(observations: Observations, min_track_frames: int) -> Observations:
    """Leave out the tracks that were detected in fewer than `min_track_frames` frames.

    Frames in which the bird was missed do not count, however long the track lasts. All frames of the video stay, and so
    do the identities of the other tracks.
    """
    return observations.select(tracks=observations.present.sum(1) >= min_track_frames)
