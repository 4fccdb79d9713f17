"""The problem of a stage: program, data, objective; what a solver is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit.model.camera import CropCamera
from jaxfit.model.kinematics import Pose, Rig
from jaxfit.objective.objective import weighted_sum
from jaxfit.objective.posed_window import PosedWindow, Priors, Raster, Targets
from jaxfit.objective.registry import Term


class Program(NamedTuple):
    """The data that all problems of a stage share. `rig` and `priors` are traced; the other fields are static."""

    rig: Rig
    priors: Priors
    camera: CropCamera
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
    """A method that improves the pose of one problem. Both functions are pure; a batch maps them over its problems.

    A state has the fields `loss`, the last loss that the solver computed, and `rejected`, the number of steps of this
    stage that were rejected because the loss or its gradient was not finite. After the first rejected step, the pose is
    constant.
    """

    init: Callable[[Program, Problem, Any], Any]
    """Return the state before the first call of `step`, at the anchor. The third argument is the state after the
    previous stage, whose moments the solver continues. None: the solver starts without moments."""
    step: Callable[[Program, Problem, Pose, Any], tuple[Pose, Any]]
    """Take one step. Return the next pose and state."""
    preparing_steps: int = 0
    """Number of calls of `step` that precede the first step and only evaluate the anchor. `init` could evaluate it, but
    the objective would then be compiled twice, which takes longer than the evaluation."""


def problem_window(program: Program, problem: Problem, pose: Pose) -> PosedWindow:
    """Return the posed window that the terms evaluate."""
    targets = problem.targets
    on = problem.hyperparameters.keypoints_on
    if targets.views is not None:  # the keypoints of the model, once for each view
        on = jnp.tile(on, targets.confidence.shape[-1] // on.shape[-1])
    active = targets.confidence * on
    targets = eqx.tree_at(lambda t: t.confidence, targets, active)
    rig, priors, camera, raster = program.rig, program.priors, program.camera, program.raster
    return PosedWindow(pose, problem.anchor, targets, rig, priors, camera, raster, program.shared)


def problem_loss(program: Program, problem: Problem, pose: Pose) -> Float[Array, ""]:
    """Return the objective. The gradient of fixed parameters is 0, so their moments stay 0."""
    window = problem_window(program, problem, with_fixed(problem, pose))
    return weighted_sum(window, program.terms, problem.hyperparameters.settings)


def with_fixed(problem: Problem, pose: Pose) -> Pose:
    """Return the pose with fixed parameters that are constants for JAX."""
    return jax.tree.map(
        lambda x, step: jnp.where(step > 0, x, jax.lax.stop_gradient(x)), pose, problem.hyperparameters.step_size
    )
