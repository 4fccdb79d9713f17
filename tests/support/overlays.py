"""Footage and a result of two toy birds, for the tests of overlays."""

import functools

import numpy as np

from jaxfit.data.solution import Solution
from jaxfit.model.camera import CropCamera
from jaxfit.simulation.flock import smooth_motion
from jaxfit.video.writer import VideoWriter
from support.birds import solution_of, toy_bird

BIRD, CAMERA, N, T = toy_bird(shapes=0), CropCamera(), 2, 6
WIDTH, HEIGHT, FPS = 320, 200, 12.5
CROPS = ((10, 40, 128), (170, 30, 160))
FIRST = 3
"""Number of the result's first frame; the video has frames before and after it."""
GREY = 120


@functools.cache
def solution(**changes) -> Solution:
    """Two birds beside each other; the second is away in the third frame."""
    poses = [smooth_motion(BIRD, T, seed) for seed in range(N)]
    valid = np.ones((N, T), bool)
    valid[1, 2] = False
    values = {
        "track_id": np.array([4, 11]),
        "frame_index": np.arange(FIRST, FIRST + T),
        "valid": valid,
        "image_size_px": np.where(valid[..., None], [WIDTH, HEIGHT], 0),
    }
    return solution_of(BIRD, poses, np.array(CROPS)[:, None]).with_arrays(**values | changes)


def film(path, frames=FIRST + T + 2, size=(WIDTH, HEIGHT)):
    with VideoWriter(path, size, FPS) as writer:
        for _ in range(frames):
            writer.write(np.full((size[1], size[0], 3), GREY, np.uint8))
    return path
