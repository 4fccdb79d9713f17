"""Visibility of birds in the camera: amodal masks, visible masks, occluded keypoints."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.model.bird import Bird
from jaxfit.raster.zbuffer import hard_mask, zbuffer
from jaxfit.simulation.viewpoint import Viewpoint

__all__ = ["Visibility", "mesh_keypoints", "render_visibility"]

SURFACE_TOLERANCE = 0.6
"""A keypoint is visible up to this depth behind the surface of its own bird, model units (1.2 cm)."""


class Visibility(NamedTuple):
    """Masks and keypoints of N birds in one frame."""

    amodal_masks: list[Bool[np.ndarray, "H W"]]
    """The whole mask of each bird, without occlusion."""
    visible_masks: list[Bool[np.ndarray, "H W"]]
    """The part of each mask that is not occluded by other birds."""
    keypoints_px: Float[np.ndarray, "N K 2"]
    inside: Bool[np.ndarray, "N K"]
    """Whether a keypoint lies in the picture."""
    keypoint_visible: Bool[np.ndarray, "N K"]
    """Whether a keypoint lies in the picture and is not occluded by another bird or by its own bird."""


def mesh_keypoints(bird: Bird, vertices_world: Float[np.ndarray, "T N V 3"]) -> Float[np.ndarray, "T N K 3"]:
    """Compute the keypoints of posed birds, world frame."""
    weights = np.asarray(bird.keypoint_weights, np.float64)
    return np.einsum("kv,tnvc->tnkc", weights, vertices_world, optimize=True)


def render_visibility(
    vertices_world: Float[np.ndarray, "N V 3"],
    keypoints_world: Float[np.ndarray, "N K 3"],
    faces: np.ndarray,
    view: Viewpoint,
) -> Visibility:
    """Render the masks of one frame and project the keypoints; masks are exact at pixel centres.

    Args:
        vertices_world: vertices of the birds, model units.
        keypoints_world: keypoints of the birds, model units.
        faces: (F, 3) faces of one bird.
        view: the camera.
    """
    N, V = vertices_world.shape[:2]
    screen = view.to_screen(vertices_world).astype(np.float32)
    shape = (view.height, view.width)
    amodal_masks = [hard_mask(mesh, faces, view.width, view.height) for mesh in screen]
    owner, depth = np.full(shape, -1), np.full(shape, np.inf, np.float32)
    low = np.clip(np.floor(screen[..., :2].min((0, 1))).astype(int), 0, [view.width, view.height])
    high = np.clip(np.ceil(screen[..., :2].max((0, 1))).astype(int), 0, [view.width, view.height])
    columns, rows = high - low
    if columns > 0 and rows > 0:
        all_faces = np.concatenate([faces + n * V for n in range(N)])
        fragments = zbuffer(
            (screen - np.array([*low, 0], np.float32)).reshape(-1, 3), all_faces, int(columns), int(rows)
        )
        box = slice(low[1], high[1]), slice(low[0], high[0])
        owner[box] = np.where(fragments.face >= 0, fragments.face // len(faces), -1)
        depth[box] = fragments.depth
    points = view.to_screen(keypoints_world)
    inside = np.all((points[..., :2] >= 0) & (points[..., :2] < [view.width, view.height]), axis=-1)
    column, row = (np.clip(points[..., i].astype(int), 0, side - 1) for i, side in enumerate(shape[::-1]))
    tolerance = np.where(owner[row, column] == np.arange(N)[:, None], SURFACE_TOLERANCE, 0)  # only for the own surface
    visible = inside & (points[..., 2] <= depth[row, column] + tolerance)
    return Visibility(amodal_masks, [owner == n for n in range(N)], points[..., :2], inside, visible)
