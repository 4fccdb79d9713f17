"""Build the murre: `python -m jaxfit.model.murre.build` writes `jaxfit/model/murre.npz`."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxfit.model.anatomy import JOINT_NAMES, MURRE_KEYPOINTS, mirror_pairs
from jaxfit.model.bird import Bird
from jaxfit.model.checks import check_bird
from jaxfit.model.files import MURRE_PATH, save_bird
from jaxfit.model.murre.plumage import half_colours, keypoint_weights
from jaxfit.model.murre.prior import joint_limits, pose_prior
from jaxfit.model.murre.skeleton import CM_PER_UNIT, PARENTS, joint_positions
from jaxfit.model.murre.skinning import half_weights, mirrored_weights
from jaxfit.model.murre.surface import make_half, mirrored
from jaxfit.model.murre.variation import SHAPES, bone_prior, half_shapes

__all__ = ["build_murre"]


def build_murre() -> Bird:
    """Build the murre from the numbers in this package; the result is equal on all machines up to rounding."""
    half = make_half()
    mesh = mirrored(half)
    left = half_weights(half)
    mirror = np.where(mesh.right[:, None], [-1.0, 1.0, 1.0], 1.0)
    shapes = half_shapes(half, left)[:, mesh.half] * mirror
    pose_mean, pose_covariance = pose_prior()
    bone_mean, bone_covariance = bone_prior()

    def float32(array):
        return jnp.asarray(np.asarray(array, np.float32))

    bird = Bird(
        vertices=float32(mesh.vertices / CM_PER_UNIT),
        faces=jnp.asarray(mesh.faces.astype(np.int32)),
        joints=float32(joint_positions() / CM_PER_UNIT),
        skin_weights=float32(mirrored_weights(mesh, left)),
        keypoint_weights=float32(keypoint_weights(half, mesh)),
        shape_basis=float32(shapes / CM_PER_UNIT),
        shape_variance=float32(np.ones(len(SHAPES))),
        pose_mean=float32(pose_mean),
        pose_covariance=float32(pose_covariance),
        bone_mean=float32(bone_mean),
        bone_covariance=float32(bone_covariance),
        vertex_colours=float32(half_colours(half)[mesh.half]),
        joint_limits=float32(joint_limits()),
        parents=PARENTS,
        joint_names=JOINT_NAMES,
        keypoint_names=MURRE_KEYPOINTS,
        joint_pairs=mirror_pairs(JOINT_NAMES),
        keypoint_pairs=mirror_pairs(MURRE_KEYPOINTS),
        name="murre",
        metres_per_unit=CM_PER_UNIT / 100,
    )
    return check_bird(bird, "murre")


if __name__ == "__main__":
    save_bird(build_murre(), MURRE_PATH)
