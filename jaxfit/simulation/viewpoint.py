"""Where the camera of a simulated scene stands, and the way from the ledge to its pixels.

World frame: x along the ledge to the right, y from its edge towards the wall, z up; the ledge is z = 0. Model units.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

__all__ = ["UNITS_ACROSS", "Viewpoint", "camera_axes", "look_down"]

UNITS_ACROSS = 125.0
"""Model units across the picture at the ledge: a bird of 21 units is then a seventh of the width long."""


class Viewpoint(NamedTuple):
    """A pinhole camera in the world, its principal point in the middle of the picture."""

    R_cam_world: Float[np.ndarray, "3 3"]
    position_world: Float[np.ndarray, "3"]
    focal_px: float
    width: int
    height: int

    def to_camera(self, points_world: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
        """World → camera frame (x right, y down, z forward)."""
        return (points_world - self.position_world) @ self.R_cam_world.T

    def to_screen(self, points_world: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
        """World → x, y in pixels and depth in model units."""
        cam = self.to_camera(points_world)
        centre = np.array([self.width / 2, self.height / 2])
        xy = self.focal_px * cam[..., :2] / np.maximum(cam[..., 2:], 1e-3) + centre
        return np.concatenate([xy, cam[..., 2:]], axis=-1)

    def rays(self, step: int = 1) -> Float[np.ndarray, "H W 3"]:
        """Directions in the world frame through the centres of pixels, of every `step`-th row and column."""
        x = (np.arange(0, self.width, step) + step / 2 - self.width / 2) / self.focal_px
        y = (np.arange(0, self.height, step) + step / 2 - self.height / 2) / self.focal_px
        R = self.R_cam_world
        return (x[:, None] * R[0] + (y[:, None] * R[1] + R[2])[:, None]).astype(np.float32)

    @property
    def crop(self) -> Float[np.ndarray, "3"]:
        """x0, y0, size of the square around the whole picture: as a crop, its camera is this one."""
        side = max(self.width, self.height)
        return np.array([(self.width - side) / 2, (self.height - side) / 2, side], np.float32)


def camera_axes(pitch_deg: float, yaw_deg: float, roll_deg: float) -> Float[np.ndarray, "3 3"]:
    """Right, down and forward of a camera in the world, as rows: R_cam_world.

    Args:
        pitch_deg: how far it looks below the horizontal.
        yaw_deg: how far it looks to the right of the wall's normal.
        roll_deg: how far it is turned about its viewing axis.
    """
    pitch, yaw, roll = np.radians([pitch_deg, yaw_deg, roll_deg])
    forward = np.array([np.cos(pitch) * np.sin(yaw), np.cos(pitch) * np.cos(yaw), -np.sin(pitch)])
    right = np.array([np.cos(yaw), -np.sin(yaw), 0])
    down = np.cross(forward, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    return np.array([right, down, forward])


def look_down(rng: np.random.Generator, width: int, height: int, depth: float) -> Viewpoint:
    """A camera above a ledge, as over an instrumented cliff: 62° to 74° below the horizontal, 5 m away.

    Args:
        rng: source of randomness.
        width, height: of the picture, pixels.
        depth: of the ledge from edge to wall, model units.
    """
    R_cam_world = camera_axes(rng.uniform(62, 74), rng.uniform(-10, 10), rng.uniform(-3, 3))
    distance = rng.uniform(230, 270)
    # a narrow picture sees as much of the ledge from front to back as a wide one from side to side
    across = max(UNITS_ACROSS, 85 * width / height)
    return Viewpoint(
        R_cam_world=R_cam_world,
        position_world=np.array([0, 0.45 * depth, 8]) - distance * R_cam_world[2],
        focal_px=width * distance / across,
        width=width,
        height=height,
    )
