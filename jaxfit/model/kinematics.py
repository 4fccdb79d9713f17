"""Forward kinematics: posed joints, keypoints and vertices from a pose.

Skinning is linear in the joint transforms A (J, 3, 4). Constant factors are therefore multiplied once, into a `Rig`:
keypoints are a linear map (K, J, 4) of A that needs no mesh, and vertices need one (12, J)·(J, V) product.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfit.model.bird import Bird
from jaxfit.model.pose import Pose
from jaxfit.model.rotation import axis_angle_to_matrix

__all__ = [
    "Rig",
    "each_frame",
    "fold_bird",
    "joint_transforms",
    "posed_joints",
    "posed_keypoints",
    "posed_vertices",
    "shaped_vertices",
    "unit_joints",
    "window_joints",
    "window_keypoints",
    "window_transforms",
    "window_vertices",
]


class Rig(eqx.Module):
    """The arrays of a bird that forward kinematics needs, with constant factors multiplied in advance.

    Pass a rig to compiled functions as an argument. XLA would fold a constant rig into the program, which is slow.
    """

    joints: Float[Array, "J 3"]
    keypoint_map: Float[Array, "K J 4"]
    """Σ_v keypoint_weights · skin_weights · (v, 1): keypoints as a linear map of the joint transforms."""
    keypoint_shape_map: Float[Array, "S K J 3"]
    """The same map for each shape direction."""
    vertices: Float[Array, "3 V"]
    """Rest vertices. V is the last axis here and below, so that products run along contiguous memory."""
    skin_weights: Float[Array, "J V"]
    vertex_joints: Int[Array, "V M"]
    """The joints that move each vertex, for M joints or fewer."""
    vertex_weights: Float[Array, "V M"]
    """Skinning weights of these joints; 0 for entries that are not used."""
    shape_basis: Float[Array, "S 3 V"]
    faces: Int[Array, "F 3"]
    parents: tuple[int, ...] = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    keypoint_names: tuple[str, ...] = eqx.field(static=True)


def fold_bird(bird: Bird) -> Rig:
    """Multiply keypoint weights, skin weights, rest vertices and shape directions into a rig (in float64)."""
    weights = np.asarray(bird.skin_weights, np.float64)
    to_keypoints = np.asarray(bird.keypoint_weights, np.float64)
    basis = np.asarray(bird.shape_basis, np.float64)
    homogeneous = np.concatenate([np.asarray(bird.vertices, np.float64), np.ones((len(weights), 1))], axis=1)

    def on_keypoints(points):  # Σ_v keypoint_weights · skin_weights · point
        return jnp.asarray(np.einsum("kv,vj,...vc->...kjc", to_keypoints, weights, points, optimize=True), jnp.float32)

    most = max(int((weights != 0).sum(axis=1).max(initial=0)), 1)
    vertex_joints = np.argsort(weights == 0, axis=1, kind="stable")[:, :most]  # the joints with a weight first
    return Rig(
        joints=jnp.asarray(bird.joints, jnp.float32),
        keypoint_map=on_keypoints(homogeneous),
        keypoint_shape_map=on_keypoints(basis),
        vertices=jnp.asarray(bird.vertices, jnp.float32).T,
        skin_weights=jnp.asarray(weights.T, jnp.float32),
        vertex_joints=jnp.asarray(vertex_joints, jnp.int32),
        vertex_weights=jnp.asarray(np.take_along_axis(weights, vertex_joints, axis=1), jnp.float32),
        shape_basis=jnp.asarray(basis.transpose(0, 2, 1), jnp.float32),
        faces=jnp.asarray(bird.faces, jnp.int32),
        parents=bird.parents,
        joint_names=bird.joint_names,
        keypoint_names=bird.keypoint_names,
    )


def joint_transforms(rig: Rig, pose: Pose) -> Float[Array, "J 3 4"]:
    """Return the unit-scale joint transforms A_j: a rest point v that moves only with joint j is posed at A_j·(v, 1).

    R_j = R_parent · R(θ_j),  t_j = t_parent + R_parent · (bone_j · (J_j − J_parent)),  A_j = [R_j | t_j − R_j · J_j],
    with R_0 = R(global_orient) and t_0 = J_0: the global orientation rotates about the rest position J_0 of the root
    joint, not about the origin of the model. Scale and translation are applied after skinning. The result is the same
    as with scaled vertices, joints and offsets before skinning.

    Source: avian-mesh (Badger et al. 2020), section 3, "pose".
    """
    depth = [0] * len(rig.parents)
    for j, parent in enumerate(rig.parents[1:], start=1):
        depth[j] = depth[parent] + 1
    rotations = axis_angle_to_matrix(jnp.concatenate([pose.global_orient[None], pose.body_pose]))
    parents = np.maximum(np.asarray(rig.parents), 0)
    offsets = (rig.joints - rig.joints[parents])[1:] * pose.bone_length[:, None]
    # One level of the tree at a time: XLA compiles seven small steps faster than a chain of 25 joints.
    level = np.array([0])
    R_levels, t_levels, order = [rotations[:1]], [rig.joints[:1]], [0]
    for d in range(1, max(depth) + 1):
        children = np.flatnonzero(np.asarray(depth) == d)
        position = np.searchsorted(level, parents[children])
        R_parent, t_parent = R_levels[-1][position], t_levels[-1][position]
        R_levels.append(_matmul(R_parent, rotations[children]))
        t_levels.append(t_parent + _matvec(R_parent, offsets[children - 1]))
        order.extend(children.tolist())
        level = children
    joint_order = np.argsort(order)
    R, t = jnp.concatenate(R_levels)[joint_order], jnp.concatenate(t_levels)[joint_order]
    return jnp.concatenate([R, (t - _matvec(R, rig.joints))[..., None]], axis=-1)


def posed_keypoints(rig: Rig, A: Float[Array, "J 3 4"], pose: Pose) -> Float[Array, "K 3"]:
    """Return the posed keypoints of one frame from its joint transforms, camera frame, model units."""
    unit = jnp.einsum("kjc,jdc->kd", rig.keypoint_map, A)
    if rig.shape_basis.shape[0]:
        shaped = jnp.tensordot(pose.betas, rig.keypoint_shape_map, axes=1)  # (K, J, 3)
        unit = unit + jnp.einsum("kjc,jdc->kd", shaped, A[..., :3])
    return unit * pose.scale + pose.transl


def posed_vertices(rig: Rig, A: Float[Array, "J 3 4"], pose: Pose) -> Float[Array, "V 3"]:
    """Return the posed vertices of one frame by linear blend skinning, camera frame, model units."""
    T = (A.reshape(-1, 12).T @ rig.skin_weights).reshape(3, 4, -1)
    v = shaped_vertices(rig, pose)
    # written as a sum, because XLA needs ten times as long for the same contraction
    unit = jnp.stack([T[d, 0] * v[0] + T[d, 1] * v[1] + T[d, 2] * v[2] + T[d, 3] for d in range(3)], axis=-1)
    return unit * pose.scale + pose.transl


def shaped_vertices(rig: Rig, pose: Pose) -> Float[Array, "3 V"]:
    """Return the rest vertices of the shape of a pose, model units."""
    return rig.vertices + jnp.tensordot(pose.betas, rig.shape_basis, axes=1)


def posed_joints(rig: Rig, A: Float[Array, "J 3 4"], pose: Pose) -> Float[Array, "J 3"]:
    """Return the posed joints of one frame, camera frame, model units."""
    return unit_joints(rig, A) * pose.scale + pose.transl


def unit_joints(rig: Rig, A: Float[Array, "J 3 4"]) -> Float[Array, "J 3"]:
    """Return the posed joints before scale and translation: axes of the camera frame, model units at scale 1."""
    return _matvec(A[..., :3], rig.joints) + A[..., 3]


def window_transforms(rig: Rig, pose: Pose) -> Float[Array, "T J 3 4"]:
    """Return `joint_transforms` of every frame of a window."""
    return each_frame(lambda frame: joint_transforms(rig, frame), pose)


def window_keypoints(rig: Rig, A: Float[Array, "T J 3 4"], pose: Pose) -> Float[Array, "T K 3"]:
    """Return `posed_keypoints` of every frame of a window."""
    return each_frame(lambda frame, A: posed_keypoints(rig, A, frame), pose, A)


def window_joints(rig: Rig, A: Float[Array, "T J 3 4"], pose: Pose) -> Float[Array, "T J 3"]:
    """Return `posed_joints` of every frame of a window."""
    return each_frame(lambda frame, A: posed_joints(rig, A, frame), pose, A)


def window_vertices(rig: Rig, A: Float[Array, "T J 3 4"], pose: Pose) -> Float[Array, "T V 3"]:
    """Return `posed_vertices` of every frame of a window."""
    return each_frame(lambda frame, A: posed_vertices(rig, A, frame), pose, A)


def each_frame(function, pose: Pose, *framewise: Array):
    """Apply a function of one frame to every frame of a window.

    Args:
        function: takes the Pose of one frame and one entry of each further array.
        pose: a window. All frames share `bone_length` and `betas`, and share `scale` if `scale` has one entry.
        framewise: further arrays with a leading frame axis.
    """

    def apply(orient, body, transl, scale, *rest):
        return function(Pose(orient, body, transl, scale, pose.bone_length, pose.betas), *rest)

    scale = jnp.broadcast_to(pose.scale, pose.global_orient.shape[:1])
    return jax.vmap(apply)(pose.global_orient, pose.body_pose, pose.transl, scale, *framewise)


def _matmul(a: Float[Array, "*B 3 3"], b: Float[Array, "*B 3 3"]) -> Float[Array, "*B 3 3"]:
    """Multiply small matrices by sums: XLA fuses and vectorises sums, but calls a library for a batched dot."""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def _matvec(a: Float[Array, "*B 3 3"], v: Float[Array, "*B 3"]) -> Float[Array, "*B 3"]:
    return jnp.sum(a * v[..., None, :], axis=-1)
