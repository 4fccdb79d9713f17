"""Orientations from outlines: candidate orientations are matched to masks, without keypoints.

Silhouettes are those of the mean body and of random draws from the priors of pose, bones and shape. Silhouettes and
masks are brought to one centre and one area. The distance of two outlines is the mean of both truncated chamfer
distances: from each pixel of one outline to the nearest pixel of the other. So bill and tail count by the length of
their outline, not by their small area. The cost of an orientation is that of `OUTLINE_KEYPOINTS` keypoints at the
distance of the best draw.

An outline does not tell front from back: seen from far, a symmetric bird has the same outline from the direction
(x, y, z) and from (x, −y, −z), in its own axes. One of the two is seen from below, if the other is seen from above.
Cameras are held level and look level or down at most birds, and birds keep their backs up. So an orientation with a
back that does not point up or to the camera is a little more distant (`UPRIGHT`).

Source: Barrow et al. 1977, *Parametric correspondence and chamfer matching*; the draws are ours.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from jaxfit.config.fit import InitialiseConfig
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CROP_PX
from jaxfit.model.kinematics import Pose, Rig, fold_bird, joint_transforms, posed_vertices, rest_pose
from jaxfit.model.rotation import view_grid, viewing_axis_rotations

OUTLINE_KEYPOINTS = 20
"""Number of keypoints that an outline counts as."""
UPRIGHT = 2.0
"""Distance that is added for a back that points straight down in the picture, to one of its sides, or away from the
camera; in pixels of the compared pictures."""
DRAWN_PX, COMPARED_PX = 192, 48
"""Sides of the pictures in which silhouettes are drawn, and compared."""
TRUNCATED_PX = 6.0
"""Largest distance of outlines, in pixels of the compared pictures: feet that a mask lacks cost no more."""
DRAWS = 16
"""Number of bodies, the mean body among them."""
CORNERS = np.array([(4, 1, 1), (1, 4, 1), (1, 1, 4), (2, 2, 2), (3, 3, 0), (0, 3, 3), (3, 0, 3)]) / 6
"""Barycentric coordinates of the points of a face that are drawn."""


class OutlineMatch(NamedTuple):
    """Candidate orientations C and the masks of T frames."""

    known: Bool[np.ndarray, "*W T"]
    """Whether the frame has a mask."""
    distance_px: Float[np.ndarray, "*W T C"]
    """Distance of the outlines, pixels of a 256-pixel crop; 0 without a mask."""
    scale_px: Float[np.ndarray, "*W T C"]
    """Pixels of a 256-pixel crop per model unit, so that the mean body has the area of the mask; 1 without a mask."""
    middle_px: Float[np.ndarray, "*W T 2"]
    """Centre of the mask, pixels of a 256-pixel crop."""
    middle: Float[np.ndarray, "*W C 2"]
    """Centre of the silhouette of the mean body, x and y from the root joint, model units."""


class _Library(NamedTuple):
    """The silhouettes of all draws and candidates."""

    outline: UInt8[np.ndarray, "draws C P"]
    """1 on the outline."""
    distance: UInt8[np.ndarray, "draws C P"]
    """Distance from the outline, 255 at `TRUNCATED_PX`."""
    area: Float[np.ndarray, "C"]
    """Of the mean body, model units²."""
    middle: Float[np.ndarray, "C 2"]


class Bodies(NamedTuple):
    """Bodies whose silhouettes are matched, without rotation."""

    vertices: Float[np.ndarray, "draws V 3"]
    """From the root joint, model units; the mean body first."""
    faces: np.ndarray


def drawn_bodies(bird: Bird) -> Bodies:
    """Return the mean body of a model, and random bodies of its priors; always the same."""
    rng, rest = np.random.default_rng(0), rest_pose(bird)

    def drawn(mean, covariance) -> np.ndarray:
        values, axes = np.linalg.eigh(np.asarray(covariance, np.float64))
        z = rng.normal(size=(DRAWS, len(values))) * np.sqrt(np.maximum(values, 0))
        z[0] = 0
        return np.asarray(np.asarray(mean).reshape(-1) + z @ axes.T, np.float32)

    body_pose = drawn(rest.body_pose, bird.pose_covariance).reshape(DRAWS, *rest.body_pose.shape)
    bones = np.maximum(drawn(rest.bone_length, bird.bone_covariance), 0.1)
    betas = drawn(rest.betas, np.diag(bird.shape_variance))
    rig = fold_bird(bird)

    poses = (
        replace(rest, body_pose=jnp.asarray(angles), bone_length=jnp.asarray(lengths), betas=jnp.asarray(shape))
        for angles, lengths, shape in zip(body_pose, bones, betas, strict=True)
    )
    posed = [_vertices_from_root(rig, pose) for pose in poses]
    return Bodies(np.asarray(posed, np.float64), np.asarray(bird.faces, np.int64))


@eqx.filter_jit  # of the module, so that the batches of a fit compile it once
def _vertices_from_root(rig: Rig, pose: Pose) -> Float[Array, "V 3"]:
    return posed_vertices(rig, joint_transforms(rig, pose), pose) - rig.joints[0]


def match_outlines(
    masks: UInt8[np.ndarray, "T S S"], wanted: Bool[np.ndarray, "T"], bodies: Bodies, config: InitialiseConfig
) -> OutlineMatch:
    """Match every candidate orientation of a config to the masks of the wanted frames.

    Args:
        masks: crops of the masks; 1 in the bird.
        wanted: frames with a mask.
        bodies: the bodies of the model.
        config: the candidates: `initial_poses.candidate_orientations`.
    """
    views, turns = _views(config)
    library = _library(bodies.vertices.tobytes(), bodies.faces.tobytes(), views.tobytes(), config.turns)
    candidates = (turns[:, None] @ views).reshape(-1, 3, 3)
    known = wanted & (masks == 1).any((1, 2))
    T, C = len(masks), len(candidates)
    nearest, size_px, middle_px = np.zeros((T, C)), np.ones(T), np.zeros((T, 2))
    at, unit = np.flatnonzero(known), CROP_PX / masks.shape[1]
    pictures = [(masks[t] == 1).astype(np.float32) for t in at.tolist()]
    if pictures:
        area, middle = (np.array(part) for part in zip(*map(_area_and_middle, pictures), strict=True))
        size_px[at], middle_px[at] = unit * np.sqrt(area), unit * middle
        outlines = [_outline(_turned(*own, 0)) for own in zip(pictures, area, middle, strict=True)]
        outline, distance = (np.stack(part).astype(np.float32) for part in zip(*outlines, strict=True))
        nearest[at] = np.inf
        for drawn, drawn_distance in zip(library.outline, library.distance, strict=True):
            there = outline @ drawn_distance.astype(np.float32).T / outline.sum(1, keepdims=True)
            back = distance @ drawn.astype(np.float32).T / np.maximum(drawn.sum(1, dtype=np.float32), 1)
            nearest[at] = np.minimum(nearest[at], (there + back) / 2 * TRUNCATED_PX / 255)
        # the back away from the camera, down in the picture, or to a side of the picture
        back = candidates[:, :, 2]
        nearest[at] += UPRIGHT * (np.maximum(back[:, 1:], 0).sum(1) + np.abs(back[:, 0]))
    distance_px = nearest * (size_px / (COMPARED_PX / 4))[:, None]
    scale_px = np.where(known[:, None], size_px[:, None] / np.sqrt(library.area), 1.0)
    single = [np.asarray(x, np.float32) for x in (distance_px, scale_px, middle_px, library.middle)]
    return OutlineMatch(known, *single)


def _views(config: InitialiseConfig) -> tuple[Float[np.ndarray, "D 3 3"], Float[np.ndarray, "turns 3 3"]]:
    """Return the rotations model → camera of the directions, and the turns about the viewing axis."""
    views = view_grid(config.directions, 1) if config.method == "so3" else np.diag([1.0, -1.0, -1.0])[None]
    return np.ascontiguousarray(views), viewing_axis_rotations(config.turns)


@lru_cache(2)
def _library(vertices: bytes, faces: bytes, views: bytes, turns: int) -> _Library:
    """Return the silhouettes of the candidates; the arrays are given as bytes, which have a hash."""
    triangles = np.frombuffer(faces, np.int64).reshape(-1, 3)
    directions = np.frombuffer(views, np.float64).reshape(-1, 3, 3)
    shape = DRAWS, turns, len(directions)
    outline, distance = (np.zeros((*shape, COMPARED_PX**2), np.uint8) for _ in range(2))
    areas, middles = np.zeros(shape[2]), np.zeros((shape[2], 2))
    angles = 2 * np.pi * np.arange(turns) / turns
    for i, body in enumerate(np.frombuffer(vertices, np.float64).reshape(DRAWS, -1, 3)):
        points = (CORNERS @ body[triangles]).reshape(-1, 3)
        radius = 1.05 * np.linalg.norm(points, axis=1).max()
        pixel = 2 * radius / DRAWN_PX
        for d, R in enumerate(directions):
            column, row = ((points @ R[:2].T + radius) / pixel).astype(int).T
            hit = np.bincount(row * DRAWN_PX + column, minlength=DRAWN_PX**2).reshape(DRAWN_PX, DRAWN_PX) > 0
            closed = cv2.morphologyEx(hit.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
            picture = closed.astype(np.float32)
            area, middle = _area_and_middle(picture)
            for j, angle in enumerate(angles):
                outline[i, j, d], distance[i, j, d] = _outline(_turned(picture, area, middle, angle))
            if i == 0:
                areas[d], middles[d] = area * pixel**2, middle * pixel - radius
    turned = np.stack([middles @ R[:2, :2].T for R in viewing_axis_rotations(turns)])
    flat = DRAWS, -1, COMPARED_PX**2
    return _Library(outline.reshape(flat), distance.reshape(flat), np.tile(areas, turns), turned.reshape(-1, 2))


def _area_and_middle(picture: Float[np.ndarray, "S S"]) -> tuple[float, Float[np.ndarray, "2"]]:
    """Return the area and the centre of a silhouette in pixels."""
    moments = cv2.moments(picture)
    middle = np.array([moments["m10"], moments["m01"]]) / moments["m00"] + 0.5  # pixel centres at i + 0.5
    return moments["m00"], middle


def _turned(picture: Float[np.ndarray, "S S"], area: float, middle: np.ndarray, angle: float) -> np.ndarray:
    """Return a silhouette turned about its centre, in the middle of a compared picture and with a common area."""
    zoom = COMPARED_PX / 4 / np.sqrt(area)
    c, s = zoom * np.cos(angle), zoom * np.sin(angle)
    linear = np.array([[c, -s], [s, c]])
    shift = COMPARED_PX / 2 - 0.5 - linear @ (middle - 0.5)
    matrix = np.concatenate([linear, shift[:, None]], axis=1)
    if zoom < 0.5:  # bilinear samples would skip pixels
        picture = cv2.blur(picture, (round(1 / zoom),) * 2)
    return cv2.warpAffine(picture, matrix, (COMPARED_PX, COMPARED_PX)) > 0.5


def _outline(inside: Bool[np.ndarray, "S S"]) -> tuple[UInt8[np.ndarray, "P"], UInt8[np.ndarray, "P"]]:
    """Return the outline of a silhouette, and the truncated distance from the outline: 255 at `TRUNCATED_PX`."""
    filled = inside.astype(np.uint8)
    outline = filled - cv2.erode(filled, np.ones((3, 3), np.uint8))
    distance = np.minimum(cv2.distanceTransform(1 - outline, cv2.DIST_L2, 3) / TRUNCATED_PX, 1)
    return outline.ravel(), (255 * distance).astype(np.uint8).ravel()
