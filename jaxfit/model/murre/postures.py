"""Named body poses, the pose prior and the joint limits.

A two-bone inverse kinematics in the sagittal plane (hip, knee) places the legs. With the pitch of the posture about
+x, the tarsi (on which murres rest) and the toes lie flat on level ground.

Pose prior and joint limits of the murre: designed from the postures, not learnt from birds. The prior is the mean and
covariance of poses between pairs of postures and of their mirror images, with a little independent noise at every
joint. The prior prefers the postures of murres on a ledge, most of all standing, and has a large variance along the
unfolding of the wings.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxfit.model.anatomy import JOINT_NAMES, other_side
from jaxfit.model.murre.skeleton import MIDDLE_AND_LEFT, spread_rotations

SIDES = ("left", "right")


class Posture(NamedTuple):
    """A body pose and the pitch of the bird."""

    body_pose: Float[np.ndarray, "bones 3"]
    """Axis-angle of every joint except the root, radians."""
    pitch_rad: float
    """Rotation of the whole bird about +x (bill upwards), radians; 0 is the rest pose."""


def mirrored_pose(body_pose: Float[np.ndarray, "*B bones 3"]) -> Float[np.ndarray, "*B bones 3"]:
    """Return the mirror image of a body pose: sides exchanged, rotations about y and z reversed."""
    swap = [JOINT_NAMES.index(other_side(name)) - 1 for name in JOINT_NAMES[1:]]
    return body_pose[..., swap, :] * np.array([1.0, -1.0, -1.0])


def _posture(
    pitch: float,
    ankles: dict[str, tuple[float, float]] | tuple[float, float] | None = None,
    spread: float = 0.0,
    flap: float = 0.0,
    /,
    **turns: tuple[float, float, float],
) -> Posture:
    """Return a posture; angles are in degrees.

    Args:
        pitch: rotation of the whole bird about +x, degrees.
        ankles: position of the ankles relative to the root (forwards, upwards), in centimetres, with the bird pitched;
            one position for both sides, or one position per side. None: the legs trail behind, as in flight.
        spread: share of the unfolding of the wings, 0 (folded) to 1 (spread).
        flap: elevation of the wings, degrees.
        turns: axis-angles that are added to joints, by name, degrees; the values of left joints apply to both sides.
    """
    pose = {name: np.zeros(3) for name in JOINT_NAMES}
    for name, R in spread_rotations().items():
        pose[name] = spread * Rotation.from_matrix(R).as_rotvec()
    pose["left_wing_root"] = np.radians([0.0, ROOT_SHARE * flap, 0.0])
    raised = Rotation.from_euler("y", (1 - ROOT_SHARE) * flap, degrees=True)
    pose["left_shoulder"] = (raised * Rotation.from_rotvec(pose["left_shoulder"])).as_rotvec()
    for name, turn in turns.items():
        pose[name] = pose[name] + np.radians(turn)
    for joint in [name for name in JOINT_NAMES if name.startswith("left_")]:
        pose[joint.replace("left_", "right_")] = pose[joint] * [1, -1, -1]
    for side in SIDES:
        if ankles is None:
            bends = TRAILING_LEG
        else:
            bends = _leg_bends(np.radians(pitch), ankles[side] if isinstance(ankles, dict) else ankles)
        for joint, bend in zip(("hip", "knee", "ankle", "foot"), bends, strict=True):
            pose[f"{side}_{joint}"][0] += bend
    return Posture(np.stack([pose[name] for name in JOINT_NAMES[1:]]), float(np.radians(pitch)))


ROOT_SHARE = 0.5
"""Share of the wing elevation that the wing root takes; the shoulder takes the rest."""
TRAILING_LEG = np.radians([0.0, -25.0, -95.0, -20.0])
"""Rotations of hip, knee, ankle and foot about x in flight: the feet point backwards."""


def _leg_bends(pitch: float, ankle: tuple[float, float]) -> tuple[float, float, float, float]:
    """Return the rotations of hip, knee, ankle and foot about x that reach `ankle`, with level tarsus and toes.

    Positions in the plane (y, z) are complex numbers y + iz.
    """
    hip, knee, at_ankle, foot = (
        complex(*MIDDLE_AND_LEFT[f"left_{name}"][1:]) for name in ("hip", "knee", "ankle", "foot")
    )
    thigh, tibia = knee - hip, at_ankle - knee
    target = complex(*ankle) * np.exp(-1j * pitch) - hip
    distance = np.clip(abs(target), abs(abs(tibia) - abs(thigh)) + 0.05, abs(tibia) + abs(thigh) - 0.05)
    # as in the rest pose, the knee stays in front of the line from hip to ankle
    cosine = (distance**2 - abs(thigh) ** 2 - abs(tibia) ** 2) / (2 * abs(thigh) * abs(tibia))
    rest = np.angle(tibia / thigh)
    bend = np.sign(rest) * np.arccos(np.clip(cosine, -1, 1)) - rest
    reached = thigh + tibia * np.exp(1j * bend)
    swing = np.angle(target / reached)
    tarsus = np.angle(foot - at_ankle)
    # in the rest pose the tarsus has the slope of the skeleton and the toes are level
    return float(swing), float(bend), float(-tarsus - pitch - swing - bend), float(tarsus)


STAND, STEP = (-2.9, -8.5), 2.0
"""Ankle position of a standing bird relative to the root (forwards, upwards), and half a step, centimetres."""
UPRIGHT = {
    "lower_body": (-10, 0, 0),
    "tail": (-20, 0, 0),
    "neck_root": (-13, 0, 0),
    "neck": (-13, 0, 0),
    "head": (-24, 0, 0),
}
"""Rotations of back, neck and head of a standing bird, degrees."""

POSTURES: dict[str, Posture] = {
    "standing": _posture(50, STAND, **UPRIGHT),
    "alert": _posture(
        57,
        (-3.2, -9.1),
        lower_body=(-14, 0, 0),
        tail=(-26, 0, 0),
        neck_root=(-16, 0, 0),
        neck=(0, 0, 0),
        head=(-38, 0, 0),
    ),
    "incubating": _posture(
        27,
        (-6.4, -4.3),
        lower_body=(-5, 0, 0),
        tail=(-16, 0, 0),
        neck_root=(10, 0, 0),
        neck=(8, 0, 0),
        head=(-46, 0, 0),
    ),
    "preening_left": _posture(
        46,
        STAND,
        lower_body=(-8, 0, 0),
        tail=(-12, 0, 0),
        neck_root=(-5, 10, 50),
        neck=(-15, 15, 62),
        head=(-50, 0, 52),
    ),
    "walking_left": _posture(
        46,
        {"left": (STAND[0] + STEP, STAND[1]), "right": (STAND[0] - STEP, STAND[1])},
        lower_body=(-8, 0, 4),
        tail=(-12, 0, 0),
        neck_root=(-12, 0, 0),
        neck=(-10, 0, 0),
        head=(-24, 0, 0),
    ),
    "wings_up": _posture(8, None, 1.0, 38, head=(-8, 0, 0), neck_root=(-18, 0, 0), neck=(-12, 0, 0)),
    "wings_down": _posture(8, None, 0.95, -32, head=(-8, 0, 0), neck_root=(-18, 0, 0), neck=(-12, 0, 0)),
    "wings_half": _posture(50, STAND, 0.45, 22, **UPRIGHT),
    "flapping_up": _posture(48, STAND, 0.95, 34, **UPRIGHT),
    "flapping_down": _posture(48, STAND, 0.85, -12, **UPRIGHT),
    "jab": _posture(
        34,
        (-4.5, -7.4),
        lower_body=(-4, 0, 0),
        tail=(-8, 0, 0),
        neck_root=(-38, 0, 0),
        neck=(-16, 0, 0),
        head=(14, 0, 0),
    ),
}
for _name in ("preening", "walking"):
    _left = POSTURES[f"{_name}_left"]
    POSTURES[f"{_name}_right"] = Posture(mirrored_pose(_left.body_pose), _left.pitch_rad)


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
