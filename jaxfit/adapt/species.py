"""The parameters of a species: bone lengths that are equal on both sides, and the model that has them as its mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfit.extras import own_version
from jaxfit.limits import NPZ_TEXT_CHARACTERS
from jaxfit.model.bird import Bird
from jaxfit.model.describe import model_hash
from jaxfit.model.kinematics import fold_bird, joint_transforms, posed_keypoints, posed_vertices
from jaxfit.model.pose import rest_pose

__all__ = [
    "BONE_SD",
    "absolute_bones",
    "body_length",
    "mean_keypoints",
    "provenance_notes",
    "rest_surface",
    "species_bird",
    "symmetric_bone_precision",
    "symmetric_bones",
    "widened_bone_covariance",
]

BONE_SD = 0.05
"""Standard deviation by which the mean length of any bone may differ between species, besides the prior of the model.
The published prior knows individuals of one species: in this prior, half of the bones have one length."""


def body_length(bird: Bird) -> float:
    """Return the length of the rest pose from bill to tail (the extent along y), in model units."""
    return float(np.ptp(np.asarray(bird.vertices)[:, 1]))


def symmetric_bones(bird: Bird) -> Float[np.ndarray, "bones Q"]:
    """Return the matrix from Q lengths to all bones, which gives the left and the right bone of a pair one length."""
    bones = bird.num_joints - 1
    right_of = {left - 1: right - 1 for left, right in bird.joint_pairs if left and right}
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
    joints, parents = np.asarray(bird.joints, np.float64), np.array(bird.parents)
    rest = np.linalg.norm(joints[1:] - joints[parents[1:]], axis=1)
    return rest * np.asarray(bird.bone_mean if bone_length is None else bone_length, np.float64)


def rest_surface(bird: Bird) -> Float[np.ndarray, "V 3"]:
    """Return the vertices of the rest pose with the mean bone lengths of the prior, model units."""
    rig, pose = fold_bird(bird), rest_pose(bird)
    pose = replace(pose, body_pose=jnp.zeros_like(pose.body_pose))
    return np.asarray(posed_vertices(rig, joint_transforms(rig, pose), pose), np.float64)


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
    return {"provenance": np.array([f"{key}: {value}"[:NPZ_TEXT_CHARACTERS] for key, value in lines.items()])}


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
