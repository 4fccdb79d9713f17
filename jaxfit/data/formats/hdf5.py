"""Opening of HDF5 files: h5py reads them, after a check that they hold all of their data themselves."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.reading import reading

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""First bytes of an HDF5 file."""
_MAX_BYTES = 4e9
"""Largest array of a file that is read."""
_MAX_COMPRESSION = 2000
"""Largest ratio of an array and its file; gzip compresses zeros to a thousandth."""


@contextmanager
def open_hdf5(path: Path, kind: str) -> Iterator[Any]:
    """Open an HDF5 file for reading, as a context manager.

    Args:
        path: the file.
        kind: the expected kind of file with its article, for messages.

    Raises:
        InputError: the extra `formats` is missing; the file cannot be read, refers to data outside the file, or holds
            an array that is too large; or the body raises any exception.
    """
    require_extra("formats", str(path), "h5py")
    import h5py

    with reading(path, kind):
        _check_heaps(path)
    with reading(path, kind), h5py.File(path, "r", locking=False) as file:
        links: list[tuple[str, Any]] = []
        file.visititems_links(lambda name, link: links.append((name, link)))
        for name, link in links:
            _check_entry(path, file, name, link)
        yield file


def _check_heaps(path: Path) -> None:
    """Raise InputError if a heap of texts is damaged: the HDF5 library (2.0) never returns from an object without size.

    Source: HDF5 file format specification, section III.E, global heap.
    """
    content = path.read_bytes()
    at = content.find(b"GCOL")
    while at >= 0:
        size = int.from_bytes(content[at + 8 : at + 16], "little")
        end, place = at + size, at + 16
        while place + 16 <= end <= len(content):
            free = content[place : place + 2] == b"\0\0"  # the free space, whose length includes its header
            length = int.from_bytes(content[place + 8 : place + 16], "little")
            place += length if free else 16 + -(-length // 8) * 8
            if free and length < 16:
                break
        if size < 16 or end > len(content) or place + 16 <= end or place > end:
            raise InputError(path, f"is damaged: its heap of texts at byte {at:,} is not valid", "copy it again")
        at = content.find(b"GCOL", at + 1)


def _check_entry(path: Path, file: Any, name: str, link: Any) -> None:
    """Raise InputError if an entry is stored in another file, or is larger than memory should hold."""
    import h5py

    external = isinstance(link, h5py.ExternalLink)
    entry = None if external or isinstance(link, h5py.SoftLink) else file[name]
    array = entry if isinstance(entry, h5py.Dataset) else None
    if external or (array is not None and (array.is_virtual or array.external)):
        raise InputError(path, f"{name} is stored outside the file", "write a file that holds its own data")
    needed = 0 if array is None or array.shape is None else math.prod(array.shape) * array.dtype.itemsize
    if needed > min(_MAX_BYTES, path.stat().st_size * _MAX_COMPRESSION):
        raise InputError(
            path, f"{name} needs {needed:,} bytes, too many for its file", "split the file, or copy it again"
        )


def hdf5_text(value: Any) -> str:
    """Return a value of h5py as text."""
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)
