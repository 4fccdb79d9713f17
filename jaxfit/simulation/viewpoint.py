"""The camera of a simulated scene.

World frame: x along the ledge to the right, y from the edge to the wall, z up; the ledge is z = 0. Model units.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

PICTURE_WIDTH_UNITS = 125.0
"""Width of the picture at the ledge, model units. A bird is 21 units long."""


class Viewpoint(NamedTuple):
    """A pinhole camera in the world frame, with the principal point in the middle of the picture."""

    R_cam_world: Float[np.ndarray, "3 3"]
    position_world: Float[np.ndarray, "3"]
    focal_px: float
    width: int
    height: int

    def to_camera(self, points_world: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
        """Transform points from the world frame to the camera frame (x right, y down, z forward)."""
        return (points_world - self.position_world) @ self.R_cam_world.T

    def to_screen(self, points_world: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
        """Project points of the world frame to x, y in pixels and depth in model units."""
        cam = self.to_camera(points_world)
        centre = np.array([self.width / 2, self.height / 2])
        xy = self.focal_px * cam[..., :2] / np.maximum(cam[..., 2:], 1e-3) + centre
        return np.concatenate([xy, cam[..., 2:]], axis=-1)

    def rays(self, step: int = 1) -> Float[np.ndarray, "H W 3"]:
        """Compute directions, world frame, through the centres of blocks of `step` × `step` pixels."""
        x = (np.arange(0, self.width, step) + step / 2 - self.width / 2) / self.focal_px
        y = (np.arange(0, self.height, step) + step / 2 - self.height / 2) / self.focal_px
        R = self.R_cam_world
        return (x[:, None] * R[0] + (y[:, None] * R[1] + R[2])[:, None]).astype(np.float32)

    @property
    def crop(self) -> Float[np.ndarray, "3"]:
        """x0, y0, size of the square around the whole picture, as a crop with this camera, pixels."""
        side = max(self.width, self.height)
        return np.array([(self.width - side) / 2, (self.height - side) / 2, side], np.float32)


def camera_axes(pitch_deg: float, yaw_deg: float, roll_deg: float) -> Float[np.ndarray, "3 3"]:
    """Compute the rotation R_cam_world, whose rows are right, down and forward of the camera in the world frame.

    Args:
        pitch_deg: angle of the viewing axis below the horizontal.
        yaw_deg: angle of the viewing axis to the right of the wall's normal.
        roll_deg: rotation about the viewing axis.
    """
    pitch, yaw, roll = np.radians([pitch_deg, yaw_deg, roll_deg])
    forward = np.array([np.cos(pitch) * np.sin(yaw), np.cos(pitch) * np.cos(yaw), -np.sin(pitch)])
    right = np.array([np.cos(yaw), -np.sin(yaw), 0])
    down = np.cross(forward, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    return np.array([right, down, forward])


def random_viewpoint(rng: np.random.Generator, width: int, height: int, depth: float) -> Viewpoint:
    """Draw a camera above the ledge, as at an instrumented cliff: pitch 62° to 74°, distance about 5 m.

    Args:
        rng: source of randomness.
        width, height: size of the picture, pixels.
        depth: distance from the edge of the ledge to the wall, model units.
    """
    R_cam_world = camera_axes(rng.uniform(62, 74), rng.uniform(-10, 10), rng.uniform(-3, 3))
    distance = rng.uniform(230, 270)
    # a narrow picture still shows the whole depth of the ledge
    width_units = max(PICTURE_WIDTH_UNITS, 85 * width / height)
    return Viewpoint(
        R_cam_world=R_cam_world,
        position_world=np.array([0, 0.45 * depth, 8]) - distance * R_cam_world[2],
        focal_px=width * distance / width_units,
        width=width,
        height=height,
    )
