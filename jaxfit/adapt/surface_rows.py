"""Comparison of a posed bird with the surface of a scan: residuals, derivatives and weights, in both directions.

A noisy point of a scan lies more often outside a curved surface than inside. Its closest point on the model makes the
model too large: with noise of standard deviation σ, a sphere of radius R by σ²/R. So every point p of the scan
is compared with points q of the model that are drawn from p(q | p) ∝ exp(−‖p − q‖² / 2σ²), which has no such bias.
The bias is small without noise, and there closest points are more exact than drawn points.

Source: Myronenko and Song 2010, *Point Set Registration: Coherent Point Drift*, for the distribution and for σ.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jaxfit.adapt.gauss_newton import Linear, Rows
from jaxfit.adapt.surface import Samples, boundary_faces, closest_points, sample_surface, search_samples, visible_faces
from jaxfit.raster.zbuffer import vertex_normals

__all__ = ["ModelSamples", "ScanSurface", "surface_rows"]

DENSER = 4
"""Number of points of a surface that are searched, relative to the number of points that are compared."""
LITTLE_NOISE = 0.005
"""Largest σ as a share of the length for closest points: drawn points are too coarse for a scan with less noise."""
DRAWS = 3
"""Number of points of the model that are drawn for one point of the scan."""
CANDIDATES = 128
"""Number of nearest points of the model from which they are drawn."""
MEDIAN_DISTANCE = 1.54
"""Median distance of two points in space, relative to the standard deviation of one coordinate of their difference."""
SMALLEST_SIGMA = 2e-5
"""Smallest σ as a share of the length, for scans without noise."""
REACH = 0.06
"""Width of the robust weights of points of the scan, as a share of the length: the model can grow to such points."""
BEYOND = 4.0
"""A point of the scan farther than this many σ pulls the model towards itself, and not along the normal: no normal
points to a part of the scan beyond the end of the model, such as a longer tail."""
OF_MODEL = 0.1
"""Weight of the points of the model relative to the points of the scan. They are compared with closest points, which
are biased, but only they shorten a part of the model that the scan lacks."""
SLIDE = 0.1
"""Share of the weight for the whole distance, and not along the normal: the surfaces would slide otherwise."""


class ScanSurface:
    """The scan in the frame of the model, with the points that are compared."""

    def __init__(self, vertices: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "Q 3"], count: int):
        self.vertices, self.faces = vertices, faces
        self.search = search_samples(vertices, faces, DENSER * count)
        self.points = sample_surface(vertices, faces, count, seed=1).points(vertices, faces)
        self.boundary = boundary_faces(faces)
        random = np.random.default_rng(3).random((count, DRAWS))
        self.chances = (np.arange(DRAWS) + random) / DRAWS  # the same in all steps, so that the steps converge


class ModelSamples(NamedTuple):
    """The visible part of the model, with the points that are compared."""

    faces: Int[np.ndarray, "visible 3"]
    search: Samples
    samples: Samples

    @classmethod
    def of(cls, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], count: int) -> ModelSamples:
        """Return the visible part of a posed model with `count` points."""
        outer = faces[visible_faces(vertices, faces)]
        return cls(
            outer, search_samples(vertices, outer, DENSER * count), sample_surface(vertices, outer, count, seed=2)
        )


class _Pairs(NamedTuple):
    """Points of the model and the points of the scan that they are compared with."""

    samples: Samples
    target: Float[np.ndarray, "M 3"]
    weight: Float[np.ndarray, "M"]
    beyond: float
    """Distance from which on the residual is the distance."""


def surface_rows(
    posed: Linear, model: ModelSamples, scan: ScanSurface, length: float, coarse: float, weight: float
) -> list[Rows]:
    """Return the rows of points of the scan against the model, and of points of the model against the scan.

    Args:
        posed: the posed model.
        model: its visible part.
        scan: the scan.
        length: length of the bird, model units.
        coarse: largest σ, as a share of the length.
        weight: number of independent measurements that count as much as all points of the scan together.
    """
    vertices = posed.vertices.astype(np.float64)
    normals = vertex_normals(vertices, model.faces).astype(np.float64)
    # the samples without the vertices, whose density varies
    spread = model.search.points(vertices, model.faces)[: DENSER * len(model.samples.face)]
    chosen, sigma = _draw(scan, spread, coarse * length, SMALLEST_SIGMA * length)
    scanned = _Pairs(
        Samples(model.search.face[chosen], model.search.barycentric[chosen]),
        np.repeat(scan.points, DRAWS, axis=0),
        np.ones(len(chosen)),
        BEYOND * sigma,
    )
    of_model = OF_MODEL
    if sigma < LITTLE_NOISE * length:
        found = closest_points(scan.points, vertices, model.faces, model.search)
        scanned = _Pairs(Samples(found.face, found.barycentric), scan.points, np.ones(len(found.face)), 0.0)
        sigma, of_model = max(1.5 * float(np.median(found.distance)), SMALLEST_SIGMA * length), 1.0
    own = model.samples.points(vertices, model.faces)
    closest = closest_points(own, scan.vertices, scan.faces, scan.search)
    # a point of the model far from the border of a hole has no counterpart; without the near points, the model grows
    whole = ~scan.boundary[closest.face] | (closest.distance < REACH * length / 3)
    reach = max(3 * sigma, REACH * length)
    rows = []
    for pairs, width, share in (
        (scanned, reach, 1.0),
        (_Pairs(model.samples, closest.point, whole.astype(float), np.inf), 3 * sigma, of_model),
    ):
        rows += _rows(posed, vertices, normals, model.faces, pairs, width, share * weight / sigma**2)
    return rows


def _draw(
    scan: ScanSurface, points: Float[np.ndarray, "M 3"], largest: float, smallest: float
) -> tuple[Int[np.ndarray, "P*DRAWS"], float]:
    """Return the numbers of the points of the model that are drawn for every point of the scan, and σ."""
    distance, near = (np.asarray(found) for found in KDTree(points).query(scan.points, k=CANDIDATES))
    sigma = 1.5 * float(np.median(distance[:, 0]))
    for _ in range(4):
        sigma = float(np.clip(sigma, smallest, largest))
        chance = np.exp((distance[:, :1] ** 2 - distance**2) / (2 * sigma**2)).cumsum(axis=1)
        at = (chance[:, None] < chance[:, -1:, None] * scan.chances[..., None]).sum(axis=2)
        # noise of the scan gives distances of this median
        sigma = float(np.median(np.take_along_axis(distance, at, axis=1))) / MEDIAN_DISTANCE
    return np.take_along_axis(near, at, axis=1).ravel(), float(np.clip(sigma, smallest, largest))


def _rows(posed: Linear, vertices, normals, faces, pairs: _Pairs, width: float, weight: float) -> list[Rows]:
    """Return the rows of pairs of points: at all pairs along the normal, at some pairs in all directions."""
    corners, barycentric = faces[pairs.samples.face], pairs.samples.barycentric
    gap = pairs.samples.points(vertices, faces) - pairs.target
    distance = np.linalg.norm(gap, axis=1)
    direction = np.einsum("pk,pkc->pc", barycentric, normals[corners])
    direction = np.where((distance > pairs.beyond)[:, None], gap, direction)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    jacobian = np.einsum("pk,pkcx->pcx", barycentric.astype(np.float32), posed.by_vertices[corners], optimize=True)
    along = np.einsum("pc,pcx->px", direction.astype(np.float32), jacobian)
    robust = weight * pairs.weight / (1 + (distance / width) ** 2) ** 2
    some = slice(None, None, 5)
    whole = SLIDE * robust[some] / len(gap[some])
    return [
        Rows((gap * direction).sum(1), along, (1 - SLIDE) * robust / len(gap)),
        Rows(gap[some].ravel(), jacobian[some].reshape(3 * len(whole), -1), np.repeat(whole, 3)),
    ]
