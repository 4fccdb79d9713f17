"""One stage of a fit: steps of a solver on a batch of problems, as one compiled program."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfit.fitting.problem import Problem, Program, problem_window
from jaxfit.model.pose import Pose
from jaxfit.objective.objective import evaluate_terms

__all__ = ["Report", "StageState", "advance", "begin", "report"]


class StageState(NamedTuple):
    """The current poses and solver states of a batch of B problems in one stage."""

    pose: Pose
    solver: Any
    """The state of the solver, with leading axis B."""


@eqx.filter_jit
def begin(program: Program, problems: Problem, carried: Any) -> StageState:
    """Return the state at the beginning of a stage, at the anchor poses.

    Args:
        program: the program of the stage.
        problems: the problems, with leading axis B.
        carried: the solver state after the previous stage, whose moments continue. None: the moments start at 0.
    """

    def one(problem: Problem, carried: Any) -> Any:
        return program.solver.init(program, problem, carried)

    solver = jax.vmap(one)(problems, carried)
    # `advance` reuses the memory of its state, so the state must not share memory with the anchor
    return StageState(*jax.tree.map(jnp.copy, (problems.anchor, solver)))


@eqx.filter_jit(donate="all-except-first")
def advance(
    fixed: tuple[Program, Problem, Int[Array, ""]], state: StageState
) -> tuple[StageState, Float[Array, "B"], Int[Array, "B"]]:
    """Take some steps.

    Args:
        fixed: the program, the problems (B, …) and the number of steps (traced).
        state: the current state. Its memory is reused, so the caller must use the returned state instead.

    Returns:
        The new state, and `Solver.outcome` of each problem: loss (B,) and rejected steps (B,).
    """
    program, problems, steps = fixed

    def one(problem: Problem, state: StageState) -> StageState:
        def step(_, state: StageState) -> StageState:
            return StageState(*program.solver.step(program, problem, *state))

        return jax.lax.fori_loop(0, steps, step, state)

    state = jax.vmap(one)(problems, state)
    return state, *jax.vmap(program.solver.outcome)(state.solver)


class Report(NamedTuple):
    """The objective and the keypoints at a batch of poses."""

    loss: dict[str, Float[Array, "B"]]
    """Weighted value of each term in the objective."""
    keypoints_cam: Float[Array, "B T K 3"]
    keypoints_px: Float[Array, "B T K 2"]
    """Crop pixels."""


@eqx.filter_jit
def report(program: Program, problems: Problem, pose: Pose) -> Report:
    """Evaluate the objective at a batch of poses. A solver's state has only the loss before its last step."""

    def one(problem: Problem, pose: Pose) -> Report:
        window, settings = problem_window(program, problem, pose), problem.hyperparameters.settings
        values = evaluate_terms(window, program.terms, settings)
        weighted = {name: jnp.asarray(settings[name]["weight"]) * value for name, value in values.items()}
        return Report(weighted, window.keypoints_cam, window.keypoints_px)

    return jax.vmap(one)(problems, pose)
