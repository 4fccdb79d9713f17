"""Arrays read back from an ``.npz`` or ``.npy``, whatever may have happened to it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.errors import InputError

__all__ = ["load_npy", "load_npz"]


def load_npz(path: str | Path, required: Mapping[str, int], version: int | None = None) -> dict[str, np.ndarray]:
    """Read every array of an ``.npz``, running no pickled code.

    Args:
        path: the file.
        required: name → number of dimensions of each array that must be there.
        version: the newest ``format_version`` that the caller understands, which the file must then hold: a
            whole number from 1. It is looked at first: a newer file may well have other arrays. None: any file.

    Returns:
        Name → array, also of arrays that were not asked for.

    Raises:
        InputError: no such file, not an ``.npz``, truncated, Python objects inside, of a newer version, an array
            missing or of another number of dimensions.
    """
    path = Path(path)
    found = _load(path, ".npz")
    if isinstance(found, np.ndarray):
        raise InputError(path, "holds one bare array, not an .npz", "check the path")
    if version is not None:
        _check_version(path, found.get("format_version"), version)
    for name, ndim in required.items():
        if not isinstance(found.get(name), np.ndarray):
            raise InputError(path, f"lacks the array {name}", "write the file again with this version")
        if found[name].ndim != ndim:
            problem = f"{name} has shape {found[name].shape}, expected {ndim} dimensions"
            raise InputError(path, problem, "write the file again")
    return {name: array for name, array in found.items() if isinstance(array, np.ndarray)}


def load_npy(path: str | Path) -> np.ndarray:
    """Read the array of an ``.npy``, running no pickled code.

    Raises:
        InputError: no such file, not an ``.npy``, truncated, or Python objects inside.
    """
    path = Path(path)
    found = _load(path, ".npy")
    if not isinstance(found, np.ndarray):
        raise InputError(path, "is an .npz, not one bare array", "check the path")
    return found


def _load(path: Path, kind: str) -> np.ndarray | dict[str, Any]:
    if not path.exists():
        raise InputError(path, "does not exist", "check the path")
    if path.is_dir():
        raise InputError(path, f"is a folder, not an {kind} file", "check the path")
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded
        with loaded:
            return {name: loaded[name] for name in loaded.files}
    except PermissionError as error:
        raise InputError(path, "cannot be read: permission denied", "change its permissions") from error
    except Exception as error:  # zip, zlib, header and memory errors alike mean: these bytes are no arrays of ours
        if "allow_pickle" in str(error):
            problem = "is a pickle or holds Python objects, which jaxfit does not load"
            raise InputError(path, problem, "save plain arrays with numpy.save or numpy.savez") from error
        problem = f"is not a readable {kind}: {str(error) or type(error).__name__}"
        raise InputError(path, problem, "it may be truncated: copy or write it again") from error


def _check_version(path: Path, found: Any, newest: int) -> None:
    if not isinstance(found, np.ndarray):
        raise InputError(path, "lacks the array format_version", "write the file again with this version")
    if found.ndim or found.dtype.kind not in "iu" or found < 1:
        shown = f"{found!s:.40}"
        raise InputError(path, f"format_version is {shown}, expected a whole number from 1", "write the file again")
    if found > newest:
        problem = f"format_version is {found}, newer than this jaxfit reads ({newest})"
        raise InputError(path, problem, "it needs a newer jaxfit")
