"""`Camera`: a calibrated camera with its lens and its pose in the world."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import cv2
import numpy as np
from jaxtyping import Bool, Float

MAX_IMAGE_SIDE_PX = 16_384
"""Longest side of an image. The run lengths of larger masks overflow the buffers of pycocotools."""
Lens = Literal["perspective", "fisheye"]
"""Models of lens distortion, as OpenCV defines them (`cv2.projectPoints`, `cv2.fisheye.projectPoints`)."""

_COEFFICIENTS: dict[str, tuple[int, ...]] = {"perspective": (0, 4, 5, 8, 12, 14), "fisheye": (0, 4)}
_ROTATION_TOLERANCE = 1e-3
"""Largest deviation of RᵀR from the identity: the digits of a text file, not another matrix."""
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
_ROUND_TRIP_PX = 0.01
_MAX_PX = 1e7
"""Largest focal length and largest position of the principal point."""
_MAX_NUMBER = 1e12
"""Largest coordinate and coefficient; a sum with the square of a larger number loses small numbers."""


def _undistort_points(points: np.ndarray, K: np.ndarray, distortion: np.ndarray, *more: Any) -> np.ndarray:
    """Call the function of this version of OpenCV that takes a stop criterion: version 4 has a separate one."""
    older = getattr(cv2, "undistortPointsIter", None)
    if older is not None:
        _, R, P, criteria = more
        return older(points, K, distortion, R, P, criteria)
    return cv2.undistortPoints(points, K, distortion, *more)


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera: x_cam = R_cam_world · x_world + transl_cam, then the lens, then the intrinsic matrix.

    Camera frame: x right, y down, z forward. Pixel centres are at i + 0.5, so a principal point of OpenCV, whose pixel
    centres are at whole numbers, is larger by 0.5 here. Lengths are in metres.

    Raises:
        ValueError: a value is not finite, has another shape, or is not possible; the message names the field.
    """

    name: str
    """Name of the camera; a set of cameras has each name once."""
    matrix: Float[np.ndarray, "3 3"]
    """Intrinsic matrix: focal lengths and principal point in pixels, and skew."""
    distortion: Float[np.ndarray, "D"]
    """Coefficients of the lens in OpenCV's order: k1, k2, p1, p2, k3, … (4, 5, 8, 12 or 14), for a fisheye k1 to k4;
    empty without distortion."""
    R_cam_world: Float[np.ndarray, "3 3"]
    """Rotation world → camera."""
    transl_cam: Float[np.ndarray, "3"]
    """Origin of the world in the camera frame, metres."""
    size_px: tuple[int, int] | None = None
    """Width and height of the image; None if the file of the camera does not contain the size."""
    lens: Lens = "perspective"

    def __post_init__(self):
        if not self.name:
            raise ValueError("name must not be empty")
        if self.lens not in get_args(Lens):
            raise ValueError(f"lens must be one of {', '.join(get_args(Lens))}, not {self.lens!r}")
        shapes = {"matrix": (3, 3), "distortion": (-1,), "R_cam_world": (3, 3), "transl_cam": (3,)}
        for name, shape in shapes.items():
            try:
                value = np.array(getattr(self, name), np.float64).reshape(shape)
            except ValueError:
                raise ValueError(f"{name} must have the shape {shape}, not {np.shape(getattr(self, name))}") from None
            if not np.isfinite(value).all():
                raise ValueError(f"{name} must be finite")
            limit = _MAX_PX if name == "matrix" else _MAX_NUMBER
            if np.abs(value).max(initial=0) > limit:
                raise ValueError(f"{name} holds {np.abs(value).max():g}, more than {limit:g}")
            object.__setattr__(self, name, value)
        if len(self.distortion) not in _COEFFICIENTS[self.lens]:
            allowed = ", ".join(map(str, _COEFFICIENTS[self.lens]))
            raise ValueError(
                f"distortion of a {self.lens} lens must have {allowed} coefficients, not {len(self.distortion)}"
            )
        K, R = self.matrix, self.R_cam_world
        if K[0, 0] <= 0 or K[1, 1] <= 0 or K[1, 0] or K[2].tolist() != [0, 0, 1]:
            raise ValueError("matrix must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with focal lengths above 0")
        if np.abs(R.T @ R - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(R) < 0:
            raise ValueError("R_cam_world must be a rotation: orthogonal, with determinant 1")
        U, _, V = np.linalg.svd(R)
        object.__setattr__(self, "R_cam_world", U @ V)  # removes the rounding of a text file
        if self.size_px is not None:
            width, height = (int(side) for side in self.size_px)
            if not (1 <= width <= MAX_IMAGE_SIDE_PX and 1 <= height <= MAX_IMAGE_SIDE_PX):
                raise ValueError(f"size_px must be in 1…{MAX_IMAGE_SIDE_PX}, not {width}×{height}")
            object.__setattr__(self, "size_px", (width, height))
        for name in shapes:
            getattr(self, name).flags.writeable = False

    @property
    def position_world(self) -> Float[np.ndarray, "3"]:
        """Optical centre in the world, metres."""
        return -self.R_cam_world.T @ self.transl_cam

    @property
    def field_of_view_deg(self) -> tuple[float, float] | None:
        """Angles of view of the image's width and height, through its centre, degrees; None without an image size."""
        if self.size_px is None:
            return None
        width, height = self.size_px
        ends = np.array([[0, height / 2], [width, height / 2], [width / 2, 0], [width / 2, height]])
        rays = self.rays_cam(ends)
        cosines = np.einsum("ic,ic->i", rays[::2], rays[1::2])
        across, down = np.degrees(np.arccos(np.clip(cosines, -1, 1))).tolist()
        return across, down

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens has no distortion."""
        return self.lens == "perspective" and not self.distortion.any()

    def pinhole(self) -> Camera:
        """Return the camera without its distortion. Its pixels are those of `undistort`."""
        return replace(self, distortion=np.zeros(0), lens="perspective")

    def moved(self, R_new_world: Float[np.ndarray, "3 3"], transl_new: Float[np.ndarray, "3"]) -> Camera:
        """Return the camera in another world frame, with x_new = R_new_world · x_world + transl_new."""
        R = self.R_cam_world @ np.asarray(R_new_world).T
        return replace(self, R_cam_world=R, transl_cam=self.transl_cam - R @ transl_new)

    def scaled(self, factor: float) -> Camera:
        """Return the camera in a world whose lengths are multiplied by a factor, for a change of unit."""
        if not (factor > 0 and math.isfinite(factor)):
            raise ValueError(f"factor must be above 0 and finite, not {factor}")
        return replace(self, transl_cam=self.transl_cam * factor)

    def to_camera(self, points_world: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
        """Transform points from the world frame to the camera frame, metres."""
        return np.asarray(points_world) @ self.R_cam_world.T + self.transl_cam

    def to_world(self, points_cam: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
        """Transform points from the camera frame to the world frame, metres."""
        return (np.asarray(points_cam) - self.transl_cam) @ self.R_cam_world

    def project(self, points_world: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 2"]:
        """Project points of the world, metres, to pixels of the image; NaN for points behind the camera."""
        points_cam = np.asarray(self.to_camera(points_world))
        depth = np.asarray(points_cam[..., 2:])
        ahead: np.ndarray = np.greater(depth, 0)
        xy = np.where(ahead, points_cam[..., :2] / np.where(ahead, depth, 1), np.nan)
        return self._to_px(self._distorted(xy))

    def distort(self, points_px: Float[np.ndarray, "*B 2"]) -> Float[np.ndarray, "*B 2"]:
        """Convert pixels of `pinhole` to pixels of the image."""
        return self._to_px(self._distorted(self._to_plane(points_px)))

    def undistort(self, points_px: Float[np.ndarray, "*B 2"]) -> Float[np.ndarray, "*B 2"]:
        """Convert pixels of the image to pixels of `pinhole`. NaN where the lens model has no inverse."""
        points_px = np.asarray(points_px, np.float64)
        if self.is_pinhole:
            return points_px.copy()
        plane = self._to_plane(points_px).reshape(-1, 1, 2)
        known = np.isfinite(plane[:, 0]).all(-1)
        straight = np.full_like(plane, np.nan)
        if known.any():
            undistort = cv2.fisheye.undistortPoints if self.lens == "fisheye" else _undistort_points
            with np.errstate(all="ignore"):
                straight[known] = undistort(plane[known], np.eye(3), self._coefficients, None, None, None, _CRITERIA)
        straight = straight.reshape(points_px.shape)
        error_px = np.abs(self._to_px(self._distorted(straight)) - points_px).max(-1, keepdims=True)
        return np.where(error_px < _ROUND_TRIP_PX, self._to_px(straight), np.nan)

    def rays_cam(self, points_px: Float[np.ndarray, "*B 2"]) -> Float[np.ndarray, "*B 3"]:
        """Return the unit vectors in the camera frame that pixels of the image show."""
        plane = self._to_plane(self.undistort(points_px))
        rays = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def inside(self, points_px: Float[np.ndarray, "*B 2"]) -> Bool[np.ndarray, "*B"]:
        """Return whether points lie in the image; without an image size, whether the points are finite."""
        upper = (np.inf, np.inf) if self.size_px is None else self.size_px
        within = np.isfinite(points_px) & (points_px >= 0) & (points_px < np.array(upper))
        return np.asarray(within.all(-1))

    @property
    def _coefficients(self) -> np.ndarray:
        return self.distortion if len(self.distortion) else np.zeros(4)

    def _to_plane(self, points_px: np.ndarray) -> np.ndarray:
        """Return points of the plane z = 1 of the camera frame, still with distortion."""
        xy = np.asarray(points_px, np.float64) - self.matrix[:2, 2]
        y = xy[..., 1] / self.matrix[1, 1]
        return np.stack([(xy[..., 0] - self.matrix[0, 1] * y) / self.matrix[0, 0], y], axis=-1)

    def _to_px(self, plane: np.ndarray) -> np.ndarray:
        return plane @ self.matrix[:2, :2].T + self.matrix[:2, 2]

    def _distorted(self, plane: np.ndarray) -> np.ndarray:
        if self.is_pinhole:
            return plane
        points = np.asarray(plane, np.float64).reshape(-1, 2)
        known = np.isfinite(points).all(-1)
        moved = np.full_like(points, np.nan)
        if known.any():
            nothing, identity = np.zeros(3), np.eye(3)
            if self.lens == "fisheye":
                moved[known] = cv2.fisheye.distortPoints(points[known][:, None], identity, self._coefficients)[:, 0]
            else:
                ahead = np.concatenate([points[known], np.ones((known.sum(), 1))], axis=1)
                moved[known] = cv2.projectPoints(ahead, nothing, nothing, identity, self._coefficients)[0][:, 0]
        return moved.reshape(plane.shape)
