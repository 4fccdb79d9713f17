"""Named postures of the murre: body poses, each with a pitch of the whole bird.

A two-bone inverse kinematics in the sagittal plane (hip, knee) places the legs. With the pitch of the posture about
+x, the tarsi (on which murres rest) and the toes lie flat on level ground.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxfit.model.anatomy import JOINT_NAMES, other_side
from jaxfit.model.murre.skeleton import MIDDLE_AND_LEFT, spread_rotations

__all__ = ["POSTURES", "Posture", "mirrored_pose"]

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
