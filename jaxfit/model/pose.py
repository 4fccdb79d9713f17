"""The pose parameters of a bird in one frame or in all frames of a window, as one pytree."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit.model.bird import Bird

__all__ = ["Pose", "rest_pose"]


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
