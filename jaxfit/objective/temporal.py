"""Velocity and acceleration terms. Pairs and triples of frames with a missing frame contribute 0."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxfit.objective.posed_window import PosedWindow
from jaxfit.objective.registry import term
from jaxfit.objective.residuals import NORM, Residuals, Scalar

__all__ = ["acceleration", "complete_runs", "velocity"]


@term
def velocity(
    window: PosedWindow, *, beta_global: Scalar | float = 10.0, beta_pose: Scalar | float = 1.0
) -> tuple[Residuals, Residuals]:
    """Penalise the velocity of the pose: E_vel = Σ_k β_k Σ_i ‖θ_k,i+1 − θ_k,i‖₂ over k = global orientation, body pose.

    Source: Hägerlind et al. 2024, velocity term; norms not squared.
    """
    return _differences(window, 1, beta_global, beta_pose)


@term
def acceleration(
    window: PosedWindow, *, beta_global: Scalar | float = 10.0, beta_pose: Scalar | float = 1.0
) -> tuple[Residuals, Residuals]:
    """Penalise the acceleration of the pose: E_acc = Σ_k β_k Σ_i ‖θ′_k,i+1 − θ′_k,i‖₂.

    θ′ is the difference of consecutive frames.

    Source: Hägerlind et al. 2024, acceleration term; norms not squared.
    """
    return _differences(window, 2, beta_global, beta_pose)


def _differences(
    window: PosedWindow, order: int, beta_global: Scalar | float, beta_pose: Scalar | float
) -> tuple[Residuals, Residuals]:
    frames = window.pose.global_orient.shape[0]
    complete = jnp.asarray(complete_runs(window.present, order), jnp.float32)
    orient = jnp.diff(window.pose.global_orient, order, axis=0)
    body = jnp.diff(window.pose.body_pose.reshape(frames, -1), order, axis=0)
    return Residuals(orient, beta_global * complete, NORM), Residuals(body, beta_pose * complete, NORM)


def complete_runs(present: Bool[Array | np.ndarray, "T"], order: int) -> Bool[Array | np.ndarray, "runs"]:
    """Return, for each frame i, whether frames i, i + 1, …, i + order are all present."""
    frames = present.shape[0]
    complete = present[: frames - order]
    for shift in range(1, order + 1):
        complete = complete & present[shift : frames - order + shift]
    return complete
