"""A stage of a fit on two toy birds, and its solution by the library's solvers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxfit.config.fit import FitConfig, StageConfig
from jaxfit.fitting.solve import advance, begin
from jaxfit.fitting.stages import stage_hyperparameters, stage_problem
from jaxfit.model.camera import Camera, project
from jaxfit.model.kinematics import fold_bird, window_keypoints, window_transforms
from jaxfit.objective.objective import weighted_sum
from jaxfit.objective.posed_window import PosedWindow, Targets, priors_of
from jaxfit.simulation.motion import smooth_motion
from support.birds import toy_bird

B, T, STEPS = 2, 4, 25
BIRD, CAMERA = toy_bird(), Camera()
RIG, PRIORS = fold_bird(BIRD), priors_of(BIRD)
FIRST = StageConfig(
    "first",
    STEPS,
    ("keypoints", "pose_prior", "velocity"),
    learning_rate=0.02,
    step_scale={"transl": (1.0, 0.5, 0.0), "scale": 0.25},
)
SECOND = dataclasses.replace(FIRST, name="second", learning_rate=0.01, carry_moments=True)
CONFIG = FitConfig((FIRST, SECOND), {"pose_prior": 10, "velocity": 5})


def problem(stage=FIRST, config=CONFIG):
    return stage_problem(config, stage, RIG, PRIORS, CAMERA)


def hyperparameters(stage=FIRST, config=CONFIG, lanes=B):
    return stacked([stage_hyperparameters(config, stage, BIRD.keypoint_names)] * lanes)


def stacked(values):
    return jax.tree.map(lambda *x: jnp.stack(x), *values)


def case(broken=None):
    """Starts a little off the truth, and targets; the keypoints of bird `broken` are beyond all numbers."""
    truths = [smooth_motion(BIRD, T, seed) for seed in range(B)]
    targets = []
    for n, truth in enumerate(truths):
        points = project(window_keypoints(RIG, window_transforms(RIG, truth), truth), CAMERA)
        targets.append(
            Targets(
                keypoints_px=jnp.full_like(points, 1e30) if n == broken else points,
                confidence=jnp.ones(points.shape[:2]),
                mask=jnp.zeros((T, 0, 0), jnp.uint8),
                has_mask=jnp.zeros(T, bool),
                present=jnp.ones(T, bool),
                corner_px=jnp.zeros((T, 2)),
            )
        )
    rng = np.random.default_rng(0)
    truth = stacked(truths)
    start = dataclasses.replace(
        truth,
        global_orient=truth.global_orient + 0.1 * rng.normal(size=truth.global_orient.shape).astype(np.float32),
        body_pose=jnp.zeros_like(truth.body_pose),
        transl=truth.transl + jnp.array([0.5, -0.5, 0]),
        scale=jnp.ones((B, 1)),
    )
    return start, stacked(targets)


def solve(stages, start, targets, chunks=(STEPS,)):
    """Run stages as the fit does; final poses, losses before the last step, refused steps."""
    before, pose = None, start
    for stage in stages:
        own = problem(stage), hyperparameters(stage, lanes=len(targets.present))
        # the solver gives up what it is given: keep the caller's start
        state = begin(*own, jax.tree.map(jnp.copy, pose), targets, before if stage.carry_moments else None)
        for steps in chunks:
            state, loss, refused = advance((*own, targets, jnp.int32(steps)), state)
        pose, before = state.pose, state
    return jax.tree.map(np.asarray, (pose, loss, refused))


def total(pose, start, targets, stage=FIRST):
    settings = CONFIG.stage_settings(stage)
    return weighted_sum(PosedWindow(pose, start, targets, RIG, PRIORS, CAMERA, problem().raster), settings)
