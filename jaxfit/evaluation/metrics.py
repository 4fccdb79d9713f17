"""How close a fit is to what was seen, or to the truth. NumPy, exactly defined, one number each.

Leading axes (…) are images or frames, of any number. A keypoint counts where ``visible``; where nothing
counts, the result is NaN and no warning.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from jaxfit.data.masks import box_of_mask
from jaxfit.evaluation.keypoint_errors import (
    correct_keypoints,
    distances,
    points,
    squared_errors,
    squared_velocity_errors,
)

__all__ = [
    "iou",
    "longest_side_of_mask",
    "me_p",
    "me_v",
    "mpjpe",
    "pa_mpjpe",
    "pck",
    "pck_per_image",
    "procrustes_align",
]


def _mean(samples: np.ndarray) -> float:
    counted = samples[np.isfinite(samples)]
    return float(counted.mean()) if counted.size else float("nan")


def pck_per_image(
    predicted_px: Any, observed_px: Any, visible: Any, longest_side_px: Any, threshold: float
) -> np.ndarray:
    """Percentage of correct keypoints, for each image.

    PCK_i = |{k visible : ‖predicted_ik − observed_ik‖ ≤ threshold · side_i}| / |{k visible}|

    A visible keypoint without a finite prediction, or in an image without a side, is not correct.

    Args:
        predicted_px: (…, K, 2) pixels.
        observed_px: (…, K, 2) in the same pixels.
        visible: (…, K) bool.
        longest_side_px: (…) longest side of the bird in the same pixels.
        threshold: share of the side, such as 0.05.

    Returns:
        (…) shares in [0, 1]; NaN where no keypoint is visible.

    Raises:
        ValueError: shapes that do not agree.
    """
    correct = correct_keypoints(predicted_px, observed_px, visible, longest_side_px, threshold)
    counted = np.isfinite(correct).sum(-1)
    return np.where(counted > 0, np.nansum(correct, -1) / np.maximum(counted, 1), np.nan)


def pck(
    predicted_px: Any,
    observed_px: Any,
    visible: Any,
    longest_side_px: Any,
    threshold: float,
    reduction: Literal["per_image", "pooled"] = "per_image",
) -> float:
    """Percentage of correct keypoints, over all images.

    ``per_image``: the mean of PCK_i over the images that show a keypoint. This is what AVES reports; its
    longest side is that of the annotated mask, last minus first pixel (``longest_side_of_mask`` − 1), and its
    comparison is <. ``pooled``: correct over visible keypoints of all images together, so that an image
    with more keypoints weighs more.

    Args:
        predicted_px: (…, K, 2) pixels.
        observed_px: (…, K, 2) in the same pixels.
        visible: (…, K) bool.
        longest_side_px: (…) longest side of the bird in the same pixels.
        threshold: share of the side, such as 0.05.
        reduction: how the images come together.

    Returns:
        Share in [0, 1].

    Raises:
        ValueError: shapes that do not agree, or another reduction.

    Source: Wang et al. 2021, *Birds of a Feather*, the fitter's evaluation code.
    """
    if reduction not in ("per_image", "pooled"):
        raise ValueError(f'reduction must be "per_image" or "pooled", not {reduction!r}')
    figure = pck_per_image if reduction == "per_image" else correct_keypoints
    return _mean(figure(predicted_px, observed_px, visible, longest_side_px, threshold))


def iou(mask_a: Any, mask_b: Any) -> float:
    """Intersection over union |A ∩ B| / |A ∪ B| of two masks; NaN where both are empty.

    Args:
        mask_a: (H, W) bool.
        mask_b: (H, W) bool.

    Raises:
        ValueError: masks of different shapes.
    """
    mask_a, mask_b = np.asarray(mask_a, bool), np.asarray(mask_b, bool)
    if mask_a.shape != mask_b.shape:
        raise ValueError(f"mask_a and mask_b must have one shape, not {mask_a.shape} and {mask_b.shape}")
    # a bird is small in its picture
    x, y, width, height = box_of_mask(mask_a) or (0, 0, 0, 0)
    box = slice(y, y + height), slice(x, x + width)
    both = np.count_nonzero(mask_a[box] & mask_b[box])
    union = np.count_nonzero(mask_a[box]) + np.count_nonzero(mask_b) - both
    return both / union if union else float("nan")


def longest_side_of_mask(mask: Any) -> float:
    """Longest side of the mask's tight box in pixels, first and last pixel included; NaN for an empty mask.

    Args:
        mask: (H, W) bool.

    Raises:
        ValueError: ``mask`` has not two dimensions.
    """
    mask = np.asarray(mask, bool)
    if mask.ndim != 2:
        raise ValueError(f"mask must have shape (H, W), not {mask.shape}")
    box = box_of_mask(mask)
    return float(max(box[2:])) if box else float("nan")


def me_p(predicted: Any, observed: Any, visible: Any, longest_side: Any) -> float:
    """RMS error of the projected keypoints' position, as a share of the bird's size.

    me_p = √( mean over visible keypoints of ‖predicted − observed‖² / side² )

    Keypoints without a finite prediction, or in a frame without a side, are left out: count them apart.

    Args:
        predicted: (…, K, 2) pixels.
        observed: (…, K, 2) in the same pixels.
        visible: (…, K) bool.
        longest_side: (…) longest side of the predicted mask's box in the same pixels.

    Raises:
        ValueError: shapes that do not agree.

    Source: Hägerlind et al. 2024, evaluation.
    """
    return math.sqrt(_mean(squared_errors(predicted, observed, visible, longest_side)))


def me_v(predicted: Any, observed: Any, visible: Any, longest_side: Any, frame_index: Any = None) -> float:
    """RMS error of the projected keypoints' frame-to-frame velocity, as a share of the bird's size.

    v_t = (predicted_t+1 − predicted_t) − (observed_t+1 − observed_t)
    me_v = √( mean over pairs (t, t+1) of ‖v_t‖² / side_t² )

    A pair counts where the keypoint is visible in both frames and the frames follow each other in the video;
    it is divided by the side of the earlier frame. Pairs without finite predictions or side are left out.

    Args:
        predicted: (…, T, K, 2) pixels.
        observed: (…, T, K, 2) in the same pixels.
        visible: (…, T, K) bool.
        longest_side: (…, T) longest side of the predicted mask's box in the same pixels.
        frame_index: (T,) numbers of the frames in the video; None where all follow each other.

    Raises:
        ValueError: shapes that do not agree.

    Source: Hägerlind et al. 2024, evaluation.
    """
    return math.sqrt(_mean(squared_velocity_errors(predicted, observed, visible, longest_side, frame_index)))


def mpjpe(predicted: Any, truth: Any, visible: Any = None) -> float:
    """Mean distance between predicted and true points, in their unit.

    Args:
        predicted: (…, K, 3).
        truth: (…, K, 3) in the same frame and unit.
        visible: (…, K) bool; None for all. Points that are not finite are left out.

    Raises:
        ValueError: shapes that do not agree.
    """
    return _mean(distances(predicted, truth, visible))


def procrustes_align(predicted: Any, truth: Any, visible: Any = None) -> np.ndarray:
    """Predicted points after the rotation, scale and translation of each frame that brings them closest.

    min over s ≥ 0, R ∈ SO(3), t of Σ_k ‖s R p_k + t − q_k‖² over the visible points.

    Args:
        predicted: (…, K, 3).
        truth: (…, K, 3) in any frame and unit.
        visible: (…, K) bool; None for all. Points that are not finite are left out of the alignment.

    Returns:
        (…, K, 3) in the truth's frame and unit; NaN in frames with fewer than three points to align.

    Raises:
        ValueError: shapes that do not agree.

    Source: Umeyama 1991, equations 40 to 42.
    """
    predicted, truth, visible = points(predicted, truth, visible)
    used = visible & np.isfinite(predicted).all(-1) & np.isfinite(truth).all(-1)
    weight = used[..., None] / np.maximum(used.sum(-1), 1)[..., None, None]
    mean_p = (np.where(used[..., None], predicted, 0) * weight).sum(-2, keepdims=True)
    mean_q = (np.where(used[..., None], truth, 0) * weight).sum(-2, keepdims=True)
    p = np.where(used[..., None], predicted - mean_p, 0)
    q = np.where(used[..., None], truth - mean_q, 0)
    U, D, Vt = np.linalg.svd(np.swapaxes(q, -1, -2) @ p)
    sign = np.ones(D.shape)
    sign[..., 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))  # no reflections
    R = (U * sign[..., None, :]) @ Vt
    variance = (p**2).sum((-1, -2))
    scale = (D * sign).sum(-1) / np.where(variance > 0, variance, 1)
    aligned = scale[..., None, None] * (predicted - mean_p) @ np.swapaxes(R, -1, -2) + mean_q
    return np.where(used.sum(-1)[..., None, None] >= 3, aligned, np.nan)


def pa_mpjpe(predicted: Any, truth: Any, visible: Any = None) -> float:
    """Mean distance after aligning each frame by ``procrustes_align``, in the truth's unit.

    Args:
        predicted: (…, K, 3).
        truth: (…, K, 3).
        visible: (…, K) bool; None for all. Frames with fewer than three points are left out.

    Raises:
        ValueError: shapes that do not agree.
    """
    return mpjpe(procrustes_align(predicted, truth, visible), truth, visible)
