"""Smooth, left-right symmetric displacements of the vertices, as further shape directions of a bird.

The directions are eigenvectors of a graph Laplacian of the mesh. The Laplacian of the published models needs links
besides the edges, because their bodies, feathers and eyes are separate pieces: each vertex is also linked to its
nearest neighbours that move with the same joints.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import eigsh
from scipy.spatial import KDTree

from jaxfit.adapt.species import body_length
from jaxfit.model.bird import Bird

__all__ = ["mirror_vertices", "offset_directions", "with_offsets"]

NEIGHBOURS = 6
"""Number of nearest neighbours that a vertex is linked to, besides its edges."""
MIRROR_TOLERANCE = 0.01
"""Largest distance of a vertex from its mirror image, as a share of the bird's length."""


def mirror_vertices(bird: Bird) -> Int[np.ndarray, "V"]:
    """Return the vertex that mirrors each vertex at the plane x = 0. A vertex without a mirror image mirrors itself."""
    vertices = np.asarray(bird.vertices, np.float64)
    distance, other = KDTree(vertices).query(vertices * [-1, 1, 1])
    own, other = np.arange(len(vertices)), np.asarray(other)
    paired = (other[other] == own) & (distance < MIRROR_TOLERANCE * body_length(bird))
    return np.where(paired, other, own)


class Directions(NamedTuple):
    """Displacements of all vertices for one unit of each coefficient, in model units."""

    basis: Float[np.ndarray, "O V 3"]
    variance: Float[np.ndarray, "O"]
    """Variance of each coefficient: smooth displacements are more probable than rough displacements."""


def with_offsets(bird: Bird, modes: int, sd: float) -> Bird:
    """Return a bird whose shape directions are followed by `offset_directions`."""
    if modes == 0:
        return bird
    directions = offset_directions(bird, modes, sd)
    basis = np.concatenate([np.asarray(bird.shape_basis), directions.basis])
    variance = np.concatenate([np.asarray(bird.shape_variance), directions.variance])
    return replace(bird, shape_basis=jnp.asarray(basis, jnp.float32), shape_variance=jnp.asarray(variance, jnp.float32))


def offset_directions(bird: Bird, modes: int, sd: float) -> Directions:
    """Return smooth displacements that are symmetric under x → −x.

    The eigenvectors φ of the graph Laplacian are even or odd under the mirror. Even modes displace the vertices along
    y or z, odd modes along x. The standard deviation of a mode with the eigenvalue λ is sd · λ_c / (λ_c + λ), with λ_c
    the median eigenvalue of the modes.

    Args:
        bird: the model.
        modes: number of even modes, and number of odd modes. There are 3 · modes directions.
        sd: standard deviation of the displacement of a vertex by one smooth mode, as a share of the bird's length.
    """
    laplacian = _laplacian(bird)
    mirror = mirror_vertices(bird)
    length = body_length(bird)
    basis, variance = [], []
    for sign, axes in ((1, (1, 2)), (-1, (0,))):
        to_vertices = _symmetric_functions(mirror, sign)
        reduced = (to_vertices.T @ laplacian @ to_vertices).tocsc()
        start = np.random.default_rng(0).standard_normal(reduced.shape[0])  # eigsh starts at random otherwise
        values, vectors = eigsh(reduced, k=min(modes, reduced.shape[0] - 2), sigma=-1e-3, v0=start)
        order = np.argsort(values)
        values = np.maximum(values[order], 0)
        fields = (to_vertices @ vectors[:, order]).T * np.sqrt(len(mirror))  # RMS 1
        deviation = sd * length * np.median(values) / (np.median(values) + values)
        for axis in axes:
            basis.append(fields[:, :, None] * np.eye(3)[axis])
            variance.append(deviation**2)
    return Directions(np.concatenate(basis), np.concatenate(variance))


def _laplacian(bird: Bird) -> sparse.csr_matrix:
    """Return the graph Laplacian, symmetric under the mirror: edges, and neighbours that move with the same joints."""
    vertices, faces = np.asarray(bird.vertices, np.float64), np.asarray(bird.faces)
    weights, count = np.asarray(bird.skin_weights, np.float64), len(vertices)
    _, near = KDTree(vertices).query(vertices, k=NEIGHBOURS + 1)
    pairs = np.concatenate(
        [faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]
        + [np.stack([np.arange(count), np.asarray(near)[:, k]], axis=1) for k in range(1, NEIGHBOURS + 1)]
    )
    distance = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    together = np.minimum(weights[pairs[:, 0]], weights[pairs[:, 1]]).sum(axis=1)  # 1 for equal skin weights
    closeness = together / (1 + (distance / np.median(distance)) ** 2) + 1e-4
    links = sparse.coo_matrix((closeness, pairs.T), shape=(count, count)).tocsr()
    links = links.maximum(links.T)
    mirror = mirror_vertices(bird)
    swap = sparse.csr_matrix((np.ones(count), (np.arange(count), mirror)), shape=(count, count))
    links = (links + swap @ links @ swap.T) / 2
    return sparse.diags(np.asarray(links.sum(axis=1)).ravel()) - links


def _symmetric_functions(mirror: Int[np.ndarray, "V"], sign: int) -> sparse.csr_matrix:
    """Return orthonormal columns that span the even (sign 1) or odd (sign −1) functions of the vertices."""
    own = np.arange(len(mirror))
    left, alone = own[own < mirror], own[own == mirror]
    pairs = np.arange(len(left))
    rows = [left, mirror[left]]
    columns = [pairs, pairs]
    values = [np.full(len(left), 0.5**0.5), np.full(len(left), sign * 0.5**0.5)]
    if sign > 0:
        rows.append(alone)
        columns.append(len(left) + np.arange(len(alone)))
        values.append(np.ones(len(alone)))
    size = len(left) + (len(alone) if sign > 0 else 0)
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_matrix(entries, shape=(len(mirror), size))
