"""Closest points on triangle meshes, and the faces that are visible from outside."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxfit.model.rotation import view_grid
from jaxfit.raster.zbuffer import zbuffer

__all__ = [
    "Closest",
    "Samples",
    "boundary_faces",
    "closest_points",
    "sample_surface",
    "search_samples",
    "visible_faces",
]

CANDIDATES = 4
"""Number of nearest samples whose faces are searched for the closest point."""
VIEWS, VIEW_PX = 20, 384
"""Number and size of the pictures that decide which faces are visible."""


class Samples(NamedTuple):
    """Points on the faces of a mesh. The points follow the vertices if the mesh is posed."""

    face: Int[np.ndarray, "P"]
    barycentric: Float[np.ndarray, "P 3"]

    def points(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "P 3"]:
        """Return the positions of the samples on a mesh."""
        return np.einsum("pk,pkc->pc", self.barycentric, vertices[faces[self.face]])


class Closest(NamedTuple):
    """The closest point of a mesh for each of some points."""

    point: Float[np.ndarray, "P 3"]
    distance: Float[np.ndarray, "P"]
    face: Int[np.ndarray, "P"]
    barycentric: Float[np.ndarray, "P 3"]


def sample_surface(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], count: int, seed: int = 0
) -> Samples:
    """Return `count` points that are spread over the faces, with a density per area that is constant.

    Raises:
        ValueError: the mesh has no area.
    """
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    total = area.sum()
    if not total > 0:
        raise ValueError("faces: expected a mesh with an area above 0")
    random = np.random.default_rng(seed)
    # one sample per equal step of the summed area: more even than independent samples
    steps = (np.arange(count) + random.random(count)) / count * total
    face = np.minimum(np.searchsorted(np.cumsum(area), steps), len(faces) - 1)
    u, v = random.random((2, count))
    u, v = np.where(u + v > 1, (1 - u, 1 - v), (u, v))
    return Samples(face, np.stack([1 - u - v, u, v], axis=1))


def search_samples(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], count: int) -> Samples:
    """Return `sample_surface` and all vertices of the faces, so that `closest_points` also searches small faces."""
    spread = sample_surface(vertices, faces, count)
    _, first = np.unique(faces, return_index=True)
    corners = np.eye(3)[first % 3]
    return Samples(np.concatenate([spread.face, first // 3]), np.concatenate([spread.barycentric, corners]))


def closest_points(
    points: Float[np.ndarray, "P 3"],
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    samples: Samples,
) -> Closest:
    """Return the closest point on a mesh for each point.

    The faces of the nearest samples are searched, so the result is exact where the samples are dense.

    Args:
        points: in the frame of the vertices.
        vertices, faces: the mesh.
        samples: samples of the mesh, from `search_samples`.
    """
    on_mesh = samples.points(vertices, faces)
    _, nearest = KDTree(on_mesh).query(points, k=CANDIDATES)
    candidates = samples.face[nearest]  # (P, k)
    triangles = vertices[faces[candidates.ravel()]]
    repeated = np.repeat(points, CANDIDATES, axis=0)
    on_triangles = trimesh.triangles.closest_point(triangles, repeated).reshape(*candidates.shape, 3)
    distance = np.linalg.norm(on_triangles - points[:, None], axis=-1)
    best = np.nan_to_num(distance, nan=np.inf).argmin(1)
    rows = np.arange(len(points))
    face, point = candidates[rows, best], on_triangles[rows, best]
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = trimesh.triangles.points_to_barycentric(vertices[faces[face]], point)
    weights = np.where(np.isfinite(weights).all(axis=1, keepdims=True), weights, 1 / 3)  # a face without area
    return Closest(point, distance[rows, best], face, np.clip(weights, 0, 1))


def boundary_faces(faces: Int[np.ndarray, "F 3"]) -> Bool[np.ndarray, "F"]:
    """Return whether each face has a vertex at the border of a hole, that is, on an edge of one face only."""
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(sides, axis=0, return_counts=True)
    border = np.zeros(int(faces.max(initial=-1)) + 1, bool)
    border[unique[count == 1]] = True
    return np.asarray(border[faces].any(axis=1))


def visible_faces(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Bool[np.ndarray, "F"]:
    """Return whether each face is visible from any of `VIEWS` directions around the mesh.

    The body below a folded wing is part of a model, but no scanner sees it.
    """
    centred = vertices - (vertices.min(0) + vertices.max(0)) / 2
    radius = np.linalg.norm(centred, axis=1).max()
    turned = np.einsum("cij,vj->cvi", view_grid(VIEWS, 1), centred) * (0.49 * VIEW_PX / radius)
    screen = turned + np.array([VIEW_PX / 2, VIEW_PX / 2, VIEW_PX])
    visible = np.zeros(len(faces), bool)
    seen = zbuffer(screen.astype(np.float32), faces, VIEW_PX, VIEW_PX).face
    visible[np.unique(seen[seen >= 0])] = True
    return visible
