"""Errors of every keypoint in every frame, from which metrics follow.

The errors are arrays; NaN where a keypoint does not count. Leading axes (…) are images or frames, of any number; the
last axis is the keypoints. `jaxfit.evaluation.bootstrap` reduces the arrays to sums for each bird, and the sums to
metrics:

    PCK = mean of `pck_per_image`;  me_p = √ mean of `squared_errors`;  me_v = √ mean of `squared_velocity_errors`;
    MPJPE = mean of `distances`;  PA-MPJPE = mean of `distances` after `procrustes_align`

Source: Hägerlind et al. 2024, evaluation (me_p, me_v); Wang et al. 2021, *Birds of a Feather*, evaluation code (PCK:
mean over images; there the longest side is one pixel shorter, and the comparison is <).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxfit.data.masks import box_of_mask
from jaxfit.data.tracks import consecutive


def correct_keypoints(
    predicted_px: Any, observed_px: Any, visible: Any, longest_side_px: Any, threshold: float
) -> np.ndarray:
    """Return 1 where ‖predicted − observed‖ ≤ threshold · side, else 0; NaN where the keypoint is not visible.

    A visible keypoint without a finite prediction, or in an image without a side, is not correct.

    Args:
        predicted_px: (…, K, 2) pixels.
        observed_px: (…, K, 2) in the same pixels.
        visible: (…, K) bool.
        longest_side_px: (…) longest side of the bird in the same pixels.
        threshold: fraction of the side, such as 0.05.

    Returns:
        (…, K).
    """
    predicted, observed, visible = _points(predicted_px, observed_px, visible)
    allowed = threshold * _sides(longest_side_px, visible.shape[:-1])
    with np.errstate(invalid="ignore"):
        correct = np.linalg.norm(predicted - observed, axis=-1) <= allowed
    return np.where(visible, correct.astype(np.float64), np.nan)


def squared_errors(predicted: Any, observed: Any, visible: Any, longest_side: Any) -> np.ndarray:
    """Return ‖predicted − observed‖² / side²; me_p is the root of the mean.

    Keypoints without a finite prediction, or in a frame without a side, do not count.

    Args:
        predicted: (…, K, 2) pixels.
        observed: (…, K, 2) in the same pixels.
        visible: (…, K) bool.
        longest_side: (…) longest side of the predicted mask's box in the same pixels.

    Returns:
        (…, K).
    """
    predicted, observed, visible = _points(predicted, observed, visible)
    with np.errstate(invalid="ignore"):
        squared = ((predicted - observed) ** 2).sum(-1) / _sides(longest_side, visible.shape[:-1]) ** 2
    return _counted(squared, visible)


def squared_velocity_errors(
    predicted: Any, observed: Any, visible: Any, longest_side: Any, frame_index: Any = None
) -> np.ndarray:
    """Return ‖(predicted_t+1 − predicted_t) − (observed_t+1 − observed_t)‖² / side_t²; me_v is the root of the mean.

    Velocity is the displacement from one frame of the file to the next. In a file of every n-th frame of a video, it
    spans n frames of the video and is not divided by n.

    A pair of frames counts where the keypoint is visible in both frames and the frames are consecutive: their numbers
    differ by the step of the file (`jaxfit.data.tracks.frame_step`). The error of a pair belongs to the earlier
    frame t; the last frame has no error.

    Args:
        predicted: (…, T, K, 2) pixels.
        observed: (…, T, K, 2) in the same pixels.
        visible: (…, T, K) bool.
        longest_side: (…, T) longest side of the predicted mask's box in the same pixels.
        frame_index: (T,) numbers of the frames in the video; None where all frames are consecutive.

    Returns:
        (…, T, K).
    """
    predicted, observed, visible = _points(predicted, observed, visible)
    frames = np.arange(predicted.shape[-3]) if frame_index is None else np.asarray(frame_index)
    both = visible[..., 1:, :] & visible[..., :-1, :] & consecutive(frames)[:, None]
    side = _sides(longest_side, visible.shape[:-1])[..., :-1, :]
    with np.errstate(invalid="ignore"):
        squared = ((np.diff(predicted, axis=-3) - np.diff(observed, axis=-3)) ** 2).sum(-1) / side**2
    errors = np.full(visible.shape, np.nan)
    errors[..., :-1, :] = _counted(squared, both)
    return errors


def distances(predicted: Any, truth: Any, visible: Any = None) -> np.ndarray:
    """Return ‖predicted − truth‖; the MPJPE is the mean. Points that are not finite do not count.

    Args:
        predicted: (…, K, 3).
        truth: (…, K, 3) in the same frame and unit.
        visible: (…, K) bool; None for all.

    Returns:
        (…, K) in the same unit.
    """
    predicted, truth, visible = _points(predicted, truth, visible)
    with np.errstate(invalid="ignore"):
        return _counted(np.linalg.norm(predicted - truth, axis=-1), visible)


def _points(predicted: Any, observed: Any, visible: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return predicted and observed points as float64, and their visibility as bool (None: all visible)."""
    predicted, observed = np.asarray(predicted, np.float64), np.asarray(observed, np.float64)
    visible = np.ones(observed.shape[:-1], bool) if visible is None else np.asarray(visible).astype(bool)
    return predicted, observed, visible


def _sides(longest_side: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return sides of shape (…, 1); NaN for an empty mask, which has no side."""
    sides = np.broadcast_to(np.asarray(longest_side, np.float64), shape)
    return np.where(sides > 0, sides, np.nan)[..., None]


def _counted(values: np.ndarray, counted: np.ndarray) -> np.ndarray:
    return np.where(counted & np.isfinite(values), values, np.nan)


def mean_error(errors: np.ndarray) -> float:
    """Return the mean of the errors that count (not NaN); NaN without one."""
    counted = errors[np.isfinite(errors)]
    return float(counted.mean()) if counted.size else float("nan")


def pck_per_image(
    predicted_px: Any, observed_px: Any, visible: Any, longest_side_px: Any, threshold: float
) -> np.ndarray:
    """Return the percentage of correct keypoints (PCK) of each image.

    PCK_i = |{k visible : ‖predicted_ik − observed_ik‖ ≤ threshold · side_i}| / |{k visible}|

    Args: as for `correct_keypoints`.

    Returns:
        (…) fractions in [0, 1]; NaN where no keypoint is visible.
    """
    correct = correct_keypoints(predicted_px, observed_px, visible, longest_side_px, threshold)
    counted = np.isfinite(correct).sum(-1)
    return np.where(counted > 0, np.nansum(correct, -1) / np.maximum(counted, 1), np.nan)


def iou(mask_a: Any, mask_b: Any) -> float:
    """Return the intersection over union |A ∩ B| / |A ∪ B| of two masks; NaN where both are empty.

    Args:
        mask_a: (H, W) bool.
        mask_b: (H, W) bool.
    """
    mask_a, mask_b = np.asarray(mask_a, bool), np.asarray(mask_b, bool)
    # pixels outside the box need not be read: a bird is small in its image
    x, y, width, height = box_of_mask(mask_a) or (0, 0, 0, 0)
    box = slice(y, y + height), slice(x, x + width)
    both = np.count_nonzero(mask_a[box] & mask_b[box])
    union = np.count_nonzero(mask_a[box]) + np.count_nonzero(mask_b) - both
    return both / union if union else float("nan")


def procrustes_align(predicted: Any, truth: Any, visible: Any = None) -> np.ndarray:
    """Align the predicted points of each frame to the true points by a rotation, a scale and a translation.

    min over s ≥ 0, R ∈ SO(3), t of Σ_k ‖s R p_k + t − q_k‖² over the visible points.

    Args:
        predicted: (…, K, 3).
        truth: (…, K, 3) in any frame and unit.
        visible: (…, K) bool; None for all. Points that are not finite do not enter the alignment.

    Returns:
        (…, K, 3) in the truth's frame and unit; NaN in frames with fewer than three points.

    Source: Umeyama 1991, equations 40 to 42.
    """
    predicted, truth, visible = _points(predicted, truth, visible)
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
