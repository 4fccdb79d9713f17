"""Crops of single birds on a black background, at the input size of a network."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.perception.instances import Instance

__all__ = ["DILATE_PX", "PAD_PX", "Crop", "crop_bird"]

PAD_PX = 40
DILATE_PX = 70
"""The paper's values, for footage in which birds are about 250 pixels long."""


class Crop(NamedTuple):
    """A box of the frame and the size of the resampled picture; pixel centres at i + 0.5 in both."""

    x0: int
    """Left border, image pixels; negative if the box extends beyond the frame."""
    y0: int
    """Upper border, image pixels."""
    width: int
    """Width of the box, image pixels."""
    height: int
    """Height of the box, image pixels."""
    size_px: tuple[int, int]
    """Width and height of the resampled picture, crop pixels."""

    @property
    def scale(self) -> Float[np.ndarray, "2"]:
        """Image pixels per crop pixel, along x and y. The two differ because the box is rounded to whole pixels."""
        return np.array([self.width, self.height]) / np.array(self.size_px)

    def to_image(self, points_px: Float[np.ndarray, "*B 2"]) -> Float[np.ndarray, "*B 2"]:
        """Convert points from crop pixels to image pixels."""
        return points_px * self.scale + (self.x0, self.y0)

    def to_crop(self, points_px: Float[np.ndarray, "*B 2"]) -> Float[np.ndarray, "*B 2"]:
        """Convert points from image pixels to crop pixels; the inverse of `to_image`."""
        return (points_px - (self.x0, self.y0)) / self.scale


def crop_bird(
    frame: UInt8[np.ndarray, "H W 3"],
    instance: Instance,
    size_px: tuple[int, int],
    pad_px: int = PAD_PX,
    dilate_px: int = DILATE_PX,
) -> tuple[UInt8[np.ndarray, "h w 3"], Crop]:
    """Crop one bird and set every pixel outside its dilated mask to black, including other birds.

    The tight box of the mask is padded, then enlarged about its centre (to half a pixel) to the aspect ratio of the
    picture. Reduction averages over areas, which avoids aliasing.

    Args:
        frame: any colour order; only pixels within the box are read.
        instance: its mask lies within the frame.
        size_px: width and height of the picture.
        pad_px: margin on every side of the box, image pixels; 0 or more.
        dilate_px: side of the square that dilates the mask, image pixels; 0 does not dilate.

    Returns:
        The picture, black where the box extends beyond the frame, and the crop that converts to image pixels.

    Source: Hägerlind et al. 2024, the crops of its keypoint network (40 and 70 pixels).
    """
    crop = _padded_box(instance, size_px, pad_px)
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
    picture = np.zeros((crop.height, crop.width, 3), np.uint8)
    picture[inside] = cv2.bitwise_and(part, part, mask=mask[inside])
    is_reduction = crop.width >= size_px[0] and crop.height >= size_px[1]
    # when it enlarges, OpenCV's area mode shifts the pixel centres
    return cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA if is_reduction else cv2.INTER_LINEAR), crop


def _padded_box(instance: Instance, size_px: tuple[int, int], pad_px: int) -> Crop:
    h, w = instance.mask.shape
    padded_w, padded_h = w + 2 * pad_px, h + 2 * pad_px
    width = max(padded_w, round(padded_h * size_px[0] / size_px[1]))
    height = max(padded_h, round(padded_w * size_px[1] / size_px[0]))
    x0 = instance.x0 - pad_px - (width - padded_w) // 2
    y0 = instance.y0 - pad_px - (height - padded_h) // 2
    return Crop(x0, y0, width, height, size_px)
