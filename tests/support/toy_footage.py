"""Footage of three toy birds side by side, and stand-ins for networks that report the truth of it."""

import cv2
import numpy as np

from jaxfit.model.camera import Camera
from jaxfit.perception.instances import instance_of
from jaxfit.simulation.detections import detect
from jaxfit.simulation.motion import smooth_motion
from support.birds import toy_bird

BIRD, FRAMES, SIDE = toy_bird(shapes=0), 12, 64
BIRDS = 3
QUICK = """
base: reconstruct
track: {min_track_frames: 3}
fit:
  base: paper
  window: 12
  crop: {size_px: 64, focal_px: 541.75}
  terms: {keypoints: 100, pose_prior: 0.1, velocity: 0.1}
  stages:
    - {name: only, steps: 30, terms: [keypoints, pose_prior, velocity], step_scale: {transl: [1, 1, 0]}}
"""
"""A config that fits them in no time."""


class Footage:
    """Truth of a video of 192×64 pixels: bird n stands between columns 64 n and 64 (n + 1)."""

    def __init__(self):
        motion = [smooth_motion(BIRD, FRAMES, seed) for seed in range(BIRDS)]
        seen = detect(BIRD, motion, camera=Camera(541.75, SIDE / 2, SIDE))
        self.masks = [[seen.mask(n, t) for n in range(BIRDS)] for t in range(FRAMES)]
        shift = np.array([SIDE, 0]) * np.arange(BIRDS)[:, None, None, None]
        self.keypoints_px = np.moveaxis(seen.keypoints_px + shift, 0, 1)  # T N K 2

    def frame(self, t):
        """Grey birds on black; the first pixel says which frame it is."""
        picture = np.concatenate([np.repeat(mask[..., None], 3, -1) * 160 for mask in self.masks[t]], axis=1)
        picture[0, 0] = t
        return picture.astype(np.uint8)

    def write(self, folder):
        """The frames as images, which keep every pixel."""
        folder.mkdir()
        for t in range(FRAMES):
            cv2.imwrite(str(folder / f"{t}.png"), self.frame(t))
        return folder

    def birds(self, t):
        return [instance_of(self.masks[t][n], 0.9 - 0.1 * n, "bird", SIDE * n) for n in range(BIRDS)]


class TrueSegmenter:
    """Reports every bird, the later ones first; none in the frames and of the birds that it is told to miss."""

    class_names = ("bird",)

    def __init__(self, footage, missed=()):
        self.footage, self.missed, self.seen = footage, set(missed), []

    def __call__(self, frame):
        t = int(frame[0, 0, 0])
        self.seen.append(t)
        birds = self.footage.birds(t)
        return [birds[n] for n in reversed(range(BIRDS)) if (t, n) not in self.missed]


class TrueKeypoints:
    """Reports the keypoints of the birds whose instances it is given, and remembers how many these were."""

    keypoint_names = BIRD.keypoint_names

    def __init__(self, footage):
        self.footage, self.asked = footage, []

    def __call__(self, frame, instances):
        t = int(frame[0, 0, 0])
        self.asked.append(len(instances))
        points = [self.footage.keypoints_px[t, instance.x0 // SIDE] for instance in instances]
        shape = (len(instances), len(self.keypoint_names))
        return np.array(points, np.float32).reshape(*shape, 2), np.full(shape, 0.8, np.float32)
