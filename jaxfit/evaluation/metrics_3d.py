"""Parts of the 3D errors of posed birds, in NumPy.

Leading axes (…) are birds, of any number; NaN where nothing is measured. See also ``metrics.mpjpe`` and
``metrics.pa_mpjpe``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxfit.data.frame_numbers import consecutive

__all__ = ["acceleration_errors", "best_scale", "crop_rotation"]


def crop_rotation(centre_px: Any, principal_px: Any, focal_px: float) -> np.ndarray:
    """Return the rotation from the frame of a crop's camera to the frame of the real camera.

    A fit treats its crop as the image of a camera that looks at the centre of the crop. In the real camera, this
    centre lies on the ray d = ((centre − principal point) / focal, 1). So the optical axis e_z of the crop's camera
    is the direction d. R is the shortest rotation from e_z to d, which keeps the image upright:

    R = I + [v]× + [v]×² / (1 + c),  v = e_z × d/‖d‖,  c = e_z · d/‖d‖

    Without R, the orientation of a bird near the edge of a wide image is wrong by up to half the angle of view.

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
    """Return the scale factor that brings the predicted points of a bird closest to the truth, over all frames.

    min over a ≥ 0 of Σ_tk ‖a p_tk − q_tk‖²:  a = max(0, Σ p·q / Σ p·p)

    Args:
        predicted: (…, T, K, 3) relative to the origin of each frame.
        truth: (…, T, K, 3) relative to the origin of each frame.
        counted: (…, T) bool: the frames that count.

    Returns:
        (…); NaN where no frame counts or all points lie at the origin.

    Source: Rhodin et al. 2018 (N-MPJPE), with one factor per track instead of one factor per frame.
    """
    used = np.asarray(counted, bool)[..., None, None]
    p, q = np.where(used, predicted, 0.0), np.where(used, truth, 0.0)
    squares = (p * p).sum((-3, -2, -1))
    return np.where(squares > 0, np.maximum((p * q).sum((-3, -2, -1)), 0) / np.where(squares > 0, squares, 1), np.nan)


def acceleration_errors(predicted: Any, truth: Any, counted: Any, frame_index: Any) -> np.ndarray:
    """Return the error of the points' acceleration, in their unit per squared frame of the file.

    ‖Δ²p_tk − Δ²q_tk‖ at t, the middle of three frames,  Δ²x_t = x_t−1 − 2 x_t + x_t+1

    In a file of every n-th frame of a video, a difference spans n frames of the video and is not divided by n.

    Args:
        predicted: (…, T, K, 3) in the frame and unit of the truth.
        truth: (…, T, K, 3).
        counted: (…, T) bool: the frames that count; a triple counts where all three frames count.
        frame_index: (T,) numbers of the frames in the video; a triple counts where the frames are consecutive: their
            numbers differ by the step of the file (`jaxfit.data.frame_numbers.frame_step`).

    Returns:
        (…, T, K); NaN where no triple counts.

    Source: Kanazawa et al. 2019, *Learning 3D Human Dynamics from Video*; their acceleration error is the mean of
    this.
    """
    predicted, truth, counted = np.asarray(predicted, np.float64), np.asarray(truth, np.float64), np.asarray(counted)
    errors = np.full(predicted.shape[:-1], np.nan)
    steps = consecutive(frame_index)
    triple = counted[..., :-2] & counted[..., 1:-1] & counted[..., 2:] & steps[:-1] & steps[1:]
    difference = np.linalg.norm(np.diff(predicted - truth, 2, axis=-3), axis=-1)
    errors[..., 1:-1, :] = np.where(triple[..., None], difference, np.nan)
    return errors
