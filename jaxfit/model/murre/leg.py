"""The left leg of the murre: feathered thigh and tibia, tarsus, and three webbed toes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxfit.model.murre.skeleton import MIDDLE_AND_LEFT

__all__ = ["LEG_PARTS", "leg_rings"]

RING_ANGLES = np.radians(np.arange(0, 360, 45))
LEG_PARTS = ("thigh", "tibia", "tibia", "ankle", "tarsus", "tarsus", "foot", "toes", "toes")
"""Part of the leg that each ring belongs to, from the body to the toes."""
TOES = {0: (1.75, 3.9), 1: (0.95, 3.75), 2: (0.0, 5.0), 3: (-1.0, 4.1), 4: (-2.0, 4.5)}
"""Ends of the inner, middle and outer toe (0, 2, 4) and of the webs between the toes: offsets from the foot joint in
centimetres, sideways (to the inner side) and forwards."""


def leg_rings() -> Float[np.ndarray, "L 8 3"]:
    """Return the rings of the leg from the body to the toes, in centimetres.

    The points of a ring begin on the inner side of the leg and run over the front to the outer side.
    """
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
    """Return an ellipse around `centre`, normal to `along`, with half-axes `side` (along x) and `front`."""
    along = along / np.linalg.norm(along)
    forwards = np.array([0.0, -along[2], along[1]])
    forwards /= np.linalg.norm(forwards)
    cosine, sine = np.cos(RING_ANGLES)[:, None], np.sin(RING_ANGLES)[:, None]
    return centre + side * cosine * [1, 0, 0] + front * sine * forwards
