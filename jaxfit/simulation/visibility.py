"""What of each bird the camera sees: whole and visible masks, boxes, hidden keypoints."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.model.bird import Bird
from jaxfit.raster.zbuffer import hard_mask, zbuffer
from jaxfit.simulation.viewpoint import Viewpoint

__all__ = ["View", "keypoints_of", "see"]

NEAR_SURFACE = 0.6
"""A keypoint this far behind its own bird's surface still counts as seen, model units (1.2 cm)."""


class View(NamedTuple):
    """One frame of N birds."""

    whole: list[Bool[np.ndarray, "H W"]]
    """Each bird as if it stood alone."""
    visible: list[Bool[np.ndarray, "H W"]]
    """What neighbours leave of it."""
    keypoints_px: Float[np.ndarray, "N K 2"]
    inside: Bool[np.ndarray, "N K"]
    """The keypoint lies in the picture."""
    seen: Bool[np.ndarray, "N K"]
    """Inside, and neither behind another bird nor behind its own."""


def keypoints_of(bird: Bird, vertices_world: Float[np.ndarray, "T N V 3"]) -> Float[np.ndarray, "T N K 3"]:
    """The keypoints of posed birds."""
    weights = np.asarray(bird.keypoint_weights, np.float64)
    return np.einsum("kv,tnvc->tnkc", weights, vertices_world, optimize=True)


def see(
    vertices_world: Float[np.ndarray, "N V 3"],
    keypoints_world: Float[np.ndarray, "N K 3"],
    faces: np.ndarray,
    view: Viewpoint,
) -> View:
    """Masks and keypoints of one frame, exact to the pixel's centre."""
    N, V = vertices_world.shape[:2]
    screen = view.to_screen(vertices_world).astype(np.float32)
    shape = (view.height, view.width)
    whole = [hard_mask(mesh, faces, view.width, view.height) for mesh in screen]
    owner, depth = np.full(shape, -1), np.full(shape, np.inf, np.float32)
    low = np.clip(np.floor(screen[..., :2].min((0, 1))).astype(int), 0, [view.width, view.height])
    high = np.clip(np.ceil(screen[..., :2].max((0, 1))).astype(int), 0, [view.width, view.height])
    columns, rows = high - low
    if columns > 0 and rows > 0:
        together = np.concatenate([faces + n * V for n in range(N)])
        fragments = zbuffer(
            (screen - np.array([*low, 0], np.float32)).reshape(-1, 3), together, int(columns), int(rows)
        )
        box = slice(low[1], high[1]), slice(low[0], high[0])
        owner[box] = np.where(fragments.face >= 0, fragments.face // len(faces), -1)
        depth[box] = fragments.depth
    points = view.to_screen(keypoints_world)
    inside = np.all((points[..., :2] >= 0) & (points[..., :2] < [view.width, view.height]), axis=-1)
    column, row = (np.clip(points[..., i].astype(int), 0, side - 1) for i, side in enumerate(shape[::-1]))
    behind = np.where(owner[row, column] == np.arange(N)[:, None], NEAR_SURFACE, 0)  # its own surface, not another's
    seen = inside & (points[..., 2] <= depth[row, column] + behind)
    return View(whole, [owner == n for n in range(N)], points[..., :2], inside, seen)
