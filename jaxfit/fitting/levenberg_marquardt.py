"""Levenberg-Marquardt: a few steps that know the curvature, instead of hundreds that do not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float, Int

from jaxfit.fitting.lane import Lane, Solver, lane_loss, lane_window
from jaxfit.model.pose import Pose
from jaxfit.objective.curvature import Rows, frame_rows
from jaxfit.objective.objective import evaluate_curvature

__all__ = ["LEVENBERG_MARQUARDT"]

CG_STEPS, CG_TOLERANCE = 100, 0.01
"""Conjugate-gradient steps within each step, at most, and the relative residual at which they end: the first steps need
few, and far below 1e-6 single precision underflows to 0/0."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-5, 1e8
EASE, TIGHTEN = 0.2, 5.0
"""Factors on the damping after a step that lowered the loss, and after one that did not."""


class _State(NamedTuple):
    loss: Float[Array, ""]
    gradient: Pose
    damping: Float[Array, ""]
    refused: Int[Array, ""]


_loss_and_gradient = jax.value_and_grad(lane_loss)


def _init(pose: Pose, lane: Lane, before: Any) -> _State:
    assert before is None  # configs are checked: no solver has anything for this one
    return _State(*_loss_and_gradient(pose, lane), jnp.float32(FIRST_DAMPING), jnp.int32(0))


def _step(pose: Pose, lane: Lane, state: _State) -> tuple[Pose, _State]:
    """x ← x + d with (H + μ·diag H)·d = −g where that lowers the objective; μ falls then, and else rises.

    H is the curvature of the terms' quadratic bounds. It is never formed: within a frame it is JᵀJ, between frames one
    band, and conjugate gradients need only its products.

    Source: Marquardt 1963, An algorithm for least-squares estimation of nonlinear parameters.
    """
    curvature = evaluate_curvature(lane_window(pose, lane), lane.hyperparameters.settings)
    free = (
        frame_rows(jax.tree.map(lambda x, size: jnp.broadcast_to(size, x.shape), pose, lane.hyperparameters.step_size))
        > 0
    )
    frames, scales = len(free), pose.scale.shape[0]

    def allowed(rows: Rows) -> Rows:
        """The part of a change that fixed parameters and a common scale allow."""
        rows = jnp.where(free, rows, 0.0)
        return rows.at[:, -1].set(rows[:, -1].mean()) if scales < frames else rows

    gradient = frame_rows(state.gradient)
    gradient = gradient.at[:, -1].divide(frames // scales)  # of a common scale each frame has its share
    diagonal = allowed(curvature.diagonal)
    # a parameter that nothing pulls at has no gradient either, and stays
    diagonal = jnp.where(diagonal > 0, diagonal, 1.0)
    change, _ = cg(
        lambda d: allowed(curvature.product(d)) + state.damping * diagonal * d,
        -allowed(gradient),
        M=lambda d: d / diagonal,
        tol=CG_TOLERANCE,
        maxiter=CG_STEPS,
    )
    moved = _moved(pose, change)
    loss, new_gradient = _loss_and_gradient(moved, lane)
    lower = (loss < state.loss) & _finite(new_gradient)

    def better(new: Any, old: Any) -> Any:
        return jax.tree.map(lambda a, b: jnp.where(lower, a, b), new, old)

    damping = jnp.clip(state.damping * jnp.where(lower, EASE, TIGHTEN), LEAST_DAMPING, MOST_DAMPING)
    stuck = ~(jnp.isfinite(state.loss) & _finite(state.gradient))
    loss, gradient = better((loss, new_gradient), (state.loss, state.gradient))
    return better(moved, pose), _State(loss, gradient, damping, state.refused + stuck)


def _outcome(state: _State) -> tuple[Float[Array, ""], Int[Array, ""]]:
    return state.loss, state.refused


def _moved(pose: Pose, rows: Rows) -> Pose:
    return replace(
        pose,
        global_orient=pose.global_orient + rows[:, :3],
        body_pose=pose.body_pose + rows[:, 3:-4].reshape(pose.body_pose.shape),
        transl=pose.transl + rows[:, -4:-1],
        scale=pose.scale + rows[: len(pose.scale), -1],
    )


def _finite(tree: Pose) -> Bool[Array, ""]:
    return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(tree)]).all()


LEVENBERG_MARQUARDT = Solver(_init, _step, _outcome)
