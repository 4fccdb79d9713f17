"""Variation between murres: shape directions and the prior of bone lengths.

The directions are designed from the ranges in `measurements`, not learnt. One unit of a shape coefficient is one
standard deviation, which is a quarter of the range from the lowest to the highest measurement.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxfit.model.anatomy import JOINT_NAMES, mirror_pairs
from jaxfit.model.murre.measurements import MEASUREMENTS
from jaxfit.model.murre.skeleton import MIDDLE_AND_LEFT, WING_TIP
from jaxfit.model.murre.skinning import smooth_step
from jaxfit.model.murre.surface import RINGS, Half, sections_at

__all__ = ["SHAPES", "bone_prior", "half_shapes"]

SHAPES = ("girth", "neck thickness", "bill length", "wing length", "tail length")
PIVOT = (0.0, 0.0, 2.8)
"""Centre from which the girth direction expands the trunk, centimetres."""
BONE_DEVIATION, SIDE_CORRELATION = 0.05, 0.9
"""Standard deviation of relative bone lengths, and correlation between the two sides of a bird."""


def relative_deviation(name: str) -> float:
    """Return the standard deviation of a measurement, relative to the value of the model."""
    low, high, used, _ = MEASUREMENTS[name]
    return (high - low) / 4 / used


def half_shapes(half: Half, weights: Float[np.ndarray, "H J"]) -> Float[np.ndarray, "S H 3"]:
    """Return the vertex displacements of the left half for one unit of each shape direction, in centimetres."""
    v, basis = half.vertices, np.zeros((len(SHAPES), *half.vertices.shape))
    trunk = smooth_step(v[:, 1], -13.0, -5.0) * (1 - smooth_step(v[:, 1], 7.0, 11.0)) * (half.part < 2)
    basis[0] = relative_deviation("body_width") * trunk[:, None] * (v - PIVOT) * [1, 0, 1]

    body = half.part == 0
    row = RINGS[half.place[body, 0]]
    centre = np.zeros((body.sum(), 3))
    centre[:, 1:] = sections_at(row)[:, :2]
    neck = smooth_step(row, 8.5, 10.5) * (1 - smooth_step(row, 12.5, 14.5))
    basis[1, body] = relative_deviation("neck_width") * neck[:, None] * (v[body] - centre)

    base, tip = (sections_at(np.array(r))[:2] for r in (17.0, 20.0))
    along = np.array([0.0, *(tip - base)]) / np.linalg.norm(tip - base)
    beyond = np.clip((v[body] - [0.0, *base]) @ along, 0, None) * (row >= 17)
    basis[2, body] = relative_deviation("bill") * beyond[:, None] * along

    wrist = np.asarray(MIDDLE_AND_LEFT["left_wrist"])
    hand = np.asarray(WING_TIP) - wrist
    hand /= np.linalg.norm(hand)
    reach = np.clip((v - wrist) @ hand, 0, None) * weights[:, JOINT_NAMES.index("left_wrist")]
    basis[3] = relative_deviation("wing") * reach[:, None] * hand * (half.part == 1)[:, None]

    behind = np.clip(MIDDLE_AND_LEFT["tail"][1] - v[:, 1], 0, None) * body
    basis[4] = relative_deviation("tail") * behind[:, None] * [0.0, -1.0, 0.0]
    basis[:, v[:, 0] == 0, 0] = 0
    return basis


def bone_prior() -> tuple[Float[np.ndarray, "B"], Float[np.ndarray, "B B"]]:
    """Return mean (1) and covariance of the relative bone lengths; the two sides of a bird are strongly correlated."""
    bones = len(JOINT_NAMES) - 1
    correlation = np.eye(bones)
    for left, right in mirror_pairs(JOINT_NAMES):
        correlation[left - 1, right - 1] = correlation[right - 1, left - 1] = SIDE_CORRELATION
    return np.ones(bones), BONE_DEVIATION**2 * correlation
