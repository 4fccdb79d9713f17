"""What a bird is: a skinned mesh with a joint tree, keypoints, shape directions and priors."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

__all__ = ["Bird", "free_limits", "neutral_colours"]


class Bird(eqx.Module):
    """An articulated bird mesh in its rest pose, in model units.

    V vertices, F faces, J joints, K keypoints, S shape directions. Joint 0 is the root and every parent
    stands before its children. The arrays are the model; names, tree and pairs are static, so that a
    compiled program is shared by all birds of one build.

    Source: Badger et al. 2020, *3D Bird Reconstruction*, section 3 (mesh, pose and bone-length priors);
    Wang et al. 2021, *Birds of a Feather*, section 3 (shape directions).
    """

    vertices: Float[Array, "V 3"]
    """Rest positions of the mean shape."""
    faces: Int[Array, "F 3"]
    """Vertex indices of each triangle (int32)."""
    joints: Float[Array, "J 3"]
    """Rest positions of the joints."""
    skin_weights: Float[Array, "V J"]
    """Share of each joint in each vertex; rows sum to 1 and hold at most 8 non-zero entries."""
    keypoint_weights: Float[Array, "K V"]
    """Each keypoint as a mean of vertices; rows sum to 1."""
    shape_basis: Float[Array, "S V 3"]
    """Vertex displacement of one unit of each shape coefficient; S may be 0."""
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
    """Colour of each vertex, sRGB in [0, 1]; how the bird looks, which no fit depends on."""
    joint_limits: Float[Array, "J-1 3 2"]
    """Least and greatest of each axis-angle component of the body pose, radians; ±π where nothing is known."""
    parents: tuple[int, ...] = eqx.field(static=True)
    """Parent of each joint; −1 for the root."""
    joint_names: tuple[str, ...] = eqx.field(static=True)
    keypoint_names: tuple[str, ...] = eqx.field(static=True)
    joint_pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """(left, right) joints that mirror each other."""
    keypoint_pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """(left, right) keypoints that mirror each other."""
    name: str = eqx.field(static=True)

    @property
    def num_joints(self) -> int:
        """J."""
        return len(self.parents)

    @property
    def num_keypoints(self) -> int:
        """K."""
        return len(self.keypoint_names)

    @property
    def num_shapes(self) -> int:
        """S."""
        return self.shape_basis.shape[0]

    @property
    def keypoints(self) -> Float[Array, "K 3"]:
        """Rest positions of the keypoints."""
        return jnp.asarray(self.keypoint_weights) @ jnp.asarray(self.vertices)


def neutral_colours(vertices: int) -> Float[np.ndarray, "V 3"]:
    """`vertex_colours` of a model that has none: grey."""
    return np.full((vertices, 3), 0.7, np.float32)


def free_limits(bones: int) -> Float[np.ndarray, "bones 3 2"]:
    """`joint_limits` of a model that has none: every component may be anything in ±π."""
    return np.broadcast_to(np.array([-np.pi, np.pi], np.float32), (bones, 3, 2)).copy()
