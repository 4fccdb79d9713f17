"""`Pose`, and from a pose to joints, keypoints and vertices, with the derivative of keypoints.

Skinning is linear in the joint transforms A (J, 3, 4). Constant factors are therefore multiplied once, into a `Rig`:
keypoints are a linear map (K, J, 4) of A that needs no mesh, and vertices need one (12, J)·(J, V) product.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfit.model.bird import Bird
from jaxfit.model.rotation import axis_angle_to_matrix, right_jacobian


class Pose(eqx.Module):
    """The pose of one bird in one frame; in a window, the fields have a leading frame axis T.

    Rotations are axis-angle in radians, each joint relative to its parent. Translations are in model units, camera
    frame. In a window, `bone_length` and `betas` have no frame axis, because skeleton and shape of a bird do not
    change. `scale` has one entry per frame, or one entry for the window ("common size"). In a batch, every field has
    further leading axes W. There are J−1 bones.
    """

    global_orient: Float[Array | np.ndarray, "*T 3"]
    """Rotation model → camera, about the rest position of the root joint."""
    body_pose: Float[Array | np.ndarray, "*T bones 3"]
    """Rotation of every joint except the root relative to its parent."""
    transl: Float[Array | np.ndarray, "*T 3"]
    """Translation in the camera frame: the posed root joint is at scale · (rest position of the root) + transl."""
    scale: Float[Array | np.ndarray, "*#T"]
    """Size relative to the model's rest size."""
    bone_length: Float[Array | np.ndarray, "*W bones"]
    """Length of each bone relative to the rest skeleton."""
    betas: Float[Array | np.ndarray, "*W S"]
    """Shape coefficients."""


def rest_pose(bird: Bird, frames: int | None = None, common_size: bool = False) -> Pose:
    """Return the mean pose and mean bone lengths of the prior, without rotation and translation, at scale 1.

    Args:
        bird: the model.
        frames: length T of a window; None gives one frame without a leading axis.
        common_size: one scale for the window instead of one scale per frame.
    """
    lead = () if frames is None else (frames,)
    joints = bird.num_joints
    return Pose(
        global_orient=jnp.zeros((*lead, 3)),
        body_pose=jnp.broadcast_to(bird.pose_mean.reshape(joints - 1, 3), (*lead, joints - 1, 3)),
        transl=jnp.zeros((*lead, 3)),
        scale=jnp.ones((1,) if common_size and frames is not None else lead),
        bone_length=bird.bone_mean,
        betas=jnp.zeros(bird.num_shapes),
    )


class Rig(eqx.Module):
    """The arrays of a bird that forward kinematics needs, with constant factors multiplied in advance.

    Pass a rig to compiled functions as an argument. XLA would fold a constant rig into the program, which is slow.
    """

    joints: Float[Array, "J 3"]
    keypoint_map: Float[Array, "K J 4"]
    """Σ_v keypoint_weights · skin_weights · (v, 1): keypoints as a linear map of the joint transforms."""
    keypoint_shape_map: Float[Array, "S K J 3"]
    """The same map for each shape direction; the last coefficients may be those of a detector (`with_detector`)."""
    vertices: Float[Array, "3 V"]
    """Rest vertices. V is the last axis here and below, so that products run along contiguous memory."""
    skin_weights: Float[Array, "J V"]
    vertex_joints: Int[Array, "V M"]
    """The joints that move each vertex, for M joints or fewer."""
    vertex_weights: Float[Array, "V M"]
    """Skinning weights of these joints; 0 for entries that are not used."""
    shape_basis: Float[Array, "S 3 V"]
    """Further coefficients move keypoints only."""
    faces: Int[Array, "F 3"]
    parents: tuple[int, ...] = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    keypoint_names: tuple[str, ...] = eqx.field(static=True)
    of_detector: int = eqx.field(static=True, default=0)
    """How many of the last coefficients belong to the detector, not to the bird (`with_detector`)."""

    @property
    def num_shapes(self) -> int:
        """The number of shape coefficients of the bird."""
        return len(self.keypoint_shape_map) - self.of_detector


def fold_bird(bird: Bird) -> Rig:
    """Multiply keypoint weights, skin weights, rest vertices and shape directions into a rig (in float64)."""
    weights = np.asarray(bird.skin_weights, np.float64)
    to_keypoints = np.asarray(bird.keypoint_weights, np.float64)
    basis = np.asarray(bird.shape_basis, np.float64)
    homogeneous = np.concatenate([np.asarray(bird.vertices, np.float64), np.ones((len(weights), 1))], axis=1)

    def put(values, dtype: type = np.float32):  # unlike jnp.asarray, this compiles no program for each shape
        return jax.device_put(np.asarray(values, dtype))

    def on_keypoints(points):  # Σ_v keypoint_weights · skin_weights · point
        return put(np.einsum("kv,vj,...vc->...kjc", to_keypoints, weights, points, optimize=True))

    most = max(int((weights != 0).sum(axis=1).max(initial=0)), 1)
    vertex_joints = np.argsort(weights == 0, axis=1, kind="stable")[:, :most]  # the joints with a weight first
    return Rig(
        joints=put(bird.joints),
        keypoint_map=on_keypoints(homogeneous),
        keypoint_shape_map=on_keypoints(basis),
        vertices=put(np.asarray(bird.vertices).T),
        skin_weights=put(weights.T),
        vertex_joints=put(vertex_joints, np.int32),
        vertex_weights=put(np.take_along_axis(weights, vertex_joints, axis=1)),
        shape_basis=put(basis.transpose(0, 2, 1)),
        faces=put(bird.faces, np.int32),
        parents=bird.parents,
        joint_names=bird.joint_names,
        keypoint_names=bird.keypoint_names,
    )


def move_keypoints(rig: Rig, offsets: Float[Array | np.ndarray, "K 3"]) -> Rig:
    """Return the rig with other keypoints.

    The joints move a new point with the weights of the old point.

    Args:
        rig: the folded bird.
        offsets: added to the rest positions of the keypoints, model units.
    """
    linear, constant = rig.keypoint_map[..., :3], rig.keypoint_map[..., 3:]
    return replace(rig, keypoint_map=jnp.concatenate([linear + offsets[:, None] * constant, constant], axis=-1))


def with_detector(rig: Rig, normals: Float[np.ndarray, "V 3"], directions: Float[np.ndarray, "D K 3"]) -> Rig:
    """Return the rig with 1 + D further shape coefficients of a detector.

    The first moves the mesh along its normals and no keypoint: masks that are too large. The others move keypoints and
    not the mesh.

    Args:
        rig: the folded bird.
        normals: unit normals of the rest vertices.
        directions: movement of the rest positions of the keypoints for a coefficient of 1, model units.
    """
    constant = rig.keypoint_map[..., 3:]  # as for `move_keypoints`
    moved = jnp.asarray(directions, jnp.float32)[:, :, None] * constant
    still = jnp.zeros_like(rig.keypoint_map[None, ..., :3])
    return replace(
        rig,
        keypoint_shape_map=jnp.concatenate([rig.keypoint_shape_map, still, moved]),
        shape_basis=jnp.concatenate([rig.shape_basis, jnp.asarray(normals, jnp.float32).T[None]]),
        of_detector=1 + len(directions),
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
    if len(pose.betas):
        unit = unit + jnp.einsum("kjc,jdc->kd", _keypoint_shape(rig, pose), A[..., :3])
    return unit * pose.scale + pose.transl


def _keypoint_shape(rig: Rig, pose: Pose) -> Float[Array, "K J 3"]:
    """Return the change of the keypoint map by the coefficients of a pose; missing coefficients are 0."""
    return jnp.tensordot(pose.betas, rig.keypoint_shape_map[: len(pose.betas)], axes=1)


def posed_vertices(rig: Rig, A: Float[Array, "J 3 4"], pose: Pose) -> Float[Array, "V 3"]:
    """Return the posed vertices of one frame by linear blend skinning, camera frame, model units."""
    T = (A.reshape(-1, 12).T @ rig.skin_weights).reshape(3, 4, -1)
    v = shaped_vertices(rig, pose)
    # written as a sum, because XLA needs ten times as long for the same contraction
    unit = jnp.stack([T[d, 0] * v[0] + T[d, 1] * v[1] + T[d, 2] * v[2] + T[d, 3] for d in range(3)], axis=-1)
    return unit * pose.scale + pose.transl


def shaped_vertices(rig: Rig, pose: Pose) -> Float[Array, "3 V"]:
    """Return the rest vertices of the shape of a pose, model units."""
    return rig.vertices + jnp.tensordot(pose.betas[: rig.shape_basis.shape[0]], rig.shape_basis, axes=1)


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
    if len(pose.betas):
        keypoint_map = keypoint_map.at[..., :3].add(_keypoint_shape(rig, pose))
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
    """Return the derivatives of the keypoints with respect to `bone_length` (n = J−1) or `betas`.

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


def transform_generators(
    rig: Rig, A: Float[Array, "J 3 4"], pose: Pose, with_bones: bool = False
) -> Float[Array, "3 4 P"]:
    """Return the factors G_p of the derivatives dB_d/dp = G_p·[B_d; 0 0 0 1] of the scaled transforms B_d = s·A_d.

    The factors hold for the joints d that the parameter p moves (`moved_joints`); the others have derivatives of 0. A
    rest point v is posed at Σ_d w_d · B_d·(v, 1) + τ. The parameters are the axis-angles of all joints, root first
    (3J), the translation τ (3), the scale s (1) and, with `with_bones`, the lengths of the bones (J−1). A change dθ_j
    rotates by ω = R_j·Jr(θ_j)·dθ_j about the posed position p_j of the joint: G = [[ω]× | −ω × p_j].

    Args:
        rig: the folded bird.
        A: unit-scale joint transforms [R_d | t_d] of this pose, one frame.
        pose: pose of the same frame.
        with_bones: whether the lengths of the bones have columns.

    Returns:
        The factors, per radian, per model unit, per unit of scale, and per unit of bone length.

    Source: the geometric Jacobian, Siciliano et al. 2009, Robotics, section 3.1.
    """
    scale = jnp.asarray(pose.scale)
    turn = _turns(A, pose).swapaxes(1, 2)  # the rotations of a joint in its rows
    arm = jnp.pad(-scale * unit_joints(rig, A)[:, None], ((0, 0), (3, 0), (0, 0))) + jnp.eye(4, 3)  # (J, 4, 3)
    by_angles = jnp.cross(turn[:, None], arm[:, :, None])  # (J, 4, 3 angles, 3)
    by_angles = by_angles.transpose(3, 1, 0, 2).reshape(3, 4, -1)
    last = jnp.array([0.0, 0.0, 0.0, 1.0])[:, None]
    columns = [by_angles, jnp.eye(3)[:, None] * last, jnp.eye(3, 4)[..., None] / scale]
    if with_bones:
        columns.append(scale * _bone_vectors(rig, A).T[:, None] * last)
    return jnp.concatenate(columns, axis=-1)


def window_transform_generators(
    rig: Rig, A: Float[Array, "T J 3 4"], pose: Pose, with_bones: bool = False
) -> Float[Array, "T 3 4 P"]:
    """Return `transform_generators` of every frame of a window."""
    return each_frame(lambda frame, A: transform_generators(rig, A, frame, with_bones), pose, A)


def moved_joints(rig: Rig, with_bones: bool = False) -> Float[np.ndarray, "J P"]:
    """Return 1 where a parameter of `transform_generators` moves a joint, and else 0."""
    descendants = _descendants(rig.parents).astype(np.float32)
    columns = [np.repeat(descendants, 3, axis=1), np.ones_like(descendants[:, :1]).repeat(4, axis=1)]
    return np.concatenate([*columns, descendants[:, 1:]] if with_bones else columns, axis=1)


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
