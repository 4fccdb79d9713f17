"""Cameras of DANNCE and Label3D in `.mat` files, which follow MATLAB's conventions.

MATLAB projects row vectors, p = [X 1] · [r; t] · K, so `K` and `r` are transposed. Its pixel centres are at 1, 2, 3, …:
DANNCE subtracts 1 from Label3D's positions. The files have no image size.

Source: DANNCE, dannce/engine/io.py, ops.py (`camera_matrix`, `distortPoints`) and serve_data_DANNCE.py; Label3D,
Label3D.m (`loadcamParams`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.formats.matlab import read_variables
from jaxfit.cameras.formats.values import MATLAB_PIXELS, Parsed, camera_name, make_camera, numbers, parsed
from jaxfit.foundation.errors import InputError

_WANTED = ("params", "camParams", "camnames", "K", "RDistort", "TDistort", "r", "R", "t", "m")
_REMEDY = "give a *_dannce.mat file, or a folder of hires_cam1_params.mat, hires_cam2_params.mat, …"


def read_dannce(path: Path) -> Parsed:
    """Read the cameras of a file of Label3D or DANNCE: the cell `params`, and the names in `camnames`.

    Without `camnames`, the cameras have the names Camera1, Camera2, …, as in DANNCE. A file of one camera
    (hires_cam1_params.mat) has the number in its name.

    Raises:
        InputError: the file is damaged, too large, of MATLAB's version 7.3, or holds no cameras.
    """
    variables = read_variables(path, _WANTED)
    params = variables.get("params", variables.get("camParams"))
    if params is None:
        return parsed(path, [_single(path, variables)], "DANNCE", None, "mm")
    cells = params if isinstance(params, list) else [params]
    names = variables.get("camnames", [])
    names = names if isinstance(names, list) else [names]
    if names and len(names) != len(cells):
        problem = f"holds {len(cells)} cameras and {len(names)} camnames"
        raise InputError(path, problem, "write one name for each camera")
    names = names or [f"Camera{number + 1}" for number in range(len(cells))]
    cameras = [
        _camera(path, f"params{{{number}}}", camera_name(path, f"camnames{{{number}}}", name), cell)
        for number, (cell, name) in enumerate(zip(cells, names, strict=True), 1)
    ]
    return parsed(path, cameras, "DANNCE", None, "mm")


def read_dannce_folder(folder: Path, files: Sequence[Path]) -> Parsed:
    """Read a calibration folder of DANNCE, with one camera in each file."""
    cameras = [_single(path, read_variables(path, _WANTED)) for path in files]
    return parsed(folder, cameras, "DANNCE", None, "mm")


def _single(path: Path, variables: dict[str, Any]) -> Camera:
    number = re.search(r"cam(?:era)?_?(\d{1,9})", path.stem, re.IGNORECASE)
    return _camera(path, "", f"Camera{int(number[1])}" if number else path.stem, variables)


def _camera(path: Path, field: str, name: str, values: Any) -> Camera:
    if not isinstance(values, dict):
        raise InputError(path, f"{field} is not a struct", _REMEDY)
    where = f"{field}." if field else ""
    rotation = "r" if "r" in values else "R"
    missing = [key for key in ("K", rotation, "t") if key not in values]
    if missing:
        raise InputError(path, f"{field or 'the file'} lacks {', '.join(missing)}", _REMEDY)
    if values.get("m") == 1:
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
