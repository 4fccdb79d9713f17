"""One lane of a batch: a window under one config, and what a solver is to it.

`Hyperparameters` differ from lane to lane and need no other program, so that a sweep is one batch.
"""

from __future__ import annotations

from collections.abc import Callable
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

__all__ = ["Hyperparameters", "Lane", "Problem", "Solver", "lane_loss", "lane_window"]


class Problem(NamedTuple):
    """What all lanes of a stage share. `rig` and `priors` are traced, the rest is part of the program."""

    rig: Rig
    priors: Priors
    camera: Camera
    raster: Raster
    solver: Solver


class Hyperparameters(NamedTuple):
    """What each lane has of its own, all traced; a batch of B lanes puts an axis B in front."""

    settings: dict[str, dict[str, Float[Array | np.ndarray, "*B"]]]
    """Weight and settings of the active terms."""
    step_size: Pose
    """Adam's step for every parameter, shaped to broadcast against it; 0 keeps it fixed, for every solver."""
    keypoints_on: Float[Array | np.ndarray, "*B K"]
    """1 for the keypoints that this stage looks at, else 0."""


class Lane(NamedTuple):
    """What a solver knows beside the pose."""

    problem: Problem
    hyperparameters: Hyperparameters
    start: Pose
    """The pose at which the stage began."""
    targets: Targets


class Solver(NamedTuple):
    """How a lane's pose is improved; all three are pure, and mapped over the lanes of a batch."""

    init: Callable[[Pose, Lane, Any], Any]
    """The state before the first step; with the state of the stage before, it goes on with that one's moments."""
    step: Callable[[Pose, Lane, Any], tuple[Pose, Any]]
    """One step: the next pose and state."""
    outcome: Callable[[Any], tuple[Float[Array, ""], Int[Array, ""]]]
    """Of a state: the loss that the last step knew, and how many steps so far were refused because the loss or its
    gradient was not finite (from the first such step on the pose stands still)."""


def lane_window(pose: Pose, lane: Lane) -> PosedWindow:
    """What the terms see."""
    problem, hyperparameters, start, targets = lane
    seen = eqx.tree_at(lambda e: e.confidence, targets, targets.confidence * hyperparameters.keypoints_on)
    return PosedWindow(pose, start, seen, problem.rig, problem.priors, problem.camera, problem.raster)


def lane_loss(pose: Pose, lane: Lane) -> Float[Array, ""]:
    """The objective; parameters that do not move have no gradient, so that their moments stay zero."""
    free = jax.tree.map(
        lambda x, step: jnp.where(step > 0, x, jax.lax.stop_gradient(x)), pose, lane.hyperparameters.step_size
    )
    return weighted_sum(lane_window(free, lane), lane.hyperparameters.settings)
