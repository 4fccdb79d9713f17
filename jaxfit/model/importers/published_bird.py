"""Build a `Bird` from the arrays of a published model: the part that avian-mesh and AVES share.

Both models are posed as in `jaxfit.model.kinematics`: joint offsets times bone length, then linear blend
skinning. Units and axes are the authors': a bird is about 20 units long, looks along +y, and has +z up, so left = −x.

Source: Badger et al. 2020 (github.com/marcbadger/avian-mesh); Wang et al. 2021 (github.com/yufu-wang/aves).
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfit.errors import InputError
from jaxfit.model.anatomy import JOINT_NAMES, mirror_pairs
from jaxfit.model.bird import Bird, neutral_colours, unlimited_joints
from jaxfit.model.checks import check_bird

__all__ = ["build_bird", "read_numbers", "read_prior"]

PRIOR_FIELDS = ("pose_mean", "pose_covariance", "bone_mean", "bone_covariance")
MESH_KEYS = {"V": "f", "F": "i", "J": "f", "kintree_table": "i", "weights": "f", "vert2kpt": "f"}
"""Arrays of a published mesh, and whether each array holds real numbers ("f") or integers ("i")."""


def read_numbers(content: dict[str, Any], key: str, kind: str, source: object) -> np.ndarray:
    """Return one array of a model file as float64 (`kind` "f") or int64 (`kind` "i").

    Raises:
        InputError: the array is missing, or holds other values than such numbers.
    """
    if key not in content:
        known = ", ".join(sorted(map(str, content))[:20]) or "nothing"
        raise InputError(source, f"{key}: missing", f"the file contains {known}")
    try:
        array = np.asarray(content[key])
        if array.dtype.kind not in ("iuf" if kind == "f" else "iu"):
            raise ValueError(f"{array.dtype}, expected {'numbers' if kind == 'f' else 'integers'}")
        return array.astype(np.float64 if kind == "f" else np.int64)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(source, f"{key}: not an array of numbers: {error}", "use the published file") from error


def read_prior(content: dict[str, Any], keys: tuple[str, ...], source: object) -> dict[str, np.ndarray]:
    """Return the Gaussian priors under their names in `Bird`.

    Args:
        content: arrays of the file by name.
        keys: their names in the file, in the order of `PRIOR_FIELDS`.
        source: the file that an error names.

    Raises:
        InputError: an array is missing or has a wrong shape.
    """
    bones = len(JOINT_NAMES) - 1
    shapes = ((3 * bones,), (3 * bones, 3 * bones), (bones,), (bones, bones))
    prior = {}
    for field, key, shape in zip(PRIOR_FIELDS, keys, shapes, strict=True):
        prior[field] = array = read_numbers(content, key, "f", source)
        if array.shape != shape:
            problem = f"{key}: shape {array.shape}, expected {shape}"
            raise InputError(source, problem, "use the published prior")
    return prior


def build_bird(
    name: str,
    mesh: dict[str, Any],
    prior: dict[str, np.ndarray],
    keypoint_names: tuple[str, ...],
    source: object,
    shape: tuple[np.ndarray, np.ndarray] | None = None,
) -> Bird:
    """Build and check a bird.

    Args:
        name: name of the model.
        mesh: arrays of the model file, among them those of `MESH_KEYS`.
        prior: the priors from `read_prior`.
        keypoint_names: names of the K keypoints, in the order of `vert2kpt`.
        source: the file that an error names.
        shape: shape basis (S, V, 3) and variance (S,) of a model that has shape directions.

    Raises:
        InputError: an array is missing, or has a wrong shape or wrong numbers.
    """
    parts = {key: read_numbers(mesh, key, kind, source) for key, kind in MESH_KEYS.items()}
    joints = len(JOINT_NAMES)
    for key, expected in (
        ("kintree_table", (2, joints)),
        ("J", (joints, 3)),
        ("V", (None, 3)),
        ("F", (None, 3)),
        ("weights", (len(parts["V"]), joints)),
        ("vert2kpt", (len(keypoint_names), len(parts["V"]))),
    ):
        actual = parts[key].shape
        if len(actual) != len(expected) or any(e not in (None, a) for e, a in zip(expected, actual, strict=True)):
            shown = str(expected).replace("None", "any")
            raise InputError(source, f"{key}: shape {actual}, expected {shown}", f"is this the {name} model?")
    parents, numbers = parts["kintree_table"]
    if not np.array_equal(numbers, np.arange(joints)):
        raise InputError(source, "kintree_table: its second row must be 0, 1, 2, …", "use the published file")
    basis, variance = shape if shape is not None else (np.zeros((0, len(parts["V"]), 3)), np.zeros(0))

    def float32(array: np.ndarray) -> Any:
        # a number too large for float32 becomes infinite, and check_bird reports its field
        with np.errstate(over="ignore"):
            return jnp.asarray(array.astype(np.float32))

    # without this, an index beyond int32 would wrap round to an index that may be valid
    faces = np.where(np.abs(parts["F"]) < 2**31, parts["F"], -1)
    bird = Bird(
        vertices=float32(parts["V"]),
        faces=jnp.asarray(faces.astype(np.int32)),
        joints=float32(parts["J"]),
        skin_weights=float32(parts["weights"]),
        keypoint_weights=float32(parts["vert2kpt"]),
        shape_basis=float32(basis),
        shape_variance=float32(variance),
        **{field: float32(array) for field, array in prior.items()},
        vertex_colours=jnp.asarray(neutral_colours(len(parts["V"]))),
        joint_limits=jnp.asarray(unlimited_joints(joints - 1)),
        parents=tuple(int(parent) for parent in parents),
        joint_names=JOINT_NAMES,
        keypoint_names=keypoint_names,
        joint_pairs=mirror_pairs(JOINT_NAMES),
        keypoint_pairs=mirror_pairs(keypoint_names),
        name=name,
    )
    return check_bird(bird, source)
