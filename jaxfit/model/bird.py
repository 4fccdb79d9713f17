"""`Bird`: mesh, joint tree, keypoints, shape directions, priors; its checks, summary and hash."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfit.foundation.errors import InputError


class Bird(eqx.Module):
    """An articulated bird mesh in its rest pose, in model units.

    V vertices, F faces, J joints, K keypoints, S shape directions. Joint 0 is the root, and every parent has a
    lower index than its children. Names, joint tree and pairs are static fields, so birds with the same static
    fields and array shapes share one compiled program.

    Source: Badger et al. 2020, *3D Bird Reconstruction*, section 3 (mesh, pose and bone-length priors);
    Wang et al. 2021, *Birds of a Feather*, section 3 (shape directions).
    """

    vertices: Float[Array, "V 3"]
    """Rest positions of the vertices, mean shape."""
    faces: Int[Array, "F 3"]
    """Vertex indices of the triangles (int32)."""
    joints: Float[Array, "J 3"]
    """Rest positions of the joints."""
    skin_weights: Float[Array, "V J"]
    """Skinning weight of each joint for each vertex; rows sum to 1 and have at most 8 non-zero entries."""
    keypoint_weights: Float[Array, "K V"]
    """Keypoints as weighted means of vertices; rows sum to 1."""
    shape_basis: Float[Array, "S V 3"]
    """Vertex displacements for one unit of each shape coefficient; S may be 0."""
    shape_variance: Float[Array, "S"]
    """Variance of each shape coefficient."""
    pose_mean: Float[Array, "D"]
    """Mean of the flattened body pose, D = 3(J−1), axis-angle in radians."""
    pose_covariance: Float[Array, "D D"]
    """Covariance of the flattened body pose."""
    bone_mean: Float[Array, "J-1"]
    """Mean bone length, relative to the rest skeleton."""
    bone_covariance: Float[Array, "J-1 J-1"]
    """Covariance of the bone lengths."""
    vertex_colours: Float[Array, "V 3"]
    """Colour of each vertex, sRGB in [0, 1]; used for drawing only, a fit does not depend on the colours."""
    joint_limits: Float[Array, "J-1 3 2"]
    """Minimum and maximum of each axis-angle component of the body pose, radians; ±π where no limit is known."""
    parents: tuple[int, ...] = eqx.field(static=True)
    """Parent of each joint; −1 for the root."""
    joint_names: tuple[str, ...] = eqx.field(static=True)
    keypoint_names: tuple[str, ...] = eqx.field(static=True)
    joint_pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """(left, right) joints that mirror each other."""
    keypoint_pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """(left, right) keypoints that mirror each other."""
    name: str = eqx.field(static=True)
    metres_per_unit: float | None = eqx.field(static=True, default=None)
    """Length of one model unit in metres; None if unknown. A fit does not depend on this length."""

    @property
    def num_joints(self) -> int:
        """Number of joints J, with the root."""
        return len(self.parents)

    @property
    def num_keypoints(self) -> int:
        """Number of keypoints K."""
        return len(self.keypoint_names)

    @property
    def num_shapes(self) -> int:
        """Number of shape directions S."""
        return self.shape_basis.shape[0]

    @property
    def keypoints(self) -> Float[Array, "K 3"]:
        """Rest positions of the keypoints."""
        return jnp.asarray(self.keypoint_weights) @ jnp.asarray(self.vertices)


def neutral_colours(vertices: int) -> Float[np.ndarray, "V 3"]:
    """Return `vertex_colours` for a model without colours: grey."""
    return np.full((vertices, 3), 0.7, np.float32)


def unlimited_joints(bones: int) -> Float[np.ndarray, "bones 3 2"]:
    """Return `joint_limits` for a model without limits: −π and π for every component."""
    return np.broadcast_to(np.array([-np.pi, np.pi], np.float32), (bones, 3, 2)).copy()


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

MAX_VERTICES, MAX_FACES = 100_000, 200_000
"""Largest mesh of a bird model."""
_LIMITS = {"V": MAX_VERTICES, "F": MAX_FACES}


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


def rest_length(bird: Bird) -> float:
    """Return the distance from bill tip to tail tip at rest, model units; NaN without these keypoints."""
    names = bird.keypoint_names
    if not {"bill_tip", "tail_tip"} <= set(names):
        return float("nan")
    rest = np.asarray(bird.keypoints, np.float64)
    return float(np.linalg.norm(rest[names.index("bill_tip")] - rest[names.index("tail_tip")]))


def model_hash(bird: Bird) -> str:
    """Return the SHA-256 hash (hexadecimal) of all parts of a bird that a fit depends on.

    The hash covers the arrays (as little-endian float32 and int32), the joint tree, the names of joints and
    keypoints, and the pairs. The hash does not cover `bird.name` and `vertex_colours`, because a fit does not depend
    on them, and it does not depend on the file from which the bird was read.
    """
    digest = hashlib.sha256(b"jaxfit bird 1\n")
    for field in ARRAY_FIELDS:
        if field == "vertex_colours":
            continue
        array = np.ascontiguousarray(getattr(bird, field), "<i4" if field == "faces" else "<f4")
        digest.update(f"{field} {array.shape}\n".encode())
        digest.update(array.tobytes())
    static = [bird.parents, bird.joint_names, bird.keypoint_names, bird.joint_pairs, bird.keypoint_pairs]
    digest.update(json.dumps(static).encode())
    return digest.hexdigest()


def describe_bird(bird: Bird) -> dict[str, Any]:
    """Return facts about a model, as values that JSON can hold.

    Returns:
        `name`, `model_hash`; `metres_per_unit` (None if unknown); counts (`vertices`, `faces`, `joints`, `keypoints`,
        `shapes`); `joint_names`, `keypoint_names`, `parents` by name (None for the root), `joint_pairs` and
        `keypoint_pairs` as [left, right] names; `minimum`, `maximum`, `extents` (x, y, z, model units); `watertight`,
        `boundary_edges` (edges that belong to one face only), `volume` (cubed model units; None if not watertight);
        `max_influences` (maximum number of joints that move one vertex); `pose_prior_variance`,
        `bone_prior_variance` and `shape_variance`: smallest and largest eigenvalue (rad², 1, 1; None without shapes).
    """
    import trimesh  # imported here because the import takes half a second and few callers need it

    vertices, faces = np.asarray(bird.vertices), np.asarray(bird.faces)
    minimum, maximum = vertices.min(axis=0), vertices.max(axis=0)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    shared = np.unique(sides, axis=0, return_counts=True)[1]
    watertight = bool(mesh.is_watertight)
    joints, keypoints = bird.joint_names, bird.keypoint_names
    variance = np.asarray(bird.shape_variance)
    return {
        "name": bird.name,
        "metres_per_unit": bird.metres_per_unit,
        "model_hash": model_hash(bird),
        "vertices": len(vertices),
        "faces": len(faces),
        "joints": bird.num_joints,
        "keypoints": bird.num_keypoints,
        "shapes": bird.num_shapes,
        "joint_names": list(joints),
        "parents": [None if parent < 0 else joints[parent] for parent in bird.parents],
        "keypoint_names": list(keypoints),
        "joint_pairs": [[joints[left], joints[right]] for left, right in bird.joint_pairs],
        "keypoint_pairs": [[keypoints[left], keypoints[right]] for left, right in bird.keypoint_pairs],
        "minimum": minimum.tolist(),
        "maximum": maximum.tolist(),
        "extents": (maximum - minimum).tolist(),
        "watertight": watertight,
        "boundary_edges": int((shared == 1).sum()),
        "volume": float(mesh.volume) if watertight else None,
        "max_influences": int((np.asarray(bird.skin_weights) != 0).sum(axis=1).max()),
        "pose_prior_variance": _eigenvalue_range(bird.pose_covariance),
        "bone_prior_variance": _eigenvalue_range(bird.bone_covariance),
        "shape_variance": [float(variance.min()), float(variance.max())] if variance.size else None,
    }


def _eigenvalue_range(covariance: Any) -> list[float]:
    eigenvalues = np.linalg.eigvalsh(np.asarray(covariance, np.float64))
    return [float(eigenvalues[0]), float(eigenvalues[-1])]
