"""Errors of every keypoint in every frame, as arrays; NaN where a keypoint does not count.

`jaxfit.evaluation.metrics` reduces these arrays to one number, `jaxfit.evaluation.bootstrap` reduces them to sums for
each bird. Leading axes (…) are images or frames, of any number; the last axis is the keypoints.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxfit.data.frame_numbers import consecutive

__all__ = ["correct_keypoints", "distances", "squared_errors", "squared_velocity_errors", "validate_points"]


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

    Raises:
        ValueError: the shapes do not agree.
    """
    predicted, observed, visible = validate_points(predicted_px, observed_px, visible)
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

    Raises:
        ValueError: the shapes do not agree.
    """
    predicted, observed, visible = validate_points(predicted, observed, visible)
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
    differ by the step of the file (`jaxfit.data.frame_numbers.frame_step`). The error of a pair belongs to the earlier
    frame t; the last frame has no error.

    Args:
        predicted: (…, T, K, 2) pixels.
        observed: (…, T, K, 2) in the same pixels.
        visible: (…, T, K) bool.
        longest_side: (…, T) longest side of the predicted mask's box in the same pixels.
        frame_index: (T,) numbers of the frames in the video; None where all frames are consecutive.

    Returns:
        (…, T, K).

    Raises:
        ValueError: the shapes do not agree.
    """
    predicted, observed, visible = validate_points(predicted, observed, visible)
    if predicted.ndim < 3:
        raise ValueError(f"predicted must have shape (…, T, K, 2), not {predicted.shape}")
    T = predicted.shape[-3]
    frames = np.arange(T) if frame_index is None else np.asarray(frame_index)
    if frames.shape != (T,):
        raise ValueError(f"frame_index must have shape ({T},), not {frames.shape}")
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

    Raises:
        ValueError: the shapes do not agree.
    """
    predicted, truth, visible = validate_points(predicted, truth, visible)
    with np.errstate(invalid="ignore"):
        return _counted(np.linalg.norm(predicted - truth, axis=-1), visible)


def validate_points(predicted: Any, observed: Any, visible: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return predicted and observed points as float64, and their visibility as bool (None: all visible).

    Raises:
        ValueError: the shapes do not agree.
    """
    predicted, observed = np.asarray(predicted, np.float64), np.asarray(observed, np.float64)
    if predicted.shape != observed.shape:
        raise ValueError(f"predicted and observed must have one shape, not {predicted.shape}, {observed.shape}")
    visible = np.ones(observed.shape[:-1], bool) if visible is None else np.asarray(visible).astype(bool)
    if visible.shape != observed.shape[:-1]:
        raise ValueError(f"visible must have shape {observed.shape[:-1]}, not {visible.shape}")
    return predicted, observed, visible


def _sides(longest_side: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return sides of shape (…, 1); NaN for an empty mask, which has no side."""
    sides = np.broadcast_to(np.asarray(longest_side, np.float64), shape)
    return np.where(sides > 0, sides, np.nan)[..., None]


def _counted(values: np.ndarray, counted: np.ndarray) -> np.ndarray:
    return np.where(counted & np.isfinite(values), values, np.nan)
