"""Assembles and writes the murre, with vertex colours and keypoint positions."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfit.model.anatomy import JOINT_NAMES, MURRE_KEYPOINTS, mirror_pairs
from jaxfit.model.bird import Bird, check_bird
from jaxfit.model.files import MURRE_PATH, save_bird
from jaxfit.model.murre.postures import joint_limits, pose_prior
from jaxfit.model.murre.skeleton import CM_PER_UNIT, PARENTS, joint_positions
from jaxfit.model.murre.skinning import SHAPES, bone_prior, half_shapes, half_weights, mirrored_weights
from jaxfit.model.murre.surface import BIB_RINGS, CHORD, RINGS, SPAN, Half, Mesh, make_half, mirrored

BROWN, HEAD = (0.235, 0.180, 0.155), (0.200, 0.150, 0.130)
WHITE, UNDERWING, DUSKY = (0.94, 0.94, 0.92), (0.86, 0.85, 0.83), (0.50, 0.47, 0.45)
BLACK = (0.03, 0.03, 0.03)
BILL, LEG, PRIMARIES = (0.11, 0.11, 0.12), (0.24, 0.23, 0.22), (0.170, 0.135, 0.120)
LAST_BROWN_COLUMN = 4
"""Last brown column of the body mesh, counted from the back; the flank below this column is white."""
EYE = (int(np.argmin(np.abs(RINGS - 15.1))), 4)
"""Ring and column of the left eye."""
LAST_BROWN_AT_SHOULDER = {BIB_RINGS[0] - 3: 5, BIB_RINGS[0] - 2: 6, BIB_RINGS[0] - 1: 7, BIB_RINGS[0]: 8}
"""Last brown column of the rings behind the bib: the brown of the bib runs down the sides of the neck to the bend of
the wing."""
WHITE_BAR = (0.10, 0.46)
"""Part of the span where the trailing edge (the tips of the secondaries) is white."""


def half_colours(half: Half) -> Float[np.ndarray, "H 3"]:
    """Return the sRGB colours of the vertices of the left half."""
    colours = np.empty((len(half.vertices), 3))
    points = half.wing_index.shape[1]
    for vertex, (part, (ring, place)) in enumerate(zip(half.part, half.place, strict=True)):
        if part == 0:
            colours[vertex] = _body_colour(ring, place)
        elif part == 1:
            below = place >= points // 2
            chord = CHORD[points - 1 - place if below else place]
            colours[vertex] = _wing_colour(float(SPAN[ring - 1]), float(chord), bool(below))
        else:
            colours[vertex] = WHITE if ring <= 1 else LEG
    return colours


def _body_colour(ring: int, column: int):
    row = RINGS[ring]
    if row >= 17.2:
        return BILL
    if (ring, column) == EYE:
        return BLACK
    if row > 11:
        return HEAD
    if ring >= BIB_RINGS[1] or row < 2.9 or column <= LAST_BROWN_AT_SHOULDER.get(ring, LAST_BROWN_COLUMN):
        return BROWN
    return WHITE


def _wing_colour(span: float, chord: float, below: bool):
    if below:
        if chord < 0.1:
            return BROWN
        return UNDERWING if chord < 0.6 and span < 0.75 else DUSKY
    if WHITE_BAR[0] < span < WHITE_BAR[1] and chord > 0.9:
        return WHITE
    return PRIMARIES if span > 0.6 else BROWN


def keypoint_weights(half: Half, mesh: Mesh) -> Float[np.ndarray, "K V"]:
    """Return the weights that place each keypoint at the mean of a few vertices."""
    body, wing, leg = half.body_index, half.wing_index, half.leg_index

    def ring_at(row: float) -> int:
        return int(np.argmin(np.abs(RINGS - row)))

    points = wing.shape[1]
    wrist = 1 + int(np.argmin(np.abs(SPAN - 0.42)))
    left = {
        "eye": body[EYE],
        "foot": leg[7],
        "shin": leg[5],
        "wingtip": wing[-1, [2, 3, points - 3, points - 4]],
        "wrist": wing[wrist, [0, 1, points - 1]],
    }
    middle = {
        "forehead": body[ring_at(16.5), 0],
        "crown": body[ring_at(15.1), 0],
        "nape": body[ring_at(12.7), 0],
        "back": body[12, 0],
        "throat": body[ring_at(13.9), -1],
        "breast": body[ring_at(8.55), -1],
        "bill_base": body[ring_at(17.0), 0],
        "bill_tip": body[-1],
        "tail_base": body[ring_at(3), 0],
        "tail_tip": body[0, [0, -1]],
    }
    weights = np.zeros((len(MURRE_KEYPOINTS), len(mesh.vertices)))
    for row, name in zip(weights, MURRE_KEYPOINTS, strict=True):
        side, _, place = name.partition("_")
        chosen = left[place] if side in ("left", "right") else middle[name]
        chosen = np.atleast_1d(chosen)
        if side == "right":
            chosen = mesh.mirror[chosen]
        elif side != "left":
            chosen = np.union1d(chosen, mesh.mirror[chosen])
        row[chosen] = 1 / len(chosen)
    return weights


def build_murre() -> Bird:
    """Build the murre from the numbers in this package; the result is equal on all machines up to rounding."""
    half = make_half()
    mesh = mirrored(half)
    left = half_weights(half)
    mirror = np.where(mesh.right[:, None], [-1.0, 1.0, 1.0], 1.0)
    shapes = half_shapes(half, left)[:, mesh.half] * mirror
    pose_mean, pose_covariance = pose_prior()
    bone_mean, bone_covariance = bone_prior()

    def float32(array):
        return jnp.asarray(np.asarray(array, np.float32))

    bird = Bird(
        vertices=float32(mesh.vertices / CM_PER_UNIT),
        faces=jnp.asarray(mesh.faces.astype(np.int32)),
        joints=float32(joint_positions() / CM_PER_UNIT),
        skin_weights=float32(mirrored_weights(mesh, left)),
        keypoint_weights=float32(keypoint_weights(half, mesh)),
        shape_basis=float32(shapes / CM_PER_UNIT),
        shape_variance=float32(np.ones(len(SHAPES))),
        pose_mean=float32(pose_mean),
        pose_covariance=float32(pose_covariance),
        bone_mean=float32(bone_mean),
        bone_covariance=float32(bone_covariance),
        vertex_colours=float32(half_colours(half)[mesh.half]),
        joint_limits=float32(joint_limits()),
        parents=PARENTS,
        joint_names=JOINT_NAMES,
        keypoint_names=MURRE_KEYPOINTS,
        joint_pairs=mirror_pairs(JOINT_NAMES),
        keypoint_pairs=mirror_pairs(MURRE_KEYPOINTS),
        name="murre",
        metres_per_unit=CM_PER_UNIT / 100,
    )
    return check_bird(bird, "murre")


if __name__ == "__main__":
    save_bird(build_murre(), MURRE_PATH)
