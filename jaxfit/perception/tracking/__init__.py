"""From birds frame by frame to tracks, and their clean-up.

`tracker` chooses who says which bird is which: `iou`, the paper's, or one of `packaged`. `recorder` takes down what
was found; `short` drops what was hardly seen; `swaps` exchanges left and right back where they were mixed up.
"""

from jaxfit.perception.tracking.left_right_flips import repair_left_right_flips
from jaxfit.perception.tracking.recorder import TrackRecorder
from jaxfit.perception.tracking.short import drop_short_tracks
from jaxfit.perception.tracking.tracker import TRACKERS, Tracker, load_tracker

__all__ = ["TRACKERS", "TrackRecorder", "Tracker", "drop_short_tracks", "load_tracker", "repair_left_right_flips"]
