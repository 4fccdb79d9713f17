"""Features of posture: body, neck and head. Angles in degrees; a right-handed world with z up.

A direction d has the heading atan2(d_y, d_x), counter-clockwise from the x axis seen from above, and the elevation
asin(d_z) above the horizontal. The heading of a direction that is steeper than `STEEP_DEG` is undefined.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxfit.behaviour.birds import Birds
from jaxfit.behaviour.registry import feature

STEEP_DEG = 80.0
"""Elevation above which a heading is undefined: there, an error of 1° turns the heading by 6° or more."""
HEAD = ("bill_tip", "left_eye", "right_eye")


def unit_vector(vectors: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
    """Return directions; NaN for vectors of length 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def elevation_deg(direction: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B"]:
    """Return the elevation of directions above the plane of their first two axes."""
    return np.degrees(np.arcsin(np.clip(direction[..., 2], -1, 1)))


def heading_deg(direction: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B"]:
    """Return the heading of directions; NaN where they are steeper than `STEEP_DEG`."""
    flat = np.abs(elevation_deg(direction)) <= STEEP_DEG
    return np.where(flat, np.degrees(np.arctan2(direction[..., 1], direction[..., 0])), np.nan)


def between_deg(first: Float[np.ndarray, "*B 3"], second: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B"]:
    """Return the angle between directions, 0 to 180."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second), axis=-1), np.sum(first * second, axis=-1)))


def turn_deg(difference: Float[np.ndarray, "*B"]) -> Float[np.ndarray, "*B"]:
    """Return differences of headings in −180 to 180."""
    return (difference + 180) % 360 - 180


def gaze(birds: Birds) -> Float[np.ndarray, "N T 3"]:
    """Return the direction from the middle between the eyes to the tip of the bill."""
    eyes = (birds.keypoint("left_eye") + birds.keypoint("right_eye")) / 2
    return unit_vector(birds.keypoint("bill_tip") - eyes)


def neck(birds: Birds) -> Float[np.ndarray, "N T 3"]:
    """Return the direction from the base of the neck to the head."""
    return unit_vector(birds.joint("head") - birds.joint("neck_root"))


@feature(unit="deg", needs=("level",))
def body_pitch(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Elevation of the long axis of the body (forwards) above the horizontal; 90 is upright."""
    return elevation_deg(birds.forward)


@feature(unit="deg", needs=("level",), circular=True)
def body_roll(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Rotation of the body about its long axis; positive with the right side down, undefined above 80° of pitch."""
    right, back = birds.R_world_body[..., 0], birds.R_world_body[..., 2]
    roll = np.degrees(np.arctan2(-right[..., 2], back[..., 2]))
    return np.where(np.abs(elevation_deg(birds.forward)) <= STEEP_DEG, roll, np.nan)


@feature(unit="deg", needs=("level",), circular=True)
def body_heading(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Direction of the long axis of the body seen from above, counter-clockwise from the x axis of the world."""
    return heading_deg(birds.forward)


@feature(unit="deg", joints=("neck_root", "head"))
def neck_angle(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Angle between the long axis of the body and the line from the base of the neck to the head; 0 is stretched."""
    return between_deg(birds.forward, neck(birds))


@feature(unit="deg", keypoints=HEAD, joints=("neck_root", "head"))
def head_angle(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Angle between the line from the base of the neck to the head and the direction of gaze; 0 is stretched."""
    return between_deg(neck(birds), gaze(birds))


@feature(unit="deg", keypoints=HEAD, needs=("level",))
def gaze_elevation(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Elevation of the gaze, from the middle between the eyes to the tip of the bill, above the horizontal."""
    return elevation_deg(gaze(birds))


@feature(unit="deg", keypoints=HEAD, needs=("level",), circular=True)
def gaze_heading(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Direction of gaze seen from above, counter-clockwise from the x axis of the world."""
    return heading_deg(gaze(birds))


@feature(unit="deg", keypoints=HEAD, needs=("level",))
def gaze_turn(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Angle between the headings of gaze and body, to either side: 0 is ahead, 180 is behind."""
    return np.abs(turn_deg(heading_deg(gaze(birds)) - heading_deg(birds.forward)))


@feature(unit="length", keypoints=("bill_tip",), joints=("neck_root", "lower_body"))
def bill_to_body(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Distance of the tip of the bill from the line between the base of the neck and the lower body, a line segment."""
    tip, start, end = birds.keypoint("bill_tip"), birds.joint("neck_root"), birds.joint("lower_body")
    along = end - start
    share = np.sum((tip - start) * along, axis=-1) / np.maximum(np.sum(along**2, axis=-1), 1e-12)
    return np.linalg.norm(tip - start - np.clip(share, 0, 1)[..., None] * along, axis=-1)
