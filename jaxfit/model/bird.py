"""The bird model: a skinned mesh with a joint tree, keypoints, shape directions and priors."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

__all__ = ["Bird", "neutral_colours", "unlimited_joints"]


class Bird(eqx.Module):
    """An articulated bird mesh in its rest pose, in model units.

    V vertices, F faces, J joints, K keypoints, S shape directions. Joint 0 is the root, and every parent has a
    lower index than its children. Names, joint tree and pairs are static fields, so birds with the same static
    fields and array shapes share one compiled program.

    Source: Badger et al. 2020, *3D Bird Reconstruction*, section 3 (mesh, pose and bone-length priors);
    Wang et al. 2021, *Birds of a Feather*, section 3 (shape directions).
    """

    vertices: Float[Array, "V 3"]
    """Rest positions of the vertices, mean shape."""
    faces: Int[Array, "F 3"]
    """Vertex indices of the triangles (int32)."""
    joints: Float[Array, "J 3"]
    """Rest positions of the joints."""
    skin_weights: Float[Array, "V J"]
    """Skinning weight of each joint for each vertex; rows sum to 1 and have at most 8 non-zero entries."""
    keypoint_weights: Float[Array, "K V"]
    """Keypoints as weighted means of vertices; rows sum to 1."""
    shape_basis: Float[Array, "S V 3"]
    """Vertex displacements for one unit of each shape coefficient; S may be 0."""
    shape_variance: Float[Array, "S"]
    """Variance of each shape coefficient."""
    pose_mean: Float[Array, "D"]
    """Mean of the flattened body pose, D = 3(J−1), axis-angle in radians."""
    pose_covariance: Float[Array, "D D"]
    """Covariance of the flattened body pose."""
    bone_mean: Float[Array, "J-1"]
    """Mean bone length, relative to the rest skeleton."""
    bone_covariance: Float[Array, "J-1 J-1"]
    """Covariance of the bone lengths."""
    vertex_colours: Float[Array, "V 3"]
    """Colour of each vertex, sRGB in [0, 1]; used for drawing only, a fit does not depend on the colours."""
    joint_limits: Float[Array, "J-1 3 2"]
    """Minimum and maximum of each axis-angle component of the body pose, radians; ±π where no limit is known."""
    parents: tuple[int, ...] = eqx.field(static=True)
    """Parent of each joint; −1 for the root."""
    joint_names: tuple[str, ...] = eqx.field(static=True)
    keypoint_names: tuple[str, ...] = eqx.field(static=True)
    joint_pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """(left, right) joints that mirror each other."""
    keypoint_pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """(left, right) keypoints that mirror each other."""
    name: str = eqx.field(static=True)
    metres_per_unit: float | None = eqx.field(static=True, default=None)
    """Length of one model unit in metres; None if unknown. A fit does not depend on this length."""

    @property
    def num_joints(self) -> int:
        """Number of joints J, with the root."""
        return len(self.parents)

    @property
    def num_keypoints(self) -> int:
        """Number of keypoints K."""
        return len(self.keypoint_names)

    @property
    def num_shapes(self) -> int:
        """Number of shape directions S."""
        return self.shape_basis.shape[0]

    @property
    def keypoints(self) -> Float[Array, "K 3"]:
        """Rest positions of the keypoints."""
        return jnp.asarray(self.keypoint_weights) @ jnp.asarray(self.vertices)


def neutral_colours(vertices: int) -> Float[np.ndarray, "V 3"]:
    """Return `vertex_colours` for a model without colours: grey."""
    return np.full((vertices, 3), 0.7, np.float32)


def unlimited_joints(bones: int) -> Float[np.ndarray, "bones 3 2"]:
    """Return `joint_limits` for a model without limits: −π and π for every component."""
    return np.broadcast_to(np.array([-np.pi, np.pi], np.float32), (bones, 3, 2)).copy()
