"""The paper's tracker: a bird is where its box was a frame ago."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from scipy.optimize import linear_sum_assignment

from jaxfit.perception.instances import Instance

__all__ = ["IouTracker"]


class IouTracker:
    """Joins each bird to the box that it overlaps most among those where birds were seen last.

    Boxes are the tight ones of the masks. Among all ways of joining birds to boxes one to one, over pairs that overlap
    by more than `min_iou`, the one with the greatest sum of overlaps is taken. A bird that is missed leaves its last
    box behind for `memory` frames; whatever joins no box begins a new identity.

    Args:
        memory: frames for which a bird may be missed; frames that the video lacks are missed ones.
        min_iou: least intersection over union, not reached.
        step: numbers from one frame that is looked at to the next.

    Source: Hägerlind et al. 2024, the tracker over masks.
    """

    def __init__(self, memory: int = 5, min_iou: float = 0.1, step: int = 1):
        self._reach, self._min_iou = (memory + 1) * step, min_iou
        self._last: dict[int, tuple[int, np.ndarray]] = {}  # identity → frame and box in which it was seen last
        self._next, self._frame_index = 1, -1

    def update(
        self, frame_index: int, instances: Sequence[Instance], frame: UInt8[np.ndarray, "H W 3"] | None = None
    ) -> list[int | None]:
        """The identities of one frame's birds, as `Tracker` says; this one gives every bird one at once."""
        if frame_index <= self._frame_index:
            raise ValueError(f"frame_index must increase, but {frame_index} follows {self._frame_index}")
        self._frame_index = frame_index
        self._last = {one: seen for one, seen in self._last.items() if frame_index - seen[0] <= self._reach}
        boxes = np.array([instance.box_px for instance in instances], np.float64).reshape(-1, 4)
        known = list(self._last)
        overlap = _overlaps(np.array([self._last[one][1] for one in known]).reshape(-1, 4), boxes)
        overlap[overlap <= self._min_iou] = 0
        joined = {
            int(column): known[row]
            for row, column in zip(*linear_sum_assignment(overlap, maximize=True), strict=True)
            if overlap[row, column] > 0
        }
        identities: list[int | None] = []
        for column, box in enumerate(boxes):
            one = joined.get(column, self._next)
            self._next = max(self._next, one + 1)
            self._last[one] = frame_index, box
            identities.append(one)
        return identities


def _overlaps(a: Float[np.ndarray, "A 4"], b: Float[np.ndarray, "B 4"]) -> Float[np.ndarray, "A B"]:
    """Intersection over union of boxes (x, y, width, height)."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum((a[:, :2] + a[:, 2:])[:, None], (b[:, :2] + b[:, 2:])[None])
    shared = np.maximum(high - low, 0).prod(-1)
    return shared / (a[:, 2:].prod(-1)[:, None] + b[:, 2:].prod(-1)[None] - shared)
