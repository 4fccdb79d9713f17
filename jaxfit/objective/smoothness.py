"""Smooth motion beyond the paper's terms: on the rotations themselves, robustly, and by frequency.

They know nothing of 2π: the first two compare rotations, not their axis-angles. As elsewhere, a missing frame adds
nothing, and a window of one frame does not move.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jax.scipy.fft
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfit.model.rotation import geodesic_distance, safe_norm
from jaxfit.objective.posed_window import PosedWindow
from jaxfit.objective.registry import term
from jaxfit.objective.temporal import complete_runs
from jaxfit.objective.terms import Scalar

__all__ = ["geodesic_velocity", "huber", "huber_velocity", "low_pass"]

BUTTERWORTH_ORDER = 4


@term
def geodesic_velocity(
    window: PosedWindow, *, beta_global: Scalar | float = 10.0, beta_pose: Scalar | float = 1.0
) -> Scalar:
    """Σ_i β_g · d(G_i, G_i+1) + β_p · √(Σ_j d(R_j,i, R_j,i+1)²), d the angle between two rotations.

    The velocity term with the distance on SO(3) in place of differences of axis-angles: the length of the way from one
    pose to the next on SO(3) × … × SO(3). It agrees with `velocity` to first order near rest.

    Source: Huynh 2009, *Metrics for 3D Rotations*, Φ₆; the sums as in Hägerlind et al. 2024, velocity term.
    """
    turned, bent = _steps(window)
    moved = beta_global * turned + beta_pose * safe_norm(bent)
    return jnp.sum(jnp.where(complete_runs(window.present, 1), moved, 0.0))


@term(positive=["delta_rad"])
def huber_velocity(
    window: PosedWindow,
    *,
    delta_rad: Scalar | float = 0.1,
    beta_global: Scalar | float = 10.0,
    beta_pose: Scalar | float = 1.0,
) -> Scalar:
    """Σ_i β_g · h(d(G_i, G_i+1)) + β_p · Σ_j h(d(R_j,i, R_j,i+1)), h Huber's loss with δ in radians a frame.

    Every joint for itself: slow trembling is pulled in proportion to its size, while a joint that turns faster than δ,
    as in a wingbeat, is pulled by no more than δ.

    Source: Huber 1964, *Robust Estimation of a Location Parameter*.
    """
    turned, bent = _steps(window)
    moved = beta_global * huber(turned, delta_rad) + beta_pose * jnp.sum(huber(bent, delta_rad), axis=-1)
    return jnp.sum(jnp.where(complete_runs(window.present, 1), moved, 0.0))


def huber(x: Float[Array, "*B"], delta: Scalar | float) -> Float[Array, "*B"]:
    """Huber's loss of x ≥ 0: x²/2 up to δ, then δ (x − δ/2)."""
    near = jnp.minimum(x, delta)
    return near * (x - near / 2)


def _steps(window: PosedWindow) -> tuple[Float[Array, "pairs"], Float[Array, "pairs bones"]]:
    """Angles between consecutive frames, radians: of the global orientation, and of each joint."""
    turned = geodesic_distance(window.R_camera_root[:-1], window.R_camera_root[1:])
    return turned, geodesic_distance(window.R_parent_child[:-1], window.R_parent_child[1:])


@term(positive=["cutoff_cycles_per_frame"])
def low_pass(
    window: PosedWindow,
    *,
    cutoff_cycles_per_frame: Scalar | float = 0.15,
    beta_global: Scalar | float = 1.0,
    beta_pose: Scalar | float = 1.0,
) -> Scalar:
    """Σ_k w_k (β_g ‖ĝ_k‖² + β_p ‖θ̂_k‖²): energy of the motion that is faster than a cut-off, rad².

    ĝ_k and θ̂_k are the orthonormal DCT-II over the window of global orientation and body pose (axis-angles), of
    frequency f_k = k/2T cycles a frame, and w_k = 1/(1 + (f_c/f_k)⁸) is the response of a Butterworth high-pass filter
    of order 4: 0 for the mean pose, ½ at the cut-off, smooth in it. Frames that are missing are filled along straight
    lines between their neighbours, and beyond the first and last by these: a gap counts as slow motion.

    Source: Akhter et al. 2008, *Nonrigid Structure from Motion in Trajectory Space* (the DCT of trajectories);
    Butterworth 1930 (the weights).
    """
    frames = window.present.shape[0]
    # log 0 is left out with the mean itself: k = 0
    log_frequency = np.log(np.arange(1, frames) / (2 * frames))
    response = jax.nn.sigmoid(2 * BUTTERWORTH_ORDER * (log_frequency - jnp.log(cutoff_cycles_per_frame)))
    fill = _between(window.present)

    def energy(trajectory: Float[Array, "T D"]) -> Scalar:
        coefficients = jax.scipy.fft.dct(fill @ trajectory, axis=0, norm="ortho")[1:]
        return jnp.sum(response[:, None] * coefficients**2)

    body = jnp.asarray(window.pose.body_pose).reshape(frames, -1)
    return beta_global * energy(jnp.asarray(window.pose.global_orient)) + beta_pose * energy(body)


def _between(present: Bool[Array | np.ndarray, "T"]) -> Float[Array, "T T"]:
    """The matrix that keeps present frames and puts the others between them; 0 where no frame is present."""
    frames = present.shape[0]
    at = jnp.arange(frames)
    before = jax.lax.cummax(jnp.where(present, at, -1))
    after = jax.lax.cummin(jnp.where(present, at, frames), reverse=True)
    # outside of all present frames both ends are the nearest one
    first, last = jnp.where(before < 0, after, before), jnp.where(after == frames, before, after)
    share = (at - first) / jnp.maximum(last - first, 1)
    # an index that no frame has is a row of zeros
    return (1 - share)[:, None] * jax.nn.one_hot(first, frames) + share[:, None] * jax.nn.one_hot(last, frames)
