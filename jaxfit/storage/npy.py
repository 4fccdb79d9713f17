"""Read arrays from ``.npy`` files: sizes are checked before the numbers are read, and no pickle runs."""

from __future__ import annotations

import io
import math
import os
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxfit.errors import InputError
from jaxfit.limits import NPY_DIMENSIONS, NPY_HEADER_BYTES, NPZ_BYTES, NPZ_TEXT_CHARACTERS
from jaxfit.storage.arrays import check_shapes
from jaxfit.storage.reading import open_file

__all__ = [
    "AGAIN",
    "DAMAGED",
    "Header",
    "array_header",
    "check_size",
    "damage",
    "load_npy",
    "not_arrays",
    "plain_array",
    "reason",
]

AGAIN = "write the file again"
DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, RuntimeError),
    *(ValueError, TypeError, LookupError, OverflowError, SyntaxError, tokenize.TokenError),
)
"""Exceptions that zipfile, zlib and the parser of array headers raise for damaged content."""


def load_npy(
    path: str | Path, shape: str | None = None, mapped: bool = False, most_bytes: int = NPZ_BYTES
) -> np.ndarray:
    """Read the array of an ``.npy`` without running pickled code.

    Args:
        path: the file.
        shape: text of sizes, as in `jaxfit.storage.npz.load_npz`; None allows any shape.
        mapped: return a read-only memory map, which may be larger than `most_bytes`.
        most_bytes: largest size of the array.

    Raises:
        InputError: the file cannot be read, is not an ``.npy``, is truncated or too large; or the array holds values
            other than real numbers, booleans and text, or has another shape.
    """
    path = Path(path)
    with open_file(path, "an .npy file") as file:
        start = file.read(6)
        if start.startswith(b"PK"):
            raise InputError(path, "is an .npz, not one bare array", "check the path")
        if start != np.lib.format.MAGIC_PREFIX:
            raise not_arrays(path, ".npy", start)
        file.seek(0)
        header = array_header(path, "the array", file.read(NPY_HEADER_BYTES))
        if header.offset + header.nbytes != os.fstat(file.fileno()).st_size:
            problem = f"is not a readable .npy: an array of shape {header.shape} has another size"
            raise InputError(path, problem, "the file may be truncated: copy or write it again")
        try:
            check_shapes({"the array": header.shape}, {} if shape is None else {"the array": shape})
        except ValueError as error:
            raise InputError(path, str(error), "check the path") from None
        if mapped and header.nbytes:
            return np.memmap(path, header.dtype, "r", header.offset, header.shape, "F" if header.fortran else "C")
        check_size(path, header.nbytes, most_bytes)
        file.seek(0)
        with damage(path, "the array"):
            return plain_array(path, "the array", np.lib.format.read_array(file, max_header_size=NPY_HEADER_BYTES))


class Header(NamedTuple):
    """What a file says about an array before its numbers."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype
    offset: int
    """Position of the first number in the file."""

    @property
    def nbytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


def array_header(path: Path, name: str, start: bytes) -> Header:
    """Return the header of an array from its first bytes, if the array has plain values."""
    stream, formats = io.BytesIO(start), np.lib.format
    with damage(path, name):
        if not start.startswith(formats.MAGIC_PREFIX):
            raise ValueError("is not an array")
        version = formats.read_magic(stream)
        if version not in ((1, 0), (2, 0)):  # later versions hold structures with named parts only
            raise ValueError(f"has a header of version {version[0]}.{version[1]}, which plain arrays do not need")
        parse = formats.read_array_header_1_0 if version == (1, 0) else formats.read_array_header_2_0
        try:
            shape, fortran, dtype = parse(stream, max_header_size=NPY_HEADER_BYTES)
        except (*DAMAGED, MemoryError) as error:  # MemoryError: the parser's word for brackets that are too deep
            raise ValueError("its header cannot be read") from error
        if dtype.hasobject:
            problem = f"{name} holds Python objects; jaxfit loads no pickles and no Python objects"
            raise InputError(path, problem, "save plain arrays with numpy")
        if dtype.fields or dtype.subdtype or dtype.kind not in "biufU":
            problem = f"{name} holds {dtype.name}, expected real numbers, booleans or text"
            raise InputError(path, problem, AGAIN)
        if not all(type(size) is int and 0 <= size < 2**62 for size in shape) or len(shape) > NPY_DIMENSIONS:
            raise ValueError("has a shape that no array has")
        if dtype.itemsize == 0 or (dtype.kind == "U" and dtype.itemsize > 4 * NPZ_TEXT_CHARACTERS):
            raise ValueError(f"holds texts of {dtype.itemsize // 4} characters; the limit is {NPZ_TEXT_CHARACTERS}")
    return Header(shape, fortran, dtype, stream.tell())


def plain_array(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    """Return an array in the byte order of this machine, if its values are valid for their type."""
    if array.dtype.kind == "b" and array.size and array.view(np.uint8).max() > 1:
        raise InputError(path, f"{name} holds booleans other than 0 and 1", AGAIN)
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    if array.dtype.kind == "U" and array.size:
        codes = np.ascontiguousarray(array).reshape(-1).view(np.uint32)
        if codes.max() > 0x10FFFF or not all(text.isprintable() for text in np.unique(array).tolist()):
            raise InputError(path, f"{name} holds text that cannot be printed", AGAIN)
    return array


@contextmanager
def damage(path: Path, name: str) -> Iterator[None]:
    """Convert the errors of a damaged array in the body to an InputError that names the array."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python 2's headers, and escapes in damaged headers
            yield
    except InputError:
        raise
    except DAMAGED as error:
        raise InputError(path, f"{name} is damaged: {reason(error)}", AGAIN) from error


def reason(error: BaseException) -> str:
    """Return the text of an error; its type if it has none."""
    return str(error) or type(error).__name__


def not_arrays(path: Path, kind: str, start: bytes) -> InputError:
    """Return the error for a file that is no file of arrays; `start` holds its first bytes."""
    if not start:
        return InputError(path, f"is not a readable {kind}: the file is empty", "copy or write it again")
    problem = f"is not an {kind} of plain arrays; jaxfit loads no pickles and no Python objects"
    return InputError(path, problem, "check the path, or save plain arrays with numpy")


def check_size(path: Path, size: int, most: int) -> None:
    """Raise InputError if arrays of `size` bytes exceed the limit."""
    if size > most:
        problem = f"its arrays take {size / 1e6:,.0f} MB in memory; the limit is {most / 1e6:,.0f} MB"
        raise InputError(path, problem, "check the path")
