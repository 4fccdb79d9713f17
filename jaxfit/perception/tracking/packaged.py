"""Trackers of the optional `trackers` package, which predict where a bird will be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.perception.instances import Instance

__all__ = ["PACKAGED", "PackagedTracker"]

PACKAGED = ("bytetrack", "ocsort", "botsort")
"""ByteTrack (Zhang et al. 2022), OC-SORT (Cao et al. 2023), BoT-SORT (Aharon et al. 2022)."""


class PackagedTracker:
    """ByteTrack, OC-SORT or BoT-SORT as Roboflow's `trackers` has them.

    Each bird is tracked from its second frame on, sooner than the package would: short tracks are dropped afterwards,
    when it is known which ones they are.

    Args:
        name: one of `PACKAGED`.
        memory: frames for which a bird may be missed; frames that the video lacks are missed ones.
        min_iou: least intersection over union of a bird's box and where it is expected (times its score in BoT-SORT).
        min_score: instances trusted less begin no track.
        step: numbers from one frame that is looked at to the next.

    Raises:
        InputError: the package is not installed.
    """

    def __init__(self, name: str, memory: int = 5, min_iou: float = 0.1, min_score: float = 0.6, step: int = 1):
        try:
            import supervision  # pyright: ignore[reportMissingImports]
            import trackers  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            problem = f"needs the package {error.name}, which is not installed"
            raise InputError(f"tracker {name}", problem, 'pip install "jaxfit[trackers]"') from error
        self._detections, self._step, self._memory = supervision.Detections, step, memory
        settings: dict[str, Any] = {
            # the package counts its buffer at 30 frames a second; at that rate it means frames
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
        self._looks = name == "botsort"  # at the picture, for the camera's own motion
        self._frame_index: int | None = None

    def update(
        self, frame_index: int, instances: Sequence[Instance], frame: UInt8[np.ndarray, "H W 3"] | None = None
    ) -> list[int | None]:
        """The identities of one frame's birds, as `Tracker` says."""
        if self._frame_index is not None:
            if frame_index <= self._frame_index:
                raise ValueError(f"frame_index must increase, but {frame_index} follows {self._frame_index}")
            missing = (frame_index - self._frame_index) // self._step - 1
            for _ in range(min(missing, self._memory + 1)):  # by then every track has ended
                self._tracker.update(self._detections.empty())
        self._frame_index = frame_index
        boxes = np.array([instance.box_px for instance in instances], np.float32).reshape(-1, 4)
        found = self._detections(
            xyxy=np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1),
            confidence=np.array([instance.score for instance in instances], np.float32),
            data={"instance": np.arange(len(instances))},
        )
        tracked = self._tracker.update(found, frame if self._looks else None)
        identities: list[int | None] = [None] * len(instances)
        if len(tracked):  # in an order of its own, and without those that BoT-SORT leaves out
            for instance, one in zip(tracked.data["instance"], tracked.tracker_id, strict=True):
                identities[instance] = int(one) + 1 if one >= 0 else None
        return identities
