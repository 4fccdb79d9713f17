"""The solver Levenberg-Marquardt: damped Gauss-Newton steps of a whole window."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float, Int

from jaxfit.fitting.problem import Problem, Program, Solver, problem_window, with_fixed
from jaxfit.model.kinematics import Pose
from jaxfit.objective.curvature import FrameBlocks, Rows, add_rows, frame_rows, pentadiagonal_solver, shared_columns
from jaxfit.objective.objective import evaluate_curvature, sum_with_blocks

CG_STEPS, CG_STEPS_UNCOUPLED, CG_TOLERANCE = 30, 100, 0.01
"""Largest number of conjugate-gradient steps within one step; the same where the preconditioner does not know the
couplings that matter, those of frames with optimised parameters that they share, and those within a single frame; and
the relative residual at which they end. The first steps need few. A tolerance far below 1e-6 makes single precision
underflow to 0/0."""
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-2, 1e-5, 1e8
"""The damping μ of the first step, and the bounds of μ."""
DAMPING_DECREASE, DAMPING_INCREASE = 0.2, 5.0
"""Factors on the damping after a step that lowered the loss, and after a step that did not lower the loss."""

MAX_RELAXATION, MOMENTUM, PESSIMISTIC = 1.5, 0.4, 0.9
"""Where the true curvature along the last step was less than `PESSIMISTIC` times that of H, the next step is longer by
at most the factor `MAX_RELAXATION`, and continues the last step by the share `MOMENTUM`."""


class _LevenbergState(NamedTuple):
    loss: Float[Array, ""]
    gradient: Rows
    blocks: FrameBlocks | None
    """Σ λ · blocks of the terms with blocks, at the pose; None without such a term."""
    damping: Float[Array, ""]
    change: Rows
    """The last step; 0 if the last step was not taken."""
    curvature_ratio: Float[Array, ""]
    """Curvature of the objective along the last step, over the curvature of H; 1 if the last step was not taken."""
    rejected: Int[Array, ""]
    """Number of steps from a pose whose loss or gradient is not finite."""
    prepared: Bool[Array, ""]
    """False before the anchor is evaluated: `loss`, `gradient` and `blocks` are then 0, and so is the next step."""


def _levenberg_init(program: Program, problem: Problem, carried: Any) -> _LevenbergState:
    assert carried is None  # `FitConfig` checks this: only Adam has moments
    zero = jnp.zeros_like(frame_rows(problem.anchor, program.shared))
    frames, columns = zero.shape
    has_blocks = any(term.with_blocks is not None for term in program.terms.values())
    return _LevenbergState(
        loss=jnp.float32(0.0),
        gradient=zero,
        blocks=jnp.zeros((frames, columns, columns)) if has_blocks else None,
        damping=jnp.float32(FIRST_DAMPING),
        change=zero,
        curvature_ratio=jnp.float32(1.0),
        rejected=jnp.int32(0),
        prepared=jnp.bool_(False),
    )


def _levenberg_step(
    program: Program, problem: Problem, pose: Pose, state: _LevenbergState
) -> tuple[Pose, _LevenbergState]:
    """Return x + c with c = ω·d + β·c_last and (H + μ·diag H)·d = −g if this lowers the objective, else x.

    The first call evaluates the anchor and returns it.

    The damping μ decreases after a step that lowered the objective, and increases otherwise. H is the curvature of
    the terms' quadratic bounds: JᵀJ within a frame, and one band between frames. Conjugate gradients need only products
    with H, so that the matrix itself is not computed.

    H is too large where it bounds an unsquared norm or leaves out second derivatives. The ratio κ of the true curvature
    along the last step to that of H measures this. For κ ≥ 0.9, ω = 1 and β = 0: a plain step. Else ω = 1/κ, at most
    1.5, and β = 0.4.

    Source: Marquardt 1963, An algorithm for least-squares estimation of nonlinear parameters; Polyak 1964, Some methods
    of speeding up the convergence of iteration methods (momentum).
    """
    window, settings = problem_window(program, problem, pose), problem.hyperparameters.settings
    curvature = evaluate_curvature(window, program.terms, settings, blocks=state.blocks)
    step_size = jax.tree.map(lambda x, size: jnp.broadcast_to(size, x.shape), pose, problem.hyperparameters.step_size)
    optimised = frame_rows(step_size, program.shared) > 0
    is_shared = shared_columns(pose, program.shared)

    def allowed(rows: Rows) -> Rows:
        """Set the change of fixed parameters to 0, and the change of shared parameters to its mean."""
        rows = jnp.where(optimised, rows, 0.0)
        return jnp.where(is_shared, rows.mean(axis=0), rows)

    gradient = allowed(state.gradient)
    diagonal = allowed(curvature.diagonal)
    # a parameter without curvature has no gradient and does not change
    diagonal = jnp.where(diagonal > 0, diagonal, 1.0)
    # (H + μ·diag H)·d = −g without the matrix. The preconditioner couples the frames of each parameter, because the
    # terms of motion hold most of H where a bird is at rest.
    bands = jnp.where(optimised & ~is_shared, curvature.bands, 0.0)
    precondition = pentadiagonal_solver((1 + state.damping) * diagonal, bands)
    coupled = len(optimised) > 2 and not program.shared
    newton, _ = cg(
        lambda d: allowed(curvature.product(d)) + state.damping * diagonal * d,
        -gradient,
        M=precondition,
        tol=CG_TOLERANCE,
        maxiter=CG_STEPS if coupled else CG_STEPS_UNCOUPLED,
    )
    # H bounds the objective from above, so its step is too short where κ < 1: over-relaxation by 1/κ, with momentum
    pessimistic = state.curvature_ratio < PESSIMISTIC
    relaxation = 1 / jnp.maximum(state.curvature_ratio, 1 / MAX_RELAXATION)
    change = jnp.where(pessimistic, relaxation * newton + MOMENTUM * state.change, newton)
    new_pose = add_rows(pose, change, program.shared)
    loss, new_gradient, blocks = _evaluate(program, problem, new_pose)
    not_finite = ~(jnp.isfinite(state.loss) & jnp.isfinite(state.gradient).all())
    lower = state.prepared & ~not_finite & (loss < state.loss) & jnp.isfinite(new_gradient).all()
    lower &= jnp.all(new_pose.scale > 0)  # beyond 0, the bird is its mirror image
    # along c the objective is E + g·c + ½κ·c·H·c: solved for κ at the new pose
    bend = jnp.vdot(change, curvature.product(change))
    ratio = 2 * (loss - state.loss - jnp.vdot(gradient, change)) / jnp.where(bend > 0, bend, 1.0)

    def choose(which: Bool[Array, ""], new: Any, old: Any) -> Any:
        return jax.tree.map(lambda a, b: jnp.where(which, a, b), new, old)

    # a step that is not taken leaves pose, loss and gradient, so that only the damping (×5) changes the next attempt
    taken = lower | ~state.prepared
    factor = jnp.where(lower, DAMPING_DECREASE, DAMPING_INCREASE)
    damping = jnp.clip(state.damping * factor, MIN_DAMPING, MAX_DAMPING)
    return choose(taken, new_pose, pose), _LevenbergState(
        loss=choose(taken, loss, state.loss),
        gradient=choose(taken, new_gradient, state.gradient),
        blocks=choose(taken, blocks, state.blocks),
        damping=choose(state.prepared, damping, state.damping),
        change=choose(lower, change, jnp.zeros_like(change)),
        curvature_ratio=choose(lower, ratio, jnp.float32(1.0)),
        rejected=state.rejected + (state.prepared & not_finite),
        prepared=jnp.bool_(True),
    )


def _evaluate(program: Program, problem: Problem, pose: Pose) -> tuple[Float[Array, ""], Rows, FrameBlocks | None]:
    """Return the objective, its gradient (one row per frame), and the blocks of the terms with blocks."""

    def loss(change: Rows) -> tuple[Float[Array, ""], FrameBlocks | None]:
        changed = with_fixed(problem, add_rows(pose, change, program.shared))
        window = problem_window(program, problem, changed)
        return sum_with_blocks(window, program.terms, problem.hyperparameters.settings)

    zero = jnp.zeros_like(frame_rows(pose, program.shared))
    (value, blocks), gradient = jax.value_and_grad(loss, has_aux=True)(zero)
    return value, gradient, blocks


LEVENBERG_MARQUARDT = Solver(_levenberg_init, _levenberg_step, preparing_steps=1)
