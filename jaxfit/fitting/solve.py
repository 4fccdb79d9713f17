"""One stage of the fit: optimistix' Adam on a batch of windows, as one compiled program.

A lane is one window under one config: what configs may set without another program (`Knobs`) differs from lane to
lane, so that a sweep is one batch.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, Float, Int

from jaxfit.camera import Camera
from jaxfit.model.kinematics import Rig
from jaxfit.model.pose import Pose
from jaxfit.objective.objective import evaluate_terms, weighted_sum
from jaxfit.objective.scene import Evidence, Priors, Raster, Scene

__all__ = ["Knobs", "Problem", "Report", "StageState", "advance", "begin", "lane_scene", "report"]

NEVER = 2**30
"""Non-finite steps in a row that a lane may refuse: a diverging bird stands still and leaves others alone."""


class Problem(NamedTuple):
    """What all lanes of a stage share. `rig` and `priors` are traced, `camera` and `raster` part of the program."""

    rig: Rig
    priors: Priors
    camera: Camera
    raster: Raster


class Knobs(NamedTuple):
    """What each lane has of its own, all traced; a batch of B lanes puts an axis B in front."""

    settings: dict[str, dict[str, Float[Array | np.ndarray, "*B"]]]
    """Weight and settings of the active terms."""
    step_size: Pose
    """Adam's step for every parameter, shaped to broadcast against it; 0 keeps it fixed."""
    keypoints_on: Float[Array | np.ndarray, "*B K"]
    """1 for the keypoints that this stage looks at, else 0."""


class StageState(NamedTuple):
    """Where a batch of B windows stands."""

    pose: Pose
    start: Pose
    """The poses at which the stage began."""
    solver: Any
    """The solver's state: moments and counters."""


def lane_scene(problem: Problem, knobs: Knobs, pose: Pose, start: Pose, evidence: Evidence) -> Scene:
    """What the terms of one lane see."""
    seen = eqx.tree_at(lambda e: e.confidence, evidence, evidence.confidence * knobs.keypoints_on)
    return Scene(pose, start, seen, problem.rig, problem.priors, problem.camera, problem.raster)


def _solver(knobs: Knobs, carried: Any = None) -> optx.OptaxMinimiser:
    def scale(updates, _):
        return jax.tree.map(lambda update, step: -step * update, updates, knobs.step_size)

    adam = optax.scale_by_adam()
    if carried is not None:
        adam = optax.GradientTransformation(lambda params: carried, adam.update)
    chain = optax.chain(adam, optax.stateless(scale))
    # tolerances of 0: a stage takes exactly its steps, as its source does
    return optx.OptaxMinimiser(optax.apply_if_finite(chain, NEVER), rtol=0.0, atol=0.0)


def _fixed(pose: Pose, step_size: Pose) -> Pose:
    """Cut the gradient of parameters that do not move, so that their moments stay zero."""
    return jax.tree.map(lambda x, step: jnp.where(step > 0, x, jax.lax.stop_gradient(x)), pose, step_size)


def _loss(pose: Pose, args: Any) -> tuple[Float[Array, ""], None]:
    problem, knobs, start, evidence = args
    return weighted_sum(
        lane_scene(problem, knobs, _fixed(pose, knobs.step_size), start, evidence), knobs.settings
    ), None


STRUCT = jax.ShapeDtypeStruct((), jnp.float32)


@eqx.filter_jit
def begin(problem: Problem, knobs: Knobs, pose: Pose, evidence: Evidence, before: StageState | None) -> StageState:
    """Start a stage at `pose`; with `before`, Adam goes on with that stage's moments."""

    def one(knobs, pose, evidence, carried):
        solver = _solver(knobs, carried)
        state = solver.init(_loss, pose, (problem, knobs, pose, evidence), {}, STRUCT, None, frozenset())
        return StageState(pose, pose, state)

    return jax.vmap(one)(knobs, pose, evidence, None if before is None else _moments(before))


def _moments(state: StageState) -> optax.ScaleByAdamState:
    return state.solver.opt_state.inner_state[0]


@eqx.filter_jit(donate="all-except-first")
def advance(
    fixed: tuple[Problem, Knobs, Evidence, Int[Array, ""]], state: StageState
) -> tuple[StageState, Array, Array]:
    """Take some steps.

    Args:
        fixed: the problem, knobs and evidence (B, …) and the number of steps, traced.
        state: given up; use the returned one.

    Returns:
        The new state, each lane's loss before its last step (B,), and how many of its steps so far were
        refused because the gradient was not finite (B,).
    """
    problem, knobs, evidence, steps = fixed

    def one(knobs: Knobs, state: StageState, evidence: Evidence):
        solver = _solver(knobs)
        args = (problem, knobs, state.start, evidence)

        def step(_, carry):
            pose, solver_state = carry
            pose, solver_state, _ = solver.step(_loss, pose, args, {}, solver_state, frozenset())
            return pose, solver_state

        return jax.lax.fori_loop(0, steps, step, (state.pose, state.solver))

    pose, solver_state = jax.vmap(one)(knobs, state, evidence)
    refused = solver_state.opt_state.total_notfinite
    return StageState(pose, state.start, solver_state), solver_state.f, refused


class Report(NamedTuple):
    """What a batch of poses amounts to."""

    loss: dict[str, Float[Array, "B"]]
    """Each term's weighted share of the objective, at these poses."""
    keypoints_cam: Float[Array, "B T K 3"]
    keypoints_px: Float[Array, "B T K 2"]
    """Crop pixels."""


@eqx.filter_jit
def report(problem: Problem, knobs: Knobs, pose: Pose, start: Pose, evidence: Evidence) -> Report:
    """Evaluate poses as they are (the solver itself only knows the loss before its last step)."""

    def one(knobs, pose, start, evidence):
        scene = lane_scene(problem, knobs, pose, start, evidence)
        values = evaluate_terms(scene, knobs.settings)
        weighted = {name: knobs.settings[name]["weight"] * value for name, value in values.items()}
        return Report(weighted, scene.keypoints_cam, scene.keypoints_px)

    return jax.vmap(one)(knobs, pose, start, evidence)
