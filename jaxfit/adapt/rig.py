"""Transfer of a rig: skin weights, joints, keypoints and shape directions of a model for a mesh of another topology."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from jaxfit.adapt.surface import Closest, closest_points, search_samples
from jaxfit.model.bird import Bird, neutral_colours
from jaxfit.model.checks import MAX_INFLUENCES
from jaxfit.model.kinematics import fold_bird, joint_transforms, posed_vertices
from jaxfit.model.pose import Pose
from jaxfit.storage.npz import load_npz, npz_names

__all__ = ["Placement", "read_placement", "rest_placement", "rig_mesh"]

SMOOTHING_STEPS = 8
"""Number of times that the skin weights of a vertex are averaged with those of its neighbours."""
NOTES = {"scan_R": "3 3", "scan_size": "", "scan_root": "3", "scan_body_pose": "bones 3"}
"""Notes of a model file that `jaxfit adapt scan` writes."""


class Placement(NamedTuple):
    """The pose and the place of a model in the frame of a mesh: x = size · R (u − J_0) + root, with u posed."""

    R: Float[np.ndarray, "3 3"]
    size: float
    root: Float[np.ndarray, "3"]
    body_pose: Float[np.ndarray, "bones 3"]

    def pose(self, bird: Bird) -> Pose:
        """Return the body pose, without rotation and translation, at scale 1."""
        return Pose(
            global_orient=np.zeros(3, np.float32),
            body_pose=np.asarray(self.body_pose, np.float32),
            transl=np.zeros(3, np.float32),
            scale=np.ones((), np.float32),
            bone_length=np.asarray(bird.bone_mean),
            betas=np.zeros(bird.num_shapes, np.float32),
        )


def read_placement(path: Path, bird: Bird) -> Placement | None:
    """Return the pose of the scan from which a model was adapted; None if the model file holds no such pose."""
    if not set(NOTES) <= npz_names(path):
        return None
    notes = load_npz(path, {**NOTES, "scan_body_pose": f"{bird.num_joints - 1} 3"})
    return Placement(notes["scan_R"], float(notes["scan_size"]), notes["scan_root"], notes["scan_body_pose"])


def rest_placement(bird: Bird) -> Placement:
    """Return the placement of a mesh that lies on the rest pose of a model, in the model's frame and size."""
    root = np.asarray(bird.joints, np.float64)[0]
    return Placement(np.eye(3), 1.0, root, np.zeros((bird.num_joints - 1, 3)))


def rig_mesh(
    vertices: Float[np.ndarray, "P 3"],
    faces: Int[np.ndarray, "Q 3"],
    bird: Bird,
    placement: Placement,
    name: str = "rigged",
) -> tuple[Bird, Float[np.ndarray, "P"]]:
    """Return a model with the surface of a mesh and the rig of a bird.

    Each vertex gets the skin weights and shape directions of the closest point of the posed bird; the skin weights are
    smoothed over the mesh. Each keypoint is the closest point of the mesh. The inverse of the skinning brings the mesh
    to the rest pose, so the model in the pose of `placement` is the mesh.

    Args:
        vertices: vertices of the mesh.
        faces: faces of the mesh.
        bird: the model whose rig is transferred.
        placement: pose and place of the bird in the frame of the mesh.
        name: name of the new model.

    Returns:
        The model, in the units and the frame of the bird, and the distance of each vertex from the bird (model units).
    """
    pose = placement.pose(bird)
    if not np.any(placement.body_pose):
        pose = replace(pose, bone_length=np.ones_like(pose.bone_length))  # the rest pose has the rest bones
    rig = fold_bird(bird)
    transforms = joint_transforms(rig, pose)
    posed = np.asarray(posed_vertices(rig, transforms, pose), np.float64)
    root = np.asarray(bird.joints, np.float64)[0]
    mesh = (vertices - placement.root) @ placement.R / placement.size + root
    own_faces = np.asarray(bird.faces)
    closest = closest_points(mesh, posed, own_faces, search_samples(posed, own_faces, 60_000))
    weights = _smoothed(_carried(np.asarray(bird.skin_weights), own_faces, closest), faces)
    basis = (
        np.stack([_carried(field, own_faces, closest) for field in np.asarray(bird.shape_basis)])
        if bird.num_shapes
        else np.zeros((0, len(mesh), 3))
    )
    blended = np.einsum("vj,jrc->vrc", weights, np.asarray(transforms, np.float64))
    rest = np.linalg.solve(blended[..., :3], (mesh - blended[..., 3])[..., None])[..., 0]
    keypoints = np.asarray(bird.keypoint_weights, np.float64) @ posed
    at = closest_points(keypoints, mesh, faces, search_samples(mesh, faces, 60_000))
    to_keypoints = np.zeros((len(keypoints), len(mesh)))
    for k, (face, share) in enumerate(zip(faces[at.face], at.barycentric, strict=True)):
        np.add.at(to_keypoints[k], face, share / share.sum())
    model = replace(
        bird,
        name=name,
        vertices=jnp.asarray(rest, jnp.float32),
        faces=jnp.asarray(faces, jnp.int32),
        skin_weights=jnp.asarray(weights, jnp.float32),
        keypoint_weights=jnp.asarray(to_keypoints, jnp.float32),
        shape_basis=jnp.asarray(basis, jnp.float32),
        vertex_colours=jnp.asarray(neutral_colours(len(mesh))),
    )
    return model, closest.distance


def _carried(values: np.ndarray, faces: Int[np.ndarray, "F 3"], closest: Closest) -> np.ndarray:
    """Return values of the vertices of a surface at its closest points."""
    return np.einsum("pk,pkc->pc", closest.barycentric, values[faces[closest.face]])


def _smoothed(weights: Float[np.ndarray, "P J"], faces: Int[np.ndarray, "Q 3"]) -> Float[np.ndarray, "P J"]:
    """Return skin weights averaged with those of the neighbours, with at most `MAX_INFLUENCES` joints per vertex."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    links = sparse.coo_matrix((np.ones(len(sides)), sides.T), shape=(len(weights), len(weights))).tocsr()
    links = ((links + links.T) > 0).astype(float)
    degree = np.asarray(links.sum(axis=1))
    for _ in range(SMOOTHING_STEPS):
        weights = np.where(degree > 0, 0.5 * weights + 0.5 * (links @ weights) / np.maximum(degree, 1), weights)
    if weights.shape[1] > MAX_INFLUENCES:
        smallest = np.partition(weights, -MAX_INFLUENCES, axis=1)[:, [-MAX_INFLUENCES]]
        weights = np.where(weights >= smallest, weights, 0)
        extra = np.cumsum(weights > 0, axis=1) > MAX_INFLUENCES  # ties at the smallest weight
        weights = np.where(extra, 0, weights)
    return weights / weights.sum(axis=1, keepdims=True)
