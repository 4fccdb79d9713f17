"""Adapter to the trackers of the optional `trackers` package, which predict the position of each bird."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import install_command
from jaxfit.perception.network import Instance

EXTERNAL_TRACKERS = ("bytetrack", "ocsort", "botsort")
"""ByteTrack (Zhang et al. 2022), OC-SORT (Cao et al. 2023), BoT-SORT (Aharon et al. 2022)."""


class ExternalTracker:
    """ByteTrack, OC-SORT or BoT-SORT of Roboflow's package `trackers`.

    A track starts with the second detection of a bird, which is earlier than the package's default: short tracks are
    removed later, when their lengths are known.

    Args:
        name: one of `EXTERNAL_TRACKERS`.
        memory: number of frames for which a bird may be missed; frames that are absent from the video count as missed.
        min_iou: least intersection over union of a bird's box and its predicted box (times the score in BoT-SORT).
        min_score: instances with a lower score start no track.
        step: difference between the numbers of consecutive processed frames.

    Raises:
        InputError: the package is not installed.
    """

    def __init__(self, name: str, memory: int = 5, min_iou: float = 0.1, min_score: float = 0.6, step: int = 1):
        try:
            import supervision  # pyright: ignore[reportMissingImports]
            import trackers  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            problem = f"needs the package {error.name}, which is not installed"
            raise InputError(f"tracker {name}", problem, f"run {install_command('trackers')}") from error
        self._detections, self._step, self._memory = supervision.Detections, step, memory
        settings: dict[str, Any] = {
            # the package scales its buffer to 30 frames/s; at a frame rate of 30 the buffer is a number of frames
            "lost_track_buffer": memory,
            "frame_rate": 30.0,
            "minimum_consecutive_frames": 1,
            "high_conf_det_threshold": min_score,
        }
        if name == "ocsort":
            self._tracker = trackers.OCSORTTracker(minimum_iou_threshold=min_iou, **settings)
        elif name == "bytetrack":
            self._tracker = trackers.ByteTrackTracker(
                minimum_iou_threshold=min_iou, track_activation_threshold=min_score, **settings
            )
        else:
            self._tracker = trackers.BoTSORTTracker(
                minimum_iou_threshold_first_assoc=min_iou, track_activation_threshold=min_score, **settings
            )
        self.uses_pictures = name == "botsort"  # to estimate the motion of the camera
        self._frame_index: int | None = None

    def update(
        self, frame_index: int, instances: Sequence[Instance], frame: UInt8[np.ndarray, "H W 3"] | None = None
    ) -> list[int | None]:
        """Return the identities of one frame's instances, as `Tracker` describes."""
        if self._frame_index is not None:
            if frame_index <= self._frame_index:
                raise ValueError(f"frame_index must increase, but {frame_index} follows {self._frame_index}")
            missing = (frame_index - self._frame_index) // self._step - 1
            for _ in range(min(missing, self._memory + 1)):  # after so many frames every track has ended
                self._tracker.update(self._detections.empty())
        self._frame_index = frame_index
        boxes = np.array([instance.box_px for instance in instances], np.float32).reshape(-1, 4)
        detections = self._detections(
            xyxy=np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1),
            confidence=np.array([instance.score for instance in instances], np.float32),
            data={"instance": np.arange(len(instances))},
        )
        tracked = self._tracker.update(detections, frame if self.uses_pictures else None)
        identities: list[int | None] = [None] * len(instances)
        if len(tracked):  # the package changes the order, and BoT-SORT drops detections
            for instance, tracker_id in zip(tracked.data["instance"], tracked.tracker_id, strict=True):
                identities[instance] = int(tracker_id) + 1 if tracker_id >= 0 else None
        return identities
