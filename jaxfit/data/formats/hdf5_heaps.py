"""Check of the heaps of an HDF5 file, which hold texts of variable length.

The HDF5 library (2.0) never returns if an object of a damaged heap has no size. So every heap is checked before the
library reads a text.

Source: HDF5 file format specification, section III.E, global heap.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

from jaxfit.errors import InputError

__all__ = ["check_heaps"]

_SIGNATURE = b"GCOL\x01\x00\x00\x00"
_OBJECT = struct.Struct("<HHIQ")  # index, references, reserved, size


def check_heaps(path: Path) -> None:
    """Raise InputError if a heap of an HDF5 file is damaged.

    Args:
        path: a file that is not empty.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        at = content.find(_SIGNATURE)
        while at >= 0:
            if not _is_valid(content, at):
                remedy = "copy or write the file again"
                raise InputError(path, f"is damaged: its heap of texts at byte {at:,} is not valid", remedy)
            at = content.find(_SIGNATURE, at + 1)


def _is_valid(content: mmap.mmap, at: int) -> bool:
    header = content[at + 8 : at + 16]
    size = int.from_bytes(header, "little")
    if len(header) < 8 or size < 16 or at + size > len(content):
        return False
    place = 16
    while place + _OBJECT.size <= size:
        index, _, _, length = _OBJECT.unpack_from(content, at + place)
        # index 0 is the free space, whose size includes its header
        needed = length if index == 0 else _OBJECT.size + (length + 7) // 8 * 8
        if needed < _OBJECT.size or place + needed > size:
            return False
        place += needed
    return True
