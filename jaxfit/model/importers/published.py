"""Published bird models, turned into a `Bird` from the files their authors released.

Both models pose as in `jaxfit.model.kinematics`: joint offsets times bone length, then linear blend
skinning; units and axes are the authors' (a bird some 20 units long, looking along +y, +z up, left = −x).

Source: Badger et al. 2020 (github.com/marcbadger/avian-mesh); Wang et al. 2021 (github.com/yufu-wang/aves).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfit.errors import InputError
from jaxfit.model.anatomy import AVES_KEYPOINTS, AVIAN_MESH_KEYPOINTS, JOINT_NAMES, mirror_pairs
from jaxfit.model.bird import Bird, free_limits, neutral_colours
from jaxfit.model.checks import check_bird
from jaxfit.model.importers.torch_file import read_tensors

__all__ = ["import_aves", "import_avian_mesh", "read_model_json"]

MAX_JSON_BYTES = 64 * 2**20
PRIOR_KEYS = ("p_m", "p_cov", "b_m", "b_cov")
AVES_PRIOR_KEYS = ("pose_mean", "pose_cov", "bone_mean", "bone_cov")
PRIOR_FIELDS = ("pose_mean", "pose_covariance", "bone_mean", "bone_covariance")
MESH_KEYS = {"V": "f", "F": "i", "J": "f", "kintree_table": "i", "weights": "f", "vert2kpt": "f"}


def import_avian_mesh(json_path: Path | str, prior_path: Path | str | None = None) -> Bird:
    """The cowbird model of Badger et al. 2020: 3932 vertices, 25 joints, 12 keypoints, no shape directions.

    Args:
        json_path: `bird_eccv.json`, the mesh, in model units.
        prior_path: `pose_bone_prior.pth`, the Gaussian priors of pose (radians) and bone length; required,
            since a bird without a prior cannot be fitted sensibly.

    Raises:
        InputError: a file is missing, damaged, or lacks a field; a field has the wrong shape or numbers.
    """
    if prior_path is None:
        remedy = "give pose_bone_prior.pth too; it is published beside bird_eccv.json"
        raise InputError(json_path, "the prior of pose and bone lengths is missing", remedy)
    mesh = read_model_json(json_path)
    prior = _prior(read_tensors(prior_path), PRIOR_KEYS, prior_path)
    return _assemble("avian-mesh", mesh, prior, AVIAN_MESH_KEYPOINTS, json_path)


def import_aves(pt_path: Path | str, prior_path: Path | str | None = None) -> Bird:
    """The multi-species model of Wang et al. 2021: 3932 vertices, 25 joints, 18 keypoints, 15 shapes.

    `V` is the mean shape. `Beta` holds unit vectors over all vertices, which AVES' code multiplies by
    `Beta_sigma`: so does `shape_basis`, and `betas` mean here what they mean there. That code takes σ for
    standard deviations, but the values are those of variances along each vector: as deviations, one unit of
    the first coefficient would lengthen a bird of 23 units by 18, and the cowbird of Badger et al.
    (`beta_original`) would lie implausibly close to the mean, at χ² = 0.9 for 15 coefficients instead of
    10.8. Hence `shape_variance` = σ/σ² = 1/σ. AVES' own fit uses no variance but the penalty 150·‖betas‖₂.
    `beta_original` and `vert2kpt_cub` (the 15 parts of CUB) are nothing a fit needs and are left out.

    Args:
        pt_path: `aves.pt`, in model units; it holds the same priors as avian-mesh.
        prior_path: a `pose_bone_prior.pth` to use instead of the file's own.

    Raises:
        InputError: a file is missing, damaged, or lacks a field; a field has the wrong shape or numbers.
    """
    tensors = read_tensors(pt_path)
    if prior_path is None:
        prior = _prior(tensors, AVES_PRIOR_KEYS, pt_path)
    else:
        prior = _prior(read_tensors(prior_path), PRIOR_KEYS, prior_path)
    directions = _numbers(tensors, "Beta", "f", pt_path)
    sigma = _numbers(tensors, "Beta_sigma", "f", pt_path)
    if directions.ndim != 3 or sigma.shape != directions.shape[:1]:
        problem = f"shapes {directions.shape} and {sigma.shape}, expected (S, V, 3) and (S,)"
        raise InputError(pt_path, f"Beta, Beta_sigma: {problem}", "use aves.pt as published")
    if not np.all(sigma > 0):
        raise InputError(pt_path, "Beta_sigma: must be positive", "use aves.pt as published")
    shape = (directions * sigma[:, None, None], 1.0 / sigma)
    return _assemble("aves", tensors, prior, AVES_KEYPOINTS, pt_path, shape)


def read_model_json(path: Path | str) -> dict[str, Any]:
    """The top-level object of a model's JSON file, its values as parsed.

    Raises:
        InputError: missing, too large, not JSON (with line and column), or no object.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise InputError(path, f"larger than {MAX_JSON_BYTES} bytes", "a bird model is a few MB")
        content = json.loads(path.read_bytes())
    except json.JSONDecodeError as error:
        problem = f"not valid JSON at line {error.lineno}, column {error.colno}: {error.msg}"
        raise InputError(path, problem, "the file may be cut short; fetch it again") from error
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}", "check the path") from error
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"not readable as JSON: {error}", "expected bird_eccv.json") from error
    if not isinstance(content, dict):
        raise InputError(path, "not a JSON object", "expected bird_eccv.json")
    return content


def _numbers(content: dict[str, Any], key: str, kind: str, source: object) -> np.ndarray:
    """One entry as float64 (`kind` "f") or int64 ("i")."""
    if key not in content:
        known = ", ".join(sorted(map(str, content))[:20]) or "nothing"
        raise InputError(source, f"{key}: missing", f"the file holds {known}")
    try:
        array = np.asarray(content[key])
        if array.dtype.kind not in ("iuf" if kind == "f" else "iu"):
            raise ValueError(f"{array.dtype} where {'numbers' if kind == 'f' else 'whole numbers'} belong")
        return array.astype(np.float64 if kind == "f" else np.int64)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(source, f"{key}: not an array of numbers: {error}", "use the published file") from error


def _prior(content: dict[str, Any], keys: tuple[str, ...], source: object) -> dict[str, np.ndarray]:
    """The Gaussian priors under `Bird`'s names, from `keys` in the order of `PRIOR_FIELDS`."""
    bones = len(JOINT_NAMES) - 1
    shapes = ((3 * bones,), (3 * bones, 3 * bones), (bones,), (bones, bones))
    prior = {}
    for field, key, shape in zip(PRIOR_FIELDS, keys, shapes, strict=True):
        prior[field] = array = _numbers(content, key, "f", source)
        if array.shape != shape:
            problem = f"{key}: shape {array.shape}, expected {shape}"
            raise InputError(source, problem, "use the published prior")
    return prior


def _assemble(
    name: str,
    mesh: dict[str, Any],
    prior: dict[str, np.ndarray],
    keypoint_names: tuple[str, ...],
    source: object,
    shape: tuple[np.ndarray, np.ndarray] | None = None,
) -> Bird:
    """A checked bird from a model's mesh, prior and shape directions (basis, variance)."""
    parts = {key: _numbers(mesh, key, kind, source) for key, kind in MESH_KEYS.items()}
    joints = len(JOINT_NAMES)
    for key, expected in (
        ("kintree_table", (2, joints)),
        ("J", (joints, 3)),
        ("V", (None, 3)),
        ("F", (None, 3)),
        ("weights", (len(parts["V"]), joints)),
        ("vert2kpt", (len(keypoint_names), len(parts["V"]))),
    ):
        found = parts[key].shape
        if len(found) != len(expected) or any(e not in (None, f) for e, f in zip(expected, found, strict=True)):
            shown = str(expected).replace("None", "any")
            raise InputError(source, f"{key}: shape {found}, expected {shown}", f"is this the {name} model?")
    parents, numbers = parts["kintree_table"]
    if not np.array_equal(numbers, np.arange(joints)):
        raise InputError(source, "kintree_table: its second row must count the joints", "use the published file")
    basis, variance = shape if shape is not None else (np.zeros((0, len(parts["V"]), 3)), np.zeros(0))

    def real(array: np.ndarray) -> Any:
        with np.errstate(over="ignore"):  # what does not fit becomes infinite, and the check names its field
            return jnp.asarray(array.astype(np.float32))

    # an index that does not fit becomes one that cannot be valid, instead of wrapping round to one that is
    faces = np.where(np.abs(parts["F"]) < 2**31, parts["F"], -1)
    bird = Bird(
        vertices=real(parts["V"]),
        faces=jnp.asarray(faces.astype(np.int32)),
        joints=real(parts["J"]),
        skin_weights=real(parts["weights"]),
        keypoint_weights=real(parts["vert2kpt"]),
        shape_basis=real(basis),
        shape_variance=real(variance),
        **{field: real(array) for field, array in prior.items()},
        vertex_colours=jnp.asarray(neutral_colours(len(parts["V"]))),
        joint_limits=jnp.asarray(free_limits(joints - 1)),
        parents=tuple(int(parent) for parent in parents),
        joint_names=JOINT_NAMES,
        keypoint_names=keypoint_names,
        joint_pairs=mirror_pairs(JOINT_NAMES),
        keypoint_pairs=mirror_pairs(keypoint_names),
        name=name,
    )
    return check_bird(bird, source)
