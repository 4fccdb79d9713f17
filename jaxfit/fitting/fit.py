"""The fit as a whole: observations and a bird in, posed birds out."""

from __future__ import annotations

import logging

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxfit.camera import Camera, crop_to_image
from jaxfit.config import FitConfig
from jaxfit.errors import InputError
from jaxfit.fitting.batch import Fitted, fit_batch, frames_per_batch
from jaxfit.fitting.initialise import initial_poses
from jaxfit.fitting.solution import Solution
from jaxfit.fitting.start import Start
from jaxfit.fitting.window import Windows, cut_windows, filter_observations, load_evidence
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Rig, fold_bird
from jaxfit.model.pose import Pose
from jaxfit.objective.scene import Evidence, priors_of
from jaxfit.observations import Observations, check_keypoints
from jaxfit.progress import ProgressTask, silent

__all__ = ["fit"]

logger = logging.getLogger(__name__)


def fit(
    observations: Observations,
    bird: Bird,
    config: FitConfig,
    start: Start | None = None,
    progress: ProgressTask = silent,
    source: object = "observations",
) -> Solution:
    """Pose every bird of a video (or of a set of photographs).

    Args:
        observations: keypoints and masks; their keypoints must be the bird's, in any order.
        bird: the model.
        config: what to do.
        start: where to start; None searches by `config.initialise`.
        progress: where progress is shown.
        source: what the observations are called in an error.

    Returns:
        The poses, with a status for every track: `ok`, `no usable frame` or `diverged`.

    Raises:
        InputError: no bird, keypoints that are not the model's, no track with a usable frame, crops that cannot
            be made.
    """
    if not observations.num_tracks:
        raise InputError(source, "holds no bird", "look for birds in other footage, or with another network")
    observations = check_keypoints(observations, bird.keypoint_names, source)
    observations = filter_observations(observations, config.filter_window)
    windows = cut_windows(observations, config)
    if len(windows) == 0:
        raise InputError(
            source,
            f"no track has a frame with {config.min_keypoints} confident keypoints",
            "detect more keypoints, or lower min_keypoints in the config",
        )
    camera = Camera(config.crop.focal_px, config.crop.size_px / 2, config.crop.size_px)
    # shape directions that nothing moves would only cost time
    shaped = any("betas" in stage.free for stage in config.stages) or (start is not None and start.has_shape)
    used = bird if shaped else _without_shape(bird)
    rig, priors = fold_bird(used), priors_of(used)
    if start is not None:
        start = start.at_crops(observations, windows)
    size = min(max(frames_per_batch(bird, config) // config.window, 1), len(windows))
    steps = sum(stage.steps for stage in config.stages)
    birds = len(np.unique(windows.track))
    solution = _Collector(observations, windows, bird, camera)
    batches = range(0, len(windows), size)
    logger.info("%d birds, %d windows of %d frames, %d batches", birds, len(windows), config.window, len(batches))
    with progress(f"Fitting {birds} {'bird' if birds == 1 else 'birds'}", steps * len(batches)) as tick:
        for first in batches:
            rows = np.arange(first, min(first + size, len(windows)))
            # every batch has the same shape, so that one compiled program serves all: a short one is filled
            # up with windows of its own
            part = windows[np.resize(rows, size)]
            evidence = load_evidence(observations, part, camera.size_px)
            tick(0, "starting poses")
            poses = _starting_poses(used, rig, evidence, start, part, config, camera)
            fitted = fit_batch(used, rig, priors, config, camera, evidence, poses, tick)
            solution.add(rows, jax.tree.map(np.asarray, fitted))
    return solution.finish()


def _starting_poses(
    bird: Bird,
    rig: Rig,
    evidence: Evidence,
    start: Start | None,
    windows: Windows,
    config: FitConfig,
    camera: Camera,
) -> Pose:
    """Starting poses of a batch, with leading axes W, H (hypotheses)."""
    if start is None:
        keypoints_px, confidence = jnp.asarray(evidence.keypoints_px), jnp.asarray(evidence.confidence)
        return initial_poses(bird, rig, keypoints_px, confidence, config.initialise, camera, config.common_size)
    rows = zip(windows.track, windows.frame, windows.present, strict=True)
    poses = [start.window_pose(bird, int(n), frame, present, config.common_size) for n, frame, present in rows]
    return jax.tree.map(lambda *x: jnp.stack(x)[:, None], *poses)


def _without_shape(bird: Bird) -> Bird:
    return eqx.tree_at(
        lambda b: (b.shape_basis, b.shape_variance), bird, (bird.shape_basis[:0], bird.shape_variance[:0])
    )


class _Collector:
    """Puts fitted windows back where their birds stand in the video."""

    def __init__(self, observations: Observations, windows: Windows, bird: Bird, camera: Camera):
        self.observations, self.windows, self.bird, self.camera = observations, windows, bird, camera
        birds, frames = observations.num_tracks, observations.num_frames
        joints, keypoints = bird.num_joints, bird.num_keypoints
        shapes = {
            "global_orient": (3,),
            "body_pose": (joints - 1, 3),
            "transl": (3,),
            "scale": (),
            "bone_length": (joints - 1,),
            "betas": (bird.num_shapes,),
            "keypoints_3d": (keypoints, 3),
            "keypoints_2d": (keypoints, 2),
            "crop": (3,),
        }
        self.arrays = {name: np.full((birds, frames, *shape), np.nan, np.float32) for name, shape in shapes.items()}
        self.valid = np.zeros((birds, frames), bool)
        self.image_size_px = np.zeros((birds, frames, 2), np.int64)
        self.loss: dict[str, np.ndarray] = {}
        self.status = np.full(birds, "no usable frame", dtype="<U32")

    def add(self, rows: np.ndarray, fitted: Fitted) -> None:
        """Take the windows `rows`; of a diverged one only the status."""
        for i, w in enumerate(rows):
            n = self.windows.track[w]
            if fitted.diverged[i]:
                self.status[n] = "diverged"
            elif self.status[n] != "diverged":
                self.status[n] = "ok"
            for name, value in fitted.report.loss.items():
                self.loss.setdefault(name, np.full(len(self.status), np.nan, np.float32))
                self.loss[name][n] = np.nan_to_num(self.loss[name][n]) + value[i]
            if fitted.diverged[i]:
                continue
            present = self.windows.present[w]
            at = self.windows.frame[w][present]
            crop = self.windows.crop[w][present].astype(np.float32)
            pose = jax.tree.map(lambda x, i=i: x[i], fitted.pose)
            betas = np.zeros(self.bird.num_shapes, np.float32)
            betas[: len(pose.betas)] = pose.betas
            values = {
                "global_orient": pose.global_orient[present],
                "body_pose": pose.body_pose[present],
                "transl": pose.transl[present],
                "scale": np.broadcast_to(pose.scale, present.shape)[present],
                "bone_length": pose.bone_length,
                "betas": betas,
                "keypoints_3d": fitted.report.keypoints_cam[i][present],
                "keypoints_2d": crop_to_image(fitted.report.keypoints_px[i][present], crop, self.camera.size_px),
                "crop": crop,
            }
            for name, value in values.items():
                self.arrays[name][n, at] = value
            self.valid[n, at] = True
            self.image_size_px[n, at] = [self.observations.image_size(int(n), int(t)) for t in at]

    def finish(self) -> Solution:
        """The solution of all windows added."""
        return Solution(
            track_id=self.observations.track_id,
            frame_index=self.observations.frame_index,
            valid=self.valid,
            **self.arrays,
            image_size_px=self.image_size_px,
            focal=self.camera.focal_px,
            crop_px=self.camera.size_px,
            keypoint_names=self.bird.keypoint_names,
            joint_names=self.bird.joint_names,
            loss=self.loss,
            status=self.status,
        )
