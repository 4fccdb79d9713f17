"""One stage of the fit: a solver's steps on a batch of windows, as one compiled program."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int

from jaxfit.fitting.lane import Knobs, Lane, Problem, lane_scene
from jaxfit.model.pose import Pose
from jaxfit.objective.objective import evaluate_terms
from jaxfit.objective.scene import Evidence

__all__ = ["Report", "StageState", "advance", "begin", "report"]


class StageState(NamedTuple):
    """Where a batch of B windows stands."""

    pose: Pose
    start: Pose
    """The poses at which the stage began."""
    solver: Any
    """The solver's own state."""


@eqx.filter_jit
def begin(problem: Problem, knobs: Knobs, pose: Pose, evidence: Evidence, before: StageState | None) -> StageState:
    """Start a stage at `pose`; with `before`, the solver goes on with that stage's moments."""

    def one(knobs, pose, evidence, carried):
        return problem.solver.init(pose, Lane(problem, knobs, pose, evidence), carried)

    carried = None if before is None else before.solver
    return StageState(pose, pose, jax.vmap(one)(knobs, pose, evidence, carried))


@eqx.filter_jit(donate="all-except-first")
def advance(
    fixed: tuple[Problem, Knobs, Evidence, Int[Array, ""]], state: StageState
) -> tuple[StageState, Array, Array]:
    """Take some steps.

    Args:
        fixed: the problem, knobs and evidence (B, …) and the number of steps, traced.
        state: given up; use the returned one.

    Returns:
        The new state, and each lane's `Solver.outcome`: loss (B,) and refused steps (B,).
    """
    problem, knobs, evidence, steps = fixed

    def one(knobs: Knobs, state: StageState, evidence: Evidence):
        lane = Lane(problem, knobs, state.start, evidence)
        return jax.lax.fori_loop(
            0, steps, lambda _, carry: problem.solver.step(carry[0], lane, carry[1]), (state.pose, state.solver)
        )

    pose, solver_state = jax.vmap(one)(knobs, state, evidence)
    return StageState(pose, state.start, solver_state), *jax.vmap(problem.solver.outcome)(solver_state)


class Report(NamedTuple):
    """What a batch of poses amounts to."""

    loss: dict[str, Float[Array, "B"]]
    """Each term's weighted share of the objective, at these poses."""
    keypoints_cam: Float[Array, "B T K 3"]
    keypoints_px: Float[Array, "B T K 2"]
    """Crop pixels."""


@eqx.filter_jit
def report(problem: Problem, knobs: Knobs, pose: Pose, start: Pose, evidence: Evidence) -> Report:
    """Evaluate poses as they are (Adam itself only knows the loss before its last step)."""

    def one(knobs, pose, start, evidence):
        scene = lane_scene(pose, Lane(problem, knobs, start, evidence))
        values = evaluate_terms(scene, knobs.settings)
        weighted = {name: knobs.settings[name]["weight"] * value for name, value in values.items()}
        return Report(weighted, scene.keypoints_cam, scene.keypoints_px)

    return jax.vmap(one)(knobs, pose, start, evidence)
