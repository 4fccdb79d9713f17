"""Save and load a bird model as one `.npz` file: plain arrays and names, no pickles.

The file contains the fields of `Bird` under their own names, and `format_version` (now 1). Parents and pairs are
integer arrays, names are text arrays. A file of a newer version is rejected; unknown extra arrays are ignored.
`vertex_colours` and `joint_limits` may be absent, because older files lack these fields: then the bird is grey and
the joints have no limits. `metres_per_unit` is absent where the length of a model unit is unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxfit.foundation.array_files import load_npz, validate_arrays
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.published import check_published
from jaxfit.model.bird import ARRAY_FIELDS, Bird, check_bird, neutral_colours, unlimited_joints
from jaxfit.model.published import AVES, import_aves, models_folder

FORMAT_VERSION = 1
MURRE_PATH = Path(__file__).with_name("murre.npz")
"""The model file that comes with jaxfit."""
OPTIONAL_FIELDS = ("vertex_colours", "joint_limits")
_UNIT = "metres_per_unit"
_PROVENANCE = "provenance"
STATIC_FIELDS = {
    "parents": "J",
    "joint_names": "J",
    "keypoint_names": "K",
    "joint_pairs": "joint_pairs 2",
    "keypoint_pairs": "keypoint_pairs 2",
    "name": "",
}
"""Fields of `Bird` that are not arrays, and the axes of their arrays in the file."""
TEXT_FIELDS = ("joint_names", "keypoint_names", "name")


def save_bird(bird: Bird, path: Path | str, notes: Mapping[str, Any] | None = None) -> None:
    """Write a bird to an `.npz` file atomically; an existing file of that name is replaced.

    Args:
        bird: the model; the arrays are stored as float32 and int32.
        path: the file, conventionally `<name>.npz`.
        notes: further numbers or texts to store, for example the number of poses that a prior was learnt from;
            `load_bird` ignores them.

    Raises:
        InputError: a field of the bird is wrong, or the file cannot be written.
    """
    check_bird(bird, f"bird {bird.name!r}")
    arrays: dict[str, np.ndarray] = {"format_version": np.asarray(FORMAT_VERSION, np.int32)}
    for field in ARRAY_FIELDS:
        arrays[field] = np.asarray(getattr(bird, field), np.int32 if field == "faces" else np.float32)
    for field, axes in STATIC_FIELDS.items():
        value = getattr(bird, field)
        array = np.asarray(value, np.str_ if field in TEXT_FIELDS else np.int32)
        arrays[field] = array.reshape(-1, 2) if axes.endswith(" 2") else array
    if bird.metres_per_unit is not None:
        arrays[_UNIT] = np.asarray(bird.metres_per_unit, np.float64)
    arrays |= {name: np.asarray(value) for name, value in (notes or {}).items()}
    write_whole(path, lambda file: np.savez_compressed(file, allow_pickle=False, **arrays))


def load_bird(path: Path | str) -> Bird:
    """Read and check a bird that `save_bird` wrote.

    Args:
        path: the `.npz` file.

    Returns:
        The bird, with jax arrays of float32 and int32.

    Raises:
        InputError: the file does not exist, is a folder or not an `.npz`, is truncated, contains Python objects or
            has a newer version; or a field is missing or has a wrong shape or wrong content.
    """
    path = Path(path)
    shapes = ARRAY_FIELDS | STATIC_FIELDS | {_UNIT: ""}
    optional = {name: shapes[name] for name in (*OPTIONAL_FIELDS, _UNIT)}
    required = {name: shape for name, shape in shapes.items() if name not in optional}
    content = load_npz(path, required, FORMAT_VERSION, optional=optional)
    whole = ("faces", "parents", "joint_pairs", "keypoint_pairs")
    types: dict[str, Any] = {
        name: "U" if name in TEXT_FIELDS else np.int64 if name in whole else np.float32 for name in content
    }
    types[_UNIT] = np.float64
    try:
        content = validate_arrays(content, {name: (shapes[name], types[name]) for name in content})
    except ValueError as error:
        raise InputError(path, str(error), "write the file again with save_bird") from None
    arrays: dict[str, Any] = {field: content[field] for field in ARRAY_FIELDS if field in content}
    # an index beyond int32 stays an index that check_bird refuses
    arrays["faces"] = np.clip(content["faces"], -1, 2**31 - 1).astype(np.int32)
    arrays.setdefault("vertex_colours", neutral_colours(len(content["vertices"])))
    arrays.setdefault("joint_limits", unlimited_joints(max(len(content["parents"]) - 1, 0)))
    bird = Bird(
        **jax.device_put(arrays),
        parents=tuple(int(parent) for parent in content["parents"]),
        joint_names=tuple(map(str, content["joint_names"])),
        keypoint_names=tuple(map(str, content["keypoint_names"])),
        joint_pairs=tuple((int(left), int(right)) for left, right in content["joint_pairs"]),
        keypoint_pairs=tuple((int(left), int(right)) for left, right in content["keypoint_pairs"]),
        name=str(content["name"]),
        metres_per_unit=float(content[_UNIT]) if _UNIT in content else None,
    )
    return check_bird(bird, path)


def read_provenance(name_or_path: Path | str) -> dict[str, str]:
    """Return how an adapted model was made, from the note `provenance` of its file; empty for other models.

    Raises:
        InputError: the file cannot be read, or the note is not a list of texts.
    """
    if str(name_or_path) in ("murre", "aves"):
        return {}
    content = load_npz(name_or_path, {}, optional={_PROVENANCE: "lines"})
    lines = content.get(_PROVENANCE, np.zeros(0, np.str_))
    if lines.dtype.kind != "U":
        raise InputError(name_or_path, f"{_PROVENANCE}: {lines.dtype} array, expected text", "adapt the model again")
    return {key: value for key, _, value in (line.partition(": ") for line in map(str, lines))}


def load_murre() -> Bird:
    """Load the bird that comes with jaxfit: a common guillemot (common murre), *Uria aalge*."""
    return load_bird(MURRE_PATH)


def find_bird(name_or_path: Path | str) -> Bird:
    """Load a bird by its name or from its file.

    Args:
        name_or_path: "murre" for the bird that comes with jaxfit; "aves" for the published model that
            `jaxfit model get aves` downloads; any other value is the path of an `.npz` file.

    Raises:
        InputError: as `load_bird`; or the file of "aves" is missing, or has another content than the published file.
    """
    if str(name_or_path) == "murre":
        return load_murre()
    if str(name_or_path) == "aves":
        path = models_folder() / AVES.file_name
        check_published(path, AVES)
        return import_aves(path)
    return load_bird(name_or_path)
