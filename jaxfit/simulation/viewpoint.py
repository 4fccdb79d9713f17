"""The cameras of a simulated scene.

World frame: x along the ledge to the right, y from the edge to the wall, z up; the ledge is z = 0. Model units.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit.cameras.camera import Camera
from jaxfit.foundation.errors import InputError

PICTURE_WIDTH_UNITS = 125.0
"""Width of the picture at the ledge, model units. A bird is 21 units long."""
AIM_HEIGHT_UNITS = 8.0
"""Height above the ledge of the point that cameras look at, model units."""
RING_YAW_DEG, RING_PITCH_DEG = 60.0, (38.0, 62.0)
"""Cameras of a ring stand in front of the wall, up to this angle to both sides, and look down by an angle from this
range."""
DISTORTION_K1 = (-0.3, -0.15)
"""Range of the first coefficient of lens distortion: barrel distortion of usual surveillance lenses."""
SQUARE_PIXELS = 1e-6


class Viewpoint(NamedTuple):
    """A camera in the world frame. Without `lens`, a pinhole with the principal point in the middle of the picture."""

    R_cam_world: Float[np.ndarray, "3 3"]
    position_world: Float[np.ndarray, "3"]
    focal_px: float
    width: int
    height: int
    lens: Camera | None = None
    """A camera at the origin of the camera frame, with another principal point or with distortion."""

    def to_camera(self, points_world: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
        """Transform points from the world frame to the camera frame (x right, y down, z forward)."""
        return (points_world - self.position_world) @ self.R_cam_world.T

    def to_screen(self, points_world: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
        """Project points of the world frame to x, y in pixels and depth in model units."""
        cam = self.to_camera(points_world)
        depth = np.maximum(cam[..., 2:], 1e-3)
        if self.lens is not None:
            xy = self.lens.project(np.concatenate([cam[..., :2], depth], axis=-1))
            return np.concatenate([xy, cam[..., 2:]], axis=-1)
        centre = np.array([self.width / 2, self.height / 2])
        xy = self.focal_px * cam[..., :2] / depth + centre
        return np.concatenate([xy, cam[..., 2:]], axis=-1)

    def rays(self, step: int = 1) -> Float[np.ndarray, "H W 3"]:
        """Compute directions, world frame, through the centres of blocks of `step` × `step` pixels."""
        x_px, y_px = (np.arange(0, side, step) + step / 2 for side in (self.width, self.height))
        R = self.R_cam_world
        if self.lens is not None:
            return (self.lens.rays_cam(np.stack(np.meshgrid(x_px, y_px), axis=-1)) @ R).astype(np.float32)
        x, y = (x_px - self.width / 2) / self.focal_px, (y_px - self.height / 2) / self.focal_px
        return (x[:, None] * R[0] + (y[:, None] * R[1] + R[2])[:, None]).astype(np.float32)

    @property
    def crop(self) -> Float[np.ndarray, "3"]:
        """x0, y0, size of a square as a crop with this camera, pixels: the principal point is its middle. Without
        `lens`, this is the square around the whole picture."""
        side = max(self.width, self.height)
        x, y = (self.width / 2, self.height / 2) if self.lens is None else self.lens.matrix[:2, 2]
        return np.array([x - side / 2, y - side / 2, side], np.float32)

    def smaller(self, factor: int) -> Viewpoint:
        """Return the camera with pictures of fewer pixels, both sides divided by a whole number."""
        width, height, lens = self.width // factor, self.height // factor, self.lens
        if lens is not None:
            matrix = lens.matrix / factor
            lens = lens_camera(matrix, lens.distortion, (width, height))
        return self._replace(width=width, height=height, focal_px=self.focal_px / factor, lens=lens)

    def camera(self, name: str, metres_per_unit: float) -> Camera:
        """Return the calibrated camera, in metres."""
        middle = np.array([[self.focal_px, 0, self.width / 2], [0, self.focal_px, self.height / 2], [0, 0, 1]])
        matrix, distortion = (middle, np.zeros(0)) if self.lens is None else (self.lens.matrix, self.lens.distortion)
        transl_cam = -self.R_cam_world @ self.position_world * metres_per_unit
        return Camera(name, matrix, distortion, self.R_cam_world, transl_cam, (self.width, self.height))


def lens_camera(
    matrix: Float[np.ndarray, "3 3"], distortion: Float[np.ndarray, "D"], size_px: tuple[int, int]
) -> Camera:
    """Return a camera at the origin, for `Viewpoint.lens`; the last row of the matrix may have any scale."""
    matrix = np.concatenate([np.asarray(matrix)[:2], [[0, 0, 1]]])
    return Camera("lens", matrix, distortion, np.eye(3), np.zeros(3), size_px)


def viewpoint_of(camera: Camera, metres_per_unit: float) -> Viewpoint:
    """Return the viewpoint of a calibrated camera.

    Raises:
        InputError: the camera has no image size, no square pixels, or a fisheye lens, which a simulated truth cannot
            describe.
    """
    K, what = camera.matrix, f"camera {camera.name}"
    if camera.size_px is None:
        raise InputError(what, "has no image size", "add the image size to the file of the cameras")
    if camera.lens != "perspective" or abs(K[0, 0] / K[1, 1] - 1) > SQUARE_PIXELS or K[0, 1]:
        raise InputError(
            what, "has a fisheye lens, or pixels that are not square", "simulate a camera with one focal length"
        )
    position = camera.position_world / metres_per_unit
    lens = lens_camera(K, camera.distortion, camera.size_px)
    return Viewpoint(camera.R_cam_world, position, float(K[0, 0]), *camera.size_px, lens)


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
    return _looking_at_ledge(R_cam_world, rng.uniform(230, 270), width, height, depth)


def ring_viewpoints(
    rng: np.random.Generator, count: int, width: int, height: int, depth: float, distorted: bool
) -> list[Viewpoint]:
    """Draw cameras on an arc in front of the ledge, from left to right; each sees the whole ledge.

    Args:
        rng: source of randomness.
        count: number of cameras, at least 1.
        width, height: size of the pictures, pixels.
        depth: distance from the edge of the ledge to the wall, model units.
        distorted: whether the lenses have barrel distortion, and principal points beside the middle of the picture.
    """
    views = []
    for yaw in np.linspace(-RING_YAW_DEG, RING_YAW_DEG, count) if count > 1 else [0.0]:
        R = camera_axes(rng.uniform(*RING_PITCH_DEG), yaw + rng.uniform(-5, 5), rng.uniform(-3, 3))
        view = _looking_at_ledge(R, rng.uniform(230, 270), width, height, depth)
        if distorted:
            k1, x, y = rng.uniform(*DISTORTION_K1), *(0.01 * width * rng.normal(size=2))
            matrix = np.array([[view.focal_px, 0, width / 2 + x], [0, view.focal_px, height / 2 + y], [0, 0, 1]])
            view = view._replace(lens=lens_camera(matrix, np.array([k1, 0.2 * k1**2, 0, 0, 0]), (width, height)))
        views.append(view)
    return views


def _looking_at_ledge(R_cam_world: np.ndarray, distance: float, width: int, height: int, depth: float) -> Viewpoint:
    """Return a camera with this rotation that looks at the middle of the ledge from a distance in model units."""
    # a narrow picture still shows the whole depth of the ledge
    width_units = max(PICTURE_WIDTH_UNITS, 85 * width / height)
    return Viewpoint(
        R_cam_world=R_cam_world,
        position_world=np.array([0, 0.45 * depth, AIM_HEIGHT_UNITS]) - distance * R_cam_world[2],
        focal_px=width * distance / width_units,
        width=width,
        height=height,
    )
