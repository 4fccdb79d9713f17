"""Closest points on meshes, visible faces, alignment by keypoints."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxfit.model.rotation import view_grid
from jaxfit.raster.zbuffer import zbuffer

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


MIRROR_RATIO = 0.88
"""A scan counts as mirrored if the mirrored keypoints fit with at most this share of the error. Of 80
simulated birds in random poses with 12 keypoints, at most 2 count as mirrored by mistake."""


class Similarity(NamedTuple):
    """x → scale · R x + shift."""

    scale: float
    R: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    def apply(self, points: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P 3"]:
        """Return the moved points."""
        return self.scale * points @ self.R.T + self.shift

    def invert(self, points: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P 3"]:
        """Return the points before the move."""
        return (points - self.shift) @ self.R / self.scale


def fit_similarity(
    source: Float[np.ndarray, "P 3"],
    target: Float[np.ndarray, "P 3"],
    weight: Float[np.ndarray, "P"] | None = None,
    mirrored: bool = False,
) -> Similarity:
    """Return the similarity with the smallest weighted sum of squared distances.

    Args:
        source: points before the move.
        target: points after the move.
        weight: weights of the points; None for equal weights.
        mirrored: R is a rotation and a reflection, instead of a rotation.

    Source: Umeyama 1991, *Least-Squares Estimation of Transformation Parameters Between Two Point Patterns*.
    """
    weight = np.ones(len(source)) if weight is None else weight
    share = (weight / weight.sum())[:, None]
    centre, target_centre = (share * source).sum(0), (share * target).sum(0)
    a, b = source - centre, target - target_centre
    U, singular, Vt = np.linalg.svd((share * b).T @ a)
    sign = np.sign(np.linalg.det(U @ Vt)) * (-1 if mirrored else 1)
    signs = np.array([1, 1, sign if sign else 1])
    R = (U * signs) @ Vt
    scale = float((singular * signs).sum() / max((share * a**2).sum(), 1e-300))
    return Similarity(scale, R, target_centre - scale * R @ centre)


def robust_similarity(
    source: Float[np.ndarray, "P 3"],
    target: Float[np.ndarray, "P 3"],
    mirrored: bool = False,
    up: Float[np.ndarray, "3"] | None = None,
) -> tuple[Similarity, float]:
    """Return a similarity that single wrong points hardly change, and its error as a share of the target's size.

    Args:
        source: keypoints of a model, whose upward direction is +z.
        target: keypoints of a scan.
        mirrored: as for `fit_similarity`.
        up: upward direction of the scan, a unit vector. It counts as two further points, above and below the centre.
    """
    size = _size(target)
    if up is not None:
        above, model_up = up * size, np.array([0, 0, _size(source)])
        source = np.concatenate([source, source.mean(0) + np.stack([model_up, -model_up])])
        target = np.concatenate([target, target.mean(0) + np.stack([above, -above])])
    weight = np.ones(len(source))
    for _ in range(10):
        similarity = fit_similarity(source, target, weight, mirrored)
        error = np.linalg.norm(similarity.apply(source) - target, axis=1) / max(size, 1e-300)
        weight = 1 / (1 + (error / 0.3) ** 2) ** 2
    robust = np.sqrt((error**2 / (1 + (error / 0.3) ** 2)).mean())
    return similarity, float(robust)


def _size(points: Float[np.ndarray, "P 3"]) -> float:
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean()))


def is_mirrored(source: Float[np.ndarray, "P 3"], target: Float[np.ndarray, "P 3"]) -> bool:
    """Return whether the mirrored keypoints fit clearly better: the scan is mirrored, or left and right are exchanged.

    Keypoints in one plane fit equally well in both ways, and then the result is False.
    """
    proper, reflected = (robust_similarity(source, target, mirrored)[1] for mirrored in (False, True))
    return reflected < MIRROR_RATIO * proper
