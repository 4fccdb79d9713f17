"""How keypoints move with a pose: their derivative written out, far cheaper than by automatic differentiation."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit.model.kinematics import Rig, each_frame, unit_joints
from jaxfit.model.pose import Pose
from jaxfit.model.rotation import right_jacobian

__all__ = ["keypoint_rotation_rows", "window_keypoint_rows"]


def keypoint_rotation_rows(
    rig: Rig, A: Float[Array, "J 3 4"], pose: Pose, directions: Float[Array, "K R 3"]
) -> Float[Array, "K R J 3"]:
    """Rows n·∂x/∂θ_j of each keypoint x, for its directions n and the axis-angles θ of all joints, root first.

    Turning joint j by ω (camera frame) carries all that hangs on it about the joint's posed place p_j:
    n·dx = ω·(l_kj × n), with the lever l_kj = scale · Σ_{d below j} (map_kd·A_d − w_kd·p_j); and
    ω = R_j·Jr(θ_j)·dθ_j. Identity directions give the Jacobian itself.

    Args:
        rig: the folded bird.
        A: unit-scale joint transforms of this pose, one frame.
        pose: of the same frame.
        directions: rows that the derivative is multiplied with from the left, camera frame.

    Source: the geometric Jacobian, Siciliano et al. 2009, Robotics, section 3.1, with skinning weights.
    """
    below = jnp.asarray(_below(rig.parents), jnp.float32)
    keypoint_map = rig.keypoint_map
    if rig.shape_basis.shape[0]:
        keypoint_map = keypoint_map.at[..., :3].add(jnp.tensordot(pose.betas, rig.keypoint_shape_map, axes=1))
    carried = jnp.einsum("kdc,dxc->kxd", keypoint_map, A) @ below
    weight = keypoint_map[..., 3] @ below
    lever = pose.scale * (carried - weight[:, None] * unit_joints(rig, A).T)  # (K, 3, J)
    (lx, ly, lz), (nx, ny, nz) = jnp.moveaxis(lever[:, :, None], 1, 0), jnp.moveaxis(directions[..., None], 2, 0)
    torque = (ly * nz - lz * ny, lz * nx - lx * nz, lx * ny - ly * nx)  # each (K, R, J)
    angles = jnp.concatenate([pose.global_orient[None], pose.body_pose])
    turn = jnp.sum(A[..., :3, None] * right_jacobian(angles)[:, None], axis=-2)  # (J, 3, 3)
    return torque[0][..., None] * turn[:, 0] + torque[1][..., None] * turn[:, 1] + torque[2][..., None] * turn[:, 2]


def window_keypoint_rows(
    rig: Rig, A: Float[Array, "T J 3 4"], pose: Pose, directions: Float[Array, "T K R 3"]
) -> Float[Array, "T K R angles"]:
    """`keypoint_rotation_rows` of every frame of a window, the 3J angles side by side."""

    def one(frame: Pose, A, directions):
        rows = keypoint_rotation_rows(rig, A, frame, directions)
        return rows.reshape(*rows.shape[:2], -1)

    return each_frame(one, pose, A, directions)


def _below(parents: tuple[int, ...]) -> np.ndarray:
    """(J, J): whether joint d is j or hangs on it."""
    below = np.eye(len(parents), dtype=bool)
    for d, parent in enumerate(parents[1:], start=1):
        below[d] |= below[parent]
    return below
