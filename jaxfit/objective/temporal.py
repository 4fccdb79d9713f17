"""Temporal terms: velocity, acceleration; geodesic, Huber, low-pass.

Further terms for smooth motion: geodesic velocity, robust velocity, and a penalty on high frequencies. The two velocity
terms compare rotations, not axis-angles, so a jump of an axis-angle by 2π has no effect. Missing frames contribute 0 to
all terms, and windows of one frame have the value 0.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jax.scipy.fft
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfit.model.rotation import rotation_change
from jaxfit.objective.posed_window import PosedWindow
from jaxfit.objective.registry import term
from jaxfit.objective.residuals import NORM, Residuals, Scalar, huber


@term
def velocity(
    window: PosedWindow, *, beta_global: Scalar | float = 10.0, beta_pose: Scalar | float = 1.0
) -> tuple[Residuals, ...]:
    """Penalise the velocity of the pose: E_vel = Σ_k β_k Σ_i ‖θ_k,i+1 − θ_k,i‖₂ over k = global orientation, body pose.

    Source: Hägerlind et al. 2024, velocity term; norms not squared.
    """
    return _differences(window, 1, beta_global, beta_pose)


@term
def acceleration(
    window: PosedWindow, *, beta_global: Scalar | float = 10.0, beta_pose: Scalar | float = 1.0
) -> tuple[Residuals, ...]:
    """Penalise the acceleration of the pose: E_acc = Σ_k β_k Σ_i ‖θ′_k,i+1 − θ′_k,i‖₂.

    θ′ is the difference of consecutive frames.

    Source: Hägerlind et al. 2024, acceleration term; norms not squared.
    """
    return _differences(window, 2, beta_global, beta_pose)


def _differences(
    window: PosedWindow, order: int, beta_global: Scalar | float, beta_pose: Scalar | float
) -> tuple[Residuals, ...]:
    frames = window.pose.global_orient.shape[0]
    complete = jnp.asarray(complete_runs(window.present, order), jnp.float32)
    orient = jnp.diff(window.pose.global_orient, order, axis=0)
    body = jnp.diff(window.pose.body_pose.reshape(frames, -1), order, axis=0)
    parts = (orient, beta_global * complete), (body, beta_pose * complete)
    return tuple(Residuals(*part, NORM, chain=True) for part in parts)


def complete_runs(present: Bool[Array | np.ndarray, "T"], order: int) -> Bool[Array | np.ndarray, "runs"]:
    """Return, for each frame i, whether frames i, i + 1, …, i + order are all present."""
    frames = present.shape[0]
    complete = present[: frames - order]
    for shift in range(1, order + 1):
        complete = complete & present[shift : frames - order + shift]
    return complete


BUTTERWORTH_ORDER = 4


@term
def geodesic_velocity(
    window: PosedWindow, *, beta_global: Scalar | float = 10.0, beta_pose: Scalar | float = 1.0
) -> tuple[Residuals, ...]:
    """Penalise the geodesic distance between the poses of consecutive frames.

    E = Σ_i β_g · d(G_i, G_i+1) + β_p · √(Σ_j d(R_j,i, R_j,i+1)²), with d the angle between two rotations, G the global
    orientation and R_j the rotation of joint j.

    This is the velocity term with the distance on SO(3) instead of differences of axis-angles: the second part is the
    geodesic distance of the body poses on SO(3) × … × SO(3). Near zero rotation, the term agrees with `velocity` to
    first order.

    Source: Huynh 2009, *Metrics for 3D Rotations*, Φ₆; the sums as in Hägerlind et al. 2024, velocity term.
    """
    # the norm of the concatenated rotation vectors is √(Σ_j d_j²): all joints are one group
    orient, joints, complete = _rotations_between_frames(window)
    joints = joints.reshape(len(joints), 3 * joints.shape[1])
    parts = (orient, beta_global * complete), (joints, beta_pose * complete)
    return tuple(Residuals(*part, NORM, chain=True) for part in parts)


@term(positive=["delta_rad"])
def huber_velocity(
    window: PosedWindow,
    *,
    delta_rad: Scalar | float = 0.1,
    beta_global: Scalar | float = 10.0,
    beta_pose: Scalar | float = 1.0,
) -> tuple[Residuals, ...]:
    """Penalise the rotation of every joint between consecutive frames by Huber's loss.

    E = Σ_i β_g · h(d(G_i, G_i+1)) + β_p · Σ_j h(d(R_j,i, R_j,i+1)), with h Huber's loss and δ in radians per frame.

    Each joint has its own loss. The gradient of slow jitter is proportional to its size; the gradient of a joint that
    rotates faster than δ, as in a wingbeat, is limited to δ.

    Source: Huber 1964, *Robust Estimation of a Location Parameter*.
    """
    orient, joints, complete = _rotations_between_frames(window)
    kernel = huber(delta_rad)
    parts = (orient, beta_global * complete), (joints, beta_pose * complete[:, None])
    return tuple(Residuals(*part, kernel, chain=True) for part in parts)


def _rotations_between_frames(
    window: PosedWindow,
) -> tuple[Float[Array, "pairs 3"], Float[Array, "pairs bones 3"], Float[Array, "pairs"]]:
    """Return the rotations between consecutive frames of the global orientation and of each joint, as axis-angles, and
    1 for the pairs of frames that are both present, else 0."""
    orient = rotation_change(window.pose.global_orient[:-1], window.pose.global_orient[1:])
    joints = rotation_change(window.pose.body_pose[:-1], window.pose.body_pose[1:])
    return orient, joints, jnp.asarray(complete_runs(window.present, 1), jnp.float32)


@term(positive=["cutoff_cycles_per_frame"])
def low_pass(
    window: PosedWindow,
    *,
    cutoff_cycles_per_frame: Scalar | float = 0.15,
    beta_global: Scalar | float = 1.0,
    beta_pose: Scalar | float = 1.0,
) -> tuple[Residuals, Residuals]:
    """Penalise the energy of motion above a cut-off frequency, rad².

    E = Σ_k w_k (β_g ‖ĝ_k‖² + β_p ‖θ̂_k‖²), where ĝ_k and θ̂_k are the coefficients of the orthonormal DCT-II over the
    window of the global orientation and the body pose (axis-angles), with frequency f_k = k/2T cycles per frame. The
    weight w_k = 1/(1 + (f_c/f_k)⁸) is the response of a Butterworth high-pass filter of order 4: 0 for the mean pose,
    ½ at the cut-off f_c, differentiable in f_c. Missing frames are interpolated linearly between their neighbours;
    frames before the first and after the last present frame take the value of that frame.

    Source: Akhter et al. 2008, *Nonrigid Structure from Motion in Trajectory Space* (the DCT of trajectories);
    Butterworth 1930 (the weights).
    """
    frames = window.present.shape[0]
    # k = 0, the mean pose, has weight 0 and is excluded, because log 0 is not finite
    log_frequency = np.log(np.arange(1, frames) / (2 * frames))
    # 1/(1 + (f_c/f)^2n) = sigmoid(2n·(log f − log f_c)), n the order of the filter: finite gradients for every f_c
    response = jax.nn.sigmoid(2 * BUTTERWORTH_ORDER * (log_frequency - jnp.log(cutoff_cycles_per_frame)))
    fill = _interpolation(window.present)

    def coefficients(trajectory: Float[Array, "T D"]) -> Float[Array, "T-1 D"]:
        return jax.scipy.fft.dct(fill @ trajectory, axis=0, norm="ortho")[1:]

    orient = coefficients(jnp.asarray(window.pose.global_orient))
    body = coefficients(jnp.asarray(window.pose.body_pose).reshape(frames, -1))
    return Residuals(orient, beta_global * response), Residuals(body, beta_pose * response)


def _interpolation(present: Bool[Array | np.ndarray, "T"]) -> Float[Array, "T T"]:
    """Return the matrix that interpolates missing frames linearly from present frames; 0 if no frame is present."""
    frames = present.shape[0]
    at = jnp.arange(frames)
    before = jax.lax.cummax(jnp.where(present, at, -1))
    after = jax.lax.cummin(jnp.where(present, at, frames), reverse=True)
    # before the first and after the last present frame, both ends are the nearest present frame
    first, last = jnp.where(before < 0, after, before), jnp.where(after == frames, before, after)
    share = (at - first) / jnp.maximum(last - first, 1)
    # one_hot gives a row of zeros for an index outside the window
    return (1 - share)[:, None] * jax.nn.one_hot(first, frames) + share[:, None] * jax.nn.one_hot(last, frames)
