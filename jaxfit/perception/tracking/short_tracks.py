"""Removal of short tracks."""

from __future__ import annotations

from jaxfit.data.observations import Observations

__all__ = ["drop_short_tracks"]


def drop_short_tracks(observations: Observations, min_track_frames: int) -> Observations:
    """Exclude the tracks that have detections in fewer than `min_track_frames` frames.

    Only frames with a detection of the bird count, not the frames in between. The frames of the video and the
    identities of the other tracks do not change.
    """
    return observations.select(tracks=observations.present.sum(1) >= min_track_frames)
