"""What segmenters find in a frame, and what finds it: the contracts that every network is adapted to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxfit.data.masks import box_of_mask, encode_patch

__all__ = ["Instance", "KeypointDetector", "Segmenter", "instance_of"]


class Instance(NamedTuple):
    """One bird in one frame; its mask is kept as far as it reaches, not over the whole frame."""

    mask: Bool[np.ndarray, "h w"]
    """The visible bird, cut to the mask's own tight box: every border row and column holds a True."""
    x0: int
    """Column of the frame in which the mask begins."""
    y0: int
    """Row of the frame in which the mask begins."""
    score: float
    """Trust in it, within [0, 1]."""
    label: str
    """Name of its class."""

    @property
    def box_px(self) -> Float[np.ndarray, "4"]:
        """x, y of the upper left corner, width, height: the tight box of the mask, image pixels."""
        height, width = self.mask.shape
        return np.array([self.x0, self.y0, width, height], np.float32)

    def encode(self, width: int, height: int) -> dict[str, Any]:
        """Run lengths over a frame of that size, as `Observations.masks` holds them."""
        return encode_patch(self.mask, self.x0, self.y0, width, height)


def instance_of(mask: Bool[np.ndarray, "h w"], score: float, label: str, x0: int = 0, y0: int = 0) -> Instance | None:
    """An instance of a mask that is not tight yet; None of an empty mask.

    Args:
        mask: a part of the frame, or all of it.
        score, label: as `Instance` has them.
        x0, y0: where that part begins in the frame, pixels; 0 or more.
    """
    box = box_of_mask(mask)
    if box is None:
        return None
    left, top, width, height = box
    return Instance(mask[top : top + height, left : left + width], x0 + left, y0 + top, float(score), label)


class Segmenter(Protocol):
    """Finds the instances of a frame."""

    class_names: tuple[str, ...]
    """Every class that it can name."""

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """Instances of a blue-green-red frame, the most trusted first; masks lie within the frame."""
        ...


class KeypointDetector(Protocol):
    """Finds the keypoints of birds that a segmenter found."""

    keypoint_names: tuple[str, ...]
    """K names in the order of its output."""

    def __call__(
        self, frame: UInt8[np.ndarray, "H W 3"], instances: Sequence[Instance]
    ) -> tuple[Float[np.ndarray, "M K 2"], Float[np.ndarray, "M K"]]:
        """Positions (x, y in image pixels, pixel centres at i + 0.5) and confidences within [0, 1], float32."""
        ...
