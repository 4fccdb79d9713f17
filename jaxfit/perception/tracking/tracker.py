"""Which bird of one frame is which of the next: the contract of trackers, and how one is chosen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.perception.instances import Instance
from jaxfit.perception.tracking.iou import IouTracker
from jaxfit.perception.tracking.packaged import PACKAGED, PackagedTracker

__all__ = ["TRACKERS", "Tracker", "load_tracker"]

TRACKERS = ("iou", *PACKAGED)
"""The names that `load_tracker` knows."""


class Tracker(Protocol):
    """Gives every bird an identity that it keeps from frame to frame."""

    def update(
        self, frame_index: int, instances: Sequence[Instance], frame: UInt8[np.ndarray, "H W 3"] | None = None
    ) -> list[int | None]:
        """The identities of one frame's birds.

        Args:
            frame_index: number of the frame in the video; it increases from call to call. Frames that are left
                out count as frames in which no bird was seen.
            instances: what a segmenter found in it.
            frame: its picture, for trackers that look at it.

        Returns:
            One for each instance, from 1 on, never two the same and never one that another bird had; None where
            it is not tracked, or not yet.

        Raises:
            ValueError: `frame_index` does not increase.
        """
        ...


def load_tracker(
    name: str = "iou", *, memory: int = 5, min_iou: float = 0.1, min_score: float = 0.6, step: int = 1
) -> Tracker:
    """A tracker for one video.

    Args:
        name: `iou`, the paper's; or `bytetrack`, `ocsort` or `botsort` of the optional `trackers` package, for scenes
            where birds cross: they predict where a bird will be.
        memory: frames for which a bird may be missed without losing its identity.
        min_iou: boxes of the same bird overlap by more than this.
        min_score: instances trusted less begin no track; the paper's tracker takes all.
        step: numbers from one frame that is looked at to the next.

    Raises:
        InputError: an unknown name, or a package that is not installed.
        ValueError: a setting that makes no sense.
    """
    if memory < 0 or not 0 <= min_iou <= 1 or not 0 <= min_score <= 1 or step < 1:
        raise ValueError(
            "memory must be 0 or more, min_iou and min_score within [0, 1], step 1 or more, "
            f"not {memory}, {min_iou}, {min_score}, {step}"
        )
    if name == "iou":
        return IouTracker(memory, min_iou, step)
    if name in PACKAGED:
        return PackagedTracker(name, memory, min_iou, min_score, step)
    raise InputError(f"tracker {name}", "is unknown", f"choose one of {', '.join(TRACKERS)}")
