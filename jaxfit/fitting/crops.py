"""Crops: the squares that are cut from the images around each bird."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxfit.config.fit import CropConfig
from jaxfit.data.observations import Observations
from jaxfit.model.camera import CROP_PX
from jaxfit.raster.silhouette_reference import UNKNOWN

MIN_SIZE_PX = 16.0
"""Smallest side of a crop, in image pixels."""
MAX_CROP_IMAGE_SIDES = 2
"""Largest side of a crop, as a multiple of the longer side of its image."""
MARGIN_PX = 3.0
"""Pixels this close to another bird's mask are unknown, in pixels of a 256-pixel crop: masks are ragged, and the edge
of a silhouette is soft."""


def crop_squares(
    observations: Observations,
    track: Int[np.ndarray, "W"],
    frame: Int[np.ndarray, "W T"],
    present: Bool[np.ndarray, "W T"],
    config: CropConfig,
) -> Float[np.ndarray, "W T 3"]:
    """Return (x0, y0, size) in image pixels for every frame of some windows: whole numbers, one size for each window.

    The size is at most `MAX_CROP_IMAGE_SIDES` times the longer side of the window's largest image.
    """
    crop, sizes_px = np.zeros((*frame.shape, 3)), observations.image_sizes_px()
    for w, n in enumerate(track.tolist()):
        image_px = sizes_px[n, frame[w, present[w]]]
        if not len(image_px):  # a camera that does not see the bird of the window
            crop[w] = 0, 0, MIN_SIZE_PX
        elif config.mode == "image" and square_images(image_px):
            crop[w] = 0, 0, image_px[0, 0]
        else:
            largest_px = float(MAX_CROP_IMAGE_SIDES * image_px.max())
            crop[w] = _around_the_bird(observations, n, frame[w], present[w], largest_px, config)
    return crop


def square_images(size_px: Int[np.ndarray, "T 2"]) -> bool:
    """Return whether images, of a width and a height, are square and of one size."""
    return len(np.unique(size_px)) <= 1


def _around_the_bird(
    observations: Observations, n: int, frame, present, largest_px: float, config: CropConfig
) -> Float[np.ndarray, "T 3"]:
    """Return the crops of one window: the size of the largest box, with the centres of the boxes.

    A frame without the bird has the crop of the nearest frame with the bird.
    """
    at = frame[present]
    box = observations.box_px[n, at]
    corners = np.concatenate([box[:, :2], box[:, :2] + box[:, 2:]], axis=1).astype(np.float64)  # x0, y0, x1, y1
    without_box = box[:, 2:].min(axis=1) <= 0
    if without_box.any():  # a box is more reliable: a single keypoint may be an outlier
        confident = (observations.confidence[n, at[without_box]] > 0)[..., None]
        points = observations.keypoints_px[n, at[without_box]]
        first = np.where(confident, points, np.inf).min(axis=1)
        corners[without_box] = np.concatenate([first, np.where(confident, points, -np.inf).max(axis=1)], axis=1)
    longest = (corners[:, 2:] - corners[:, :2]).max()
    size = max(min(np.ceil(longest * (1 + 2 * config.padding)), largest_px), MIN_SIZE_PX)
    centre = (corners[:, :2] + corners[:, 2:]) / 2
    if len(at) < len(frame):
        centre = centre[np.abs(np.arange(len(frame))[:, None] - np.flatnonzero(present)).argmin(1)]
    return np.concatenate([np.round(centre - size / 2), np.full((len(frame), 1), size)], axis=1)


def cut_mask(mask: Bool[np.ndarray, "H W"], crop: Float[np.ndarray, "3"], mask_px: int) -> np.ndarray:
    """Return the crop of a mask, (mask_px, mask_px): 1 where the mask covers at least half of the pixel, else 0."""
    x0, y0, size = (int(v) for v in crop)
    rows, columns = mask.shape
    top, left, bottom, right = max(y0, 0), max(x0, 0), min(y0 + size, rows), min(x0 + size, columns)
    if top >= bottom or left >= right:
        return np.zeros((mask_px, mask_px), np.uint8)
    cut = np.zeros((size, size), np.uint8)  # only pages that are written take memory
    np.multiply(mask[top:bottom, left:right], np.uint8(255), out=cut[top - y0 : bottom - y0, left - x0 : right - x0])
    if size != mask_px:
        method = cv2.INTER_AREA if size > mask_px else cv2.INTER_LINEAR
        cut = cv2.resize(cut, (mask_px, mask_px), interpolation=method)
    return (cut >= 128).astype(np.uint8)


def mark_unknown(
    cut: UInt8[np.ndarray, "S S"],
    others: Bool[np.ndarray, "H W"] | None,
    shape: tuple[int, int],
    crop: Float[np.ndarray, "3"],
) -> None:
    """Mark the unknown pixels of the crop of a mask: the background near other birds and beyond the image's border.

    Args:
        cut: the crop of the mask, 0 or 1; it is changed in place.
        others: mask of the other birds in the image; None without them.
        shape: height and width of the image.
        crop: x0, y0 and size in image pixels.
    """
    mask_px = len(cut)
    centre = (np.arange(mask_px) + 0.5) * crop[2] / mask_px
    x, y = crop[0] + centre, crop[1] + centre
    unknown = ((y < 0) | (y > shape[0]))[:, None] | (x < 0) | (x > shape[1])
    if others is not None:
        radius = round(MARGIN_PX * mask_px / CROP_PX)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
        unknown |= cv2.dilate(cut_mask(others, crop, mask_px), disc) > 0
    cut[unknown & (cut == 0)] = UNKNOWN
