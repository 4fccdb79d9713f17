"""Simulated detections of posed birds: noisy keypoints, outliers, exact masks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxfit.data.masks import encode_mask
from jaxfit.data.observations import Observations
from jaxfit.model.bird import Bird
from jaxfit.model.camera import Camera, project, to_screen
from jaxfit.model.kinematics import fold_bird, window_keypoints, window_transforms, window_vertices
from jaxfit.model.pose import Pose
from jaxfit.raster.zbuffer import hard_mask

__all__ = ["detect"]


def detect(
    bird: Bird,
    poses: Sequence[Pose],
    noise_px: float = 0.0,
    outliers: float = 0.0,
    seed: int = 0,
    masks: bool = True,
    camera: Camera = Camera(),
) -> Observations:
    """Simulate observations of several birds in one square image, without occlusion between birds.

    Args:
        bird: the model.
        poses: one window (T frames) per bird, camera frame.
        noise_px: standard deviation of x and y of each keypoint, pixels.
        outliers: share of keypoints with a uniformly random position in the image; their confidence is 1.
        seed: seed of the noise.
        masks: whether to render masks; masks are amodal.
        camera: the camera of the image.
    """
    rng = np.random.default_rng(seed)
    rig = fold_bird(bird)
    size, frames = camera.size_px, poses[0].global_orient.shape[0]
    keypoints_px, boxes, rle = [], [], {}
    for n, pose in enumerate(poses):
        A = window_transforms(rig, pose)
        points = np.asarray(project(window_keypoints(rig, A, pose), camera), np.float64)
        points = points + rng.normal(size=points.shape) * noise_px
        is_outlier = rng.random(points.shape[:2]) < outliers
        keypoints_px.append(np.where(is_outlier[..., None], rng.uniform(0, size, points.shape), points))
        screen = np.asarray(to_screen(window_vertices(rig, A, pose), camera))
        low, high = screen[..., :2].min(1), screen[..., :2].max(1)
        boxes.append(np.concatenate([low, high - low], axis=-1))
        if masks:
            for t in range(frames):
                rle[n, t] = encode_mask(hard_mask(screen[t], bird.faces, size, size))
    return Observations(
        track_id=np.arange(len(poses)),
        frame_index=np.arange(frames),
        present=np.ones((len(poses), frames), bool),
        keypoints_px=np.asarray(keypoints_px),
        confidence=np.ones((len(poses), frames, bird.num_keypoints)),
        box_px=np.asarray(boxes),
        image_size_px=np.full((frames, 2), size),
        file_name=np.array([f"{t:06d}.png" for t in range(frames)]),
        keypoint_names=bird.keypoint_names,
        masks=rle,
    )
