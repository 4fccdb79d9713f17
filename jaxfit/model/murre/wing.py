"""The left wing of the murre: one sheet of points, folded on the flank and spread.

The wing is one sheet, not a stack of feathers. In the folded wing, the wrist lies at the breast, the leading edge runs
down to the wrist and then back along the flank, and the tips of the secondaries lie along the back. In the spread wing,
the same points form a long narrow wing. `skinning` computes the weights that transform the folded wing into the spread
wing.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

__all__ = ["CHORD", "SPAN", "folded_sheet", "spread_sheet", "wing_rings"]

CHORD = np.array([0.0, 0.17, 0.34, 0.53, 0.75, 0.88, 1.0])
"""Positions of the points from the leading edge (0) to the trailing edge (1), one point for each ring of the slit."""
SPAN = np.array([0.06, 0.13, 0.20, 0.27, 0.34, 0.41, 0.48, 0.55, 0.63, 0.71, 0.79, 0.87, 0.94, 1.0])
"""Positions of the rings from the body (0) to the tip (1); the wrist is at 0.42."""

# Folded wing, one span position per row: span, then y and arc length from the slit down the flank (cm), first of the
# leading edge, then of the trailing edge.
FOLDED = np.array(
    [
        (0.00, 7.4, 0.0, -1.2, 0.0),
        (0.12, 7.9, 1.5, -2.4, 0.40),
        (0.24, 8.3, 3.1, -4.6, 0.30),
        (0.42, 7.6, 5.3, -7.4, 0.05),
        (0.60, 3.2, 5.9, -9.8, -0.25),
        (0.80, -4.0, 4.7, -11.6, -0.1),
        (0.94, -9.8, 2.7, -12.5, 0.3),
        (1.00, -12.0, 1.4, -12.7, 0.7),
    ]
)
# Spread wing, one span position per row: span, then x and y of the leading edge and of the trailing edge (cm).
SPREAD = np.array(
    [
        (0.00, -4.5, 7.4, -5.0, -1.2),
        (0.12, -7.6, 8.3, -8.2, -1.5),
        (0.24, -11.2, 8.8, -11.6, -1.5),
        (0.42, -16.6, 8.0, -16.6, -1.3),
        (0.60, -22.2, 6.0, -21.6, -1.7),
        (0.80, -28.6, 2.7, -27.8, -2.6),
        (0.94, -32.9, 0.0, -32.2, -3.0),
        (1.00, -34.6, -1.4, -34.3, -2.5),
    ]
)
# Body surface under the folded wing: y, z of the centre, half width, height above and below the centre (cm).
BED = np.array(
    [
        (-15.0, 2.2, 1.7, 1.0, 1.0),
        (-11.0, 2.3, 2.9, 1.75, 1.9),
        (-8.0, 2.35, 4.1, 2.9, 3.0),
        (-4.0, 2.5, 5.2, 3.95, 4.3),
        (0.0, 2.8, 5.7, 4.55, 4.95),
        (4.0, 3.3, 5.65, 4.7, 5.1),
        (7.0, 4.3, 5.15, 4.5, 5.0),
        (9.0, 5.4, 4.6, 4.2, 4.7),
    ]
)
SLIT_ANGLE = np.radians(61)
HINGE = (0.42, 0.04)
"""Distance of the upper and the lower side of the first ring from the body, in centimetres."""


def _on_flank(y, arc, off) -> np.ndarray:
    """Return points of the folded wing from y, arc length below the slit, and distance from the body."""
    z, width, above, below = PchipInterpolator(BED[:, 0], BED[:, 1:])(np.clip(y, -15, 9)).T
    angle = SLIT_ANGLE + arc / np.maximum(width, 3.0)
    height = np.where(np.cos(angle) >= 0, above, below) * np.cos(angle)
    across = width * np.sin(angle)
    normal = np.stack([np.sin(angle), np.cos(angle)])
    return np.stack([-(across + off * normal[0]), y, z + height + off * normal[1]], axis=-1)


def _edges(table, span):
    return PchipInterpolator(table[:, 0], table[:, 1:])(span)


def _thickness(span, chord):
    """Return the thickness of the wing in centimetres: thick at the arm, thin at the feathers and the tip."""
    arm = np.interp(span, [0, 0.12, 0.42, 0.7, 1.0], [1.1, 0.85, 0.55, 0.32, 0.15])
    profile = np.interp(chord, [0, 0.1, 0.3, 0.6, 1.0], [0.45, 0.9, 1.0, 0.5, 0.2])
    return np.maximum(arm * profile, 0.12)


def folded_sheet() -> tuple[Float[np.ndarray, "U C 3"], Float[np.ndarray, "U C 3"]]:
    """Return the upper (outer) and the lower (inner) side of the folded wing, in centimetres."""
    front_y, front_arc, back_y, back_arc = (column[:, None] for column in _edges(FOLDED, SPAN).T)
    y = front_y + CHORD * (back_y - front_y)
    arc = front_arc + CHORD * (back_arc - front_arc)
    span = np.broadcast_to(SPAN[:, None], y.shape)
    gap = 0.05 + 0.12 * np.minimum(1, span / 0.2) * np.sin(np.pi * np.clip(CHORD, 0.05, 0.7))
    thick = _thickness(span, CHORD)
    shape = (*y.shape, 3)
    lower = _on_flank(y.ravel(), arc.ravel(), gap.ravel()).reshape(shape)
    upper = _on_flank(y.ravel(), arc.ravel(), (gap + thick).ravel()).reshape(shape)
    return upper, lower


def spread_sheet() -> tuple[Float[np.ndarray, "U C 3"], Float[np.ndarray, "U C 3"]]:
    """Return the upper and the lower side of the spread wing, in centimetres."""
    front_x, front_y, back_x, back_y = (column[:, None] for column in _edges(SPREAD, SPAN).T)
    x = front_x + CHORD * (back_x - front_x)
    y = front_y + CHORD * (back_y - front_y)
    span = np.broadcast_to(SPAN[:, None], y.shape)
    camber = 0.5 * np.sin(np.pi * CHORD) * (1 - 0.7 * span)
    z = np.interp(span, [0, 0.2, 1], [5.3, 5.5, 5.0]) + camber - 0.5 * CHORD
    thick = _thickness(span, CHORD)
    middle = np.stack([x, y, z], axis=-1)
    half = np.stack([0 * thick, 0 * thick, thick / 2], axis=-1)
    return middle + half, middle - half


def wing_rings(slit: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "U P 3"]:
    """Return the folded wing as rings from body to tip, in centimetres.

    A ring runs along the upper side from front to back, then along the lower side from back to front. The first ring
    is the hinge: the outline of the slit, slightly contracted and moved out of the body, so that the hinge can turn
    half-way with the wing in both directions.

    Args:
        slit: vertices of the slit of the body, in the same order.
    """
    upper, lower = folded_sheet()
    rings = np.concatenate([upper, lower[:, ::-1]], axis=1)
    middle = (slit + slit[::-1]) / 2  # between upper and lower side
    outwards = np.array([-np.sin(SLIT_ANGLE), 0.0, np.cos(SLIT_ANGLE)])
    distance = np.repeat(HINGE, len(slit) // 2)
    rings[0] = slit + 0.3 * (middle - slit) + distance[:, None] * outwards
    return rings
