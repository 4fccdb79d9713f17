"""Pose prior and joint limits of the murre: designed from the postures, not learnt from birds.

The prior is the mean and covariance of poses between pairs of postures and of their mirror images, with a little
independent noise at every joint. The prior prefers the postures of murres on a ledge, most of all standing, and has a
large variance along the unfolding of the wings.
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
"""Share of the time that a bird spends near each posture."""
NOISE = {"neck_root": 0.12, "neck": 0.15, "head": 0.18, "hip": 0.10, "knee": 0.12, "ankle": 0.15, "foot": 0.15}
OTHER_NOISE = 0.06
"""Standard deviation of the independent noise of the joints that `NOISE` and `RIGID` do not name, radians."""
RIGID = {"jaw": 0.03, "chest": 0.02}
MARGIN = 0.35
"""Minimum distance of the joint limits from the outermost posture, radians."""


def pose_prior() -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    """Return mean and covariance of the flattened body pose, radians and rad².

    For poses a + s (b − a), with a and b drawn with the probabilities `SHARES` and s uniform in [0, 1], the moments
    have a closed form: E = Σ p_a x_a and Cov = (2/3) Σ p_a (x_a − E)(x_a − E)ᵀ, because E[(1 − s)² + s²] = 2/3. The
    prior needs no sampling, so it is equal on all machines.
    """
    names = list(SHARES)
    poses = np.stack([POSTURES[name].body_pose for name in names])
    share = np.array([SHARES[name] for name in names])
    poses = np.concatenate([poses, mirrored_pose(poses)]).reshape(2 * len(names), -1)
    share = np.concatenate([share, share]) / (2 * share.sum())
    mean = share @ poses
    offset = poses - mean
    noise = np.repeat(joint_noise(), 3)
    return mean, (2 / 3) * np.einsum("a,ai,aj->ij", share, offset, offset) + np.diag(noise**2)


def joint_noise() -> Float[np.ndarray, "B"]:
    """Return the standard deviation of the independent noise of each joint, radians."""
    known = NOISE | RIGID
    return np.array([known.get(n.removeprefix("left_").removeprefix("right_"), OTHER_NOISE) for n in JOINT_NAMES[1:]])


def joint_limits() -> Float[np.ndarray, "B 3 2"]:
    """Return minimum and maximum of each component over the rest pose, all postures and their mirror images.

    The limits include a margin: the larger of `MARGIN` and three standard deviations of the joint noise.
    """
    poses = np.stack([np.zeros((len(JOINT_NAMES) - 1, 3)), *(posture.body_pose for posture in POSTURES.values())])
    poses = np.concatenate([poses, mirrored_pose(poses)])
    margin = np.maximum(MARGIN, 3 * joint_noise())[:, None]
    return np.stack([poses.min(axis=0) - margin, poses.max(axis=0) + margin], axis=-1)
