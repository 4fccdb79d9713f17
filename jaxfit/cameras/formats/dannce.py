"""Cameras of DANNCE and Label3D in `.mat` files, which follow MATLAB's conventions.

MATLAB projects row vectors, p = [X 1] · [r; t] · K, so `K` and `r` are transposed. Its pixel centres are at 1, 2, 3, …:
DANNCE subtracts 1 from Label3D's positions. The files have no image size.

Only the variables of cameras are read from a file. Their size and their levels are checked before scipy reads them.

Source: DANNCE, dannce/engine/io.py, ops.py (`camera_matrix`, `distortPoints`) and serve_data_DANNCE.py; Label3D,
Label3D.m (`loadcamParams`); MATLAB, MAT-File Format, level 5.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np
import scipy.io

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.formats.values import MATLAB_PIXELS, Parsed, camera_name, make_camera, numbers, parsed
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import CAMERA_BYTES, CAMERA_LEVELS, MAT_VARIABLES
from jaxfit.foundation.reading import open_file

MAT_SIGNATURES = (b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file", b"\x89HDF\r\n\x1a\n")
"""First bytes of a `.mat` file."""

_WANTED = ("params", "camParams", "camnames", "K", "RDistort", "TDistort", "r", "R", "t", "m")
_HEADER_BYTES, _MATRIX, _COMPRESSED = 128, 14, 15
_OLDER = "save the file again in MATLAB with save(..., '-v7')"
_REMEDY = "give a *_dannce.mat file, or a folder of hires_cam1_params.mat, hires_cam2_params.mat, …"


def read_dannce(path: Path) -> Parsed:
    """Read the cameras of a file of Label3D or DANNCE: the cell `params`, and the names in `camnames`.

    Without `camnames`, the cameras have the names Camera1, Camera2, …, as in DANNCE. A file of one camera
    (hires_cam1_params.mat) has the number in its name.

    Raises:
        InputError: the file is damaged, too large, of MATLAB's version 7.3, or holds no cameras.
    """
    variables = _variables(path)
    params = variables.get("params", variables.get("camParams"))
    if params is None:
        return parsed(path, [_single(path, variables)], "DANNCE", None, "mm")
    cells = [_unwrapped(each) for each in np.asarray(params, object).ravel(order="F")]
    names = [str(_unwrapped(each)) for each in np.asarray(variables.get("camnames", ()), object).ravel(order="F")]
    if names and len(names) != len(cells):
        raise InputError(
            path, f"holds {len(cells)} cameras and {len(names)} camnames", "write one name for each camera"
        )
    names = names or [f"Camera{number + 1}" for number in range(len(cells))]
    cameras = [
        _camera(path, f"params{{{number}}}", camera_name(path, f"camnames{{{number}}}", name), _fields(path, cell))
        for number, (cell, name) in enumerate(zip(cells, names, strict=True), 1)
    ]
    return parsed(path, cameras, "DANNCE", None, "mm")


def read_dannce_folder(folder: Path, files: Sequence[Path]) -> Parsed:
    """Read a calibration folder of DANNCE, with one camera in each file."""
    cameras = [_single(path, _variables(path)) for path in files]
    return parsed(folder, cameras, "DANNCE", None, "mm")


def _single(path: Path, variables: dict[str, Any]) -> Camera:
    number = re.search(r"cam(?:era)?_?(\d{1,9})", path.stem, re.IGNORECASE)
    return _camera(path, "", f"Camera{int(number[1])}" if number else path.stem, variables)


def _camera(path: Path, field: str, name: str, values: dict[str, Any]) -> Camera:
    where = f"{field}." if field else ""
    rotation = "r" if "r" in values else "R"
    missing = [key for key in ("K", rotation, "t") if key not in values]
    if missing:
        raise InputError(path, f"{field or 'the file'} lacks {', '.join(missing)}", _REMEDY)
    if np.any(values.get("m", 0) == 1):
        raise InputError(path, f"{where}m marks the image of a mirror", "mirrored cameras are not supported")
    K = numbers(path, f"{where}K", values["K"], (3, 3)).T
    if K[2, :2].any():
        problem = f"{where}K must be MATLAB's IntrinsicMatrix, [fx 0 0; s fy 0; cx cy 1]"
        raise InputError(path, problem, "transpose K and r, as DANNCE expects them")
    radial = numbers(path, f"{where}RDistort", values.get("RDistort", np.zeros(0)), (-1,)).tolist()
    tangential = numbers(path, f"{where}TDistort", values.get("TDistort", np.zeros(0)), (-1,)).tolist()
    if len(radial) > 3 or len(tangential) > 2:
        raise InputError(
            path, f"{where}RDistort and TDistort have {len(radial)} and {len(tangential)} numbers", _REMEDY
        )
    k1, k2, k3 = radial + [0.0] * (3 - len(radial))
    p1, p2 = tangential + [0.0] * (2 - len(tangential))
    R = numbers(path, where + rotation, values[rotation], (3, 3)).T
    transl = numbers(path, f"{where}t", values["t"], (3,))
    return make_camera(path, field, name, K, np.array([k1, k2, p1, p2, k3]), (R, transl), None, MATLAB_PIXELS)


def _fields(path: Path, value: Any) -> dict[str, Any]:
    """Return the fields of a struct of MATLAB."""
    if isinstance(value, np.void) and value.dtype.names:
        return {name: value[name] for name in value.dtype.names}
    raise InputError(path, "params does not hold structs", _REMEDY)


def _unwrapped(value: Any) -> Any:
    """Return the value inside arrays of one entry, as which scipy reads structs and texts."""
    while isinstance(value, np.ndarray) and value.size == 1:
        value = value.ravel()[0]
    return value


def _variables(path: Path) -> dict[str, Any]:
    """Return the variables of cameras in a `.mat` file of version 5 to 7."""
    with open_file(path, "a .mat file") as file:
        header = file.read(_HEADER_BYTES)
        if header.startswith(MAT_SIGNATURES[1:]):
            raise InputError(path, "is a .mat file of version 7.3, which jaxfit does not read", _OLDER)
        if len(header) < _HEADER_BYTES or header[126:128] not in (b"IM", b"MI"):
            raise InputError(path, "is not a .mat file of MATLAB 5 to 7", _OLDER)
        order = "<" if header[126:128] == b"IM" else ">"
        elements = list(_elements(path, file, order))
    content = b"".join([header[:116], bytes(8), header[124:], *elements])
    try:
        found = scipy.io.loadmat(io.BytesIO(content))
    except Exception as error:  # scipy has no list of the errors that damage causes
        _damaged(path, str(error))
    return {name: value for name, value in found.items() if not name.startswith("__")}


def _elements(path: Path, file: BinaryIO, order: str) -> Iterator[bytes]:
    """Yield the wanted variables as elements of the file, without compression."""
    position, total = _HEADER_BYTES, 0
    for number in range(MAT_VARIABLES + 1):
        file.seek(position)
        tag = file.read(8)
        if not tag:
            return
        if number == MAT_VARIABLES:
            raise InputError(path, f"holds more than {MAT_VARIABLES:,} variables", _REMEDY)
        if len(tag) < 8:
            _damaged(path, "it ends midway")
        kind, size = struct.unpack(f"{order}II", tag)
        start = tag + file.read(min(size, 4096))
        if kind == _COMPRESSED:
            start = _expanded(path, start[8:], 512)
        if _name(start, order) in _WANTED:
            file.seek(position + 8)
            element = tag + file.read(min(size, CAMERA_BYTES + 1))
            if kind == _COMPRESSED:
                element = _expanded(path, element[8:], CAMERA_BYTES + 1)
            total += len(element)
            if total > CAMERA_BYTES:
                raise InputError(path, f"holds cameras of more than {CAMERA_BYTES:,} bytes", _REMEDY)
            _check_levels(path, element, order, 0)
            yield element
        position += 8 + size


def _expanded(path: Path, content: bytes, most_bytes: int) -> bytes:
    try:
        return zlib.decompressobj().decompress(content, most_bytes)
    except zlib.error as error:
        _damaged(path, str(error))


def _parts(content: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield type and bytes of the elements that follow each other; the last one may be incomplete."""
    position = 0
    while position + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, position)
        if kind >> 16:  # a small element: size and type share four bytes, the values are in the next four
            yield kind & 0xFFFF, content[position + 4 : position + 4 + min(kind >> 16, 4)]
            position += 8
        else:
            yield kind, content[position + 8 : position + 8 + size]
            position += 8 + size + (-size % 8 if kind != _COMPRESSED else 0)


def _name(element: bytes, order: str) -> str:
    """Return the name of a variable from the start of its element: flags, dimensions, name."""
    kind = struct.unpack_from(f"{order}I", element)[0] if len(element) >= 8 else 0
    parts = [part for _, part in zip(range(3), _parts(element[8:], order), strict=False)]
    return parts[2][1].decode("latin-1") if kind == _MATRIX and len(parts) == 3 else ""


def _check_levels(path: Path, content: bytes, order: str, level: int) -> None:
    if level > CAMERA_LEVELS:
        _damaged(path, f"it is nested more than {CAMERA_LEVELS} levels deep")
    for kind, part in _parts(content, order):
        if kind == _COMPRESSED and level:
            _damaged(path, "a variable holds compressed parts")
        if kind == _MATRIX:
            _check_levels(path, part, order, level + 1)


def _damaged(path: Path, reason: str) -> NoReturn:
    raise InputError(path, f"is damaged: {reason or 'unknown reason'}", "copy or write the file again")
