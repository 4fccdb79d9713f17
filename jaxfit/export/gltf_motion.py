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

from jaxfit.data.solution import Solution
from jaxfit.export.result import Exported
from jaxfit.model.bird import Bird

__all__ = ["FOUR", "Motion", "bird_motion", "four_weights", "image_focal_px"]

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


def image_focal_px(solution: Solution) -> float:
    """Return a focal length of the whole image in image pixels: the median over all poses of that of their crops.

    The focal length of the footage is unknown. Every crop has its own focal length in image pixels: focal_px · size /
    crop_px.
    """
    sizes = solution.crop[..., 2][solution.valid]
    return float(np.median(solution.focal_px * sizes / solution.crop_px))


def bird_motion(exported: Exported, n: int, focal_px: float) -> Motion:
    """Return the motion of one bird, placed in the camera frame of the image.

    The camera of the image sees the root joint at the same pixel as the camera of the crop, and sees the bird at the
    same size in the picture. The bird has the size of the model: with its scale in the result, and the focal length f
    of the crop in image pixels, depth' = depth / scale · focal_px / f. The bird is turned by the rotation between the
    viewing rays of its root joint, so that both cameras see the same side of the bird.

    Args:
        exported: the result.
        n: position of the track, with at least one pose.
        focal_px: focal length of the image, see `image_focal_px`.
    """
    s, bird = exported.solution, exported.bird
    at = np.flatnonzero(s.valid[n])
    orient, body = s.global_orient[n, at], s.body_pose[n, at]
    angles = np.concatenate([orient[:, None], body], axis=1).astype(np.float64)
    rotations = Rotation.from_rotvec(angles.reshape(-1, 3)).as_quat().reshape(*angles.shape[:2], 4)
    joints = np.asarray(bird.joints, np.float64)
    offsets = joints - np.where(np.arange(len(joints))[:, None] > 0, joints[np.maximum(bird.parents, 0)], 0)
    bones = np.concatenate([np.ones((len(at), 1)), s.bone_length[n, at]], axis=1)
    root = s.transl[n, at] / s.scale[n, at, None].astype(np.float64) + joints[0]  # camera frame of the crop
    crop = s.crop[n, at].astype(np.float64)
    crop_focal = s.focal_px * crop[:, 2] / s.crop_px
    centre = np.median(s.image_size_px[n, at], axis=0) / 2
    pixel = root[:, :2] / root[:, 2:] * crop_focal[:, None] + crop[:, :2] + crop[:, 2:] / 2
    ray = np.concatenate([(pixel - centre) / focal_px, np.ones((len(at), 1))], axis=1)
    turn = _between(root, ray)
    seen = ray * (root[:, 2] * focal_px / crop_focal)[:, None]
    place = seen - turn.apply(joints[0])  # the turn is about the root joint
    return Motion(
        at=at,
        rotations=_continuous(rotations),
        translations=bones[..., None] * offsets,
        place=place * exported.length,
        facing=_continuous(turn.as_quat()),
        size=exported.length,
        betas=s.betas[n, at].astype(np.float64),
    )


def _between(first: Float[np.ndarray, "M 3"], second: Float[np.ndarray, "M 3"]) -> Rotation:
    """Return the smallest rotations that turn one direction into another."""
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (first, second))
    axis = np.cross(a, b)
    sine, cosine = np.linalg.norm(axis, axis=1, keepdims=True), np.sum(a * b, axis=1, keepdims=True)
    return Rotation.from_rotvec(axis / np.maximum(sine, 1e-12) * np.arctan2(sine, cosine))


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
