"""Stages as data, turned into what the solver takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from jaxfit.config.fit import FitConfig, InitialiseConfig, StageConfig
from jaxfit.fitting.adam import ADAM
from jaxfit.fitting.lane import Hyperparameters, Problem, Solver
from jaxfit.fitting.levenberg_marquardt import LEVENBERG_MARQUARDT
from jaxfit.model.camera import Camera
from jaxfit.model.kinematics import Rig
from jaxfit.model.pose import Pose
from jaxfit.objective.posed_window import Priors, Raster
from jaxfit.objective.registry import find_term
from jaxfit.raster.silhouette import Blur

__all__ = ["needs_mask", "program", "stage_hyperparameters", "stage_problem"]

SOLVERS: Mapping[str, Solver] = {"adam": ADAM, "levenberg_marquardt": LEVENBERG_MARQUARDT}
"""By the name that a stage gives as its `solver`."""
STEP_SHAPES = {
    "global_orient": (3,),
    "body_pose": (1, 3),
    "transl": (3,),
    "scale": (),
    "bone_length": (1,),
    "betas": (1,),
}
"""Step sizes are those of one frame, the same for all bones and shape coefficients."""


def needs_mask(stage: StageConfig) -> bool:
    """Whether any of a stage's terms looks at the silhouette."""
    return any(find_term(name).compares_masks for name in stage.terms)


def stage_problem(config: FitConfig, stage: StageConfig, rig: Rig, priors: Priors, camera: Camera) -> Problem:
    """What the lanes of one stage share."""
    usual = Blur.for_size(camera.size_px)
    raster = Raster(Blur(usual.sigma * stage.blur**2, usual.radius * stage.blur), config.backend)
    return Problem(rig, priors, camera, raster, SOLVERS[stage.solver])


def stage_hyperparameters(config: FitConfig, stage: StageConfig, keypoint_names: Sequence[str]) -> Hyperparameters:
    """What one config may set in a stage without another program, as NumPy arrays of one lane."""

    def step_size(name: str, shape: tuple[int, ...]) -> np.ndarray:
        scale = np.asarray(stage.step_scale.get(name, 1.0), np.float32)
        return np.array(
            np.broadcast_to(stage.learning_rate * scale if name in stage.optimised else 0.0, shape), np.float32
        )

    return Hyperparameters(
        settings={
            name: {key: np.array(value, np.float32) for key, value in values.items()}
            for name, values in config.stage_settings(stage).items()
        },
        step_size=Pose(**{name: step_size(name, shape) for name, shape in STEP_SHAPES.items()}),
        keypoints_on=np.array([name not in stage.keypoints_off for name in keypoint_names], np.float32),
    )


def program(config: FitConfig) -> FitConfig:
    """The part of the config that determines the compiled program."""
    stages = tuple(
        replace(
            stage,
            optimised=tuple(name for name in stage.optimised if name == "betas"),  # it decides whether there are any
            learning_rate=1.0,
            step_scale={},
            keypoints_off=(),
            override={},
        )
        for stage in config.stages
    )
    return replace(
        config,
        stages=stages,
        terms={},
        filter_window=1,
        min_keypoints=1,
        crop=replace(config.crop, padding=0.0),
        initialise=InitialiseConfig(hypotheses=config.initialise.hypotheses),
    )
