"""A bird in one `.npz` file: plain arrays and names, no pickles.

Beside the fields of `Bird` under their own names the file holds `format_version` (now 1); parents and pairs
are integer arrays, names are arrays of text. A file of a newer version is refused, unknown extra arrays are
passed over. `vertex_colours` and `joint_limits` may be absent, as they are from files written before birds had
them: then the bird is grey and its joints turn freely.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxfit.errors import InputError
from jaxfit.model.bird import Bird, free_limits, neutral_colours
from jaxfit.model.checks import ARRAY_FIELDS, check_bird
from jaxfit.storage.files import write_whole
from jaxfit.storage.npz import load_npz

__all__ = ["FORMAT_VERSION", "MURRE_PATH", "find_bird", "load_bird", "load_murre", "save_bird"]

FORMAT_VERSION = 1
MURRE_PATH = Path(__file__).with_name("murre.npz")
"""The bird that comes with jaxfit; `jaxfit.model.murre.build` writes it."""
OPTIONAL_FIELDS = ("vertex_colours", "joint_limits")
STATIC_FIELDS = {
    "parents": 1,
    "joint_names": 1,
    "keypoint_names": 1,
    "joint_pairs": 2,
    "keypoint_pairs": 2,
    "name": 0,
}
"""Fields of `Bird` that are no arrays there, and their dimensions in the file."""
TEXT_FIELDS = ("joint_names", "keypoint_names", "name")


def save_bird(bird: Bird, path: Path | str, notes: Mapping[str, float] | None = None) -> None:
    """Write a bird to an `.npz` file, whole or not at all; an older file of that name is replaced.

    Args:
        bird: the model; its arrays are stored as float32 and int32.
        path: the file, conventionally `<name>.npz`.
        notes: further numbers for the record, such as what a prior was learnt from; `load_bird` passes over them.

    Raises:
        InputError: a field of the bird is wrong, or the file cannot be written.
    """
    check_bird(bird, f"bird {bird.name!r}")
    arrays: dict[str, np.ndarray] = {"format_version": np.asarray(FORMAT_VERSION, np.int32)}
    for field in ARRAY_FIELDS:
        arrays[field] = np.asarray(getattr(bird, field), np.int32 if field == "faces" else np.float32)
    for field, dimensions in STATIC_FIELDS.items():
        value = getattr(bird, field)
        array = np.asarray(value, np.str_ if field in TEXT_FIELDS else np.int32)
        arrays[field] = array.reshape(-1, 2) if dimensions == 2 else array
    arrays |= {name: np.asarray(value) for name, value in (notes or {}).items()}
    write_whole(path, lambda file: np.savez_compressed(file, allow_pickle=False, **arrays))


def load_bird(path: Path | str) -> Bird:
    """Read a bird that `save_bird` wrote, and check it.

    Args:
        path: the `.npz` file.

    Returns:
        The bird, with jax arrays of float32 and int32.

    Raises:
        InputError: no such file, a folder, no `.npz`, truncated, Python objects inside, of a newer version,
            a field missing, or of a wrong shape or content.
    """
    path = Path(path)
    found = load_npz(path, {}, FORMAT_VERSION)
    dimensions = {field: len(axes.split()) for field, axes in ARRAY_FIELDS.items()} | STATIC_FIELDS
    for field, ndim in dimensions.items():
        if field in OPTIONAL_FIELDS and field not in found:
            continue
        if field not in found:
            raise InputError(path, f"{field}: missing", "import the model again with `jaxfit model import`")
        kinds = "U" if field in TEXT_FIELDS else "f" if field in ARRAY_FIELDS and field != "faces" else "iu"
        array = found[field]
        if array.ndim != ndim or array.dtype.kind not in kinds:
            problem = f"{field}: a {array.dtype} array of shape {array.shape} does not belong here"
            raise InputError(path, problem, "write the file again with save_bird")

    def pairs(field: str) -> tuple[tuple[int, int], ...]:
        if found[field].shape[1] != 2:
            problem = f"{field}: shape {found[field].shape}, expected (pairs, 2)"
            raise InputError(path, problem, "write the file again with save_bird")
        return tuple((int(left), int(right)) for left, right in found[field])

    def whole(array: np.ndarray) -> np.ndarray:
        # an index beyond int32 is turned into one that is never valid, not wrapped round to one that may be
        return np.where((array < 2**31) & (array >= 0), array, -1).astype(np.int32)

    with np.errstate(over="ignore"):  # what does not fit float32 becomes infinite, which the check reports
        arrays = {
            field: jnp.asarray(whole(found[field]) if field == "faces" else found[field].astype(np.float32))
            for field in ARRAY_FIELDS
            if field in found
        }
    arrays.setdefault("vertex_colours", jnp.asarray(neutral_colours(len(found["vertices"]))))
    arrays.setdefault("joint_limits", jnp.asarray(free_limits(max(len(found["parents"]) - 1, 0))))
    bird = Bird(
        **arrays,
        parents=tuple(int(parent) for parent in found["parents"]),
        joint_names=tuple(map(str, found["joint_names"])),
        keypoint_names=tuple(map(str, found["keypoint_names"])),
        joint_pairs=pairs("joint_pairs"),
        keypoint_pairs=pairs("keypoint_pairs"),
        name=str(found["name"]),
    )
    return check_bird(bird, path)


def load_murre() -> Bird:
    """The bird that comes with jaxfit: a common guillemot (common murre), *Uria aalge*."""
    return load_bird(MURRE_PATH)


def find_bird(name_or_path: Path | str) -> Bird:
    """A bird by its name or from its file.

    Args:
        name_or_path: "murre" for the bird that comes with jaxfit, anything else is the path of an `.npz` file.

    Raises:
        InputError: as `load_bird`.
    """
    return load_murre() if str(name_or_path) == "murre" else load_bird(name_or_path)
