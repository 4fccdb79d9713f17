"""Bone lengths, provenance and smooth displacements of an adapted model.

Smooth, left-right symmetric displacements of the vertices, as further shape directions of a bird. The directions are
eigenvectors of a graph Laplacian of the mesh. The Laplacian of the published models needs links besides the edges,
because their bodies, feathers and eyes are separate pieces: each vertex is also linked to its nearest neighbours that
move with the same joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy import sparse
from scipy.sparse.linalg import eigsh
from scipy.spatial import KDTree

from jaxfit.foundation.extras import own_version
from jaxfit.model.bird import Bird, model_hash, rest_bone_lengths
from jaxfit.model.kinematics import Pose, Rig, fold_bird, joint_transforms, posed_keypoints, posed_vertices, rest_pose

BONE_SD = 0.05
"""Standard deviation by which the mean length of any bone may differ between species, besides the prior of the model.
The published prior knows individuals of one species: in this prior, half of the bones have one length."""


def body_length(bird: Bird) -> float:
    """Return the length of the rest pose from bill to tail (the extent along y), in model units."""
    return float(np.ptp(np.asarray(bird.vertices)[:, 1]))


def symmetric_bones(bird: Bird) -> Float[np.ndarray, "bones Q"]:
    """Return the matrix from Q lengths to all bones, which gives the left and the right bone of a pair one length."""
    bones = bird.num_joints - 1
    right_of = dict(bird.bone_pairs)
    right = set(right_of.values())
    columns = []
    for bone in range(bones):
        if bone not in right:
            column = np.zeros(bones)
            column[[bone, right_of.get(bone, bone)]] = 1
            columns.append(column)
    return np.stack(columns, axis=1)


def widened_bone_covariance(bird: Bird, sd: float = BONE_SD) -> Float[np.ndarray, "bones bones"]:
    """Return the covariance of the mean bone lengths of species: the covariance of the model, and `sd`² per bone."""
    return np.asarray(bird.bone_covariance, np.float64) + sd**2 * np.eye(bird.num_joints - 1)


def symmetric_bone_precision(bird: Bird) -> Float[np.ndarray, "Q Q"]:
    """Return the inverse of `widened_bone_covariance` for the lengths of `symmetric_bones`."""
    symmetric = symmetric_bones(bird)
    return symmetric.T @ np.linalg.inv(widened_bone_covariance(bird)) @ symmetric


def absolute_bones(bird: Bird, bone_length: Any = None) -> Float[np.ndarray, "bones"]:
    """Return the lengths of the bones in model units.

    Args:
        bird: the model.
        bone_length: relative to the rest skeleton; None for the mean of the prior.
    """
    return rest_bone_lengths(bird) * np.asarray(bird.bone_mean if bone_length is None else bone_length, np.float64)


def rest_surface(bird: Bird) -> Float[np.ndarray, "V 3"]:
    """Return the vertices of the rest pose with the mean bone lengths of the prior, model units."""
    rig, pose, A = _straight(bird)
    return np.asarray(posed_vertices(rig, A, pose), np.float64)


def rest_points(bird: Bird) -> dict[str, dict[str, Float[np.ndarray, "3"]]]:
    """Return the keypoints and the joints of `rest_surface` by name, model units."""
    rig, pose, A = _straight(bird)
    joints = np.asarray(jnp.einsum("jdc,jc->jd", A[..., :3], rig.joints) + A[..., 3], np.float64)
    keypoints = np.asarray(posed_keypoints(rig, A, pose), np.float64)
    return {
        "keypoints": dict(zip(bird.keypoint_names, keypoints, strict=True)),
        "joints": dict(zip(bird.joint_names, joints, strict=True)),
    }


def _straight(bird: Bird) -> tuple[Rig, Pose, Float[Array, "J 3 4"]]:
    """Return the rig, the rest pose with straight joints and the mean bone lengths of the prior, and its transforms."""
    rig, pose = fold_bird(bird), rest_pose(bird)
    pose = replace(pose, body_pose=jnp.zeros_like(pose.body_pose))
    return rig, pose, joint_transforms(rig, pose)


def mean_keypoints(bird: Bird) -> Float[np.ndarray, "K 3"]:
    """Return the keypoints of the mean pose of the prior, in the model's frame, model units."""
    rig, pose = fold_bird(bird), rest_pose(bird)
    return np.asarray(posed_keypoints(rig, joint_transforms(rig, pose), pose), np.float64)


def provenance_notes(base: Bird, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the notes of a model file that say how the model was adapted: one array `provenance` of `key: value`.

    Args:
        base: the model that was adapted.
        facts: what was free, from how many images, the settings.
    """
    lines = {"base": base.name, "base_hash": model_hash(base), "jaxfit": own_version(), **facts}
    return {"provenance": np.array([f"{key}: {value}" for key, value in lines.items()])}


def species_bird(
    base: Bird, name: str, bone_mean: Any, shift: Float[np.ndarray, "V 3"], covariance: Any = None
) -> Bird:
    """Return a model with new means: bone lengths, and rest vertices that are moved by `shift`.

    The shape directions stay: their coefficients now measure the difference from the new mean.

    Args:
        base: the model that was adapted.
        name: name of the new model.
        bone_mean: mean bone lengths, relative to the rest skeleton.
        shift: displacement of the rest vertices, model units.
        covariance: covariance of the bone lengths; None keeps the covariance of the base.
    """
    return replace(
        base,
        name=name,
        vertices=jnp.asarray(np.asarray(base.vertices) + shift, jnp.float32),
        bone_mean=jnp.asarray(bone_mean, jnp.float32),
        bone_covariance=base.bone_covariance if covariance is None else jnp.asarray(covariance, jnp.float32),
    )


NEIGHBOURS = 6
"""Number of nearest neighbours that a vertex is linked to, besides its edges."""
MIRROR_TOLERANCE = 0.01
"""Largest distance of a vertex from its mirror image, as a share of the bird's length."""


def mirror_vertices(bird: Bird) -> Int[np.ndarray, "V"]:
    """Return the vertex that mirrors each vertex at the plane x = 0. A vertex without a mirror image mirrors itself."""
    vertices = np.asarray(bird.vertices, np.float64)
    distance, other = KDTree(vertices).query(vertices * [-1, 1, 1])
    vertex, other = np.arange(len(vertices)), np.asarray(other)
    paired = (other[other] == vertex) & (distance < MIRROR_TOLERANCE * body_length(bird))
    return np.where(paired, other, vertex)


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
    vertex = np.arange(len(mirror))
    left, alone = vertex[vertex < mirror], vertex[vertex == mirror]
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
