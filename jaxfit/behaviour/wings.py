"""Features of wings and legs: spread, elevation, wingbeats, strides."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxfit.behaviour.birds import Birds
from jaxfit.behaviour.motion import speed
from jaxfit.behaviour.posture import elevation_deg, unit_vector
from jaxfit.behaviour.registry import feature
from jaxfit.behaviour.rhythm import Rhythm, rhythm_of

TIPS = ("left_wingtip", "right_wingtip")
ARMS = ("left_shoulder", "left_elbow", "left_wrist", "right_shoulder", "right_elbow", "right_wrist")
FEET = ("left_foot", "right_foot")
MIN_BEAT_DEG = 5.0
"""Smallest amplitude of a wingbeat, degrees: larger than the noise of fitted poses."""
MIN_STRIDE = 0.03
"""Smallest amplitude of the distance between the feet in a stride, body lengths."""


@feature(unit="1", keypoints=TIPS, joints=ARMS)
def wing_spread(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Distance between the wingtips ÷ wing span with straight wings: shoulder to shoulder, and along both wings."""
    span = np.linalg.norm(birds.joint("left_shoulder") - birds.joint("right_shoulder"), axis=-1)
    for side in ("left", "right"):
        hand = np.linalg.norm(birds.keypoint(f"{side}_wingtip") - birds.joint(f"{side}_wrist"), axis=-1)
        span = span + birds.bone(f"{side}_elbow") + birds.bone(f"{side}_wrist") + hand
    return np.linalg.norm(birds.keypoint(TIPS[0]) - birds.keypoint(TIPS[1]), axis=-1) / span


@feature(unit="deg", keypoints=TIPS, joints=ARMS)
def wing_elevation(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Elevation of the line from shoulder to wingtip above the frontal plane of the body, mean of both wings."""
    sides = []
    for side in ("left", "right"):
        wing = birds.in_body(birds.keypoint(f"{side}_wingtip") - birds.joint(f"{side}_shoulder"))
        sides.append(elevation_deg(unit_vector(wing)))
    return (sides[0] + sides[1]) / 2


def wingbeat(birds: Birds) -> Rhythm:
    """Return the rhythm of the wing elevation."""
    return rhythm_of(
        birds.once(wing_elevation), birds.time_s, birds.step_s, birds.interval_s, MIN_BEAT_DEG, birds.first
    )


@feature(unit="Hz", keypoints=TIPS, joints=ARMS, needs=("time",))
def beat_frequency(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Frequency of the wing elevation in a window of 1 or 2 s, if it is below half the frame rate (see beat_alias)."""
    return birds.once(wingbeat).frequency_hz


@feature(unit="Hz", keypoints=TIPS, joints=ARMS, needs=("time",))
def beat_alias(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Frame rate minus beat_frequency: wings that beat at this frequency look the same in the video."""
    return 1 / birds.step_s - birds.once(wingbeat).frequency_hz


@feature(unit="deg", keypoints=TIPS, joints=ARMS, needs=("time",))
def beat_amplitude(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Half of the range of the wing elevation in a wingbeat."""
    return birds.once(wingbeat).amplitude


@feature(unit="deg", keypoints=TIPS, joints=ARMS, needs=("time",), circular=True)
def stroke_phase(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Phase of the wingbeat: 0 with the wings highest, 90 in the middle of the downstroke, 180 lowest, −90 upstroke."""
    return (birds.once(wingbeat).phase_deg + 180) % 360 - 180


def stride(birds: Birds) -> Rhythm:
    """Return the rhythm of the distance of the left foot before the right foot, body lengths."""
    apart = birds.keypoint(FEET[0]) - birds.keypoint(FEET[1])
    forward = unit_vector(birds.forward * [1, 1, 0]) if birds.level else birds.forward
    ahead = np.sum(apart * forward, axis=-1) / birds.body_length
    on_ledge = ~(birds.contact < 0.5)
    ahead = np.where(on_ledge, ahead, np.nan)
    return rhythm_of(ahead, birds.time_s, birds.step_s, birds.interval_s, MIN_STRIDE, birds.first)


@feature(unit="Hz", keypoints=FEET, needs=("time",))
def stride_frequency(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Frequency of the distance of the left foot before the right foot, on the ledge; a stride is two steps."""
    return birds.once(stride).frequency_hz


@feature(unit="length", keypoints=FEET, needs=("level", "time"))
def stride_length(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Speed ÷ stride_frequency."""
    return birds.once(speed) / birds.once(stride).frequency_hz
