"""Tracking: from the instances of each frame to tracks, and the clean-up of tracks.

`tracker` defines the tracker protocol and loads a tracker: the paper's (`iou_tracker`) or a tracker of an optional
package (`external_trackers`). `recorder` collects the results of all frames. `skipped_tracks` removes short tracks and
tracks with low scores. `left_right_flips` repairs left and right keypoints that the detector exchanged.
"""

from jaxfit.perception.tracking.left_right_flips import repair_left_right_flips
from jaxfit.perception.tracking.recorder import TrackRecorder
from jaxfit.perception.tracking.skipped_tracks import drop_low_scores, drop_short_tracks, mean_scores
from jaxfit.perception.tracking.tracker import TRACKERS, Tracker, load_tracker

__all__ = [
    "TRACKERS",
    "TrackRecorder",
    "Tracker",
    "drop_low_scores",
    "drop_short_tracks",
    "load_tracker",
    "mean_scores",
    "repair_left_right_flips",
]
