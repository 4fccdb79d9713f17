"""Instances, and the protocols of segmenters and keypoint detectors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxfit.data.masks import box_of_mask, encode_patch
from jaxfit.errors import InputError
from jaxfit.limits import INSTANCES, MASK_AREA

__all__ = ["Instance", "KeypointDetector", "Segmenter", "collect_instances", "instance_of"]


class Instance(NamedTuple):
    """One bird in one frame. The mask covers the bird's box, not the whole frame."""

    mask: Bool[np.ndarray, "h w"]
    """The visible part of the bird, cropped to its tight box: every border row and column contains a True."""
    x0: int
    """Column of the frame at which the mask begins."""
    y0: int
    """Row of the frame at which the mask begins."""
    score: float
    """Confidence of the instance, within [0, 1]."""
    label: str
    """Name of the class."""

    @property
    def box_px(self) -> Float[np.ndarray, "4"]:
        """The tight box of the mask: x, y of the upper left corner, width, height; image pixels."""
        height, width = self.mask.shape
        return np.array([self.x0, self.y0, width, height], np.float32)

    def encode(self, width: int, height: int) -> dict[str, Any]:
        """Encode the mask as run lengths over a frame of the given size, as in `Observations.masks`."""
        return encode_patch(self.mask, self.x0, self.y0, width, height)


def instance_of(mask: Bool[np.ndarray, "h w"], score: float, label: str, x0: int = 0, y0: int = 0) -> Instance | None:
    """Create an instance from a mask that may have empty borders; return None for an empty mask.

    Args:
        mask: mask of the whole frame or of a part of the frame.
        score, label: as in `Instance`; the score is clipped to [0, 1].
        x0, y0: position of this part in the frame, pixels; 0 or more.
    """
    box = box_of_mask(mask)
    if box is None:
        return None
    left, top, width, height = box
    return Instance(
        mask[top : top + height, left : left + width], x0 + left, y0 + top, min(max(float(score), 0.0), 1.0), label
    )


def collect_instances(
    source: object, instances: Iterable[Instance | None], frame_px: tuple[int, int]
) -> list[Instance]:
    """Return the instances of a frame without None.

    Args:
        source: the network, for messages.
        instances: instances, or None for an empty mask.
        frame_px: width and height of the frame.

    Raises:
        InputError: the number of instances or the area of their masks shows that the network does not detect birds.
    """
    collected, area = [], 0
    for instance in instances:
        if instance is None:
            continue
        collected.append(instance)
        area += instance.mask.size
        if len(collected) > INSTANCES or area > MASK_AREA * frame_px[0] * frame_px[1]:
            problem = f"detects more than {INSTANCES} instances in one frame, or boxes of {MASK_AREA} times its area"
            raise InputError(source, problem, "raise min_score, or give another network")
    return collected


class Segmenter(Protocol):
    """Detects the instances of a frame."""

    class_names: tuple[str, ...]
    """The classes that the segmenter reports."""

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """Return the instances of a blue-green-red frame, by falling score; masks lie within the frame."""
        ...


class KeypointDetector(Protocol):
    """Detects the keypoints of instances."""

    keypoint_names: tuple[str, ...]
    """K names in the order of the output."""

    def __call__(
        self, frame: UInt8[np.ndarray, "H W 3"], instances: Sequence[Instance]
    ) -> tuple[Float[np.ndarray, "M K 2"], Float[np.ndarray, "M K"]]:
        """Return positions (x, y in image pixels, pixel centres at i + 0.5) and confidences within [0, 1], float32."""
        ...
