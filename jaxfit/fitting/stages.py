"""Programs and hyperparameters of the stages of a config."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxfit.config.fit import FitConfig, InitialiseConfig, StageConfig
from jaxfit.fitting.adam import ADAM
from jaxfit.fitting.levenberg_marquardt import LEVENBERG_MARQUARDT
from jaxfit.fitting.problem import Hyperparameters, Program, Solver
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CROP_PX, Camera
from jaxfit.model.kinematics import Rig, fold_bird
from jaxfit.model.pose import Pose
from jaxfit.objective.curvature import SHARED_PARAMETERS
from jaxfit.objective.posed_window import Priors, Raster, priors_of
from jaxfit.objective.registry import find_terms
from jaxfit.raster.silhouette import Blur

__all__ = [
    "FitModel",
    "compiled_part",
    "crop_camera",
    "fit_model",
    "needs_mask",
    "stage_hyperparameters",
    "stage_program",
    "without_mask_stages",
]

SOLVERS: Mapping[str, Solver] = {"adam": ADAM, "levenberg_marquardt": LEVENBERG_MARQUARDT}
"""Solvers by their name in `StageConfig.solver`."""
STEP_SHAPES = {
    "global_orient": (3,),
    "body_pose": (1, 3),
    "transl": (3,),
    "scale": (),
    "bone_length": (1,),
    "betas": (1,),
}
"""Shapes of the step sizes: all frames, bones and shape coefficients have the same step size."""


class FitModel(NamedTuple):
    """The bird, its folded arrays, its priors and the crop camera, for all stages of a fit."""

    bird: Bird
    rig: Rig
    priors: Priors
    camera: Camera


def fit_model(bird: Bird, config: FitConfig) -> FitModel:
    """Return the model of a fit: the bird, folded, and the crop camera of the config."""
    return FitModel(bird, fold_bird(bird), priors_of(bird), crop_camera(config))


def crop_camera(config: FitConfig) -> Camera:
    """Return the crop camera, in crop pixels."""
    return Camera(config.crop.focal_px, CROP_PX / 2, CROP_PX)


def needs_mask(stage: StageConfig) -> bool:
    """Return whether any term of a stage compares masks."""
    return any(term.compares_masks for term in find_terms(stage.terms).values())


def without_mask_stages(config: FitConfig) -> FitConfig:
    """Return a config whose stages compare no masks, for observations without masks.

    A stage that compares masks becomes a continuation of the stage before it: it has the terms, the keypoints, the
    optimised parameters and the solver of that stage, but its own steps and its own `override`. Without the
    continuation, the fit would end after a stage that another stage is meant to follow: its steps may end far from the
    minimum, and its `override` may be for the beginning of a fit only. A stage that compares masks is left out if no
    stage stands before it.

    A config that has no other stages keeps its stages, without the terms that compare masks.
    """
    if all(map(needs_mask, config.stages)):
        stages = [replace(stage, terms=_terms_without_masks(stage)) for stage in config.stages]
        return replace(config, stages=tuple(stages))
    kept: list[StageConfig] = []
    for stage in config.stages:
        if kept and needs_mask(stage):
            kept.append(_continuation(kept[-1], stage))
        elif not needs_mask(stage):
            carry = stage.carry_moments and bool(kept) and kept[-1].solver == "adam"
            kept.append(replace(stage, carry_moments=carry))
    return replace(config, stages=tuple(kept))


def _continuation(before: StageConfig, stage: StageConfig) -> StageConfig:
    """Return the stage that takes the place of `stage`, which compares masks, after the stage `before`."""
    return replace(
        before,
        name=stage.name,
        # a number of steps of one solver says nothing about the other solver
        steps=stage.steps if stage.solver == before.solver else before.steps,
        override=stage.override,
        carry_moments=before.solver == "adam",
        keep_best=stage.keep_best,
        near_poses=stage.near_poses,
    )


def _terms_without_masks(stage: StageConfig) -> tuple[str, ...]:
    others = (name for name, term in find_terms(stage.terms).items() if not term.compares_masks)
    return tuple(others) or stage.terms


def stage_program(config: FitConfig, stage: StageConfig, model: FitModel) -> Program:
    """Return the program of one stage. The functions of the terms are part of the program."""
    paper_blur = Blur.for_size(config.crop.size_px)
    blur = Blur(paper_blur.sigma * stage.blur**2, paper_blur.radius * stage.blur)
    raster = Raster(blur, config.crop.size_px, config.backend)
    return Program(
        model.rig,
        model.priors,
        model.camera,
        raster,
        find_terms(stage.terms),
        SOLVERS[stage.solver],
        _shared_columns(stage),
    )


def _shared_columns(stage: StageConfig) -> tuple[str, ...]:
    """Return the shared parameters that Levenberg-Marquardt optimises; Adam does not need their names."""
    if stage.solver == "adam":
        return ()
    return tuple(name for name in SHARED_PARAMETERS if name in stage.optimised)


def stage_hyperparameters(config: FitConfig, stage: StageConfig, keypoint_names: Sequence[str]) -> Hyperparameters:
    """Return the hyperparameters of one stage of one config, as NumPy arrays for one problem."""

    def step_size(name: str, shape: tuple[int, ...]) -> np.ndarray:
        scale = np.asarray(stage.step_scale.get(name, 1.0), np.float32)
        size = stage.learning_rate * scale if name in stage.optimised else 0.0
        return np.array(np.broadcast_to(size, shape), np.float32)

    return Hyperparameters(
        settings={
            name: {key: np.array(value, np.float32) for key, value in values.items()}
            for name, values in config.stage_settings(stage).items()
        },
        step_size=Pose(**{name: step_size(name, shape) for name, shape in STEP_SHAPES.items()}),
        keypoints_on=np.array([name not in stage.keypoints_off for name in keypoint_names], np.float32),
    )


def compiled_part(config: FitConfig) -> FitConfig:
    """Return the part of the config that determines the compiled program.

    Configs with an equal compiled part differ only in hyperparameters and in the preparation of the data.
    """
    stages = tuple(
        replace(
            stage,
            # `betas` sets the number of shape coefficients, and the solver may need columns for shared parameters; the
            # other names only set step sizes
            optimised=tuple(sorted({*_shared_columns(stage), *({"betas"} & set(stage.optimised))})),
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
        overlap=0,
        filter_window=1,
        min_keypoints=1,
        crop=replace(config.crop, padding=0.0),
        initialise=InitialiseConfig(hypotheses=config.initialise.hypotheses),
    )
