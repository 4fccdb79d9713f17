"""Facts about a bird model for people to check, and the hash that identifies the model in results."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import numpy as np

from jaxfit.model.bird import Bird
from jaxfit.model.checks import ARRAY_FIELDS

__all__ = ["describe_bird", "model_hash"]


def model_hash(bird: Bird) -> str:
    """Return the SHA-256 hash (hexadecimal) of all parts of a bird that a fit depends on.

    The hash covers the arrays (as little-endian float32 and int32), the joint tree, the names of joints and
    keypoints, and the pairs. The hash does not cover `bird.name` and `vertex_colours`, because a fit does not depend
    on them, and it does not depend on the file from which the bird was read.
    """
    digest = hashlib.sha256(b"jaxfit bird 1\n")
    for field in ARRAY_FIELDS:
        if field == "vertex_colours":
            continue
        array = np.ascontiguousarray(getattr(bird, field), "<i4" if field == "faces" else "<f4")
        digest.update(f"{field} {array.shape}\n".encode())
        digest.update(array.tobytes())
    static = [bird.parents, bird.joint_names, bird.keypoint_names, bird.joint_pairs, bird.keypoint_pairs]
    digest.update(json.dumps(static).encode())
    return digest.hexdigest()


def describe_bird(bird: Bird) -> dict[str, Any]:
    """Return facts about a model, as values that JSON can hold.

    Returns:
        `name`, `model_hash`; `metres_per_unit` (None if unknown); counts (`vertices`, `faces`, `joints`, `keypoints`,
        `shapes`); `joint_names`, `keypoint_names`, `parents` by name (None for the root), `joint_pairs` and
        `keypoint_pairs` as [left, right] names; `minimum`, `maximum`, `extents` (x, y, z, model units); `watertight`,
        `boundary_edges` (edges that belong to one face only), `volume` (cubed model units; None if not watertight);
        `max_influences` (maximum number of joints that move one vertex); `pose_prior_variance`,
        `bone_prior_variance` and `shape_variance`: smallest and largest eigenvalue (rad², 1, 1; None without shapes).
    """
    import trimesh  # imported here because the import takes half a second and few callers need it

    vertices, faces = np.asarray(bird.vertices), np.asarray(bird.faces)
    minimum, maximum = vertices.min(axis=0), vertices.max(axis=0)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    shared = np.unique(sides, axis=0, return_counts=True)[1]
    watertight = bool(mesh.is_watertight)
    joints, keypoints = bird.joint_names, bird.keypoint_names
    variance = np.asarray(bird.shape_variance)
    return {
        "name": bird.name,
        "metres_per_unit": bird.metres_per_unit,
        "model_hash": model_hash(bird),
        "vertices": len(vertices),
        "faces": len(faces),
        "joints": bird.num_joints,
        "keypoints": bird.num_keypoints,
        "shapes": bird.num_shapes,
        "joint_names": list(joints),
        "parents": [None if parent < 0 else joints[parent] for parent in bird.parents],
        "keypoint_names": list(keypoints),
        "joint_pairs": [[joints[left], joints[right]] for left, right in bird.joint_pairs],
        "keypoint_pairs": [[keypoints[left], keypoints[right]] for left, right in bird.keypoint_pairs],
        "minimum": minimum.tolist(),
        "maximum": maximum.tolist(),
        "extents": (maximum - minimum).tolist(),
        "watertight": watertight,
        "boundary_edges": int((shared == 1).sum()),
        "volume": float(mesh.volume) if watertight else None,
        "max_influences": int((np.asarray(bird.skin_weights) != 0).sum(axis=1).max()),
        "pose_prior_variance": _eigenvalue_range(bird.pose_covariance),
        "bone_prior_variance": _eigenvalue_range(bird.bone_covariance),
        "shape_variance": [float(variance.min()), float(variance.max())] if variance.size else None,
    }


def _eigenvalue_range(covariance: Any) -> list[float]:
    eigenvalues = np.linalg.eigvalsh(np.asarray(covariance, np.float64))
    return [float(eigenvalues[0]), float(eigenvalues[-1])]
