"""Stages as data, turned into what the solver takes."""

from __future__ import annotations

import jax.numpy as jnp

from jaxfit.camera import Camera
from jaxfit.config import FitConfig, StageConfig
from jaxfit.fitting.solve import Problem
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Rig
from jaxfit.model.pose import Pose
from jaxfit.objective.objective import compares_masks
from jaxfit.objective.scene import Priors, Raster
from jaxfit.silhouette import Blur

__all__ = ["needs_mask", "stage_problem"]

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
    return any(compares_masks(name) for name in stage.terms)


def stage_problem(
    config: FitConfig, stage: StageConfig, bird: Bird, rig: Rig, priors: Priors, camera: Camera
) -> Problem:
    """What the solver needs for one stage; weights, settings and step sizes become traced arrays."""

    def step_size(name: str, shape: tuple[int, ...]):
        scale = jnp.asarray(stage.step_scale.get(name, 1.0), jnp.float32)
        return jnp.broadcast_to(stage.learning_rate * scale if name in stage.free else 0.0, shape)

    usual = Blur.for_size(camera.size_px)
    settings = {
        name: {key: jnp.float32(value) for key, value in values.items()}
        for name, values in config.stage_settings(stage).items()
    }
    return Problem(
        rig=rig,
        priors=priors,
        settings=settings,
        step_size=Pose(**{name: step_size(name, shape) for name, shape in STEP_SHAPES.items()}),
        keypoints_on=jnp.array([float(name not in stage.keypoints_off) for name in bird.keypoint_names]),
        camera=camera,
        raster=Raster(Blur(usual.sigma * stage.blur**2, usual.radius * stage.blur), config.backend),
    )
