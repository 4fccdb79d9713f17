"""Read arrays from ``.npz`` and ``.npy`` files, with clear errors for damaged files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile

from jaxfit.errors import InputError

__all__ = ["load_npy", "load_npz", "npz_names"]


def load_npz(
    path: str | Path, required: Mapping[str, int], version: int | None = None, oldest: int = 1
) -> dict[str, np.ndarray]:
    """Read all arrays of an ``.npz`` without running pickled code.

    Args:
        path: the file.
        required: name → number of dimensions of each required array.
        version: the newest ``format_version`` that the caller supports; the file must then contain its version as an
            integer from 1. The version is checked first, because another version may have other arrays. None: no check.
        oldest: the oldest ``format_version`` that the caller supports.

    Returns:
        Name → array, including arrays that are not required.

    Raises:
        InputError: the file does not exist, is not an ``.npz``, is truncated, contains Python objects or has an
            unsupported version; or a required array is missing or has another number of dimensions.
    """
    path = Path(path)
    with _open(path, ".npz") as loaded:
        content = None if isinstance(loaded, np.ndarray) else {name: loaded[name] for name in loaded.files}
    if content is None:
        raise _bare_array(path)
    if version is not None:
        _check_version(path, content.get("format_version"), version, oldest)
    for name, ndim in required.items():
        if not isinstance(content.get(name), np.ndarray):
            raise InputError(path, f"lacks the array {name}", "write the file again with this version")
        if content[name].ndim != ndim:
            problem = f"{name} has shape {content[name].shape}, expected {ndim} dimensions"
            raise InputError(path, problem, "write the file again")
    return {name: array for name, array in content.items() if isinstance(array, np.ndarray)}


def npz_names(path: str | Path) -> set[str]:
    """Return the names of the arrays of an ``.npz`` without reading the arrays.

    Raises:
        InputError: the file does not exist, is not an ``.npz`` or is truncated.
    """
    path = Path(path)
    with _open(path, ".npz") as loaded:
        names = None if isinstance(loaded, np.ndarray) else set(loaded.files)
    if names is None:
        raise _bare_array(path)
    return names


def load_npy(path: str | Path) -> np.ndarray:
    """Read the array of an ``.npy`` without running pickled code.

    Raises:
        InputError: the file does not exist, is not an ``.npy``, is truncated, or contains Python objects.
    """
    path = Path(path)
    with _open(path, ".npy") as loaded:
        array = loaded if isinstance(loaded, np.ndarray) else None
    if array is None:
        raise InputError(path, "is an .npz, not one bare array", "check the path")
    return array


@contextmanager
def _open(path: Path, kind: str) -> Iterator[np.ndarray | NpzFile]:
    """Open an ``.npz`` or ``.npy``; convert all errors of opening, and of reading in the body, to InputError."""
    if not path.exists():
        raise InputError(path, "does not exist", "check the path")
    if path.is_dir():
        raise InputError(path, f"is a folder, not an {kind} file", "check the path")
    try:
        loaded: Any = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            yield loaded
        else:
            with loaded:
                yield loaded
    except PermissionError as error:
        raise InputError(path, "cannot be read: permission denied", "change its permissions") from error
    except Exception as error:  # zip, zlib, header and memory errors all mean that the file is damaged
        if "allow_pickle" in str(error):
            problem = f"is not an {kind} of plain arrays; jaxfit loads no pickles and no Python objects"
            raise InputError(path, problem, "check the path, or save plain arrays with numpy") from error
        problem = f"is not a readable {kind}: {str(error) or type(error).__name__}"
        raise InputError(path, problem, "the file may be truncated: copy or write it again") from error


def _bare_array(path: Path) -> InputError:
    return InputError(path, "holds one bare array, not an .npz", "check the path")


def _check_version(path: Path, version: Any, newest: int, oldest: int) -> None:
    if not isinstance(version, np.ndarray):
        raise InputError(path, "lacks the array format_version", "write the file again with this version")
    if version.ndim or version.dtype.kind not in "iu" or version < 1:
        shown = f"{version!s:.40}"
        raise InputError(path, f"format_version is {shown}, expected an integer from 1", "write the file again")
    if version > newest:
        problem = f"format_version is {version}, newer than this jaxfit reads ({newest})"
        raise InputError(path, problem, "it needs a newer jaxfit")
    if version < oldest:
        problem = f"format_version is {version}, older than this jaxfit reads ({oldest})"
        raise InputError(path, problem, "write the file again with this jaxfit")
