"""Birds that are discs, with keypoint errors and outline errors from known distributions."""

import dataclasses

import numpy as np

from jaxfit.config.fit import load_config
from jaxfit.data.masks import encode_mask
from jaxfit.data.observations import Observations

BIRDS, RADIUS, SIDES = 6, 60, 7
NAMES = tuple(f"{side}_point{i}" for i in range(SIDES) for side in ("left", "right")) + tuple("abcdef")
K = len(NAMES)
IMAGE_PX = (400, 600)
"""Height and width."""
CROP = np.ceil(2 * RADIUS * (1 + 2 * load_config("map").crop.padding))
"""Side of every crop in image pixels: all boxes have one size."""
UNIT = CROP / 256
"""Image pixels of a crop pixel."""


def disc(n, radius):
    """Return the mask of a bird, with a radius that is a number or a function of the angle."""
    rows, columns = np.mgrid[: IMAGE_PX[0], : IMAGE_PX[1]] + 0.5
    x, y = columns - centre(n)[0], rows - centre(n)[1]
    return encode_mask(np.hypot(x, y) < (radius(np.arctan2(y, x)) if callable(radius) else radius))


def centre(n):
    return np.array([100 + 200 * (n % 3), 100 + 200 * (n // 3)])


def labelled(frames, radius=RADIUS, masks=True):
    """Return exact labels of all birds in some frames; the keypoints lie on a ring inside the disc."""
    T = len(frames)
    angle = 2 * np.pi * np.arange(K) / K
    ring = 40 * np.stack([np.cos(angle), np.sin(angle)], -1)
    centres = np.array([centre(n) for n in range(BIRDS)], float)
    box = np.broadcast_to(
        np.concatenate([centres - RADIUS, np.full((BIRDS, 2), 2 * RADIUS)], 1)[:, None], (BIRDS, T, 4)
    )
    rles = [disc(n, radius) for n in range(BIRDS)] if masks else []
    return Observations(
        track_id=np.arange(BIRDS) + 3,
        frame_index=np.asarray(frames),
        present=np.ones((BIRDS, T), bool),
        keypoints_px=np.broadcast_to((centres[:, None] + ring)[:, None], (BIRDS, T, K, 2)),
        confidence=np.ones((BIRDS, T, K)),
        box_px=box,
        image_size_px=np.full((T, 2), IMAGE_PX[::-1]),
        file_name=np.array([f"{frame}.png" for frame in frames]),
        keypoint_names=NAMES,
        masks={(n, t): rle for n, rle in enumerate(rles) for t in range(T)},
    )


def student_t(rng, shape, dof):
    """Return draws of a bivariate Student t: a normal vector divided by one root of chi² / ν."""
    return rng.normal(size=(*shape, 2)) * np.sqrt(dof / rng.chisquare(dof, shape))[..., None]


def detected(frames, error_px, confidence, radius=RADIUS, masks=True):
    """Return the exact birds with errors in crop pixels; tracks have other numbers than the labels."""
    exact = labelled(frames, radius, masks)
    moved = exact.with_keypoints(exact.keypoints_px + error_px * UNIT, confidence)
    return dataclasses.replace(moved, track_id=np.arange(BIRDS) + 30)
