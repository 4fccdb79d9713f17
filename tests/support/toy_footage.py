"""A video of three toy birds side by side, and stand-ins for networks that report the truth."""

import functools
import threading

import cv2
import numpy as np

from jaxfit.model.camera import CropCamera
from jaxfit.model.files import save_bird
from jaxfit.perception.network import instance_of
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect
from support.birds import toy_bird

BIRD, FRAMES, SIDE = toy_bird(shapes=0), 12, 64
BIRDS = 3
MISSED = [(t, n) for t in (3, 4, 9) for n in range(BIRDS) if t != 4 or n != 1]
"""Frames and birds that some tests hide from the segmenter."""
QUICK = """
base: reconstruct
track: {min_track_frames: 3}
fit:
  base: paper
  window: 12
  crop: {size_px: 64}
  terms: {keypoints: 6.25, pose_prior: 0.1, velocity: 0.1}
  stages:
    - {name: only, steps: 30, terms: [keypoints, pose_prior, velocity], step_scale: {transl: [1, 1, 0]}}
"""
"""A config with a short fit of these birds."""


@functools.cache
def _truth():
    """Return the masks by frame and bird, and the keypoints (T, N, K, 2). The first use compiles many programs."""
    motion = [smooth_motion(BIRD, FRAMES, seed) for seed in range(BIRDS)]
    detections = detect(BIRD, motion, camera=CropCamera(541.75, SIDE / 2, SIDE))
    masks = [[detections.mask(n, t) for n in range(BIRDS)] for t in range(FRAMES)]
    shift = np.array([SIDE, 0]) * np.arange(BIRDS)[:, None, None, None]
    return masks, np.moveaxis(detections.keypoints_px + shift, 0, 1)


class Footage:
    """The video of 192×64 pixels and its truth: bird n lies between columns 64 n and 64 (n + 1)."""

    @functools.cached_property
    def masks(self):
        return _truth()[0]

    @functools.cached_property
    def keypoints_px(self):
        return _truth()[1]

    def frame(self, t):
        """Grey birds on black; the first pixel is the number of the frame."""
        picture = np.concatenate([np.repeat(mask[..., None], 3, -1) * 160 for mask in self.masks[t]], axis=1)
        picture[0, 0] = t
        return picture.astype(np.uint8)

    def write(self, folder):
        """Write the frames as lossless images."""
        folder.mkdir()
        for t in range(FRAMES):
            cv2.imwrite(str(folder / f"{t}.png"), self.frame(t))
        return folder

    def write_inputs(self, folder, config=QUICK):
        """Write the frames, the model and a config, as a command needs them."""
        self.write(folder / "frames")
        save_bird(BIRD, folder / "toy.npz")
        (folder / "quick.yaml").write_text(config)

    def birds(self, t):
        return [instance_of(self.masks[t][n], 0.9 - 0.1 * n, "bird", SIDE * n) for n in range(BIRDS)]


class TrueSegmenter:
    """Reports every bird in reverse order, except the missed (frame, bird)."""

    class_names = ("bird",)

    def __init__(self, footage, missed=()):
        self.footage, self.missed, self.frames = footage, set(missed), []

    def __call__(self, frame):
        t = int(frame[0, 0, 0])
        self.frames.append(t)
        birds = self.footage.birds(t)
        return [birds[n] for n in reversed(range(BIRDS)) if (t, n) not in self.missed]


class BlockSegmenter(TrueSegmenter):
    """Segments blocks of frames; the score of a bird is its position in the block."""

    def segment_block(self, frames):
        return [[bird._replace(score=0.9 - 0.1 * n) for bird in self(frame)] for n, frame in enumerate(frames)]


class TrueKeypoints:
    """Reports the true keypoints of the instances, and records the number of instances of each call."""

    keypoint_names = BIRD.keypoint_names

    def __init__(self, footage):
        self.footage, self.counts = footage, []

    def __call__(self, frame, instances):
        t = int(frame[0, 0, 0])
        self.counts.append(len(instances))
        points = [self.footage.keypoints_px[t, instance.x0 // SIDE] for instance in instances]
        shape = (len(instances), len(self.keypoint_names))
        return np.array(points, np.float32).reshape(*shape, 2), np.full(shape, 0.8, np.float32)


class Monitored:
    """A part of a network whose activations have the number of the frame as distance, for every thread separately."""

    def __init__(self, *given):
        super().__init__(*given)
        self.activations, self.of_thread = self, threading.local()

    def __call__(self, frame, *instances):
        self.of_thread.distances = [*getattr(self.of_thread, "distances", []), float(frame[0, 0, 0])]
        return super().__call__(frame, *instances)

    def take(self):
        return np.array(self.of_thread.__dict__.pop("distances", []))


class MonitoredSegmenter(Monitored, TrueSegmenter):
    pass


class MonitoredKeypoints(Monitored, TrueKeypoints):
    pass


def assert_same_tracking(one, other):
    """Compare two results of tracking, except their durations."""
    for name, value in vars(one.observations).items():
        np.testing.assert_equal(value, getattr(other.observations, name), err_msg=name)
    assert one[1:-1] == other[1:-1]
