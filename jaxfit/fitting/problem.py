"""One problem of a batch: one window of one bird under one config, as a solver sees the problem."""

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

__all__ = ["BATCH_AXIS", "Hyperparameters", "Problem", "Program", "Solver", "problem_loss", "problem_window"]

BATCH_AXIS = "problems"
"""Name of the axis along which a solver is mapped over the problems of a batch."""


class Program(NamedTuple):
    """What all problems of a stage share. `rig` and `priors` are traced, the rest is part of the compiled program."""

    rig: Rig
    priors: Priors
    camera: Camera
    raster: Raster
    terms: Mapping[str, Term]
    """The stage's active terms, by name."""
    solver: Solver


class Hyperparameters(NamedTuple):
    """What may differ between the problems of a batch. All values are traced; a batch puts an axis B in front."""

    settings: dict[str, dict[str, Float[Array | np.ndarray, "*B"]]]
    """Weight and settings of the active terms."""
    step_size: Pose
    """Adam's step for every parameter, of a shape that broadcasts against the pose. 0 fixes a parameter, for every
    solver."""
    keypoints_on: Float[Array | np.ndarray, "*B K"]
    """1 for the keypoints that this stage uses, else 0."""


class Problem(NamedTuple):
    """What a solver knows of one problem besides the pose; a batch puts an axis B in front of every array."""

    hyperparameters: Hyperparameters
    anchor: Pose
    """The pose at the beginning of the stage."""
    targets: Targets


class Solver(NamedTuple):
    """How the pose of one problem is improved. All three functions are pure.

    They are mapped over the problems of a batch along the axis `BATCH_AXIS`.
    """

    init: Callable[[Program, Problem, Any], Any]
    """The state before the first step, at the anchor. The third argument is the state at the end of the stage before,
    whose moments the solver continues; None: no such state."""
    step: Callable[[Program, Problem, Pose, Any], tuple[Pose, Any]]
    """One step: the next pose and state."""
    outcome: Callable[[Any], tuple[Float[Array, ""], Int[Array, ""]]]
    """From a state: the last loss that the solver computed, and the number of steps of this stage that were rejected
    because the loss or its gradient was not finite. After the first such step the pose does not change any more."""


def problem_window(program: Program, problem: Problem, pose: Pose) -> PosedWindow:
    """Return the posed window that the terms see."""
    targets = problem.targets
    active = targets.confidence * problem.hyperparameters.keypoints_on
    targets = eqx.tree_at(lambda t: t.confidence, targets, active)
    return PosedWindow(pose, problem.anchor, targets, program.rig, program.priors, program.camera, program.raster)


def problem_loss(program: Program, problem: Problem, pose: Pose) -> Float[Array, ""]:
    """Return the objective. Fixed parameters have no gradient, so that their moments stay zero."""
    optimised = jax.tree.map(
        lambda x, step: jnp.where(step > 0, x, jax.lax.stop_gradient(x)), pose, problem.hyperparameters.step_size
    )
    return weighted_sum(problem_window(program, problem, optimised), program.terms, problem.hyperparameters.settings)
