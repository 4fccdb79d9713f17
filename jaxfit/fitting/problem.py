"""The problem that a solver solves: one window of one bird under one config."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfit.model.camera import Camera
from jaxfit.model.kinematics import Rig
from jaxfit.model.pose import Pose
from jaxfit.objective.objective import weighted_sum
from jaxfit.objective.posed_window import PosedWindow, Priors, Raster, Targets
from jaxfit.objective.registry import Term

__all__ = ["Hyperparameters", "Problem", "Program", "Solver", "problem_loss", "problem_window"]


class Program(NamedTuple):
    """The data that all problems of a stage share. `rig` and `priors` are traced; the other fields are static."""

    rig: Rig
    priors: Priors
    camera: Camera
    raster: Raster
    terms: Mapping[str, Term]
    """The stage's active terms, by name."""
    solver: Solver
    shared: tuple[str, ...] = ()
    """The parameters of `curvature.SHARED_PARAMETERS` that a solver with curvature optimises, in that order."""


class Hyperparameters(NamedTuple):
    """The values that may differ between the problems of a batch. All values are traced. A batch adds an axis B."""

    settings: dict[str, dict[str, Float[Array | np.ndarray, "*B"]]]
    """Weight and settings of the active terms."""
    step_size: Pose
    """Adam's step size for every parameter, in shapes that broadcast against the pose. 0 fixes a parameter, for every
    solver."""
    keypoints_on: Float[Array | np.ndarray, "*B K"]
    """1 for the keypoints that the stage uses, else 0."""


class Problem(NamedTuple):
    """The data of one problem, without the optimised pose. A batch adds a leading axis B to every array."""

    hyperparameters: Hyperparameters
    anchor: Pose
    """The pose at the beginning of the stage."""
    targets: Targets


class Solver(NamedTuple):
    """A method that improves the pose of one problem. All three functions are pure.

    A batch maps the functions over its problems.
    """

    init: Callable[[Program, Problem, Any], Any]
    """Return the state before the first step, at the anchor. The third argument is the state after the previous stage,
    whose moments the solver continues. None: the solver starts without moments."""
    step: Callable[[Program, Problem, Pose, Any], tuple[Pose, Any]]
    """Take one step. Return the next pose and state."""
    outcome: Callable[[Any], tuple[Float[Array, ""], Int[Array, ""]]]
    """Return, from a state, the last loss that the solver computed, and the number of steps of this stage that were
    rejected because the loss or its gradient was not finite. After the first rejected step, the pose is constant."""


def problem_window(program: Program, problem: Problem, pose: Pose) -> PosedWindow:
    """Return the posed window that the terms evaluate."""
    targets = problem.targets
    active = targets.confidence * problem.hyperparameters.keypoints_on
    targets = eqx.tree_at(lambda t: t.confidence, targets, active)
    rig, priors, camera, raster = program.rig, program.priors, program.camera, program.raster
    return PosedWindow(pose, problem.anchor, targets, rig, priors, camera, raster, program.shared)


def problem_loss(program: Program, problem: Problem, pose: Pose) -> Float[Array, ""]:
    """Return the objective. The gradient of fixed parameters is 0, so their moments stay 0."""
    optimised = jax.tree.map(
        lambda x, step: jnp.where(step > 0, x, jax.lax.stop_gradient(x)), pose, problem.hyperparameters.step_size
    )
    return weighted_sum(problem_window(program, problem, optimised), program.terms, problem.hyperparameters.settings)
