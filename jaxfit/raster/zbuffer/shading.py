"""Normals and lit colours of the vertices of a mesh."""

import math

import numpy as np
from jaxtyping import Array, Float, Float32, Int

__all__ = ["shade", "vertex_normals"]

LIGHT = (-0.4, -0.8, -0.6)
"""Direction from the scene to the light, in the camera frame (x right, y down, z forward). The light is above, left of
the scene and on the side of the camera."""


def vertex_normals(
    vertices: Float[Array | np.ndarray, "*B V 3"], faces: Int[Array | np.ndarray, "F 3"]
) -> Float32[np.ndarray, "*B V 3"]:
    """Return unit normals of the vertices: the normalised sum of the face normals, weighted by the face areas.

    The normals point outwards if the faces turn counter-clockwise seen from outside, in right-handed axes such as those
    of the camera frame. A vertex without faces, or only with faces of area 0, has the normal 0.

    Args:
        vertices: in any unit and frame.
        faces: vertex indices.

    Raises:
        ValueError: the shape of an argument is not as described.
    """
    vertices, faces = _checked(vertices, faces)
    corners = vertices[..., faces, :]
    doubled = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
    batch, count = vertices.shape[:-2], vertices.shape[-2]
    flat = doubled.reshape(math.prod(batch), len(faces), 3)
    sums = np.zeros((len(flat), count, 3))
    for b, normals in enumerate(flat):
        for axis in range(3):
            sums[b, :, axis] = np.bincount(faces.ravel(), np.repeat(normals[:, axis], 3), minlength=count)
    length = np.linalg.norm(sums, axis=-1, keepdims=True)
    unit = sums / np.where(length > 0, length, 1)
    return unit.reshape(*batch, count, 3).astype(np.float32)


def shade(
    vertices: Float[Array | np.ndarray, "V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    colours: Float[Array | np.ndarray, "V 3"],
    light: tuple[float, float, float] = LIGHT,
    ambient: float = 0.45,
) -> Float32[np.ndarray, "V 3"]:
    """Return colours under a sky and a distant light: colour · (a · (3 − n_y)/4 + (1 − a) · ((1 + n · l)/2)²).

    The sky is bright above (−y) and half as bright below. The light wraps around the bird, so that no part is black.
    If the volume of the mesh is negative, its faces turn inwards, and the normals are reversed.

    Args:
        vertices: camera frame, any unit.
        faces: vertex indices.
        colours: colours of the unlit vertices, in [0, 1].
        light: l, the direction from the bird to the light, in the camera frame, of any length but 0.
        ambient: a, the fraction of the light that comes from the sky, 0 to 1.

    Returns:
        Colours, clipped to [0, 1], for `jaxfit.raster.zbuffer.draw`.

    Raises:
        ValueError: the shape or value of an argument is not as described.
    """
    vertices, faces = _checked(vertices, faces)
    colours = np.asarray(colours)
    if vertices.ndim != 2 or colours.shape != vertices.shape:
        raise ValueError(f"colours: expected the shape of vertices, {vertices.shape}, (V, 3), got {colours.shape}")
    towards = np.asarray(light, np.float64)
    if towards.shape != (3,) or not np.isfinite(towards).all() or not towards.any():
        raise ValueError(f"light: expected a finite direction (3,) other than 0, got {light!r}")
    if not 0 <= ambient <= 1:
        raise ValueError(f"ambient: expected a fraction in [0, 1], got {ambient!r}")
    corners = (vertices - vertices.mean(0))[faces]
    volume = np.sum(np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2])
    normals = vertex_normals(vertices, faces) * (-1 if volume < 0 else 1)
    sky = (3 - normals[:, 1:2]) / 4
    sun = ((1 + normals @ (towards / np.linalg.norm(towards)))[:, None] / 2) ** 2
    return np.clip(colours * (ambient * sky + (1 - ambient) * sun), 0, 1).astype(np.float32)


def _checked(vertices, faces) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    if vertices.ndim < 2 or vertices.shape[-1] != 3:
        raise ValueError(f"vertices: expected shape (…, V, 3), got {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces: expected shape (F, 3), got {faces.shape}")
    return vertices, faces
