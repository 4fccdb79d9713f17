"""One stage of the fit: a solver's steps on a batch of windows, as one compiled program."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int

from jaxfit.fitting.lane import Hyperparameters, Lane, Problem, lane_window
from jaxfit.model.pose import Pose
from jaxfit.objective.objective import evaluate_terms
from jaxfit.objective.posed_window import Targets

__all__ = ["Report", "StageState", "advance", "begin", "report"]


class StageState(NamedTuple):
    """Where a batch of B windows stands."""

    pose: Pose
    start: Pose
    """The poses at which the stage began."""
    solver: Any
    """The solver's own state."""


@eqx.filter_jit
def begin(
    problem: Problem, hyperparameters: Hyperparameters, pose: Pose, targets: Targets, before: StageState | None
) -> StageState:
    """Start a stage at `pose`; with `before`, the solver goes on with that stage's moments."""

    def one(hyperparameters, pose, targets, carried):
        return problem.solver.init(pose, Lane(problem, hyperparameters, pose, targets), carried)

    carried = None if before is None else before.solver
    return StageState(pose, pose, jax.vmap(one)(hyperparameters, pose, targets, carried))


@eqx.filter_jit(donate="all-except-first")
def advance(
    fixed: tuple[Problem, Hyperparameters, Targets, Int[Array, ""]], state: StageState
) -> tuple[StageState, Array, Array]:
    """Take some steps.

    Args:
        fixed: the problem, hyperparameters and targets (B, …) and the number of steps, traced.
        state: given up; use the returned one.

    Returns:
        The new state, and each lane's `Solver.outcome`: loss (B,) and refused steps (B,).
    """
    problem, hyperparameters, targets, steps = fixed

    def one(hyperparameters: Hyperparameters, state: StageState, targets: Targets):
        lane = Lane(problem, hyperparameters, state.start, targets)
        return jax.lax.fori_loop(
            0, steps, lambda _, carry: problem.solver.step(carry[0], lane, carry[1]), (state.pose, state.solver)
        )

    pose, solver_state = jax.vmap(one)(hyperparameters, state, targets)
    return StageState(pose, state.start, solver_state), *jax.vmap(problem.solver.outcome)(solver_state)


class Report(NamedTuple):
    """What a batch of poses amounts to."""

    loss: dict[str, Float[Array, "B"]]
    """Each term's weighted share of the objective, at these poses."""
    keypoints_cam: Float[Array, "B T K 3"]
    keypoints_px: Float[Array, "B T K 2"]
    """Crop pixels."""


@eqx.filter_jit
def report(problem: Problem, hyperparameters: Hyperparameters, pose: Pose, start: Pose, targets: Targets) -> Report:
    """Evaluate poses as they are (Adam itself only knows the loss before its last step)."""

    def one(hyperparameters, pose, start, targets):
        window = lane_window(pose, Lane(problem, hyperparameters, start, targets))
        values = evaluate_terms(window, hyperparameters.settings)
        weighted = {name: hyperparameters.settings[name]["weight"] * value for name, value in values.items()}
        return Report(weighted, window.keypoints_cam, window.keypoints_px)

    return jax.vmap(one)(hyperparameters, pose, start, targets)
