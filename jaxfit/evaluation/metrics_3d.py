"""How close posed birds are to the truth in space. NumPy, exactly defined.

Leading axes (…) are birds, of any number; NaN where there is nothing to measure. Beside these:
``metrics.mpjpe`` and ``metrics.pa_mpjpe``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxfit.data.frame_numbers import consecutive

__all__ = ["acceleration_errors", "best_scale", "crop_rotation"]


def crop_rotation(centre_px: Any, principal_px: Any, focal_px: float) -> np.ndarray:
    """The rotation from the frame of a crop's camera into that of the camera that filmed.

    A fit treats its crop as the picture of a camera that looks straight at the crop's centre. In the real
    camera this centre lies on the ray d = ((centre − principal point) / focal, 1), so what the crop's camera calls
    "ahead" is d. R is the shortest rotation that takes the optical axis e_z to d, which leaves the picture
    upright:

    R = I + [v]× + [v]×² / (1 + c),  v = e_z × d/‖d‖,  c = e_z · d/‖d‖

    Without it a bird near the edge of a wide picture is taken to be turned by up to half the angle of view.

    Args:
        centre_px: (…, 2) centre of the crop, image pixels.
        principal_px: (…, 2) principal point of the camera, image pixels.
        focal_px: focal length of the camera, image pixels.

    Returns:
        (…, 3, 3): R with x_camera = R x_crop.

    Source: Mehta et al. 2017, *Monocular 3D Human Pose Estimation In The Wild Using Improved CNN Supervision*,
    perspective correction.
    """
    offset = (np.asarray(centre_px, np.float64) - np.asarray(principal_px, np.float64)) / focal_px
    ray = np.concatenate([offset, np.ones((*offset.shape[:-1], 1))], axis=-1)
    x, y, c = np.moveaxis(ray / np.linalg.norm(ray, axis=-1, keepdims=True), -1, 0)
    zero = np.zeros_like(c)
    V = np.stack([np.stack(row, -1) for row in ([zero, zero, x], [zero, zero, y], [-x, -y, zero])], -2)
    return np.eye(3) + V + V @ V / (1 + c)[..., None, None]


def best_scale(predicted: Any, truth: Any, counted: Any) -> np.ndarray:
    """The one factor a bird's predicted points need to come closest to the truth, over all its frames.

    min over a ≥ 0 of Σ_tk ‖a p_tk − q_tk‖²:  a = max(0, Σ p·q / Σ p·p)

    Args:
        predicted: (…, T, K, 3) about each frame's own origin.
        truth: (…, T, K, 3) likewise.
        counted: (…, T) bool: frames that take part.

    Returns:
        (…); NaN where no frame takes part or all points lie in the origin.

    Source: Rhodin et al. 2018 (N-MPJPE), with one factor a track instead of one a frame.
    """
    used = np.asarray(counted, bool)[..., None, None]
    p, q = np.where(used, predicted, 0.0), np.where(used, truth, 0.0)
    squares = (p * p).sum((-3, -2, -1))
    return np.where(squares > 0, np.maximum((p * q).sum((-3, -2, -1)), 0) / np.where(squares > 0, squares, 1), np.nan)


def acceleration_errors(predicted: Any, truth: Any, counted: Any, frame_index: Any) -> np.ndarray:
    """Error of the points' acceleration, in their unit per frame²; NaN where it does not count.

    ‖Δ²p_tk − Δ²q_tk‖ at t, the middle of its three frames,  Δ²x_t = x_t−1 − 2 x_t + x_t+1

    Args:
        predicted: (…, T, K, 3) in one frame and unit with the truth.
        truth: (…, T, K, 3).
        counted: (…, T) bool; a triple counts where all three frames do.
        frame_index: (T,) numbers of the frames in the video; a triple counts where they follow each other.

    Returns:
        (…, T, K).

    Source: Kanazawa et al. 2019, *Learning 3D Human Dynamics from Video*, acceleration error, of which this is
    the mean.
    """
    predicted, truth, counted = np.asarray(predicted, np.float64), np.asarray(truth, np.float64), np.asarray(counted)
    errors = np.full(predicted.shape[:-1], np.nan)
    steps = consecutive(frame_index)
    triple = counted[..., :-2] & counted[..., 1:-1] & counted[..., 2:] & steps[:-1] & steps[1:]
    difference = np.linalg.norm(np.diff(predicted - truth, 2, axis=-3), axis=-1)
    errors[..., 1:-1, :] = np.where(triple[..., None], difference, np.nan)
    return errors
