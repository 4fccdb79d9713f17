"""The left leg: feathered stump, tarsus, and three toes in one web."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxfit.model.murre.skeleton import MIDDLE_AND_LEFT

__all__ = ["LEG_SHARES", "leg_rings"]

ROUND = np.radians(np.arange(0, 360, 45))
LEG_SHARES = ("thigh", "tibia", "tibia", "ankle", "tarsus", "tarsus", "foot", "toes", "toes")
"""What each ring of the leg belongs to."""
TOES = {0: (1.75, 3.9), 1: (0.95, 3.75), 2: (0.0, 5.0), 3: (-1.0, 4.1), 4: (-2.0, 4.5)}
"""Ends of the inner, middle and outer toe (0, 2, 4) and of the webs between: sideways and forwards of the root."""


def leg_rings() -> Float[np.ndarray, "L 8 3"]:
    """Rings from the body to the toes; a ring begins on the inner side and runs by the front to the outer side."""
    knee, ankle, foot = (np.asarray(MIDDLE_AND_LEFT[f"left_{name}"]) for name in ("knee", "ankle", "foot"))
    tibia, tarsus = ankle - knee, foot - ankle
    toes = np.array([0.0, 1.0, 0.0])
    unit = [v / np.linalg.norm(v) for v in (tibia, tarsus, toes)]
    rings = [
        _ring(knee + 0.55 * tibia, unit[0] + [0, 0, -0.8], 1.15, 1.35),
        _ring(knee + 0.78 * tibia, unit[0] + [0, 0, -0.3], 0.72, 0.85),
        _ring(knee + 0.93 * tibia, unit[0], 0.45, 0.5),
        _ring(ankle, unit[0] + unit[1], 0.40, 0.42),
        _ring(ankle + 0.2 * tarsus, unit[1], 0.34, 0.40),
        _ring(ankle + 0.7 * tarsus, unit[1], 0.34, 0.36),
        _ring(foot, unit[1] + unit[2], 0.50, 0.36),
    ]
    for reach in (0.5, 1.0):
        ring = np.empty((8, 3))
        for p in range(8):
            side, forward = TOES[p if p <= 4 else 8 - p]
            thick = 0.26 * (1.15 - 0.75 * reach) * (0.0 if p in (0, 4) else 1.0 if p in (2, 6) else 0.6)
            sole = foot[2] - 0.40
            ring[p] = (
                foot[0] + side * (0.25 + 0.75 * reach),
                foot[1] + forward * reach,
                sole + 0.1 + (thick if p in (1, 2, 3) else -0.1 if p in (5, 6, 7) else 0.0),
            )
        rings.append(ring)
    return np.array(rings)


def _ring(centre, along, side: float, front: float) -> np.ndarray:
    along = along / np.linalg.norm(along)
    forwards = np.array([0.0, -along[2], along[1]])
    forwards /= np.linalg.norm(forwards)
    return centre + side * np.cos(ROUND)[:, None] * [1, 0, 0] + front * np.sin(ROUND)[:, None] * forwards
