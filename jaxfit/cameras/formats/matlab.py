"""Safe reading of some variables of a `.mat` file of MATLAB 5 to 7.

scipy.io.loadmat crashes the process on damaged files, so it is not used. Other variables than the wanted ones are
skipped, and the size of the wanted ones is checked before they are decompressed.

Source: MATLAB, "MAT-File Format", level 5.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Literal, NoReturn

import numpy as np

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import CAMERA_BYTES, CAMERA_LEVELS, MAT_VARIABLES
from jaxfit.foundation.reading import open_file

MAT_SIGNATURES = (b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file", b"\x89HDF\r\n\x1a\n")
"""First bytes of a `.mat` file."""

_HEADER_BYTES, _MATRIX, _COMPRESSED = 128, 14, 15
_CELL, _STRUCT, _TEXT, _NUMERIC, _COMPLEX = 1, 2, 4, range(6, 16), 0x800
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16"}
"""Type of the stored values → encoding."""
_OLDER = "save the file again in MATLAB with save(..., '-v7')"


def read_variables(path: Path, wanted: Collection[str]) -> dict[str, Any]:
    """Return the variables of a `.mat` file that have one of the wanted names.

    Numbers are arrays, texts are str, cells are lists, and structs are lists of dicts, each in the order of the file.
    Values of other kinds are None.

    Raises:
        InputError: the file is damaged, the variables are larger than `CAMERA_BYTES`, or the file has version 7.3.
    """
    with open_file(path, "a .mat file") as file:
        header = file.read(_HEADER_BYTES)
        if header.startswith(MAT_SIGNATURES[1:]):
            raise InputError(path, "is a .mat file of version 7.3, which jaxfit does not read", _OLDER)
        if len(header) < _HEADER_BYTES or header[126:128] not in (b"IM", b"MI"):
            raise InputError(path, "is not a .mat file of MATLAB 5 to 7", _OLDER)
        reader = _Reader(path, "<" if header[126:128] == b"IM" else ">")
        return dict(reader.variables(file, wanted))


class _Reader:
    def __init__(self, path: Path, order: Literal["<", ">"]):
        self._path = path
        self._order: Literal["<", ">"] = order

    def variables(self, file: BinaryIO, wanted: Collection[str]) -> Iterator[tuple[str, Any]]:
        position, total = _HEADER_BYTES, 0
        for number in range(MAT_VARIABLES + 1):
            file.seek(position)
            tag = file.read(8)
            if not tag:
                return
            if number == MAT_VARIABLES:
                raise InputError(self._path, f"holds more than {MAT_VARIABLES:,} variables", "save only the cameras")
            if len(tag) < 8:
                self._damaged("it ends midway")
            kind, size = struct.unpack(f"{self._order}II", tag)
            start = file.read(min(size, 4096))
            start = self._expanded(start, 512) if kind == _COMPRESSED else tag + start
            if (name := self._name(start)) in wanted:
                file.seek(position + 8)
                content = file.read(min(size, CAMERA_BYTES + 1))
                element = self._expanded(content, CAMERA_BYTES + 1) if kind == _COMPRESSED else tag + content
                total += len(element)
                if total > CAMERA_BYTES:
                    raise InputError(
                        self._path, f"{name} has more than {CAMERA_BYTES:,} bytes", "save only the cameras"
                    )
                ((_, matrix),) = list(self._parts(element))[:1]
                yield name, self._value(matrix, 0)
            position += 8 + size

    def _expanded(self, content: bytes, max_bytes: int) -> bytes:
        try:
            return zlib.decompressobj().decompress(content, max_bytes)
        except zlib.error as error:
            self._damaged(str(error))

    def _name(self, element: bytes) -> str:
        """Return the name of a variable from the start of its element; empty if the element is no matrix."""
        kind = struct.unpack_from(f"{self._order}I", element)[0] if len(element) >= 8 else 0
        parts = [part for part, _ in zip(self._parts(element[8:], cut=True), range(3), strict=False)]
        return parts[2][1].decode("latin-1") if kind == _MATRIX and len(parts) == 3 else ""

    def _parts(self, content: bytes, cut: bool = False) -> Iterator[tuple[int, bytes]]:
        """Yield type and bytes of the elements that follow each other.

        Args:
            content: the elements.
            cut: whether the content may end inside an element.
        """
        position = 0
        while position + 8 <= len(content):
            kind, size = struct.unpack_from(f"{self._order}II", content, position)
            if kind >> 16:  # a small element: size and type share four bytes, the values are in the next four
                kind, size = kind & 0xFFFF, kind >> 16
                yield kind, content[position + 4 : position + 4 + min(size, 4)]
                position += 8
                continue
            if position + 8 + size > len(content) and not cut:
                self._damaged("an element is longer than its matrix")
            yield kind, content[position + 8 : position + 8 + size]
            position += 8 + (size + 7) // 8 * 8

    def _value(self, matrix: bytes, level: int) -> Any:
        if level > CAMERA_LEVELS:
            self._damaged(f"it is nested more than {CAMERA_LEVELS} levels deep")
        if not matrix:
            return np.zeros(0)
        parts = list(self._parts(matrix))
        if len(parts) < 3 or len(parts[0][1]) < 4:
            self._damaged("a matrix has no flags, dimensions and name")
        flags = struct.unpack_from(f"{self._order}I", parts[0][1])[0]
        shape = [int(side) for side in self._numbers(parts[1])]
        count, kind = math.prod(shape), flags & 0xFF
        if min(shape, default=-1) < 0:
            self._damaged("a matrix has wrong dimensions")
        if kind == _CELL:
            return self._values(parts[3:], count, level)
        if kind == _STRUCT:
            return self._structs(parts[3:], count, level)
        if kind == _TEXT:
            return self._text(parts[3]) if len(parts) > 3 else ""
        if kind not in _NUMERIC or flags & _COMPLEX or len(parts) < 4:
            return None
        values = self._numbers(parts[3])
        if len(values) != count:
            self._damaged(f"a matrix has {len(values)} values for {count} places")
        return values.reshape(shape, order="F")

    def _numbers(self, part: tuple[int, bytes]) -> np.ndarray:
        kind, content = part
        if kind not in _NUMBERS:
            self._damaged(f"numbers have the type {kind}")
        stored = np.dtype(_NUMBERS[kind]).newbyteorder(self._order)
        return np.frombuffer(content[: len(content) // stored.itemsize * stored.itemsize], stored)

    def _text(self, part: tuple[int, bytes]) -> str | None:
        kind, content = part
        if kind not in _TEXTS:
            return None
        encoding = _TEXTS[kind]
        if encoding == "utf-16":
            encoding += "-le" if self._order == "<" else "-be"
        return content.decode(encoding, "replace")

    def _values(self, parts: list[tuple[int, bytes]], count: int, level: int) -> list[Any]:
        if len(parts) != count or any(kind != _MATRIX for kind, _ in parts):
            self._damaged(f"a cell has {len(parts)} values for {count} places")
        return [self._value(content, level + 1) for _, content in parts]

    def _structs(self, parts: list[tuple[int, bytes]], count: int, level: int) -> list[dict[str, Any]]:
        if len(parts) < 2 or not (lengths := self._numbers(parts[0])).size or lengths[0] < 1:
            self._damaged("a struct has no names of fields")
        length, packed = int(lengths[0]), parts[1][1]
        starts = range(0, len(packed), length)
        names = [packed[start : start + length].partition(b"\0")[0].decode("latin-1") for start in starts]
        values = self._values(parts[2:], count * len(names), level)
        return [
            dict(zip(names, values[i * len(names) : (i + 1) * len(names)], strict=True))
            for i in range(count if names else 0)
        ]

    def _damaged(self, reason: str) -> NoReturn:
        raise InputError(self._path, f"is damaged: {reason}", "copy or write the file again")
