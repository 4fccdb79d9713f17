"""Joint positions of the murre, and the unfolding of its wing.

Joints, names and axes are those of the published models (`jaxfit.model.anatomy`), so a body pose has the same meaning
for all models. In the rest pose the bird is nearly horizontal, the wings are folded, the legs point down, and the root
is at the origin between the knees. Positions in this module are in centimetres, left side only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxfit.model.anatomy import JOINT_NAMES

CM_PER_UNIT = 2.0
"""Length of one model unit. The murre is then about 20 units long, as the published birds are, so learning rates,
priors and weights that were tuned on the published birds remain valid."""

PARENTS = (-1, 0, 1, 0, 3, 3, 5, 6, 7, 3, 9, 10, 11, 3, 13, 14, 15, 3, 17, 18, 19, 3, 21, 22, 23)
"""Parent of each joint, in the order of `JOINT_NAMES`."""

MIDDLE_AND_LEFT = {
    "root": (0.0, 0.0, 0.0),
    "lower_body": (0.0, -2.5, 2.6),
    "tail": (0.0, -10.6, 2.3),
    "upper_body": (0.0, -2.5, 2.7),
    "chest": (0.0, 5.0, 3.2),
    "left_hip": (0.0, -2.5, 2.5),
    "left_knee": (-3.0, -1.5, -0.3),
    "left_ankle": (-3.3, -7.0, -4.0),
    "left_foot": (-3.3, -4.2, -6.5),
    "left_wing_root": (0.0, 7.6, 5.2),
    "left_shoulder": (-2.8, 7.6, 5.2),
    "left_elbow": (-5.3, 0.6, 4.3),
    "left_wrist": (-6.0, 7.0, 2.4),
    "neck_root": (0.0, 7.6, 4.6),
    "neck": (0.0, 10.0, 7.2),
    "head": (0.0, 12.5, 10.9),
    "jaw": (0.0, 17.0, 11.5),
}


class Frame(NamedTuple):
    """Orientation of a wing bone: the direction of the bone, and the normal of the upper side of the wing."""

    along: tuple[float, float, float]
    above: tuple[float, float, float]

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Return the axes as columns: along the bone, across the wing, out of the upper side (orthonormal)."""
        along = np.asarray(self.along) / np.linalg.norm(self.along)
        above = np.asarray(self.above) - np.dot(self.above, along) * along
        above /= np.linalg.norm(above)
        return np.stack([along, np.cross(above, along), above], axis=1)


WING_BONES = ("left_shoulder", "left_elbow", "left_wrist")
WING_TIP = (-1.6, -12.7, 3.4)
"""Tip of the longest primary of the folded wing."""
FOLDED_ABOVE = ((-0.85, 0.0, 0.5), (-0.95, 0.1, 0.25), (-0.97, 0.0, 0.25))
"""Normals of the upper side at humerus, forearm and hand of the folded wing."""
SPREAD = (
    Frame((-0.93, -0.30, 0.06), (0.0, 0.0, 1.0)),
    Frame((-0.93, 0.36, 0.02), (0.0, 0.0, 1.0)),
    Frame((-0.92, -0.38, -0.02), (0.0, 0.0, 1.0)),
)
"""Orientation of humerus, forearm and hand of the spread wing."""


def joint_positions() -> Float[np.ndarray, "J 3"]:
    """Return the rest positions of all joints in centimetres."""
    mirror = np.array([-1.0, 1.0, 1.0])
    return np.stack(
        [
            np.asarray(MIDDLE_AND_LEFT[name])
            if name in MIDDLE_AND_LEFT
            else mirror * MIDDLE_AND_LEFT[name.replace("right_", "left_")]
            for name in JOINT_NAMES
        ]
    )


def spread_rotations() -> dict[str, Float[np.ndarray, "3 3"]]:
    """Return the rotation folded → spread of each bone of the left wing, relative to its parent."""
    ends = [np.asarray(MIDDLE_AND_LEFT[name]) for name in WING_BONES] + [np.asarray(WING_TIP)]
    local, above = {}, np.eye(3)
    for i, name in enumerate(WING_BONES):
        folded = Frame(tuple(ends[i + 1] - ends[i]), FOLDED_ABOVE[i])
        world = SPREAD[i].matrix() @ folded.matrix().T
        local[name] = above.T @ world
        above = world
    return local


def spread_transforms(share: float = 1.0) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return (R, t) for each bone of the left wing, x ↦ R x + t in centimetres, for a partly unfolded wing.

    Args:
        share: share of the unfolding, 0 (folded) to 1 (spread).
    """
    R, position, transforms = np.eye(3), np.asarray(MIDDLE_AND_LEFT["left_shoulder"]), {}
    local, parent = spread_rotations(), position
    for name in WING_BONES:
        joint = np.asarray(MIDDLE_AND_LEFT[name])
        position = position + R @ (joint - parent)
        R = R @ Rotation.from_rotvec(share * Rotation.from_matrix(local[name]).as_rotvec()).as_matrix()
        transforms[name] = (R, position - R @ joint)
        parent = joint
    return transforms
