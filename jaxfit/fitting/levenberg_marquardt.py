"""Levenberg-Marquardt: a few steps that use the curvature, instead of hundreds that do not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float, Int

from jaxfit.fitting.problem import BATCH_AXIS, Problem, Program, Solver, problem_loss, problem_window
from jaxfit.model.pose import Pose
from jaxfit.objective.curvature import Curvature, Rows, frame_rows
from jaxfit.objective.objective import evaluate_curvature

__all__ = ["LEVENBERG_MARQUARDT"]

CG_STEPS, CG_TOLERANCE = 100, 0.01
"""Largest number of conjugate-gradient steps within a step, and the relative residual at which they end. The first
steps need few; far below 1e-6 single precision underflows to 0/0."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-5, 1e8
EASE, TIGHTEN = 0.2, 5.0
"""Factors on the damping after a step that lowered the loss, and after a step that did not."""


class _State(NamedTuple):
    loss: Float[Array, ""]
    gradient: Pose
    curvature: Curvature
    """At the present pose, unless `moved`."""
    moved: Bool[Array, ""]
    """Whether the pose changed since the curvature was computed."""
    damping: Float[Array, ""]
    rejected: Int[Array, ""]
    """Steps at a pose whose loss or gradient is not finite."""


_loss_and_gradient = jax.value_and_grad(problem_loss, argnums=2)


def _init(program: Program, problem: Problem, carried: Any) -> _State:
    assert carried is None  # the config was checked: no other solver has anything for this one
    loss, gradient = _loss_and_gradient(program, problem, problem.anchor)
    shapes = jax.eval_shape(lambda: _curvature(program, problem, problem.anchor))
    nothing_yet = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return _State(loss, gradient, nothing_yet, jnp.bool_(True), jnp.float32(FIRST_DAMPING), jnp.int32(0))


def _step(program: Program, problem: Problem, pose: Pose, state: _State) -> tuple[Pose, _State]:
    """x ← x + d with (H + μ·diag H)·d = −g where that lowers the objective; then μ falls, else μ rises.

    H is the curvature of the terms' quadratic bounds. H is never formed: within a frame it is JᵀJ, between frames one
    band, and conjugate gradients need only its products. After a step that lowered nothing, H is still that of the
    present pose and is not computed again.

    Source: Marquardt 1963, An algorithm for least-squares estimation of nonlinear parameters.
    """
    # over the whole batch: a condition of each problem by itself would become a selection, which computes both sides
    curvature = jax.lax.cond(
        jax.lax.psum(state.moved.astype(jnp.int32), BATCH_AXIS) > 0,
        lambda: _curvature(program, problem, pose),
        lambda: state.curvature,
    )
    step_size = problem.hyperparameters.step_size
    optimised = frame_rows(jax.tree.map(lambda x, size: jnp.broadcast_to(size, x.shape), pose, step_size)) > 0
    frames, scales = len(optimised), pose.scale.shape[0]

    def allowed(rows: Rows) -> Rows:
        """The part of a change that fixed parameters and a common scale allow."""
        rows = jnp.where(optimised, rows, 0.0)
        return rows.at[:, -1].set(rows[:, -1].mean()) if scales < frames else rows

    gradient = frame_rows(state.gradient)
    gradient = gradient.at[:, -1].divide(frames // scales)  # each frame has its share of a common scale
    diagonal = allowed(curvature.diagonal)
    # a parameter that no term pulls has no gradient either, and stays
    diagonal = jnp.where(diagonal > 0, diagonal, 1.0)
    change, _ = cg(
        lambda d: allowed(curvature.product(d)) + state.damping * diagonal * d,
        -allowed(gradient),
        M=lambda d: d / diagonal,
        tol=CG_TOLERANCE,
        maxiter=CG_STEPS,
    )
    moved = _moved(pose, change)
    loss, new_gradient = _loss_and_gradient(program, problem, moved)
    stuck = ~(jnp.isfinite(state.loss) & _finite(state.gradient))
    lower = ~stuck & (loss < state.loss) & _finite(new_gradient)

    def better(new: Any, old: Any) -> Any:
        return jax.tree.map(lambda a, b: jnp.where(lower, a, b), new, old)

    damping = jnp.clip(state.damping * jnp.where(lower, EASE, TIGHTEN), LEAST_DAMPING, MOST_DAMPING)
    loss, gradient = better((loss, new_gradient), (state.loss, state.gradient))
    return better(moved, pose), _State(loss, gradient, curvature, lower, damping, state.rejected + stuck)


def _curvature(program: Program, problem: Problem, pose: Pose) -> Curvature:
    window = problem_window(program, problem, pose)
    return evaluate_curvature(window, program.terms, problem.hyperparameters.settings)


def _outcome(state: _State) -> tuple[Float[Array, ""], Int[Array, ""]]:
    return state.loss, state.rejected


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
