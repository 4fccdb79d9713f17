"""The murre's pose prior and joint limits: designed from the postures, not learnt from birds.

Poses are drawn between pairs of postures, with a little independent noise at every joint, each with its mirror image.
Their mean and covariance are the Gaussian prior. It prefers what murres on a ledge do, standing above all, and leaves
the wings room along the way in which they unfold.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxfit.model.anatomy import JOINT_NAMES
from jaxfit.model.murre.postures import POSTURES, mirrored_pose

__all__ = ["SHARES", "joint_limits", "pose_prior"]

SHARES = {
    "standing": 0.33, "alert": 0.12, "incubating": 0.16, "preening_left": 0.06, "preening_right": 0.06,
    "walking_left": 0.06, "walking_right": 0.06, "jab": 0.05, "wings_half": 0.03, "wings_up": 0.02, "wings_down": 0.02,
    "flapping_up": 0.015, "flapping_down": 0.015,
}  # fmt: skip
"""How often a bird is near each posture."""
NOISE = {"neck_root": 0.12, "neck": 0.15, "head": 0.18, "hip": 0.10, "knee": 0.12, "ankle": 0.15, "foot": 0.15}
OTHER_NOISE = 0.06
"""Standard deviation of the independent noise of each component, radians."""
RIGID = {"jaw": 0.03, "chest": 0.02}
MARGIN = 0.35
"""Radians by which the limits lie outside of every posture."""


def pose_prior() -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """Mean and covariance of the flattened body pose.

    For poses a + s (b − a) with a and b drawn by `SHARES` and s evenly from [0, 1], the moments are known exactly:
    E = Σ p_a x_a and Cov = (2/3) Σ p_a (x_a − E)(x_a − E)ᵀ, since E[(1 − s)² + s²] = 2/3. Nothing is sampled, so the
    prior is the same on every machine.
    """
    names = list(SHARES)
    poses = np.stack([POSTURES[name].body_pose for name in names])
    share = np.array([SHARES[name] for name in names])
    poses = np.concatenate([poses, mirrored_pose(poses)]).reshape(2 * len(names), -1)
    share = np.concatenate([share, share]) / (2 * share.sum())
    mean = share @ poses
    apart = poses - mean
    noise = np.repeat(joint_noise(), 3)
    return mean, (2 / 3) * np.einsum("a,ai,aj->ij", share, apart, apart) + np.diag(noise**2)


def joint_noise() -> Float[np.ndarray, "B"]:
    """Standard deviation of each joint's own noise, radians."""
    known = NOISE | RIGID
    return np.array([known.get(n.removeprefix("left_").removeprefix("right_"), OTHER_NOISE) for n in JOINT_NAMES[1:]])


def joint_limits() -> Float[np.ndarray, "B 3 2"]:
    """Least and greatest of each component over rest and all postures and their mirror images, with a margin."""
    poses = np.stack([np.zeros((len(JOINT_NAMES) - 1, 3)), *(posture.body_pose for posture in POSTURES.values())])
    poses = np.concatenate([poses, mirrored_pose(poses)])
    margin = np.maximum(MARGIN, 3 * joint_noise())[:, None]
    return np.stack([poses.min(axis=0) - margin, poses.max(axis=0) + margin], axis=-1)
