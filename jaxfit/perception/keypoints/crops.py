"""One bird cut out of its frame, alone on black, at the size that a network takes."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.perception.instances import Instance

__all__ = ["DILATE_PX", "PAD_PX", "Crop", "crop_bird"]

PAD_PX = 40
DILATE_PX = 70
"""The paper's, for footage in which birds are about 250 pixels long."""


class Crop(NamedTuple):
    """A box of the frame and the picture that it is resampled to; pixel centres at i + 0.5 in both."""

    x0: int
    """Left border in image pixels; below 0 where it reaches over the frame's."""
    y0: int
    """Upper border in image pixels."""
    width: int
    """Of the box, image pixels."""
    height: int
    """Of the box, image pixels."""
    size_px: tuple[int, int]
    """Width and height of the picture, crop pixels."""

    @property
    def scale(self) -> Float[np.ndarray, "2"]:
        """Image pixels for one crop pixel, along x and y; they differ by the rounding of the box to whole pixels."""
        return np.array([self.width, self.height]) / np.array(self.size_px)

    def to_image(self, points_px: Float[np.ndarray, "*B 2"]) -> Float[np.ndarray, "*B 2"]:
        """Crop pixels → image pixels."""
        return points_px * self.scale + (self.x0, self.y0)

    def to_crop(self, points_px: Float[np.ndarray, "*B 2"]) -> Float[np.ndarray, "*B 2"]:
        """Image pixels → crop pixels; the inverse of `to_image`."""
        return (points_px - (self.x0, self.y0)) / self.scale


def crop_bird(
    frame: UInt8[np.ndarray, "H W 3"],
    instance: Instance,
    size_px: tuple[int, int],
    pad_px: int = PAD_PX,
    dilate_px: int = DILATE_PX,
) -> tuple[UInt8[np.ndarray, "h w 3"], Crop]:
    """The picture of one bird: whatever lies farther from its mask is black, other birds with it.

    The mask's tight box is padded, then widened about its centre (to half a pixel) to the picture's aspect ratio;
    the mask is dilated, everything outside it blanked. Shrinking averages over areas, so that nothing aliases.

    Args:
        frame: any colour order; only its pixels within the box are read.
        instance: whose mask lies within the frame.
        size_px: width and height of the picture.
        pad_px: what the box gains on every side, image pixels; 0 or more.
        dilate_px: side of the square that the mask is dilated by, image pixels; 0 leaves it as it is.

    Returns:
        The picture, black where the box reaches over the frame's border, and the way back to image pixels.

    Source: Hägerlind et al. 2024, the crops that its keypoint network is given (40 and 70 pixels).
    """
    crop = _box(instance, size_px, pad_px)
    mask = np.zeros((crop.height, crop.width), np.uint8)
    h, w = instance.mask.shape
    left, top = instance.x0 - crop.x0, instance.y0 - crop.y0
    mask[top : top + h, left : left + w] = instance.mask
    if dilate_px > 1:
        mask = cv2.dilate(mask, np.ones((dilate_px, dilate_px), np.uint8))
    rows = slice(max(crop.y0, 0), min(crop.y0 + crop.height, frame.shape[0]))
    columns = slice(max(crop.x0, 0), min(crop.x0 + crop.width, frame.shape[1]))
    inside = slice(rows.start - crop.y0, rows.stop - crop.y0), slice(columns.start - crop.x0, columns.stop - crop.x0)
    part = frame[rows, columns]
    alone = np.zeros((crop.height, crop.width, 3), np.uint8)
    alone[inside] = cv2.bitwise_and(part, part, mask=mask[inside])
    shrinks = crop.width >= size_px[0] and crop.height >= size_px[1]
    # OpenCV's area mode does not keep to pixel centres when it enlarges
    return cv2.resize(alone, size_px, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), crop


def _box(instance: Instance, size_px: tuple[int, int], pad_px: int) -> Crop:
    h, w = instance.mask.shape
    padded_w, padded_h = w + 2 * pad_px, h + 2 * pad_px
    width = max(padded_w, round(padded_h * size_px[0] / size_px[1]))
    height = max(padded_h, round(padded_w * size_px[1] / size_px[0]))
    x0 = instance.x0 - pad_px - (width - padded_w) // 2
    y0 = instance.y0 - pad_px - (height - padded_h) // 2
    return Crop(x0, y0, width, height, size_px)
