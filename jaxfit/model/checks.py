"""Check that the fields of a bird are valid and agree with each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from jaxfit.errors import InputError
from jaxfit.limits import MODEL_FACES, MODEL_JOINTS, MODEL_KEYPOINTS, MODEL_SHAPES, MODEL_VERTICES
from jaxfit.model.bird import Bird

__all__ = ["ARRAY_FIELDS", "MAX_INFLUENCES", "check_bird"]

MAX_INFLUENCES = 8
"""Maximum number of joints that move one vertex."""
SUM_TOLERANCE = 1e-3

ARRAY_FIELDS = {
    "vertices": "V 3",
    "faces": "F 3",
    "joints": "J 3",
    "skin_weights": "V J",
    "keypoint_weights": "K V",
    "shape_basis": "S V 3",
    "shape_variance": "S",
    "pose_mean": "D",
    "pose_covariance": "D D",
    "bone_mean": "B",
    "bone_covariance": "B B",
    "vertex_colours": "V 3",
    "joint_limits": "B 3 2",
}
"""Array fields of `Bird` and their axes: V vertices, F faces, J joints, K keypoints, S shapes, B = J−1 bones,
D = 3B angles."""

_LIMITS = {"V": MODEL_VERTICES, "F": MODEL_FACES, "J": MODEL_JOINTS, "K": MODEL_KEYPOINTS, "S": MODEL_SHAPES}


def check_bird(bird: Bird, source: object) -> Bird:
    """Return the bird unchanged, if all fields are valid and agree with each other.

    Args:
        bird: the model.
        source: file or object that an error names.

    Raises:
        InputError: a field is wrong; the message names the first wrong field, its value and the expected value.
    """
    _Checker(bird, source).run()
    return bird


class _Checker:
    def __init__(self, bird: Bird, source: object):
        self.bird, self.source = bird, source
        self.arrays = {name: np.asarray(getattr(bird, name)) for name in ARRAY_FIELDS}

    def run(self) -> None:
        self.check_tree()
        self.check_shapes()
        for field in ("joint_names", "keypoint_names"):
            self.check_names(field)
        self.require("name", self.bird.name.isprintable(), "cannot be printed")
        unit = self.bird.metres_per_unit
        self.require("metres_per_unit", unit is None or 0 < unit < np.inf, f"{unit} is not positive and finite")
        self.check_pairs("joint_pairs", len(self.bird.parents))
        self.check_pairs("keypoint_pairs", len(self.bird.keypoint_names))
        faces, last = self.arrays["faces"], len(self.arrays["vertices"]) - 1
        self.require("faces", faces.min() >= 0 and faces.max() <= last, f"an index outside 0…{last}")
        self.check_weights("skin_weights")
        most = int((self.arrays["skin_weights"] != 0).sum(axis=1).max())
        self.require("skin_weights", most <= MAX_INFLUENCES, f"{most} joints move one vertex, the maximum is 8")
        self.check_weights("keypoint_weights")
        self.require("shape_variance", bool((self.arrays["shape_variance"] > 0).all()), "must be positive")
        for field in ("pose_covariance", "bone_covariance"):
            self.check_covariance(field)
        self.check_colours()
        self.check_limits()

    def require(self, field: str, holds: object, problem: str) -> None:
        if not holds:
            raise InputError(self.source, f"{field}: {problem}", "correct the model, or import it again")

    def check_shapes(self) -> None:
        bones = max(len(self.bird.parents) - 1, 0)
        sizes = {"J": bones + 1, "B": bones, "D": 3 * bones, "K": len(self.bird.keypoint_names), "3": 3, "2": 2}
        for field, axes in ARRAY_FIELDS.items():
            array = self.arrays[field]
            self.require(field, array.ndim == len(axes.split()), f"shape {array.shape}, expected ({axes})")
            for axis, size in zip(axes.split(), array.shape, strict=True):
                # the first array with an axis defines the size of this axis
                expected = sizes.setdefault(axis, size)
                problem = f"shape {array.shape}, expected ({axes}) with {axis} = {expected}"
                self.require(field, size == expected, problem)
                self.require(field, size > 0 or axis == "S", f"shape {array.shape} has no entries")
                most = _LIMITS.get(axis, size)
                self.require(field, size <= most, f"shape {array.shape}, the limit is {axis} = {most:,}")
            kind = "iu" if field == "faces" else "f"
            self.require(field, array.dtype.kind in kind, f"has values of type {array.dtype}")
            self.require(field, np.isfinite(array).all(), "holds NaN or infinite numbers")

    def check_tree(self) -> None:
        parents = self.bird.parents
        self.require("parents", len(parents) >= 2, "a bird needs a root and at least one more joint")
        self.require("parents", len(parents) <= MODEL_JOINTS, f"{len(parents)} joints, the limit is {MODEL_JOINTS}")
        self.require("parents", parents[0] == -1, f"joint 0 must be the root, −1, not {parents[0]}")
        for joint, parent in enumerate(parents[1:], start=1):
            problem = f"the parent of joint {joint} must be one of 0…{joint - 1}, not {parent}"
            self.require("parents", 0 <= parent < joint, problem)

    def check_names(self, field: str) -> None:
        names: Sequence[str] = getattr(self.bird, field)
        count = len(self.bird.parents) if field == "joint_names" else len(self.arrays["keypoint_weights"])
        self.require(field, len(names) == count, f"{len(names)} names for {count}")
        self.require(field, all(names), "an empty name")
        self.require(field, all(map(str.isprintable, names)), "a name that cannot be printed")
        repeated = [name for name, uses in Counter(names).items() if uses > 1]
        self.require(field, not repeated, f"names used twice: {', '.join(sorted(repeated))}")

    def check_pairs(self, field: str, count: int) -> None:
        pairs = getattr(self.bird, field)
        self.require(field, len(pairs) <= count, f"{len(pairs)} pairs of {count}")
        used = [index for pair in pairs for index in pair]
        self.require(field, all(0 <= index < count for index in used), f"an index outside 0…{count - 1}")
        self.require(field, len(used) == len(set(used)), "an index is in two pairs, or in one pair twice")

    def check_weights(self, field: str) -> None:
        weights = self.arrays[field]
        self.require(field, (weights >= 0).all(), "negative weights")
        sums = weights.sum(axis=1)
        row = int(np.abs(sums - 1).argmax())
        sums_to_one = abs(sums[row] - 1) <= SUM_TOLERANCE
        self.require(field, sums_to_one, f"row {row} sums to {sums[row]:.4g}, not to 1")

    def check_covariance(self, field: str) -> None:
        matrix = self.arrays[field].astype(np.float64)
        size = np.abs(matrix).max()
        self.require(field, size > 0, "is zero")
        self.require(field, np.abs(matrix - matrix.T).max() <= 1e-5 * size, "is not symmetric")
        smallest = float(np.linalg.eigvalsh((matrix + matrix.T) / 2)[0])
        # rounding to float32 may make an eigenvalue of 0 slightly negative
        problem = f"is not positive semidefinite (eigenvalue {smallest:.3g})"
        self.require(field, smallest >= -1e-5 * size, problem)

    def check_colours(self) -> None:
        colours = self.arrays["vertex_colours"]
        lowest, highest = float(colours.min()), float(colours.max())
        problem = f"values from {lowest:.4g} to {highest:.4g}, sRGB values lie in [0, 1]"
        self.require("vertex_colours", lowest >= 0 and highest <= 1, problem)

    def check_limits(self) -> None:
        limits = self.arrays["joint_limits"]
        crossed = np.argwhere(limits[..., 0] > limits[..., 1])
        joint = self.bird.joint_names[crossed[0, 0] + 1] if len(crossed) else ""
        self.require("joint_limits", not joint, f"the minimum angle of {joint} exceeds the maximum")
        largest = float(np.abs(limits).max())
        # an axis-angle component beyond a full turn is never necessary
        valid = largest <= 2 * np.pi + SUM_TOLERANCE
        self.require("joint_limits", valid, f"{largest:.4g} radians is beyond a full turn")
