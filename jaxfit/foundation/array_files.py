"""Reading of `.npz` and `.npy` files, checks of arrays that belong together, memory of tables."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import reading

MAX_TABLE_GB = 2.0
"""Largest memory of the tables of a file, by estimate: tables have a cell for every track in every frame."""
AGAIN = "write the file again"
_COPY = "the file may be truncated: copy or write it again"


def validate_arrays(values: Mapping[str, Any], layout: Mapping[str, tuple[str, Any]]) -> dict[str, np.ndarray]:
    """Return read-only arrays whose types and shapes fit a layout.

    Args:
        values: name → array-like.
        layout: name → (shape, dtype). A shape is a text of sizes, such as ``"N T 3"``: a number is a fixed size;
            any other word, such as ``T`` or ``J-1``, stands for one size in all arrays of the layout.

    Returns:
        Name → a read-only array with that dtype: a copy, or the given array if it is read-only and owns its memory.

    Raises:
        ValueError: an array has another type or shape. The message names the array, the expected layout and the
            actual one.
    """
    arrays = {name: np.asarray(values[name]) for name in layout}
    for name, (_, expected) in layout.items():
        array, dtype = arrays[name], np.dtype(expected)
        # NumPy gives an empty list the type float64, so the type of an empty array is not checked
        if array.size and array.dtype.kind not in {"f": "fiu", "i": "iu"}.get(dtype.kind, dtype.kind):
            raise ValueError(f"{name} must be of type {dtype.name}, not {array.dtype}")
        if dtype.kind == "i" and array.dtype.kind == "u" and array.size and array.max() > np.iinfo(dtype).max:
            raise ValueError(f"{name} must be of type {dtype.name}, but holds {array.max()}")
    check_shapes({name: array.shape for name, array in arrays.items()}, {name: layout[name][0] for name in layout})
    for name, (_, dtype) in layout.items():
        dtype = arrays[name].dtype if np.dtype(dtype).kind == "U" else dtype
        with np.errstate(over="ignore"):  # a number too large for the type becomes infinite
            fixed = not arrays[name].flags.writeable and arrays[name].base is None
            arrays[name] = arrays[name].astype(dtype, copy=not fixed)
        arrays[name].flags.writeable = False
    return arrays


def check_shapes(shapes: Mapping[str, tuple[int, ...]], layout: Mapping[str, str]) -> None:
    """Raise ValueError if shapes do not fit a layout; the message names the array and both shapes.

    Args:
        shapes: name → shape.
        layout: name → sizes, as the shapes of `validate_arrays`.
    """
    sizes: dict[str, tuple[int, str]] = {}
    for name, sizes_text in layout.items():
        words, shape = sizes_text.split(), shapes[name]
        if len(shape) != len(words):
            raise ValueError(f"{name} must have shape ({', '.join(words)}), not {shape}")
        for axis, (word, size) in enumerate(zip(words, shape, strict=True)):
            expected, origin = (int(word), "") if word.isdigit() else sizes.setdefault(word, (size, name))
            if size != expected:
                why = f": {word} is {expected} in {origin}" if origin else ""
                raise ValueError(
                    f"{name} must have shape ({', '.join(words)}), not {shape}: axis {axis} should be {expected}{why}"
                )


def observations_bytes(num_tracks: int, num_frames: int, num_keypoints: int, name_characters: int = 0) -> int:
    """Return the largest memory that `Observations` and the copies of its construction take, in bytes.

    Args:
        num_tracks: N.
        num_frames: T.
        num_keypoints: K.
        name_characters: length of the longest file name of a frame.
    """
    return num_tracks * num_frames * (60 + 44 * num_keypoints) + num_frames * (80 + 12 * name_characters)


def check_memory(source: object, what: str, needed_bytes: float, remedy: str, allowed_gb: float = MAX_TABLE_GB) -> None:
    """Raise InputError if tables need more memory than is allowed.

    Args:
        source: the file, for the message.
        what: subject of the message, in the plural.
        needed_bytes: the estimate.
        remedy: the remedy of the message.
        allowed_gb: the largest memory in GB.
    """
    if needed_bytes > allowed_gb * 1e9:
        raise InputError(source, f"{what} need {needed_bytes / 1e9:,.1f} GB, more than {allowed_gb:g} GB", remedy)


def load_npy(path: str | Path, shape: str | None = None, mapped: bool = False) -> np.ndarray:
    """Read the array of an ``.npy`` without running pickled code.

    Args:
        path: the file.
        shape: text of sizes, as in `load_npz`; None allows any shape.
        mapped: return a read-only memory map.

    Raises:
        InputError: the file cannot be read, is not an ``.npy`` or is truncated; or the array holds values other than
            real numbers, booleans and text, or has another shape.
    """
    with reading(path, "an .npy file of plain arrays", _COPY) as path:
        if mapped:
            array: np.ndarray = np.lib.format.open_memmap(path, mode="r")
        else:
            with path.open("rb") as file:
                array = np.lib.format.read_array(file, allow_pickle=False)
        return _plain_arrays(path, {"the array": array}, {} if shape is None else {"the array": shape})["the array"]


def load_npz(
    path: str | Path,
    required: Mapping[str, str],
    version: int | None = None,
    oldest: int = 1,
    optional: Mapping[str, str] | None = None,
) -> dict[str, np.ndarray]:
    """Read the named arrays of an ``.npz`` without running pickled code; other arrays are not read.

    Args:
        path: the file.
        required: name → shape of each required array, as a text of sizes such as ``"N T 3"``
            (see `validate_arrays`).
        version: the newest ``format_version`` that the caller supports; the file must then contain its version as an
            integer from 1. The version is checked first, because another version may have other arrays. None: no check.
        oldest: the oldest ``format_version`` that the caller supports.
        optional: name → shape of arrays that the file may lack.

    Returns:
        Name → array of real numbers, booleans or text.

    Raises:
        InputError: the file cannot be read, is not an ``.npz``, is damaged or has an unsupported version; or a required
            array is missing; or an array holds other values, or has another shape.
    """
    with _archive(path) as archive:
        path = Path(path)
        if version is not None:
            _check_version(path, archive, version, oldest)
        for name in required:
            if name not in archive.files:
                raise InputError(path, f"lacks the array {name}", "write the file again with this version")
        layout = dict(required) | {name: shape for name, shape in (optional or {}).items() if name in archive.files}
        return _plain_arrays(path, {name: archive[name] for name in layout}, layout)


def npz_names(path: str | Path) -> set[str]:
    """Return the names of the arrays of an ``.npz`` without reading the arrays.

    Raises:
        InputError: the file cannot be read, is not an ``.npz`` or is truncated.
    """
    with _archive(path) as archive:
        return set(archive.files)


@contextmanager
def _archive(path: str | Path) -> Iterator[np.lib.npyio.NpzFile]:
    """Open an ``.npz`` and convert every error of its reading in the body."""
    with reading(path, "an .npz file of plain arrays", _COPY) as path:
        with path.open("rb") as file:
            is_zip = file.read(2) == b"PK" and zipfile.is_zipfile(file)
        if not is_zip:  # np.load would advise to load a pickle
            raise InputError(path, "is not an .npz file of plain arrays", _COPY)
        with np.load(path, allow_pickle=False) as archive:
            yield archive


def _plain_arrays(path: Path, arrays: Mapping[str, np.ndarray], layout: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return arrays in the byte order of this machine, after a check of their types and shapes."""
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biufU":  # a member that is no array is bytes
            kind = getattr(array, "dtype", "no array")
            raise InputError(path, f"{name} holds {kind}, expected real numbers, booleans or text", AGAIN)
        if array.dtype.kind == "U":
            array.tolist()  # a ValueError where the codes are no characters
    try:
        check_shapes({name: arrays[name].shape for name in layout}, layout)
    except ValueError as error:
        raise InputError(path, str(error), AGAIN) from None
    return {name: array.astype(array.dtype.newbyteorder("="), copy=False) for name, array in arrays.items()}


def _check_version(path: Path, archive: np.lib.npyio.NpzFile, newest: int, oldest: int) -> None:
    if "format_version" not in archive.files:
        raise InputError(path, "lacks the array format_version", "write the file again with this version")
    version = archive["format_version"]
    if version.shape != () or version.dtype.kind not in "iu" or version < 1:
        shown = f"of shape {version.shape}" if version.shape else version
        raise InputError(path, f"format_version is {shown}, expected an integer from 1", AGAIN)
    if version > newest:
        problem = f"format_version is {version}, newer than this jaxfit reads ({newest})"
        raise InputError(path, problem, "it needs a newer jaxfit")
    if version < oldest:
        problem = f"format_version is {version}, older than this jaxfit reads ({oldest})"
        raise InputError(path, problem, "write the file again with this jaxfit")
