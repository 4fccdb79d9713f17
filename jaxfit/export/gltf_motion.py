"""The motion of one bird as glTF needs it: transforms of its joints and its place in the scene, frame by frame.

glTF and the model have the same skinning: a joint has the translation bone · (J_j − J_parent) and the rotation R(θ_j)
relative to its parent, and its inverse bind matrix is the translation −J_j. Size, translation and the length of a model
unit belong to the node above the root joint.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxfit.export.result import Exported
from jaxfit.model.bird import Bird

__all__ = ["FOUR", "Motion", "bird_motion", "four_weights"]

FOUR = 4
"""Largest number of joints that move one vertex in glTF."""


class Motion(NamedTuple):
    """The motion of one bird in its M fitted frames. Frames of the camera: x right, y down, z forward."""

    at: Int[np.ndarray, "M"]
    """Positions of the fitted frames."""
    rotations: Float[np.ndarray, "M J 4"]
    """Rotation of every joint relative to its parent: unit quaternions x, y, z, w of continuous sign."""
    translations: Float[np.ndarray, "M J 3"]
    """Translation of every joint relative to its parent, model units."""
    place: Float[np.ndarray, "M 3"]
    """Translation of the bird in the camera frame of the image, in the unit of the export."""
    facing: Float[np.ndarray, "M 4"]
    """Rotation from the camera frame of the crop to the camera frame of the image: unit quaternions x, y, z, w."""
    size: float
    """Length of a model unit, in the unit of the export."""
    betas: Float[np.ndarray, "M S"]
    """Shape coefficients."""


def bird_motion(exported: Exported, n: int) -> Motion:
    """Return the motion of one bird in the camera frame of the image.

    Args:
        exported: the result.
        n: position of the track, with at least one pose.
    """
    s, bird = exported.solution, exported.bird
    at = np.flatnonzero(s.valid[n])
    orient, body = s.global_orient[n, at], s.body_pose[n, at]
    angles = np.concatenate([orient[:, None], body], axis=1).astype(np.float64)
    rotations = Rotation.from_rotvec(angles.reshape(-1, 3)).as_quat().reshape(*angles.shape[:2], 4)
    joints = np.asarray(bird.joints, np.float64)
    offsets = joints - np.where(np.arange(len(joints))[:, None] > 0, joints[np.maximum(bird.parents, 0)], 0)
    bones = np.concatenate([np.ones((len(at), 1)), s.bone_length[n, at]], axis=1)
    turn = Rotation.from_matrix(exported.in_image.turn[n, at])
    place = exported.in_image.root[n, at] - turn.apply(joints[0])  # the turn is about the root joint
    return Motion(
        at=at,
        rotations=_continuous(rotations),
        translations=bones[..., None] * offsets,
        place=place * exported.length,
        facing=_continuous(turn.as_quat()),
        size=exported.length,
        betas=s.betas[n, at].astype(np.float64),
    )


def _continuous(quaternions: Float[np.ndarray, "M *B 4"]) -> Float[np.ndarray, "M *B 4"]:
    """Return the same rotations with signs such that consecutive quaternions have a positive product."""
    products = np.sum(quaternions[1:] * quaternions[:-1], axis=-1, keepdims=True)
    signs = np.cumprod(np.where(products < 0, -1.0, 1.0), axis=0)
    return np.concatenate([quaternions[:1], quaternions[1:] * signs])


def four_weights(bird: Bird) -> tuple[Int[np.ndarray, "V 4"], Float[np.ndarray, "V 4"]]:
    """Return the four joints with the largest weights of every vertex, and their weights, scaled to a sum of 1."""
    weights = np.asarray(bird.skin_weights, np.float64)
    weights = np.pad(weights, ((0, 0), (0, max(FOUR - bird.num_joints, 0))))
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :FOUR]
    kept = np.take_along_axis(weights, joints, axis=1)
    kept /= kept.sum(axis=1, keepdims=True)
    return np.where(kept > 0, joints, 0), kept
