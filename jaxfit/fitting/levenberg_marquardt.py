"""Levenberg-Marquardt: a solver that uses the curvature of the objective and needs few steps."""

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
"""Largest number of conjugate-gradient steps within one step, and the relative residual at which they end. The
first steps need few of them. A tolerance far below 1e-6 makes single precision underflow to 0/0."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-5, 1e8
"""The damping μ of the first step, and the bounds of μ."""
DAMPING_DECREASE, DAMPING_INCREASE = 0.2, 5.0
"""Factors on the damping after a step that lowered the loss, and after a step that did not lower the loss."""

MOST_RELAXATION, MOMENTUM, PESSIMISTIC = 1.5, 0.4, 0.9
"""Where the true curvature along the last step was less than `PESSIMISTIC` times that of H, the next step is longer by
at most the factor `MOST_RELAXATION`, and continues the last step by the share `MOMENTUM`."""


class _State(NamedTuple):
    loss: Float[Array, ""]
    gradient: Pose
    curvature: Curvature
    """The curvature at the current pose, except if `moved` is set."""
    moved: Bool[Array, ""]
    """Whether the pose changed since the curvature was computed."""
    damping: Float[Array, ""]
    change: Rows
    """The last step; 0 if the last step was not taken."""
    curvature_ratio: Float[Array, ""]
    """Curvature of the objective along the last step, over the curvature of H; 1 if the last step was not taken."""
    rejected: Int[Array, ""]
    """Number of steps from a pose whose loss or gradient is not finite."""


_loss_and_gradient = jax.value_and_grad(problem_loss, argnums=2)


def _init(program: Program, problem: Problem, carried: Any) -> _State:
    assert carried is None  # `FitConfig` checks this: only Adam has moments
    loss, gradient = _loss_and_gradient(program, problem, problem.anchor)
    shapes = jax.eval_shape(lambda: _curvature(program, problem, problem.anchor))
    not_computed = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return _State(
        loss=loss,
        gradient=gradient,
        curvature=not_computed,
        moved=jnp.bool_(True),
        damping=jnp.float32(FIRST_DAMPING),
        change=jnp.zeros_like(frame_rows(problem.anchor)),
        curvature_ratio=jnp.float32(1.0),
        rejected=jnp.int32(0),
    )


def _step(program: Program, problem: Problem, pose: Pose, state: _State) -> tuple[Pose, _State]:
    """Return x + c with c = ω·d + β·c_last and (H + μ·diag H)·d = −g if this lowers the objective, else x.

    The damping μ decreases after a step that lowered the objective, and increases otherwise. H is the curvature of
    the terms' quadratic bounds: JᵀJ within a frame, and one band between frames. Conjugate gradients need only products
    with H, so that the matrix itself is not computed. If the last step did not change the pose, H is not computed
    again.

    H is too large where it bounds an unsquared norm or leaves out second derivatives. The ratio κ of the true curvature
    along the last step to that of H measures this. For κ ≥ 0.9, ω = 1 and β = 0: a plain step. Else ω = 1/κ, at most
    1.5, and β = 0.4.

    Source: Marquardt 1963, An algorithm for least-squares estimation of nonlinear parameters; Polyak 1964, Some methods
    of speeding up the convergence of iteration methods (momentum).
    """
    # one condition for the whole batch: under `vmap`, a condition per problem would compute both branches
    curvature = jax.lax.cond(
        jax.lax.psum(state.moved.astype(jnp.int32), BATCH_AXIS) > 0,
        lambda: _curvature(program, problem, pose),
        lambda: state.curvature,
    )
    step_size = problem.hyperparameters.step_size
    optimised = frame_rows(jax.tree.map(lambda x, size: jnp.broadcast_to(size, x.shape), pose, step_size)) > 0
    frames, scales = len(optimised), pose.scale.shape[0]

    def allowed(rows: Rows) -> Rows:
        """Set the change of fixed parameters to 0, and the change of a common scale to its mean."""
        rows = jnp.where(optimised, rows, 0.0)
        return rows.at[:, -1].set(rows[:, -1].mean()) if scales < frames else rows

    gradient = frame_rows(state.gradient)
    # the gradient of a common scale is divided between the frames
    gradient = allowed(gradient.at[:, -1].divide(frames // scales))
    diagonal = allowed(curvature.diagonal)
    # a parameter without curvature has no gradient and does not change
    diagonal = jnp.where(diagonal > 0, diagonal, 1.0)
    newton, _ = cg(
        lambda d: allowed(curvature.product(d)) + state.damping * diagonal * d,
        -gradient,
        M=lambda d: d / diagonal,
        tol=CG_TOLERANCE,
        maxiter=CG_STEPS,
    )
    pessimistic = state.curvature_ratio < PESSIMISTIC
    relaxation = 1 / jnp.maximum(state.curvature_ratio, 1 / MOST_RELAXATION)
    change = jnp.where(pessimistic, relaxation * newton + MOMENTUM * state.change, newton)
    new_pose = _add_rows(pose, change)
    loss, new_gradient = _loss_and_gradient(program, problem, new_pose)
    not_finite = ~(jnp.isfinite(state.loss) & _finite(state.gradient))
    lower = ~not_finite & (loss < state.loss) & _finite(new_gradient)
    bend = jnp.vdot(change, curvature.product(change))
    ratio = 2 * (loss - state.loss - jnp.vdot(gradient, change)) / jnp.where(bend > 0, bend, 1.0)

    def choose(new: Any, old: Any) -> Any:
        return jax.tree.map(lambda a, b: jnp.where(lower, a, b), new, old)

    factor = jnp.where(lower, DAMPING_DECREASE, DAMPING_INCREASE)
    return choose(new_pose, pose), _State(
        loss=choose(loss, state.loss),
        gradient=choose(new_gradient, state.gradient),
        curvature=curvature,
        moved=lower,
        damping=jnp.clip(state.damping * factor, LEAST_DAMPING, MOST_DAMPING),
        change=choose(change, jnp.zeros_like(change)),
        curvature_ratio=choose(ratio, jnp.float32(1.0)),
        rejected=state.rejected + not_finite,
    )


def _curvature(program: Program, problem: Problem, pose: Pose) -> Curvature:
    window = problem_window(program, problem, pose)
    return evaluate_curvature(window, program.terms, problem.hyperparameters.settings)


def _outcome(state: _State) -> tuple[Float[Array, ""], Int[Array, ""]]:
    return state.loss, state.rejected


def _add_rows(pose: Pose, rows: Rows) -> Pose:
    """Return the pose plus a change, which has one row per frame in the layout of `frame_rows`."""
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
