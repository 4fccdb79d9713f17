"""Pinhole camera, and conversion between image pixels and crop pixels."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

CROP_PX = 256
"""Side of every crop in crop pixels. All pixel quantities of a fit are in this unit, whatever the silhouette's size."""


class CropCamera(NamedTuple):
    """The pinhole camera of a crop, without distortion: x right, y down, z forward; pixel centres at i + 0.5.

    The defaults are the crop camera of AVES and of Hägerlind et al. 2024: 256-pixel crops, focal length 2167 pixels.
    """

    focal_px: float = 2167.0
    centre_px: float = 128.0
    size_px: int = CROP_PX


def project(points_cam: Float[Array, "*B 3"], camera: CropCamera) -> Float[Array, "*B 2"]:
    """Project camera-space points to pixels: focal · (x, y) / z + centre.

    Args:
        points_cam: in model units, camera frame. A depth below 1e-3 is replaced by 1e-3, so a point at or behind
            the camera gives a finite pixel and a finite gradient.
        camera: focal length and centre in pixels.

    Returns:
        Crop pixels (x, y).
    """
    depth = jnp.maximum(points_cam[..., 2:], 1e-3)
    return camera.focal_px * points_cam[..., :2] / depth + camera.centre_px


def to_screen(points_cam: Float[Array, "*B 3"], camera: CropCamera) -> Float[Array, "*B 3"]:
    """Return crop pixels and depth (x_px, y_px, z_cam), the input of the raster core."""
    return jnp.concatenate([project(points_cam, camera), points_cam[..., 2:]], axis=-1)


def crop_to_image(
    points_px: Float[Array | np.ndarray, "*B 2"], crop: Float[Array | np.ndarray, "*C 3"], size_px: int = CROP_PX
) -> Float[Array | np.ndarray, "*B 2"]:
    """Convert crop pixels to image pixels: x0 + x · size / size_px.

    Args:
        points_px: crop pixels.
        crop: (x0, y0, size) in image pixels, one crop per leading index.
        size_px: side of the crop in crop pixels.
    """
    return points_px * (crop[..., None, 2:] / size_px) + crop[..., None, :2]


def image_to_crop(
    points_px: Float[Array | np.ndarray, "*B 2"], crop: Float[Array | np.ndarray, "*C 3"], size_px: int = CROP_PX
) -> Float[Array | np.ndarray, "*B 2"]:
    """Convert image pixels to crop pixels; the inverse of `crop_to_image`, with the same arguments."""
    return (points_px - crop[..., None, :2]) * (size_px / crop[..., None, 2:])
