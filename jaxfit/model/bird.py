"""`Bird`: mesh, joint tree, keypoints, shape directions, priors; its checks, summary and hash."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterator
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
    def bone_pairs(self) -> tuple[tuple[int, int], ...]:
        """(left, right) bones that mirror each other: the bones that end at the joints of `joint_pairs`."""
        # no bone ends at the root
        return tuple((left - 1, right - 1) for left, right in self.joint_pairs if left and right)

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
MAX_NUMBER = 1e9
"""Largest number of a model; the squares of larger numbers lose the other terms of a sum, or overflow."""


def check_bird(bird: Bird, source: object) -> Bird:
    """Return the bird unchanged, if all fields are valid and agree with each other.

    Args:
        bird: the model.
        source: file or object that an error names.

    Raises:
        InputError: a field is wrong; the message names the first wrong field, its value and the expected value.
    """
    arrays = {name: np.asarray(getattr(bird, name)) for name in ARRAY_FIELDS}
    for field, problem in _problems(bird, arrays):
        raise InputError(source, f"{field}: {problem}", "correct the model, or import it again")
    return bird


def _problems(bird: Bird, arrays: dict[str, np.ndarray]) -> Iterator[tuple[str, str]]:
    """Yield the wrong fields of a bird, and what is wrong. The checks after the first wrong field may raise."""
    parents, joints, keypoints = bird.parents, len(bird.parents), len(bird.keypoint_names)
    if joints < 2:
        yield "parents", "a bird needs a root and at least one more joint"
    if parents[0] != -1:
        yield "parents", f"joint 0 must be the root, −1, not {parents[0]}"
    for joint, parent in enumerate(parents[1:], start=1):
        if not 0 <= parent < joint:
            yield "parents", f"the parent of joint {joint} must be one of 0…{joint - 1}, not {parent}"
    yield from _shape_problems(bird, arrays)
    if len(bird.joint_names) != joints:
        yield "joint_names", f"{len(bird.joint_names)} names for {joints}"
    for field, names in (("joint_names", bird.joint_names), ("keypoint_names", bird.keypoint_names)):
        if not all(name and name.isprintable() for name in names):
            yield field, "a name that is empty or cannot be printed"
        if repeated := [name for name, uses in Counter(names).items() if uses > 1]:
            yield field, f"names used twice: {', '.join(sorted(repeated))}"
    if not bird.name.isprintable():
        yield "name", "cannot be printed"
    if bird.metres_per_unit is not None and not 0 < bird.metres_per_unit < np.inf:
        yield "metres_per_unit", f"{bird.metres_per_unit} is not positive and finite"
    for field, pairs, count in (
        ("joint_pairs", bird.joint_pairs, joints),
        ("keypoint_pairs", bird.keypoint_pairs, keypoints),
    ):
        used = [index for pair in pairs for index in pair]
        if not all(0 <= index < count for index in used):
            yield field, f"an index outside 0…{count - 1}"
        if len(used) > len(set(used)):
            yield field, "an index is in two pairs, or in one pair twice"
    faces, last = arrays["faces"], len(arrays["vertices"]) - 1
    if faces.min() < 0 or faces.max() > last:
        yield "faces", f"an index outside 0…{last}"
    for field in ("skin_weights", "keypoint_weights"):
        weights = arrays[field]
        sums = weights.sum(axis=1)
        row = int(np.abs(sums - 1).argmax())
        if weights.min() < 0:
            yield field, "negative weights"
        if abs(sums[row] - 1) > SUM_TOLERANCE:
            yield field, f"row {row} sums to {sums[row]:.4g}, not to 1"
    most = int((arrays["skin_weights"] != 0).sum(axis=1).max())
    if most > MAX_INFLUENCES:
        yield "skin_weights", f"{most} joints move one vertex, the maximum is {MAX_INFLUENCES}"
    if not (arrays["shape_variance"] > 0).all():
        yield "shape_variance", "must be positive"
    for field in ("pose_covariance", "bone_covariance"):
        matrix = arrays[field].astype(np.float64)
        size = np.abs(matrix).max()
        smallest = float(np.linalg.eigvalsh((matrix + matrix.T) / 2)[0])
        if size == 0:
            yield field, "is zero"
        if np.abs(matrix - matrix.T).max() > 1e-5 * size:
            yield field, "is not symmetric"
        if smallest < -1e-5 * size:  # rounding to float32 may make an eigenvalue of 0 slightly negative
            yield field, f"is not positive semidefinite (eigenvalue {smallest:.3g})"
    colours, limits = arrays["vertex_colours"], arrays["joint_limits"]
    if colours.min() < 0 or colours.max() > 1:
        yield "vertex_colours", f"values from {colours.min():.4g} to {colours.max():.4g}, sRGB values lie in [0, 1]"
    for joint in np.argwhere(limits[..., 0] > limits[..., 1])[:, 0]:
        yield "joint_limits", f"the minimum angle of {bird.joint_names[joint + 1]} exceeds the maximum"
    largest = float(np.abs(limits).max())
    if largest > 2 * np.pi + SUM_TOLERANCE:  # an axis-angle component beyond a full turn is never necessary
        yield "joint_limits", f"{largest:.4g} radians is beyond a full turn"


def _shape_problems(bird: Bird, arrays: dict[str, np.ndarray]) -> Iterator[tuple[str, str]]:
    bones = len(bird.parents) - 1
    sizes = {"J": bones + 1, "B": bones, "D": 3 * bones, "K": len(bird.keypoint_names), "3": 3, "2": 2}
    for field, axes in ARRAY_FIELDS.items():
        array = arrays[field]
        if array.ndim != len(axes.split()):
            yield field, f"shape {array.shape}, expected ({axes})"
        for axis, size in zip(axes.split(), array.shape, strict=True):
            expected = sizes.setdefault(axis, size)  # the first array with an axis defines the size of this axis
            if size != expected:
                yield field, f"shape {array.shape}, expected ({axes}) with {axis} = {expected}"
            if size == 0 and axis != "S":
                yield field, f"shape {array.shape} has no entries"
            if size > _LIMITS.get(axis, size):
                yield field, f"shape {array.shape}, the limit is {axis} = {_LIMITS[axis]:,}"
        if array.dtype.kind not in ("iu" if field == "faces" else "f"):
            yield field, f"has values of type {array.dtype}"
        if not np.isfinite(array).all():
            yield field, "holds NaN or infinite numbers"
        elif field != "faces" and np.abs(array).max(initial=0) > MAX_NUMBER:
            yield field, f"holds {np.abs(array).max():.3g}, more than {MAX_NUMBER:g}"


def rest_bone_lengths(bird: Bird) -> Float[np.ndarray, "bones"]:
    """Return the lengths of the bones of the rest skeleton, model units."""
    joints = np.asarray(bird.joints, np.float64)
    return np.linalg.norm(joints[1:] - joints[np.asarray(bird.parents[1:])], axis=1)


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
