"""The mesh of the murre: a lofted body from tail to bill, with slits for the wings and holes for the legs.

The code builds the left half and joins its mirror image along the midline, so the mesh is symmetric by construction.
Lengths are in centimetres, in the axes of `jaxfit.model.anatomy`.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import PchipInterpolator

from jaxfit.model.murre.leg import leg_rings
from jaxfit.model.murre.wing import wing_rings

__all__ = ["ANGLES", "Half", "Mesh", "body_rings", "make_half", "mirrored"]

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
