"""Safe reading of `.npz` and `.npy` files, checks of arrays that belong together, memory of tables."""

from __future__ import annotations

import io
import math
import os
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import (
    NPY_DIMENSIONS,
    NPY_HEADER_BYTES,
    NPZ_ARRAYS,
    NPZ_BYTES,
    NPZ_DIRECTORY_BYTES,
    NPZ_TEXT_CHARACTERS,
    TABLE_GB,
)
from jaxfit.foundation.reading import open_file


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


def check_memory(source: object, what: str, needed_bytes: float, remedy: str, allowed_gb: float = TABLE_GB) -> None:
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


AGAIN = "write the file again"
DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, RuntimeError),
    *(ValueError, TypeError, LookupError, OverflowError, SyntaxError, tokenize.TokenError),
)
"""Exceptions that zipfile, zlib and the parser of array headers raise for damaged content."""


def load_npy(
    path: str | Path, shape: str | None = None, mapped: bool = False, max_bytes: int = NPZ_BYTES
) -> np.ndarray:
    """Read the array of an ``.npy`` without running pickled code.

    Args:
        path: the file.
        shape: text of sizes, as in `jaxfit.foundation.array_files.load_npz`; None allows any shape.
        mapped: return a read-only memory map, which may be larger than `max_bytes`.
        max_bytes: largest size of the array.

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
        check_size(path, header.nbytes, max_bytes)
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


def load_npz(
    path: str | Path,
    required: Mapping[str, str],
    version: int | None = None,
    oldest: int = 1,
    optional: Mapping[str, str] | None = None,
    max_bytes: int = NPZ_BYTES,
) -> dict[str, np.ndarray]:
    """Read the named arrays of an ``.npz`` without running pickled code; other arrays are not read.

    The types, shapes and sizes that the file declares are checked before numbers are read.

    Args:
        path: the file.
        required: name → shape of each required array, as a text of sizes such as ``"N T 3"``
            (see `jaxfit.foundation.array_files.validate_arrays`).
        version: the newest ``format_version`` that the caller supports; the file must then contain its version as an
            integer from 1. The version is checked first, because another version may have other arrays. None: no check.
        oldest: the oldest ``format_version`` that the caller supports.
        optional: name → shape of arrays that the file may lack.
        max_bytes: largest size of all named arrays together.

    Returns:
        Name → array of real numbers, booleans or text.

    Raises:
        InputError: the file cannot be read, is not an ``.npz``, is damaged, is too large or has an unsupported version;
            or a required array is missing; or an array holds other values, or has another shape.
    """
    path = Path(path)
    with _members(path) as members:
        if version is not None:
            _check_version(path, members, version, oldest)
        for name in required:
            if name not in members:
                raise InputError(path, f"lacks the array {name}", "write the file again with this version")
        layout = dict(required) | {name: shape for name, shape in (optional or {}).items() if name in members}
        headers = {name: members[name].header() for name in layout}
        try:
            check_shapes({name: header.shape for name, header in headers.items()}, layout)
        except ValueError as error:
            raise InputError(path, str(error), AGAIN) from None
        check_size(path, sum(header.nbytes for header in headers.values()), max_bytes)
        return {name: members[name].read(header) for name, header in headers.items()}


def npz_names(path: str | Path) -> set[str]:
    """Return the names of the arrays of an ``.npz`` without reading the arrays.

    Raises:
        InputError: the file cannot be read, is not an ``.npz`` or is truncated.
    """
    with _members(Path(path)) as members:
        return set(members)


@dataclass(frozen=True)
class _Member:
    """One array of an open ``.npz``."""

    path: Path
    name: str
    archive: zipfile.ZipFile
    info: zipfile.ZipInfo

    def header(self) -> Header:
        """Read and check the header of the array."""
        with damage(self.path, self.name):
            if self.info.flag_bits & 0x1:
                raise ValueError("is encrypted")
            if self.info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError("has a compression that numpy does not write")
            if self.info.file_size > 1032 * self.info.compress_size + 1032:  # deflate reaches 1032 : 1
                raise ValueError("declares a size that its content cannot have")
            with self.archive.open(self.info) as file:
                start = file.read(NPY_HEADER_BYTES)
        header = array_header(self.path, self.name, start)
        if header.offset + header.nbytes != self.info.file_size:
            problem = f"{self.name} is damaged: an array of shape {header.shape} has another size"
            raise InputError(self.path, problem, AGAIN)
        return header

    def read(self, header: Header) -> np.ndarray:
        """Read the array."""
        with damage(self.path, self.name), self.archive.open(self.info) as file:
            array = np.lib.format.read_array(file, max_header_size=NPY_HEADER_BYTES)  # type: ignore[arg-type]
            if array.shape != header.shape or array.dtype != header.dtype:
                raise ValueError("changes while it is read")
        return plain_array(self.path, self.name, array)


@contextmanager
def _members(path: Path) -> Iterator[dict[str, _Member]]:
    """Open an ``.npz`` and yield its arrays by name."""
    with open_file(path, "an .npz file") as file:
        start = file.read(6)
        if start == np.lib.format.MAGIC_PREFIX:
            raise InputError(path, "holds one bare array, not an .npz", "check the path")
        if not start.startswith(b"PK"):
            raise not_arrays(path, ".npz", start)
        try:
            archive = zipfile.ZipFile(_SmallReads(file))  # type: ignore[arg-type]
        except DAMAGED as error:
            problem = f"is not a readable .npz: {reason(error)}"
            raise InputError(path, problem, "the file may be truncated: copy or write it again") from error
        with archive:
            infos = archive.infolist()
            if len(infos) > NPZ_ARRAYS:
                raise InputError(path, f"holds {len(infos)} arrays; the limit is {NPZ_ARRAYS}", "check the path")
            members: dict[str, _Member] = {}
            for info in infos:
                name = info.filename.removesuffix(".npy")
                if name in members:
                    raise InputError(path, f"holds the array {name} twice", AGAIN)
                members[name] = _Member(path, name, archive, info)
            yield members


class _SmallReads(io.RawIOBase):
    """A file that rejects reads at once of more than any table of contents needs; zipfile sets no limit."""

    def __init__(self, file: BinaryIO):
        self._file, self._size = file, os.fstat(file.fileno()).st_size

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def read(self, size: int = -1) -> bytes:
        if size < 0:
            size = self._size - self._file.tell()
        if not 0 <= size <= NPZ_DIRECTORY_BYTES:
            raise zipfile.BadZipFile("its table of contents is too long")
        return self._file.read(size)


def _check_version(path: Path, members: Mapping[str, _Member], newest: int, oldest: int) -> None:
    if "format_version" not in members:
        raise InputError(path, "lacks the array format_version", "write the file again with this version")
    member = members["format_version"]
    header = member.header()
    array: Any = member.read(header) if header.shape == () else None
    if array is None or header.dtype.kind not in "iu" or array < 1:
        shown = f"of shape {header.shape}" if array is None else array
        raise InputError(path, f"format_version is {shown}, expected an integer from 1", AGAIN)
    if array > newest:
        problem = f"format_version is {array}, newer than this jaxfit reads ({newest})"
        raise InputError(path, problem, "it needs a newer jaxfit")
    if array < oldest:
        problem = f"format_version is {array}, older than this jaxfit reads ({oldest})"
        raise InputError(path, problem, "write the file again with this jaxfit")
