"""Mesh of the body, the left wing (folded and spread) and the left leg.

The left wing of the murre: one sheet of points, folded on the flank and spread. The wing is one sheet, not a stack of
feathers. In the folded wing, the wrist lies at the breast, the leading edge runs down to the wrist and then back along
the flank, and the tips of the secondaries lie along the back. In the spread wing, the same points form a long narrow
wing. `skinning` computes the weights that transform the folded wing into the spread wing.

The code builds the left half and joins its mirror image along the midline, so the mesh is symmetric by construction.
Lengths are in centimetres, in the axes of `jaxfit.model.anatomy`.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import PchipInterpolator

from jaxfit.model.murre.skeleton import MIDDLE_AND_LEFT

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


# One cross-section per row: y and z of the centre, slope of the spine in degrees, half width, and height above and
# below the centre.
SECTIONS = np.array(
    [
        (-15.3, 1.55, 2, 0.95, 0.12, 0.12),  # tail tip
        (-14.8, 1.60, 2, 1.75, 0.16, 0.16),
        (-13.0, 1.80, 2, 2.25, 0.35, 0.40),
        (-10.8, 2.10, 2, 2.55, 1.20, 1.45),  # tail base
        (-8.0, 2.30, 2, 3.90, 2.70, 3.00),
        (-4.0, 2.50, 3, 5.15, 3.90, 4.30),
        (0.0, 2.75, 4, 5.70, 4.50, 4.95),  # the girth
        (4.0, 3.20, 9, 5.60, 4.60, 5.10),
        (7.0, 4.10, 22, 4.95, 4.20, 4.90),
        (9.0, 5.60, 38, 4.00, 3.40, 4.20),  # breast
        (10.4, 7.20, 48, 3.20, 2.80, 3.30),
        (11.6, 8.80, 53, 2.65, 2.45, 2.60),  # neck
        (12.6, 10.2, 48, 2.35, 2.30, 2.25),
        (13.8, 11.35, 32, 2.20, 2.25, 2.05),  # nape and throat
        (15.3, 11.9, 10, 2.10, 2.10, 1.95),  # eyes
        (16.9, 11.9, -3, 1.65, 1.60, 1.55),
        (18.2, 11.7, -8, 1.00, 1.05, 1.05),
        (19.0, 11.55, -8, 0.56, 0.70, 0.66),  # where the feathers end
        (21.3, 11.25, -7, 0.35, 0.48, 0.44),
        (23.0, 11.05, -8, 0.18, 0.27, 0.25),
        (23.7, 10.93, -10, 0.04, 0.05, 0.05),  # bill tip
    ]
)
SLIT = slice(10, 17)
"""Rings at which the wing is attached, from back to front."""
RINGS = np.array([
    0, 1, 1.6, 2.3, 3, 3.5, 4.0, 4.5, 5.0, 5.4,
    *np.interp(np.linspace(-1.2, 7.4, 7), SECTIONS[5:9, 0], np.arange(5.0, 9.0)),
    8.55, 9.0, 9.12, 9.7, 10.4, 11.2, 12, 12.7, 13.3, 13.9, 14.5, 15.1, 15.8, 16.5, 17, 17.25, 18, 19, 20,
])  # fmt: skip
"""Positions of the rings of vertices, in (fractional) rows of `SECTIONS`."""
ANGLES = np.radians([0, 19, 37, 53, 69, 74, 91, 109, 127, 145, 163, 180])
"""Angles of the vertices of a ring, from the middle of the back to the middle of the belly."""
SLIT_COLUMNS = (3, 4)
BIB_RINGS = (18, 19)
"""Two rings close together, between which the brown of the foreneck ends."""
BIB = {17: 0.45, 18: 1.0, 19: 1.0, 20: 0.75, 21: 0.4, 22: 0.15}
BIB_REACH = np.interp(np.degrees(ANGLES), [0, 75, 100, 125, 150, 180], [-0.3, -0.3, -0.15, 0.15, 0.42, 0.5])
"""The bib rings lie further forward on the foreneck than at the sides: `BIB_REACH` is the shift of each column along
the spine in rows of `SECTIONS`, `BIB` the share of this shift for each ring."""
LEG_RINGS, LEG_COLUMNS = (7, 8, 9), (7, 8, 9)


class Half(NamedTuple):
    """The left half of the mesh.

    `part` is 0 for the body, 1 for the wing, 2 for the leg; `place` is the position of a vertex in its part.
    """

    vertices: Float[np.ndarray, "H 3"]
    faces: Int[np.ndarray, "G 3"]
    part: Int[np.ndarray, "H"]
    place: Int[np.ndarray, "H 2"]
    """Body: ring counted from the tail, column counted from the back. Wing and leg: ring counted from the body, and
    point of the ring."""
    body_index: Int[np.ndarray, "R C"]
    wing_index: Int[np.ndarray, "U P"]
    leg_index: Int[np.ndarray, "L P"]


class Mesh(NamedTuple):
    """The whole mesh."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    half: Int[np.ndarray, "V"]
    """Index in the left half: of the vertex itself, or of the vertex whose mirror image it is."""
    right: np.ndarray
    """Whether the vertex is a mirror image."""
    mirror: Int[np.ndarray, "V"]
    """Index of the mirror image of the vertex; for a vertex on the midline, its own index."""


def sections_at(rows: Float[np.ndarray, "*R"]) -> Float[np.ndarray, "*R 6"]:
    """Interpolate `SECTIONS` between its rows; the last axis has the six numbers of a section."""
    return PchipInterpolator(np.arange(len(SECTIONS)), SECTIONS)(rows)


def body_rings() -> Float[np.ndarray, "R C 3"]:
    """Return the points of the left half of the body: rings from tail to bill, columns from back to belly."""
    rows = np.repeat(RINGS[:, None], len(ANGLES), axis=1)
    for ring, share in BIB.items():
        rows[ring] += share * BIB_REACH
    y, z, slope, width, above, below = np.moveaxis(sections_at(rows), -1, 0)
    slope = np.radians(slope)
    side, up = np.sin(ANGLES), np.cos(ANGLES)
    height = np.where(up >= 0, above, below) * up
    side = np.where(np.abs(side) < 1e-9, 0.0, side)  # points on the midline have exactly x = 0
    return np.stack([-width * side, y - np.sin(slope) * height, z + np.cos(slope) * height], axis=-1)


def make_half() -> Half:
    """Build the left half: body, wing and leg, with shared vertices where the parts join."""
    rings = body_rings()
    rows, columns = rings.shape[:2]
    inside_leg = (LEG_RINGS[1], LEG_COLUMNS[1])
    points, part, place, faces = [], [], [], []

    def add(point, which: int, where: tuple[int, int]) -> int:
        points.append(point)
        part.append(which)
        place.append(where)
        return len(points) - 1

    body = np.full((rows, columns), -1)
    for i in range(rows):
        for k in range(columns):
            if (i, k) != inside_leg:
                body[i, k] = add(rings[i, k], 0, (i, k))
    slit = range(*SLIT.indices(rows))
    for i in range(rows - 1):
        for k in range(columns - 1):
            in_slit = i in slit[:-1] and k == SLIT_COLUMNS[0]
            in_leg = i in LEG_RINGS[:2] and k in LEG_COLUMNS[:2]
            if not in_slit and not in_leg:
                _quad(faces, body[i, k], body[i, k + 1], body[i + 1, k + 1], body[i + 1, k])
    _zip(faces, body[0], flip=True)
    _zip(faces, body[-1])

    wing_loop = [*body[slit[0] : slit[-1] + 1, SLIT_COLUMNS[0]][::-1], *body[slit[0] : slit[-1] + 1, SLIT_COLUMNS[1]]]
    wing = _extrude(faces, wing_loop, wing_rings(np.array([points[i] for i in wing_loop])), add, 1)
    _zip(faces, wing[-1])

    (a, b, c), (p, q, r) = LEG_RINGS, LEG_COLUMNS
    loop = [(b, r), (c, r), (c, q), (c, p), (b, p), (a, p), (a, q), (a, r)]
    leg = _extrude(faces, [body[at] for at in loop], leg_rings(), add, 2)
    _zip(faces, leg[-1], pointed=True)
    return Half(
        np.array(points), np.array(faces)[:, ::-1], np.array(part), np.array(place), body, np.array(wing), np.array(leg)
    )


def mirrored(half: Half) -> Mesh:
    """Return the whole mesh: the left half, and its mirror image with reversed face orientation."""
    count = len(half.vertices)
    middle = half.vertices[:, 0] == 0
    copies = np.flatnonzero(~middle)
    image = np.arange(count)
    image[copies] = count + np.arange(len(copies))
    vertices = np.concatenate([half.vertices, half.vertices[copies] * [-1, 1, 1]])
    faces = np.concatenate([half.faces, image[half.faces][:, ::-1]])
    mirror = np.concatenate([image, copies])
    right = np.arange(len(vertices)) >= count
    return Mesh(vertices, faces, np.concatenate([np.arange(count), copies]), right, mirror)


def _quad(faces: list, a: int, b: int, c: int, d: int) -> None:
    faces += [(a, b, c), (a, c, d)]


def _extrude(faces: list, loop: list, rings, add, part: int) -> list:
    """Connect rings of points to a loop of vertices by faces; loop and rings have the same direction."""
    index = [list(loop)]
    for j, ring in enumerate(rings, start=1):
        index.append([add(point, part, (j, p)) for p, point in enumerate(ring)])
        for p in range(len(ring)):
            n = (p + 1) % len(ring)
            _quad(faces, index[-2][p], index[-2][n], index[-1][n], index[-1][p])
    return index


def _zip(faces: list, loop, flip: bool = False, pointed: bool = False) -> None:
    """Close a flat loop with faces between opposite points; a pointed loop has one end point at either end."""
    loop = list(loop)
    n = len(loop)
    rungs = [(loop[p], loop[-p if pointed else n - 1 - p]) for p in range(n // 2 + pointed)]
    for (a, b), (c, d) in pairwise(rungs):
        for face in ((a, c, d), (a, d, b)):
            if len(set(face)) == 3:
                faces.append(face[::-1] if flip else face)
