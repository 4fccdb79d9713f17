"""Stages of a fit on two tiny birds, and a loop over the stages with the library's solvers."""

import dataclasses
import functools

import jax
import numpy as np

from jaxfit.config.fit import FitConfig, StageConfig
from jaxfit.fitting.problem import Problem
from jaxfit.fitting.solve import FitModel, advance, begin, stage_hyperparameters, stage_program
from jaxfit.model.camera import CropCamera, project
from jaxfit.model.kinematics import fold_bird
from jaxfit.objective.objective import weighted_sum
from jaxfit.objective.posed_window import PosedWindow, Targets, priors_of
from jaxfit.simulation.flock import smooth_motion
from support.birds import pose_window, toy_bird

B, T, STEPS = 2, 4, 25
BIRD, CAMERA = toy_bird(), CropCamera()
MODEL = FitModel(BIRD, fold_bird(BIRD), priors_of(BIRD), CAMERA)
FIRST = StageConfig(
    "first",
    STEPS,
    ("keypoints", "pose_prior", "velocity"),
    learning_rate=0.02,
    step_scale={"transl": (1.0, 0.5, 0.0), "scale": 0.25},
)
SECOND = dataclasses.replace(FIRST, name="second", learning_rate=0.01, carry_moments=True)
SHARED = ("bone_length", "betas")
POSTERIOR = dataclasses.replace(
    FIRST,
    terms=("keypoint_likelihood", "pose_prior", "bone_prior", "shape_prior", "motion_likelihood", "place_likelihood"),
    optimised=("global_orient", "body_pose", "transl", "scale", *SHARED),
)
"""A stage of likelihoods that optimises all parameters. Tests of posteriors share its compiled program."""
CONFIG = FitConfig((FIRST, SECOND), {"pose_prior": 10, "velocity": 5})


def program(stage=FIRST, config=CONFIG):
    return stage_program(config, stage, MODEL)


def problems(anchor, targets, stage=FIRST, config=CONFIG):
    """Return the problems of all birds, at the poses `anchor`."""
    one = stage_hyperparameters(config, stage, BIRD.keypoint_names)
    return jax.device_put(Problem(stacked([one] * len(targets.present)), anchor, targets))


def stacked(values):
    return jax.device_put(jax.tree.map(lambda *x: np.stack(x), *values))


def row(tree, b=0):
    """Return one problem of a batch."""
    return jax.tree.map(lambda x: np.asarray(x)[b], tree)


@functools.cache
def truths():
    return [jax.tree.map(np.asarray, smooth_motion(BIRD, T, seed)) for seed in range(B)]


def case(diverging=None):
    """Return poses near the truth, and targets. The squared keypoints of bird `diverging` exceed float32."""
    targets = []
    for n, truth in enumerate(truths()):
        points = np.asarray(project(pose_window(BIRD, truth)[0], CAMERA))
        targets.append(
            Targets(
                keypoints_px=np.full_like(points, 1e30) if n == diverging else points,
                confidence=np.ones(points.shape[:2], np.float32),
                mask=np.zeros((T, 0, 0), np.uint8),
                has_mask=np.zeros(T, bool),
                present=np.ones(T, bool),
                corner_px=np.zeros((T, 2), np.float32),
                frame_s=np.float32(0.04),
            )
        )
    rng = np.random.default_rng(0)
    truth = jax.tree.map(lambda *x: np.stack(x), *truths())
    start = dataclasses.replace(
        truth,
        global_orient=truth.global_orient + np.float32(0.1 * rng.normal(size=truth.global_orient.shape)),
        body_pose=np.zeros_like(truth.body_pose),
        transl=truth.transl + np.float32([0.5, -0.5, 0]),
        scale=np.ones((B, 1), np.float32),
    )
    return jax.device_put(start), stacked(targets)


def solve(stages, start, targets, chunks=(STEPS,)):
    """Run the stages. Return the final poses, the losses before the last step, and the numbers of rejected steps."""
    pose, solver = start, None
    for stage in stages:
        own = program(stage), problems(pose, targets, stage)
        state = begin(*own, solver if stage.carry_moments else None)
        for steps in chunks:
            state, loss, rejected = advance((*own, jax.device_put(np.int32(steps))), state)
        pose, solver = state.pose, state.solver
    return jax.tree.map(np.asarray, (pose, loss, rejected))


_compiled: dict = {}


def total(pose, start, targets, stage=FIRST):
    """Return the objective of one bird, compiled once for the terms of a stage."""

    def objective(pose, start, targets):
        own = program(stage)
        window = PosedWindow(pose, start, targets, own.rig, own.priors, own.camera, own.raster)
        return weighted_sum(window, own.terms, CONFIG.stage_settings(stage))

    return _compiled.setdefault(stage.terms, jax.jit(objective))(pose, start, targets)
