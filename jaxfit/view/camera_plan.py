"""A plan of calibrated cameras: positions and fields of view, from above and from the side."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.cameras.camera import Camera
from jaxfit.view.colours import GREY, INK, PAPER, track_colour
from jaxfit.view.drawing import dot, line, tag, text
from jaxfit.view.report.axis import round_step

PANEL_PX, MARGIN_PX, TITLE_PX = 720, 70, 46
EDGE_POINTS = 12
"""Points on each edge of an image, so that the distortion of a lens is visible."""
MIN_DEPTH = 0.1
"""Length of the drawn fields of view, at least this share of the largest distance between cameras."""
PANELS = (("from above", 0, 1, "x", "y"), ("from the side", 0, 2, "x", "z"))


def camera_plan(cameras: Sequence[Camera]) -> UInt8[np.ndarray, "H W 3"]:
    """Draw cameras in the world: a plan from above (x, y) and from the side (x, z), with a grid in metres.

    A field of view ends at the distance of the point that is closest to all viewing axes. Cameras without an image size
    have a viewing axis only.
    """
    depth = _view_depth(cameras)
    outlines = [_field_of_view(camera, depth) for camera in cameras]
    picture = np.full((PANEL_PX + TITLE_PX, 2 * PANEL_PX, 3), PAPER, np.uint8)
    everything = np.concatenate([*outlines, np.stack([camera.position_world for camera in cameras])])
    low, high = everything.min(axis=0), everything.max(axis=0)
    centre, extent = (low + high) / 2, max(float((high - low).max()), 1e-3)
    scale = (PANEL_PX - 2 * MARGIN_PX) / extent
    for i, (title, across, up, across_name, up_name) in enumerate(PANELS):
        panel = picture[:, i * PANEL_PX : (i + 1) * PANEL_PX]
        axes = [across, up]

        def to_px(points: np.ndarray, axes: list[int] = axes) -> np.ndarray:
            xy = (np.asarray(points)[..., axes] - centre[axes]) * scale
            return xy * [1, -1] + [PANEL_PX / 2, TITLE_PX + PANEL_PX / 2]

        step = _grid(panel, centre[axes], extent, scale)
        text(panel, f"{title}: {across_name} to the right, {up_name} up; grid {step:g} m", 16, TITLE_PX / 2, 20)
        for n, (camera, outline) in enumerate(zip(cameras, outlines, strict=True)):
            position, colour = to_px(camera.position_world), track_colour(n)
            corners = to_px(outline)
            for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                line(panel, a, b, colour, 2)
            for corner in corners[::EDGE_POINTS]:
                line(panel, position, corner, colour)
            dot(panel, position, 6, colour)
            tag(panel, camera.name, position[0] + 10, position[1] - 14, 15, colour)
    picture[:, PANEL_PX - 1] = GREY
    return picture


def _view_depth(cameras: Sequence[Camera]) -> float:
    """Return the mean distance of the cameras from the point that is closest to their viewing axes, metres."""
    axes = np.stack([camera.R_cam_world[2] for camera in cameras])
    positions = np.stack([camera.position_world for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    point = np.linalg.lstsq(across.sum(axis=0), np.einsum("vij,vj->i", across, positions), rcond=None)[0]
    depths = np.einsum("vi,vi->v", point - positions, axes)
    farthest = np.linalg.norm(positions[:, None] - positions, axis=-1).max()
    least = MIN_DEPTH * farthest if farthest > 0 else 1.0
    return max(float(np.median(depths)), least)


def _field_of_view(camera: Camera, depth: float) -> Float[np.ndarray, "P 3"]:
    """Return the outline of the image at a depth in the world, metres; the end of the axis without an image size."""
    if camera.size_px is None:
        return camera.position_world + depth * camera.R_cam_world[2:]
    width, height = camera.size_px
    along = np.arange(EDGE_POINTS) / EDGE_POINTS
    zero, one = np.zeros(EDGE_POINTS), np.ones(EDGE_POINTS)
    x, y = np.concatenate([along, one, 1 - along, zero]), np.concatenate([zero, along, one, 1 - along])
    rays = camera.rays_cam(np.stack([x * width, y * height], axis=1))
    points = rays / np.maximum(rays[:, 2:], 0.05) * depth
    points = points[np.isfinite(points).all(axis=1)]  # corners that the lens model cannot show
    return camera.position_world + points @ camera.R_cam_world


def _grid(panel: UInt8[np.ndarray, "H W 3"], centre: np.ndarray, extent: float, scale: float) -> float:
    """Draw a grid of round coordinates with its labels, and return its step in metres."""
    step, reach = round_step(extent / 8), PANEL_PX / 2 / scale
    for axis in (0, 1):
        first = math.ceil((centre[axis] - reach) / step)
        for i in range(first, math.floor((centre[axis] + reach) / step) + 1):
            at = (i * step - centre[axis]) * scale
            x = PANEL_PX / 2 + at
            y = TITLE_PX + PANEL_PX / 2 - at
            a, b = ((x, TITLE_PX), (x, TITLE_PX + PANEL_PX)) if axis == 0 else ((0, y), (PANEL_PX, y))
            line(panel, a, b, (225, 225, 225))
            where = (x + 3, TITLE_PX + PANEL_PX - 12) if axis == 0 else (4, y - 9)
            text(panel, f"{i * step:g}", *where, 13, INK)
    return step
