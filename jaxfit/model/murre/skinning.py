"""Skin weights, shape directions, bone lengths and the measurements behind them.

Measurements of the common guillemot from which the model is built, in centimetres, with their sources. `low` and `high`
are the range of adults of the species (all subspecies and both sexes, which differ little); `used` is the value of this
model. The ranges of total length and wingspan are published ranges. The values of wing, bill, tarsus and tail are the
usual values of the named handbooks. We rounded these ranges outwards and did not copy them from the tables of the
handbooks: they are accurate enough to build a model, but must not be cited. Values marked APPROXIMATE come from no
table. We estimated them from photographs and from the proportions of auk skeletons; their error is 10 to 20 % of the
value.

Sources:
    BWP: Cramp, S. (ed.) 1985, *The Birds of the Western Palearctic*, vol. IV, Uria aalge.
    HBW: del Hoyo, J., Elliott, A. & Sargatal, J. (eds.) 1996, *Handbook of the Birds of the World*, vol. 3, Alcidae.
    Pyle: Pyle, P. 2008, *Identification Guide to North American Birds*, part II.
    G&J: Gaston, A. J. & Jones, I. L. 1998, *The Auks*.
    Collins: Mullarney, K. et al. 1999, *Collins Bird Guide*.

The weights of body and leg are smooth steps from joint to joint. The weights of the wing solve a least-squares problem:
linear blend skinning shall transform the folded wing into the spread wing (`wing`). The tip of a feather then follows
a mean of hand, forearm and upper arm, as the feathers of a fan do, instead of one bone.

Variation between murres: shape directions and the prior of bone lengths. The directions are designed from the ranges in
`measurements`, not learnt. One unit of a shape coefficient is one standard deviation, which is a quarter of the range
from the lowest to the highest measurement.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from jaxfit.model.anatomy import JOINT_NAMES, mirror_pairs, other_side
from jaxfit.model.murre.skeleton import MIDDLE_AND_LEFT, WING_TIP, spread_transforms
from jaxfit.model.murre.surface import ANGLES, LEG_PARTS, RINGS, SPAN, Half, Mesh, sections_at, spread_sheet


class Measurement(NamedTuple):
    """Range, model value and source of one length, in centimetres."""

    low: float
    high: float
    used: float
    source: str


MEASUREMENTS = {
    "total_length": Measurement(38.0, 46.0, 42.5, "Collins 38–46; HBW 38–43; bill tip to tail tip, neck straight"),
    "wingspan": Measurement(61.0, 73.0, 67.3, "Collins 61–73; BWP 64–70"),
    "wing": Measurement(19.0, 21.6, 19.9, "BWP, Pyle: folded wing, wrist to the tip of the longest primary"),
    "bill": Measurement(4.2, 5.1, 4.7, "BWP, Pyle: culmen, from the feathers to the tip"),
    "tarsus": Measurement(3.5, 4.1, 3.8, "BWP, Pyle"),
    "tail": Measurement(4.0, 5.3, 4.8, "BWP, Pyle"),
    "middle_toe": Measurement(4.4, 5.6, 5.0, "BWP: middle toe with claw; APPROXIMATE"),
    "humerus": Measurement(7.4, 9.4, 7.5, "proportions of auk skeletons; APPROXIMATE; shorter when feathered"),
    "forearm": Measurement(5.8, 7.4, 6.7, "proportions of auk skeletons; APPROXIMATE"),
    "body_width": Measurement(
        10.0, 12.5, 11.4, "photographs, and 0.95–1.05 kg at the density of a plumed bird; APPROXIMATE"
    ),
    "body_depth": Measurement(9.0, 11.5, 9.9, "as body_width; APPROXIMATE"),
    "neck_width": Measurement(4.0, 5.8, 5.2, "photographs; APPROXIMATE"),
}


SPINE = (
    ("tail", "lower_body", 2.6, 4.2),
    ("lower_body", "upper_body", 4.4, 6.6),
    ("upper_body", "neck_root", 7.3, 9.1),
    ("neck_root", "neck", 9.1, 10.8),
    ("neck", "head", 11.2, 13.2),
)
"""(joint, next joint, start, end) from the tail to the head: the weight changes from the joint to the next joint
between `start` and `end`, in rows of `surface.SECTIONS`."""
WING = ("left_wing_root", "left_shoulder", "left_elbow", "left_wrist")
LEG = {
    "thigh": {"body": 0.4, "left_knee": 0.6},
    "tibia": {"left_knee": 1.0},
    "ankle": {"left_knee": 0.5, "left_ankle": 0.5},
    "tarsus": {"left_ankle": 1.0},
    "foot": {"left_ankle": 0.45, "left_foot": 0.55},
    "toes": {"left_foot": 1.0},
}
HINGE = {"upper_body": 0.45, "left_wing_root": 0.2, "left_shoulder": 0.35}
"""Weights of the first ring of the wing."""
MAX_JOINTS = 4
SMOOTH, NEAR = 2.0, 0.5
"""Penalties of the wing weights: on differences between neighbouring vertices, and on differences from the initial
guess; both in centimetres of position error per unit of weight."""


def half_weights(half: Half) -> Float[np.ndarray, "H J"]:
    """Return the skinning weights of the left half; rows sum to 1 and have at most four non-zero entries."""
    weights = np.zeros((len(half.vertices), len(JOINT_NAMES)))
    for vertex in np.flatnonzero(half.part == 0):
        ring, column = half.place[vertex]
        for name, share in body_weights(float(RINGS[ring]), float(ANGLES[column])).items():
            weights[vertex, JOINT_NAMES.index(name)] = share
    at_body = weights[half.leg_index[0]].mean(axis=0)
    for ring, name in enumerate(LEG_PARTS, start=1):
        for joint, share in LEG[name].items():
            row = at_body if joint == "body" else np.eye(len(JOINT_NAMES))[JOINT_NAMES.index(joint)]
            weights[half.leg_index[ring]] += share * row
    columns = [JOINT_NAMES.index(name) for name in WING]
    weights[half.wing_index[1:].ravel()[:, None], columns] = wing_weights(half).reshape(-1, len(WING))
    weights[half.wing_index[1]] = 0.0
    for name, share in HINGE.items():
        weights[half.wing_index[1], JOINT_NAMES.index(name)] = share
    return _keep_largest(weights)


def body_weights(row: float, angle: float) -> dict[str, float]:
    """Return the weights of a point of the body, by its row of `surface.SECTIONS` and its angle from the back."""
    weights = {SPINE[0][0]: 1.0}
    for before, after, start, end in SPINE:
        share = smooth_step(row, start, end)
        weights[after] = weights.get(before, 0.0) * share
        weights[before] = weights.get(before, 0.0) * (1 - share)
    breast = 0.5 * smooth_step(row, 6.0, 7.5) * (1 - smooth_step(row, 8.0, 9.2)) * smooth_step(angle, 1.5, 2.4)
    weights["chest"] = breast * weights["upper_body"]
    weights["upper_body"] -= weights["chest"]
    lower = smooth_step(row, 16.5, 17.3) * float(angle > np.pi / 2)
    weights["jaw"] = lower * weights["head"]
    weights["head"] -= weights["jaw"]
    return {name: share for name, share in weights.items() if share > 0}


def wing_weights(half: Half) -> Float[np.ndarray, "U P 4"]:
    """Return the weights on the joints `WING` that transform the folded wing into the spread wing.

    Least-squares solution of Σ_j w_j (R_j x + t_j) = y for every vertex, with folded position x and spread position
    y, subject to w ≥ 0 and Σ_j w_j = 1. Penalties keep w close to an initial guess and smooth over the wing.
    """
    folded = half.vertices[half.wing_index[1:]]
    upper, lower = spread_sheet()
    spread = np.concatenate([upper, lower[:, ::-1]], axis=1)
    moved = [folded] + [folded @ R.T + t for R, t in spread_transforms().values()]
    images = np.stack(moved, axis=-1)  # (U, P, 3, 4)
    stations, points, joints = len(SPAN), folded.shape[1], len(WING)
    index = np.arange(stations * points * joints).reshape(stations, points, joints)
    rows, columns, values, right_side = [], [], [], []

    def equation(at, coefficients, value) -> None:
        rows.append(np.full(len(at), len(right_side)))
        columns.append(at)
        values.append(coefficients)
        right_side.append(value)

    guess = _initial_guess()
    for u in range(stations):
        for p in range(points):
            for d in range(3):
                equation(index[u, p], images[u, p, d], spread[u, p, d])
            equation(index[u, p], np.full(joints, 100.0), 100.0)
            for j in range(joints):
                equation(index[u, p, j : j + 1], np.array([NEAR]), NEAR * guess[u, j])
                for other in ((u + 1, p), (u, p + 1)):
                    if other[0] < stations:
                        at = np.array([index[u, p, j], index[other[0], other[1] % points, j]])
                        equation(at, np.array([SMOOTH, -SMOOTH]), 0.0)
    matrix = np.zeros((len(right_side), index.size))
    np.add.at(matrix, (np.concatenate(rows), np.concatenate(columns)), np.concatenate(values))
    solved = nnls(matrix.T @ matrix, matrix.T @ np.array(right_side), maxiter=20 * index.size)[0]
    weights = solved.reshape(stations, points, joints)
    return weights / weights.sum(axis=-1, keepdims=True)


def _initial_guess() -> Float[np.ndarray, "U 4"]:
    """Return weights on `WING` that change by smooth steps along the span."""
    hand, fore, arm = smooth_step(SPAN, 0.36, 0.50), smooth_step(SPAN, 0.16, 0.30), smooth_step(SPAN, 0.0, 0.13)
    return np.stack([1 - arm, arm * (1 - fore), fore * (1 - hand), hand], axis=-1)


def mirrored_weights(mesh: Mesh, left: Float[np.ndarray, "H J"]) -> Float[np.ndarray, "V J"]:
    """Return the weights of the whole mesh; a vertex on the midline has equal weights for both sides."""
    swap = [JOINT_NAMES.index(other_side(name)) for name in JOINT_NAMES]
    weights = left[mesh.half]
    weights[mesh.right] = weights[mesh.right][:, swap]
    middle = mesh.mirror == np.arange(len(mesh.mirror))
    weights[middle] = (weights[middle] + weights[middle][:, swap]) / 2
    return weights


def _keep_largest(weights: np.ndarray) -> np.ndarray:
    """Keep the `MAX_JOINTS` largest weights of every row that are above 0.004, and normalise the rows."""
    smallest = np.sort(weights, axis=1)[:, [-MAX_JOINTS]]
    weights = np.where((weights >= smallest) & (weights > 0.004), weights, 0.0)
    return weights / weights.sum(axis=1, keepdims=True)


def smooth_step(x, start: float, end: float):
    """Return 0 below `start`, 1 above `end`, and the cubic 3t² − 2t³ between them."""
    t = np.clip((x - start) / (end - start), 0.0, 1.0)
    return t * t * (3 - 2 * t)


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
