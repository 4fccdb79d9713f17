"""Import of published models: avian-mesh (Badger et al. 2020) and AVES (Wang et al. 2021).

Build a `Bird` from the arrays of a published model: the part that avian-mesh and AVES share. Both models are posed as
in `jaxfit.model.kinematics`: joint offsets times bone length, then linear blend skinning. Units and axes are the
authors': a bird is about 20 units long, looks along +y, and has +z up, so left = −x.

Source: Badger et al. 2020 (github.com/marcbadger/avian-mesh); Wang et al. 2021 (github.com/yufu-wang/aves).

Import avian-mesh, the cowbird model of Badger et al. 2020. Source: Badger et al. 2020, *3D Bird Reconstruction*
(github.com/marcbadger/avian-mesh).

Import AVES, the multi-species model of Wang et al. 2021. Source: Wang et al. 2021, *Birds of a Feather*
(github.com/yufu-wang/aves).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfit.foundation.array_files import check_shapes
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.published import PublishedFile, user_folder
from jaxfit.foundation.reading import check_readable, read_json_file
from jaxfit.model.anatomy import AVES_KEYPOINTS, AVIAN_MESH_KEYPOINTS, JOINT_NAMES, mirror_pairs
from jaxfit.model.bird import Bird, check_bird, neutral_colours, unlimited_joints
from jaxfit.model.torch_file import read_tensors

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
    prior = {field: read_numbers(content, key, "f", source) for field, key in zip(PRIOR_FIELDS, keys, strict=True)}
    bones = len(JOINT_NAMES) - 1
    shapes = (f"{3 * bones}", f"{3 * bones} {3 * bones}", f"{bones}", f"{bones} {bones}")
    _check_shapes(prior, dict(zip(PRIOR_FIELDS, shapes, strict=True)), source, "use the published prior")
    return prior


def _check_shapes(arrays: dict[str, np.ndarray], layout: dict[str, str], source: object, remedy: str) -> None:
    try:
        check_shapes({name: arrays[name].shape for name in layout}, layout)
    except ValueError as error:
        raise InputError(source, str(error), remedy) from None


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
    layout = {
        "kintree_table": f"2 {joints}",
        "J": f"{joints} 3",
        "V": "V 3",
        "F": "F 3",
        "weights": f"V {joints}",
        "vert2kpt": f"{len(keypoint_names)} V",
    }
    _check_shapes(parts, layout, source, f"is this the {name} model?")
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


PRIOR_KEYS = ("p_m", "p_cov", "b_m", "b_cov")
"""Tensors of `pose_bone_prior.pth`: mean and covariance of the pose, then of the bone lengths."""

AVES = PublishedFile(
    "aves.pt",
    "https://raw.githubusercontent.com/yufu-wang/aves/f8e8ae86cfd6ebfefa9cf68ed89d104537765258/models/aves.pt",
    ("720b08798a6123f050c81dee3fdbe28fc29afb53f825a27da08ed54a0036122c",),
    "jaxfit model get aves",
)
"""The model AVES (Wang et al. 2021, MIT): mean, shapes and priors of birds of many species."""


def models_folder() -> Path:
    """Return the folder of downloaded models: `JAXFIT_MODELS`, or the folder `jaxfit/models` of the user's data."""
    return user_folder("models", "JAXFIT_MODELS")


def import_avian_mesh(json_path: Path | str, prior_path: Path | str | None = None) -> Bird:
    """Import the cowbird model: 3932 vertices, 25 joints, 12 keypoints, no shape directions.

    Args:
        json_path: `bird_eccv.json`, the mesh, in model units.
        prior_path: `pose_bone_prior.pth`, the Gaussian priors of pose (radians) and bone length. This file is
            required, because a fit without a pose prior gives poor results.

    Raises:
        InputError: a file is missing or damaged, a field is missing, or a field has a wrong shape or wrong numbers.
    """
    if prior_path is None:
        remedy = "give pose_bone_prior.pth too; it is published beside bird_eccv.json"
        raise InputError(json_path, "the prior of pose and bone lengths is missing", remedy)
    mesh = read_json_file(json_path)
    if not isinstance(mesh, dict):
        raise InputError(json_path, "not a JSON object", "expected bird_eccv.json")
    prior = read_prior(read_tensors(prior_path), PRIOR_KEYS, prior_path)
    return build_bird("avian-mesh", mesh, prior, AVIAN_MESH_KEYPOINTS, json_path)


OWN_PRIOR_KEYS = ("pose_mean", "pose_cov", "bone_mean", "bone_cov")
"""The same four tensors as `PRIOR_KEYS`, by their names in `aves.pt`."""


def import_aves(pt_path: Path | str, prior_path: Path | str | None = None) -> Bird:
    """Import the multi-species model: 3932 vertices, 25 joints, 18 keypoints, 15 shape directions.

    `V` is the mean shape. `Beta` holds unit vectors over all vertices, and the code of AVES multiplies them by
    `Beta_sigma`. `shape_basis` is this product, so `betas` have the same meaning here as in AVES.

    The code of AVES treats σ (`Beta_sigma`) as standard deviations, but the values are the variances along each
    vector. If σ were standard deviations, one unit of the first coefficient would lengthen a bird of 23 units by 18,
    and the cowbird of Badger et al. (`beta_original`) would lie implausibly close to the mean: χ² = 0.9 for 15
    coefficients instead of 10.8. Hence `shape_variance` = σ/σ² = 1/σ. The fit of AVES itself uses no variance, but
    the penalty 150·‖betas‖₂. A fit needs neither `beta_original` nor `vert2kpt_cub` (the 15 parts of CUB), so the
    importer skips both.

    Args:
        pt_path: `aves.pt`, in model units; the file contains the same priors as avian-mesh.
        prior_path: a `pose_bone_prior.pth` that replaces the priors of `aves.pt`.

    Raises:
        InputError: a file is missing or damaged, a field is missing, or a field has a wrong shape or wrong numbers.
    """
    tensors = read_tensors(pt_path)
    if prior_path is None:
        prior = read_prior(tensors, OWN_PRIOR_KEYS, pt_path)
    else:
        prior = read_prior(read_tensors(prior_path), PRIOR_KEYS, prior_path)
    directions = read_numbers(tensors, "Beta", "f", pt_path)
    sigma = read_numbers(tensors, "Beta_sigma", "f", pt_path)
    if directions.ndim != 3 or sigma.shape != directions.shape[:1]:
        problem = f"shapes {directions.shape} and {sigma.shape}, expected (S, V, 3) and (S,)"
        raise InputError(pt_path, f"Beta, Beta_sigma: {problem}", "use aves.pt as published")
    if not np.all(sigma > 0):
        raise InputError(pt_path, "Beta_sigma: must be positive", "use aves.pt as published")
    shape = (directions * sigma[:, None, None], 1.0 / sigma)
    return build_bird("aves", tensors, prior, AVES_KEYPOINTS, pt_path, shape)


_FILES = {
    "avian-mesh": {".json": "bird_eccv.json", ".pth": "pose_bone_prior.pth"},
    "aves": {".pt": "aves.pt", ".pth": "pose_bone_prior.pth"},
}
"""Published model → suffix and published name of each of its files."""
MODEL_KINDS = tuple(_FILES)
"""Published models that jaxfit imports."""


def import_model(kind: str, sources: Sequence[Path | str]) -> Bird:
    """Import a published model from its files, in any order, or from the folder that contains them.

    Args:
        kind: "avian-mesh" (`bird_eccv.json` and `pose_bone_prior.pth`) or "aves" (`aves.pt`; a prior is
            optional and replaces the prior of `aves.pt`).
        sources: files, which may have other names with the same suffix; or folders with the published names. The prior
            of a folder does not replace the prior of `aves.pt`.

    Raises:
        ValueError: an unknown kind.
        InputError: a file is missing, is given twice, or does not belong to the model.
    """
    if kind not in MODEL_KINDS:
        raise ValueError(f"kind must be one of {', '.join(MODEL_KINDS)}, not {kind!r}")
    names = _FILES[kind]
    chosen: dict[str, Path] = {}
    for source in map(Path, sources):
        if os.path.isdir(source):  # noqa: PTH112 - False for paths that cannot exist
            own = names if kind == "avian-mesh" else [".pt"]
            files = [source / names[suffix] for suffix in own if (source / names[suffix]).is_file()]
        else:
            files = [check_readable(source, "a file of a bird model")]
        for file in files:
            suffix = file.suffix.lower()
            if suffix not in names:
                remedy = f"{kind} needs {' and '.join(names.values())}"
                raise InputError(file, f"not a file of the {kind} model", remedy)
            if chosen.setdefault(suffix, file).resolve() != file.resolve():
                problem = f"a second {names[suffix]} beside {chosen[suffix]}"
                raise InputError(file, problem, "give one of the two, by its file name")
    main, name = next(iter(names.items()))
    if main not in chosen:
        shown = ", ".join(map(str, sources)) or "nothing"
        raise InputError(shown, f"holds no {name}", f"give the {kind} model's {name}")
    read = import_aves if kind == "aves" else import_avian_mesh
    return read(chosen[main], chosen.get(".pth"))
