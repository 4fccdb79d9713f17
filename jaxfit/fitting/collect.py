"""Fitted windows put back where their birds stand in the video."""

from __future__ import annotations

import logging

import jax
import numpy as np

from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.fitting.batch import Fitted
from jaxfit.fitting.window import Windows
from jaxfit.model.bird import Bird
from jaxfit.model.camera import Camera, crop_to_image

__all__ = ["Collector"]

logger = logging.getLogger(__name__)


class Collector:
    """Gathers the windows of one run."""

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
            "keypoints_cam": (keypoints, 3),
            "keypoints_px": (keypoints, 2),
            "crop": (3,),
        }
        self.arrays = {name: np.full((birds, frames, *shape), np.nan, np.float32) for name, shape in shapes.items()}
        self.valid = np.zeros((birds, frames), bool)
        self.image_size_px = np.zeros((birds, frames, 2), np.int64)
        self.loss: dict[str, np.ndarray] = {}
        self.status = np.full(birds, "no usable frame", dtype="<U32")
        self.failures: dict[int, str] = {}

    def add(self, w: int, fitted: Fitted, i: int) -> None:
        """Take window `w` from lane `i` of a batch; of a diverged one only the status."""
        n = self.windows.track[w]
        if fitted.failure[i]:
            self.status[n] = "diverged"
            track, at = int(self.observations.track_id[n]), self.windows.frame[w][self.windows.present[w]]
            first, last = self.observations.frame_index[at[[0, -1]]]
            logger.warning("track %d, frames %d to %d: %s", track, first, last, fitted.failure[i])
            self.failures.setdefault(track, f"frames {first} to {last}: {fitted.failure[i]}")
        elif self.status[n] != "diverged":
            self.status[n] = "ok"
        for name, value in fitted.report.loss.items():
            self.loss.setdefault(name, np.full(len(self.status), np.nan, np.float32))
            self.loss[name][n] = np.nan_to_num(self.loss[name][n]) + value[i]
        if fitted.failure[i]:
            return
        present = self.windows.present[w]
        at = self.windows.frame[w][present]
        crop = self.windows.crop[w][present].astype(np.float32)
        pose = jax.tree.map(lambda x: x[i], fitted.pose)
        betas = np.zeros(self.bird.num_shapes, np.float32)
        betas[: len(pose.betas)] = pose.betas
        values = {
            "global_orient": pose.global_orient[present],
            "body_pose": pose.body_pose[present],
            "transl": pose.transl[present],
            "scale": np.broadcast_to(pose.scale, present.shape)[present],
            "bone_length": pose.bone_length,
            "betas": betas,
            "keypoints_cam": fitted.report.keypoints_cam[i][present],
            "keypoints_px": crop_to_image(fitted.report.keypoints_px[i][present], crop, self.camera.size_px),
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
            focal_px=self.camera.focal_px,
            crop_px=self.camera.size_px,
            keypoint_names=self.bird.keypoint_names,
            joint_names=self.bird.joint_names,
            loss=self.loss,
            status=self.status,
            failures=self.failures,
        )
