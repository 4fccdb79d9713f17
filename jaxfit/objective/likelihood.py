"""Terms as negative log-likelihoods: heavy-tailed errors of keypoints, heavy-tailed motion.

The values are in nats. Constants that do not depend on the pose are left out, so values differ from log-densities by a
constant.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit.model.rotation import rotation_change
from jaxfit.objective.posed_window import PosedWindow
from jaxfit.objective.registry import term
from jaxfit.objective.residuals import Residuals, Scalar, student_t
from jaxfit.objective.temporal import complete_runs


@term(positive=["sd_sure_px", "sd_unsure_px", "dof"])
def keypoint_likelihood(
    window: PosedWindow,
    *,
    sd_sure_px: Scalar | float = 1.2,
    sd_unsure_px: Scalar | float = 6.0,
    dof: Scalar | float = 4.0,
) -> Residuals:
    """Compare projected and observed keypoints: E = Σ_t Σ_i (ν + 2)/2 · log(1 + ‖e_i‖²/(ν s_i²)).

    This is a bivariate Student t density of the error e, in pixels of a 256-pixel crop, with ν = `dof` degrees of
    freedom: an outlier costs little more than a large error. The scale s = s₁^c · s₀^(1−c) depends on the confidence c,
    with s₁ = `sd_sure_px` at confidence 1 and s₀ = `sd_unsure_px` at confidence 0. Keypoints of confidence 0 do not
    count.

    Source: Lange, Little and Taylor 1989, *Robust Statistical Modeling Using the t Distribution*.
    """
    # the scale is geometric in the confidence: log s is linear between log s₀ and log s₁
    confidence = jnp.asarray(window.targets.confidence)
    scale_px = keypoint_sd_px(confidence, sd_sure_px, sd_unsure_px)
    error = (window.keypoints_px - window.targets.keypoints_px) / scale_px[..., None]
    # one row of the Jacobian for x and one for y of every keypoint
    per_row = jnp.repeat(1 / scale_px, 2, axis=-1)[..., None]
    return Residuals(
        error,
        jnp.asarray(confidence > 0, jnp.float32),
        student_t(dof, 2),
        jacobian=lambda: [block * per_row for block in window.keypoint_jacobian_px],
    )


def keypoint_sd_px(
    confidence: Float[Array | np.ndarray, "*N"], sd_sure_px: Scalar | float, sd_unsure_px: Scalar | float
) -> Float[Array | np.ndarray, "*N"]:
    """Return the scale of keypoint errors, s = s₁^c · s₀^(1−c), at confidences c in [0, 1]."""
    return sd_sure_px**confidence * sd_unsure_px ** (1 - confidence)


@term(positive=["sd_px_s2", "dof"])
def place_likelihood(window: PosedWindow, *, sd_px_s2: Scalar | float = 300.0, dof: Scalar | float = 1.0) -> Residuals:
    """Penalise acceleration of the bird in the image: E = Σ_i (ν + 2)/2 · log(1 + ‖a_i‖²/(ν s²)).

    a_i is the acceleration of the projected translation of the bird, in pixels of a 256-pixel crop per second², with
    the movement of the crop added. Its density is a bivariate Student t with the scale s = `sd_px_s2` and ν = `dof`. A
    bird that stands, walks or flies has a small acceleration in most frames. With several views, a_i has three
    components (`PosedWindow.place_acceleration_px`).

    Source: Lange, Little and Taylor 1989, *Robust Statistical Modeling Using the t Distribution*.
    """
    complete = jnp.asarray(complete_runs(window.present, 2), jnp.float32)
    acceleration_px = window.place_acceleration_px
    kernel = student_t(dof, acceleration_px.shape[-1])
    return Residuals(acceleration_px / (sd_px_s2 * window.frame_s**2), complete, kernel, chain=True)


@term(positive=["sd_rad_s2", "dof"])
def motion_likelihood(
    window: PosedWindow, *, sd_rad_s2: Scalar | float = 6.25, dof: Scalar | float = 1.0
) -> tuple[Residuals, Residuals]:
    """Penalise angular acceleration: E = Σ_i Σ_j (ν + 3)/2 · log(1 + ‖a_j,i‖²/(ν s²)), over the root and all joints.

    a_j,i = (log(R_j,i+1ᵀ R_j,i+2) − log(R_j,iᵀ R_j,i+1))/Δ² is the angular acceleration on SO(3), in radians per
    second², with the time Δ between consecutive frames in seconds (`PosedWindow.frame_s`). Its density is a trivariate
    Student t with the scale s = `sd_rad_s2` and ν = `dof`. A joint at rest or in steady motion is likely, and so is the
    sudden start of a wingbeat: far beyond s, the cost grows with the logarithm only. Where the motion is smooth between
    frames, the cost of a frame does not depend on the frame rate.

    Source: Lange, Little and Taylor 1989 (the density); Huynh 2009, *Metrics for 3D Rotations* (rotations).
    """
    # an acceleration needs three frames with the bird
    complete = jnp.asarray(complete_runs(window.present, 2), jnp.float32)
    scale_rad = sd_rad_s2 * window.frame_s**2  # radians per frame²

    def accelerations(axis_angles: Float[Array | np.ndarray, "T *joints 3"]) -> Float[Array, "T-2 *joints 3"]:
        return jnp.diff(rotation_change(axis_angles[:-1], axis_angles[1:]), axis=0) / scale_rad

    kernel = student_t(dof, 3)
    orient, joints = accelerations(window.pose.global_orient), accelerations(window.pose.body_pose)
    return Residuals(orient, complete, kernel, chain=True), Residuals(joints, complete[:, None], kernel, chain=True)
