"""Velocity and acceleration terms. Pairs and triples of frames with a missing frame contribute 0."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float

from jaxfit.model.rotation import safe_norm
from jaxfit.objective.curvature import Curvature, Rows, frame_rows
from jaxfit.objective.posed_window import PosedWindow
from jaxfit.objective.registry import term
from jaxfit.objective.terms import Scalar

__all__ = ["acceleration", "complete_runs", "velocity"]


SHORTEST_RAD, AT_REST_RAD = 1e-4, 0.05
"""Lengths for the curvature of a norm, which is infinite at zero: differences shorter than `SHORTEST_RAD` count as
`SHORTEST_RAD`, and differences of exactly zero count as `AT_REST_RAD`. `AT_REST_RAD` is a typical step; with a smaller
value, a fit that starts with the same pose in all frames would hardly move."""


def _velocity_curvature(window: PosedWindow, *, beta_global: Scalar | float, beta_pose: Scalar | float) -> Curvature:
    """Return H from the bound β‖δ‖ ≤ ½β(‖δ‖²/n + n), with δ the difference of two frames and n its current norm."""
    return _differences_curvature(window, 1, beta_global, beta_pose)


def _acceleration_curvature(
    window: PosedWindow, *, beta_global: Scalar | float, beta_pose: Scalar | float
) -> Curvature:
    """Return H of the acceleration term, from the same bound for second differences."""
    return _differences_curvature(window, 2, beta_global, beta_pose)


@term(curvature=_velocity_curvature)
def velocity(window: PosedWindow, *, beta_global: Scalar | float = 10.0, beta_pose: Scalar | float = 1.0) -> Scalar:
    """Penalise the velocity of the pose: E_vel = Σ_k β_k Σ_i ‖θ_k,i+1 − θ_k,i‖₂ over k = global orientation, body pose.

    Source: Hägerlind et al. 2024, velocity term; norms not squared.
    """
    return _differences(window, 1, beta_global, beta_pose)


@term(curvature=_acceleration_curvature)
def acceleration(window: PosedWindow, *, beta_global: Scalar | float = 10.0, beta_pose: Scalar | float = 1.0) -> Scalar:
    """Penalise the acceleration of the pose: E_acc = Σ_k β_k Σ_i ‖θ′_k,i+1 − θ′_k,i‖₂.

    θ′ is the difference of consecutive frames.

    Source: Hägerlind et al. 2024, acceleration term; norms not squared.
    """
    return _differences(window, 2, beta_global, beta_pose)


def _differences(window: PosedWindow, order: int, beta_global: Scalar | float, beta_pose: Scalar | float) -> Scalar:
    frames = window.pose.global_orient.shape[0]
    if frames <= order:
        return jnp.zeros(())
    complete = complete_runs(window.present, order)
    orient = safe_norm(jnp.diff(window.pose.global_orient, order, axis=0))
    body = safe_norm(jnp.diff(window.pose.body_pose.reshape(frames, -1), order, axis=0))
    return jnp.sum(jnp.where(complete, beta_global * orient + beta_pose * body, 0.0))


def _differences_curvature(
    window: PosedWindow, order: int, beta_global: Scalar | float, beta_pose: Scalar | float
) -> Curvature:
    rows = frame_rows(window.pose)
    complete = complete_runs(window.present, order)
    orient_H = beta_global * _coupling(rows[:, :3], order, complete)
    body_H = beta_pose * _coupling(rows[:, 3:-4], order, complete)

    def diagonal(H: Float[Array, "T T"], like: Float[Array, "T n"]) -> Float[Array, "T n"]:
        return jnp.broadcast_to(jnp.diagonal(H)[:, None], like.shape)

    return Curvature(
        Partial(_differences_product, orient_H, body_H),
        _angle_rows(diagonal(orient_H, rows[:, :3]), diagonal(body_H, rows[:, 3:-4])),
    )


def _differences_product(orient_H: Float[Array, "T T"], body_H: Float[Array, "T T"], d: Rows) -> Rows:
    return _angle_rows(orient_H @ d[:, :3], body_H @ d[:, 3:-4])


def _angle_rows(orient: Float[Array, "T 3"], body: Float[Array, "T size"]) -> Rows:
    return jnp.pad(jnp.concatenate([orient, body], axis=1), ((0, 0), (0, 4)))


def _coupling(
    theta: Float[Array, "T n"], order: int, complete: Bool[Array | np.ndarray, "runs"]
) -> Float[Array, "T T"]:
    """Return Dᵀ·diag(1/‖D·θ‖)·D, D the difference operator of this order: one matrix for all components of θ."""
    D = jnp.diff(jnp.eye(len(theta)), order, axis=0)
    norm = safe_norm(D @ theta)
    length = jnp.where(norm == 0, AT_REST_RAD, jnp.maximum(norm, SHORTEST_RAD))
    return D.T @ (jnp.where(complete, 1 / length, 0.0)[:, None] * D)


def complete_runs(present: Bool[Array | np.ndarray, "T"], order: int) -> Bool[Array | np.ndarray, "runs"]:
    """Return, for each frame i, whether frames i, i + 1, …, i + order are all present."""
    frames = present.shape[0]
    complete = present[: frames - order]
    for shift in range(1, order + 1):
        complete = complete & present[shift : frames - order + shift]
    return complete
