"""The paper's tracker: it assigns each bird to the last box of a track by the overlap of boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from scipy.optimize import linear_sum_assignment

from jaxfit.data.boxes import box_iou
from jaxfit.perception.instances import Instance

__all__ = ["IouTracker"]


class IouTracker:
    """A tracker that maximises the sum of box IoUs between the birds of a frame and the last boxes of the tracks.

    A box is the tight box of an instance's mask. The assignment is one to one, over pairs whose IoU is above `min_iou`.
    A track without an instance keeps its last box for `memory` frames. An instance without a track starts a new track.

    Args:
        memory: number of frames for which a bird may be missed; frames that are absent from the video count as missed.
        min_iou: lower bound of the intersection over union; a pair must exceed this value.
        step: difference between the numbers of consecutive processed frames.

    Source: Hägerlind et al. 2024, the tracker over masks.
    """

    def __init__(self, memory: int = 5, min_iou: float = 0.1, step: int = 1):
        self._max_age, self._min_iou = (memory + 1) * step, min_iou
        self._last_seen: dict[int, tuple[int, np.ndarray]] = {}  # identity → number and box of its last frame
        self._next_identity, self._frame_index = 1, -1

    def update(
        self, frame_index: int, instances: Sequence[Instance], frame: UInt8[np.ndarray, "H W 3"] | None = None
    ) -> list[int | None]:
        """Return the identities of one frame's instances, as `Tracker` describes; every instance has an identity."""
        if frame_index <= self._frame_index:
            raise ValueError(f"frame_index must increase, but {frame_index} follows {self._frame_index}")
        self._frame_index = frame_index
        self._last_seen = {
            identity: last for identity, last in self._last_seen.items() if frame_index - last[0] <= self._max_age
        }
        boxes_px = np.array([instance.box_px for instance in instances], np.float64).reshape(-1, 4)
        known = list(self._last_seen)
        last_boxes_px = np.array([self._last_seen[identity][1] for identity in known]).reshape(-1, 4)
        iou = box_iou(last_boxes_px[:, None], boxes_px[None])
        iou[iou <= self._min_iou] = 0
        assigned = {
            int(column): known[row]
            for row, column in zip(*linear_sum_assignment(iou, maximize=True), strict=True)
            if iou[row, column] > 0
        }
        identities: list[int | None] = []
        for column, box_px in enumerate(boxes_px):
            identity = assigned.get(column, self._next_identity)
            self._next_identity = max(self._next_identity, identity + 1)
            self._last_seen[identity] = frame_index, box_px
            identities.append(identity)
        return identities
