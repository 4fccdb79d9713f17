"""Two toy birds with known truth and a result that a test changes, for the tests of evaluation."""

import functools

import numpy as np

from jaxfit.data.masks import box_of_mask, encode_mask
from jaxfit.data.observations import Observations
from jaxfit.model.camera import CropCamera, project
from jaxfit.simulation.flock import smooth_motion
from support.birds import filled_mask, pose_window, solution_of, toy_bird

BIRD, CAMERA, N, T = toy_bird(), CropCamera(), 2, 4
CORNER = np.array([30, 10])
"""Where the crop's upper left corner lies in the image."""
WIDTH, HEIGHT = 320, 280


def posed():
    return [smooth_motion(BIRD, T, seed) for seed in range(N)]


@functools.cache
def truth():
    """What was there, with masks filled triangle by triangle rather than by the raster core."""
    points, masks, boxes = [], {}, np.zeros((N, T, 4))
    for n, pose in enumerate(posed()):
        keypoints, vertices = pose_window(BIRD, pose)
        points.append(np.asarray(project(keypoints, CAMERA)) + CORNER)
        for t in range(T):
            full = np.zeros((HEIGHT, WIDTH), bool)
            x, y = CORNER
            own = filled_mask(np.asarray(project(vertices[t], CAMERA)), BIRD.faces, 256)
            full[y : y + 256, x : x + 256] = own
            masks[n, t] = encode_mask(full)
            ys, xs = np.nonzero(full)
            boxes[n, t] = [xs.min(), ys.min(), np.ptp(xs) + 1, np.ptp(ys) + 1]
    return Observations(
        track_id=np.array([5, 3]),
        frame_index=np.array([10, 11, 12, 14]),
        present=np.ones((N, T), bool),
        keypoints_px=np.array(points),
        confidence=np.ones((N, T, BIRD.num_keypoints)),
        box_px=boxes,
        image_size_px=np.full((T, 2), [WIDTH, HEIGHT]),
        file_name=np.array([f"{t}.png" for t in range(T)]),
        keypoint_names=BIRD.keypoint_names,
        masks=masks,
    )


def solution(**changes):
    return known().with_arrays(**changes)


@functools.cache
def known():
    """A result that is the truth."""
    return solution_of(BIRD, posed(), [*CORNER, 256]).with_arrays(
        track_id=np.array([5, 3]),
        frame_index=np.array([10, 11, 12, 14]),
        image_size_px=np.full((N, T, 2), [WIDTH, HEIGHT]),
    )


def longest_side_of_mask(mask):
    """Return the longest side of the box of a mask in pixels; NaN for an empty mask."""
    box = box_of_mask(mask)
    return float(max(box[2:])) if box else np.nan


def sides():
    """Longest side of each mask, (N, T)."""
    seen = truth()
    return np.array([[longest_side_of_mask(seen.mask(n, t)) for t in range(T)] for n in range(N)])
