"""Fits of toy birds that move smoothly, with known truth and small silhouettes."""

import dataclasses
import functools

import jax
import numpy as np

from jaxfit.config.fit import load_config
from jaxfit.model.camera import CropCamera, project
from jaxfit.simulation.flock import smooth_motion
from support.birds import pose_window, toy_bird

BIRD = toy_bird(shapes=0)
T, SIZE = 6, 64
CAMERA = CropCamera(2167.0 * SIZE / 256, SIZE / 2, SIZE)
ONE_WINDOW_GB = 0.002
"""Memory in GB for one window of six frames. Most tests use it, so that they share the compiled programs."""


def config(window=T, steps=(600, 25), memory_gb=ONE_WINDOW_GB, mode="image", **changes):
    paper = load_config("paper")
    stages = tuple(dataclasses.replace(s, steps=n) for s, n in zip(paper.stages, steps, strict=True))
    crop = dataclasses.replace(paper.crop, mode=mode, size_px=SIZE)
    terms = {"keypoints": 6.25, "mask": 0.0625, "pose_prior": 0.1, "velocity": 0.1, "acceleration": 0.1}
    plain = dataclasses.replace(paper, window=window, stages=stages, crop=crop, terms=terms, memory_gb=memory_gb)
    return dataclasses.replace(plain, filter_window=1, **changes)


@functools.cache
def truth(frames, seed):
    return jax.tree.map(np.asarray, smooth_motion(BIRD, frames, seed))


def truths(frames=T, birds=3):
    return [truth(frames, seed) for seed in range(birds)]


def keypoints_of(poses):
    return np.stack([np.asarray(project(pose_window(BIRD, pose)[0], CAMERA)) for pose in poses])


def replaced(observations, n, keypoints_px=None, confidence=None):
    """Return the observations with other keypoints or confidences for track `n`."""
    points, confidences = observations.keypoints_px.copy(), observations.confidence.copy()
    points[n] = points[n] if keypoints_px is None else keypoints_px
    confidences[n] = confidences[n] if confidence is None else confidence
    return observations.with_keypoints(points, confidences)
