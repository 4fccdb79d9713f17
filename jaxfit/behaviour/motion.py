"""Features of motion: speed, turning, height above the ledge."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxfit.behaviour.birds import Birds, whole_frames
from jaxfit.behaviour.posture import heading_deg, turn_deg
from jaxfit.behaviour.registry import feature
from jaxfit.fitting.ledge import SPEED_S


def rate(values: Float[np.ndarray, "N T *D"], birds: Birds, circular: bool = False) -> Float[np.ndarray, "N T *D"]:
    """Return the mean rate of change around each frame, per second; NaN if an end has no value or the window a gap.

    The window is about `SPEED_S` long: the same whole number of frames on both sides. At the ends of the video, it ends
    with the video.

    Args:
        values: values of any unit, NaN where unknown.
        birds: the birds, with the times of the frames.
        circular: whether the values are headings.
    """
    time_s, T = birds.time_s, len(birds.time_s)
    half = whole_frames(SPEED_S / 2, birds.step_s)
    first, last = np.clip(np.arange(T) - half, 0, None), np.clip(np.arange(T) + half, None, T - 1)
    seconds = time_s[last] - time_s[first]
    without_gap = (seconds > 0) & (seconds <= 4 * half * birds.step_s)
    seconds = np.where(without_gap, seconds, np.nan).reshape(-1, *(1,) * (values.ndim - 2))
    change = values[:, last] - values[:, first]
    return (turn_deg(change) if circular else change) / seconds


def velocity(birds: Birds) -> Float[np.ndarray, "N T 3"]:
    """Return the velocity of the root joint."""
    return rate(birds.place, birds)


@feature(unit="length/s", needs=("level", "time"))
def speed(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Horizontal distance that the middle of the body (the root joint) moves in about 0.2 s, per second."""
    return np.linalg.norm(birds.once(velocity)[..., :2], axis=-1)


@feature(unit="length/s", needs=("level", "time"))
def vertical_speed(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Change of the height of the middle of the body in about 0.2 s around the frame, per second; positive upwards."""
    return birds.once(velocity)[..., 2]


@feature(unit="deg/s", needs=("level", "time"))
def turning(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Change of body_heading in about 0.2 s around the frame, per second; positive counter-clockwise from above."""
    return rate(heading_deg(birds.forward), birds, circular=True)


@feature(unit="length", needs=("ledge",))
def height(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Height of the lowest keypoint of the bird above the ledge."""
    return np.min(birds.keypoints[..., 2], axis=-1)


@feature(unit="1", needs=("ledge",))
def airborne(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Probability that the bird is in the air and not on the ledge."""
    return 1 - birds.contact
