"""Read arrays from ``.npz`` files: sizes are checked before the numbers are read, and no pickle runs."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from jaxfit.errors import InputError
from jaxfit.limits import NPY_HEADER_BYTES, NPZ_ARRAYS, NPZ_BYTES, NPZ_DIRECTORY_BYTES
from jaxfit.storage.arrays import check_shapes
from jaxfit.storage.npy import AGAIN, DAMAGED, Header, array_header, check_size, damage, not_arrays, plain_array, reason
from jaxfit.storage.reading import open_file

__all__ = ["load_npz", "npz_names"]


def load_npz(
    path: str | Path,
    required: Mapping[str, str],
    version: int | None = None,
    oldest: int = 1,
    optional: Mapping[str, str] | None = None,
    most_bytes: int = NPZ_BYTES,
) -> dict[str, np.ndarray]:
    """Read the named arrays of an ``.npz`` without running pickled code; other arrays are not read.

    The types, shapes and sizes that the file declares are checked before numbers are read.

    Args:
        path: the file.
        required: name → shape of each required array, as a text of sizes such as ``"N T 3"``
            (see `jaxfit.storage.arrays.validate_arrays`).
        version: the newest ``format_version`` that the caller supports; the file must then contain its version as an
            integer from 1. The version is checked first, because another version may have other arrays. None: no check.
        oldest: the oldest ``format_version`` that the caller supports.
        optional: name → shape of arrays that the file may lack.
        most_bytes: largest size of all named arrays together.

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
        check_size(path, sum(header.nbytes for header in headers.values()), most_bytes)
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
