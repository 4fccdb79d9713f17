"""Boxes in an image: tight boxes of keypoints, and intersection over union.

A box is x and y of the upper left corner, width and height, in image pixels.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

__all__ = ["box_iou", "box_of_keypoints"]


def box_iou(boxes_a_px: Float[np.ndarray, "*#B 4"], boxes_b_px: Float[np.ndarray, "*#B 4"]) -> Float[np.ndarray, "*B"]:
    """Intersection over union |A ∩ B| / |A ∪ B| of boxes; NaN where a box is NaN or both boxes have no area.

    The leading axes are broadcast: `box_iou(a[:, None], b[None])` compares every box of `a` with every box of `b`.

    Args:
        boxes_a_px: x, y, width, height; image pixels.
        boxes_b_px: x, y, width, height; image pixels.
    """
    low = np.maximum(boxes_a_px[..., :2], boxes_b_px[..., :2])
    high = np.minimum(
        boxes_a_px[..., :2] + boxes_a_px[..., 2:],
        boxes_b_px[..., :2] + boxes_b_px[..., 2:],
    )
    intersection = np.maximum(high - low, 0).prod(-1)
    union = boxes_a_px[..., 2:].prod(-1) + boxes_b_px[..., 2:].prod(-1) - intersection
    with np.errstate(invalid="ignore"):
        return intersection / union


def box_of_keypoints(
    keypoints_px: Float[np.ndarray, "*B K 2"], known: Bool[np.ndarray, "*B K"]
) -> Float[np.ndarray, "*B 4"]:
    """The tight boxes of the known keypoints: x, y, width, height; NaN where no keypoint is known.

    Args:
        keypoints_px: positions (x, y), image pixels.
        known: whether a keypoint counts.
    """
    low = np.where(known[..., None], keypoints_px, np.inf).min(-2)
    high = np.where(known[..., None], keypoints_px, -np.inf).max(-2)
    boxes = np.concatenate([low, high - low], axis=-1)
    return np.where(known.any(-1, keepdims=True), boxes, np.nan)
