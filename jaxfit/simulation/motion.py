"""Smooth random motion of a bird, drawn from its pose prior."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxfit.model.bird import Bird
from jaxfit.model.pose import Pose
from jaxfit.model.rotation import unwrap_axis_angle

__all__ = ["smooth_motion", "smooth_noise"]

FRAMES_PER_KNOT = 20.0
"""A random knot every 20 frames: at 25 frames/s, movements last about a second."""


def smooth_noise(
    rng: np.random.Generator, frames: int, shape: tuple[int, ...] = (), frames_per_knot: float = FRAMES_PER_KNOT
) -> Float[np.ndarray, "T *shape"]:
    """Draw smooth random curves of about unit standard deviation: standard normal knots, joined by cosine ramps.

    Args:
        rng: source of randomness.
        frames: length T.
        shape: shape of the array of independent curves.
        frames_per_knot: number of frames between knots.
    """
    knots = rng.normal(size=(int(frames / frames_per_knot) + 2, *shape))
    at = np.arange(frames) / frames_per_knot
    low = at.astype(int)
    ramp = ((1 - np.cos(np.pi * (at - low))) / 2).reshape(-1, *[1] * len(shape))
    return (1 - ramp) * knots[low] + ramp * knots[low + 1]


def smooth_motion(bird: Bird, frames: int, seed: int, depth: float = 200.0, spread: float = 0.7) -> Pose:
    """Draw smooth poses of a bird seen from above that turns, leans, bends and drifts.

    Args:
        bird: the model; body poses vary about the mean of its prior.
        frames: length T of the window.
        seed: seed of the motion.
        depth: distance from the camera in model units.
        spread: amplitude of the body pose, in standard deviations of the prior.

    Returns:
        The pose of a window, with one scale between 0.9 and 1.1, mean bone lengths and mean shape.
    """
    rng = np.random.default_rng(seed)
    from_above = Rotation.from_rotvec([np.pi, 0, 0])  # rotates z up to z towards the camera
    heading = rng.uniform(-np.pi, np.pi) + 0.6 * smooth_noise(rng, frames)
    turned = Rotation.from_rotvec(heading[:, None] * [0, 0, 1])
    orient = turned * Rotation.from_rotvec(0.25 * smooth_noise(rng, frames, (3,))) * from_above
    cholesky = np.linalg.cholesky(np.asarray(bird.pose_covariance, np.float64))
    body = np.asarray(bird.pose_mean) + spread * smooth_noise(rng, frames, (len(cholesky),)) @ cholesky.T
    place = rng.normal(size=2) + np.cumsum(0.05 * smooth_noise(rng, frames, (2,)), axis=0)
    return Pose(
        global_orient=unwrap_axis_angle(jnp.asarray(orient.as_rotvec(), jnp.float32)),
        body_pose=jnp.asarray(body.reshape(frames, -1, 3), jnp.float32),
        transl=jnp.asarray(np.column_stack([place, np.full(frames, depth)]), jnp.float32),
        scale=jnp.full(1, rng.uniform(0.9, 1.1), jnp.float32),
        bone_length=jnp.asarray(bird.bone_mean),
        betas=jnp.zeros(bird.num_shapes),
    )
