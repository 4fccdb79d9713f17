"""Analytic derivatives of keypoints with respect to joint angles; much cheaper than automatic differentiation."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit.model.kinematics import Rig, each_frame, unit_joints
from jaxfit.model.pose import Pose
from jaxfit.model.rotation import right_jacobian

__all__ = [
    "keypoint_derivatives",
    "keypoint_rotation_rows",
    "shape_derivatives",
    "transform_derivatives",
    "window_keypoint_derivatives",
    "window_keypoint_rows",
    "window_shape_derivatives",
    "window_transform_derivatives",
]


def keypoint_rotation_rows(
    rig: Rig, A: Float[Array, "J 3 4"], pose: Pose, directions: Float[Array, "K R 3"]
) -> Float[Array, "K R J 3"]:
    """Return the rows n·∂x/∂θ_j for each keypoint x, its directions n and the axis-angles θ of all joints, root first.

    A rotation of joint j by ω (camera frame) rotates joint j and all its descendants about the posed position p_j of
    the joint: n·dx = ω·(l_kj × n), with the lever arm l_kj = scale · Σ_d (map_kd·A_d − w_kd·p_j), summed over d = j
    and its descendants, and ω = R_j·Jr(θ_j)·dθ_j. Identity directions give the Jacobian.

    Args:
        rig: the folded bird.
        A: unit-scale joint transforms of this pose, one frame.
        pose: pose of the same frame.
        directions: row vectors n that multiply the derivative from the left, camera frame.

    Returns:
        The derivatives, model units per radian times the unit of the directions.

    Source: the geometric Jacobian, Siciliano et al. 2009, Robotics, section 3.1, with skinning weights.
    """
    descendants = jnp.asarray(_descendants(rig.parents), jnp.float32)
    keypoint_map = rig.keypoint_map
    if rig.shape_basis.shape[0]:
        keypoint_map = keypoint_map.at[..., :3].add(jnp.tensordot(pose.betas, rig.keypoint_shape_map, axes=1))
    moved = jnp.einsum("kdc,dxc->kxd", keypoint_map, A) @ descendants
    weight = keypoint_map[..., 3] @ descendants
    lever = pose.scale * (moved - weight[:, None] * unit_joints(rig, A).T)  # (K, 3, J)
    (lx, ly, lz), (nx, ny, nz) = jnp.moveaxis(lever[:, :, None], 1, 0), jnp.moveaxis(directions[..., None], 2, 0)
    cross = (ly * nz - lz * ny, lz * nx - lx * nz, lx * ny - ly * nx)  # l × n, each component (K, R, J)
    turn = _turns(A, pose)
    return cross[0][..., None] * turn[:, 0] + cross[1][..., None] * turn[:, 1] + cross[2][..., None] * turn[:, 2]


def window_keypoint_rows(
    rig: Rig, A: Float[Array, "T J 3 4"], pose: Pose, directions: Float[Array, "T K R 3"]
) -> Float[Array, "T K R angles"]:
    """Return `keypoint_rotation_rows` of every frame of a window, with the 3J angles in one axis."""

    def frame_rows(frame: Pose, A, directions):
        rows = keypoint_rotation_rows(rig, A, frame, directions)
        return rows.reshape(*rows.shape[:2], -1)

    return each_frame(frame_rows, pose, A, directions)


def keypoint_derivatives(rig: Rig, A: Float[Array, "J 3 4"], pose: Pose, name: str) -> Float[Array, "K 3 n"]:
    """Return the derivatives of the keypoints with respect to `bone_length` (n = J−1) or `betas` (n = S).

    Args:
        rig: the folded bird.
        A: unit-scale joint transforms of this pose, one frame.
        pose: pose of the same frame.
        name: `bone_length` or `betas`.

    Returns:
        The derivatives, camera frame, model units.
    """
    if name == "betas":
        return jnp.asarray(pose.scale) * jnp.einsum("skjc,jdc->kds", rig.keypoint_shape_map, A[..., :3])
    weight = rig.keypoint_map[..., 3] @ jnp.asarray(_descendants(rig.parents), jnp.float32)
    return jnp.asarray(pose.scale) * weight[:, None, 1:] * _bone_vectors(rig, A).T


def window_keypoint_derivatives(rig: Rig, A: Float[Array, "T J 3 4"], pose: Pose, name: str) -> Float[Array, "T K 3 n"]:
    """Return `keypoint_derivatives` of every frame of a window."""
    return each_frame(lambda frame, A: keypoint_derivatives(rig, A, frame, name), pose, A)


def transform_derivatives(
    rig: Rig, A: Float[Array, "J 3 4"], pose: Pose, with_bones: bool = False
) -> Float[Array, "J 3 4 D"]:
    """Return the derivatives of the joint transforms in the camera frame, B_d = [s·R_d | s·t_d + τ].

    A rest point v is posed at Σ_d w_d · B_d·(v, 1). The columns are the axis-angles of all joints, root first (3J),
    the translation τ (3), the scale s (1) and, with `with_bones`, the lengths of the bones (J−1). A rotation of joint j
    by ω rotates the transforms of joint j and of its descendants about the posed position p_j of the joint, with
    ω = R_j·Jr(θ_j)·dθ_j.

    Args:
        rig: the folded bird.
        A: unit-scale joint transforms [R_d | t_d] of this pose, one frame.
        pose: pose of the same frame.
        with_bones: whether the lengths of the bones have columns.

    Returns:
        The derivatives, model units per radian, per model unit, per unit of scale, and per unit of bone length.

    Source: the geometric Jacobian, Siciliano et al. 2009, Robotics, section 3.1.
    """
    count = len(rig.parents)
    descendants = jnp.asarray(_descendants(rig.parents), jnp.float32)
    turn = _turns(A, pose)
    centre = jnp.pad(unit_joints(rig, A).T[:, None], ((0, 0), (3, 0), (0, 0)))  # (3, 4, J): 0 but for the last column
    arm = pose.scale * descendants[:, None, None] * (A[..., None] - centre)  # (J, 3, 4, J)
    (ax, ay, az), (tx, ty, tz) = jnp.moveaxis(arm[..., None], 1, 0), jnp.moveaxis(turn, 1, 0)
    by_angles = jnp.stack([ty * az - tz * ay, tz * ax - tx * az, tx * ay - ty * ax], axis=1)  # (J, 3, 4, J, 3)
    last = jnp.array([0.0, 0.0, 0.0, 1.0])
    by_transl = jnp.broadcast_to(jnp.eye(3)[:, None] * last[:, None], (count, 3, 4, 3))
    columns = [by_angles.reshape(count, 3, 4, -1), by_transl, A[..., None]]
    if with_bones:
        moved = jnp.asarray(pose.scale) * descendants[:, None, 1:] * _bone_vectors(rig, A).T  # (J, 3, J−1)
        columns.append(moved[:, :, None] * last[:, None])
    return jnp.concatenate(columns, axis=-1)


def window_transform_derivatives(
    rig: Rig, A: Float[Array, "T J 3 4"], pose: Pose, with_bones: bool = False
) -> Float[Array, "T J 3 4 D"]:
    """Return `transform_derivatives` of every frame of a window."""
    return each_frame(lambda frame, A: transform_derivatives(rig, A, frame, with_bones), pose, A)


def shape_derivatives(rig: Rig, A: Float[Array, "J 3 4"], pose: Pose) -> Float[Array, "V 3 S"]:
    """Return the derivatives of the posed vertices of one frame with respect to the shape coefficients, camera frame,
    model units."""
    turn = (A[..., :3].reshape(-1, 9).T @ rig.skin_weights).reshape(3, 3, -1)
    return jnp.asarray(pose.scale) * jnp.einsum("dcv,scv->vds", turn, rig.shape_basis)


def window_shape_derivatives(rig: Rig, A: Float[Array, "T J 3 4"], pose: Pose) -> Float[Array, "T V 3 S"]:
    """Return `shape_derivatives` of every frame of a window."""
    return each_frame(lambda frame, A: shape_derivatives(rig, A, frame), pose, A)


def _bone_vectors(rig: Rig, A: Float[Array, "J 3 4"]) -> Float[Array, "bones 3"]:
    """Return the bones of length 1 in the pose at scale 1, camera frame: the change of joint j and of its descendants
    per unit of length of the bone that ends at joint j."""
    parents = np.asarray(rig.parents[1:])
    offsets = rig.joints[1:] - rig.joints[parents]
    return jnp.sum(A[parents, :, :3] * offsets[:, None], axis=-1)


def _turns(A: Float[Array, "J 3 4"], pose: Pose) -> Float[Array, "J 3 3"]:
    """Return R_j·Jr(θ_j): the rotation (camera frame) of each joint per change of its axis-angle."""
    angles = jnp.concatenate([pose.global_orient[None], pose.body_pose])
    return jnp.sum(A[..., :3, None] * right_jacobian(angles)[:, None], axis=-2)


def _descendants(parents: tuple[int, ...]) -> np.ndarray:
    """Return a (J, J) matrix: entry (d, j) is true if joint d is joint j or a descendant of joint j."""
    descendants = np.eye(len(parents), dtype=bool)
    for d, parent in enumerate(parents[1:], start=1):
        descendants[d] |= descendants[parent]
    return descendants
