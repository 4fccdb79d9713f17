"""The tracker protocol, and the function that loads a tracker by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.perception.instances import Instance
from jaxfit.perception.tracking.external_trackers import EXTERNAL_TRACKERS, ExternalTracker
from jaxfit.perception.tracking.iou_tracker import IouTracker

__all__ = ["TRACKERS", "Tracker", "load_tracker"]

TRACKERS = ("iou", *EXTERNAL_TRACKERS)
"""The names that `load_tracker` accepts."""


class Tracker(Protocol):
    """Assigns each bird an identity that is constant from frame to frame."""

    def update(
        self, frame_index: int, instances: Sequence[Instance], frame: UInt8[np.ndarray, "H W 3"] | None = None
    ) -> list[int | None]:
        """Return the identities of one frame's instances.

        Args:
            frame_index: number of the frame in the video; it increases from call to call. A skipped frame counts as a
                frame without instances.
            instances: the instances of the frame.
            frame: the picture, for trackers that use it.

        Returns:
            One identity (1 or more) for each instance. The identities of a frame differ, and an identity is never
            reused for another bird. None where the instance has no track, or no track yet.

        Raises:
            ValueError: `frame_index` does not increase.
        """
        ...


def load_tracker(
    name: str = "iou", *, memory: int = 5, min_iou: float = 0.1, min_score: float = 0.6, step: int = 1
) -> Tracker:
    """Create a tracker for one video.

    Args:
        name: `iou`, the paper's tracker; or `bytetrack`, `ocsort` or `botsort` of the optional `trackers` package.
            These three predict the position of each bird, which helps where birds cross.
        memory: number of frames for which a bird may be missed without losing its identity.
        min_iou: lower bound of the IoU between boxes of the same bird.
        min_score: instances with a lower score start no track; the tracker `iou` uses all instances.
        step: difference between the numbers of consecutive processed frames.

    Raises:
        InputError: unknown name, or a package that is not installed.
        ValueError: a setting outside its range.
    """
    if memory < 0 or not 0 <= min_iou <= 1 or not 0 <= min_score <= 1 or step < 1:
        raise ValueError(
            "memory must be 0 or more, min_iou and min_score within [0, 1], step 1 or more, "
            f"not {memory}, {min_iou}, {min_score}, {step}"
        )
    if name == "iou":
        return IouTracker(memory, min_iou, step)
    if name in EXTERNAL_TRACKERS:
        return ExternalTracker(name, memory, min_iou, min_score, step)
    raise InputError(f"tracker {name}", "is unknown", f"choose one of {', '.join(TRACKERS)}")
