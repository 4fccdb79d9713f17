"""Cameras in files of `cv2.FileStorage`: OpenCV's names, pairs of stereo cameras, and JARVIS; YAML of Kalibr.

A camera is a mapping with an intrinsic matrix. Its other values are optional: distortion, image size, a pose as R or
rvec and T or tvec, a name, a unit. Names of values are compared without case, spaces and underscores. One file holds
one camera, or one camera under each key, or a list of cameras, or a stereo pair (M1, D1, M2, D2, R, T: then the first
camera is the world).

JARVIS stores the transposed intrinsic matrix and the transposed rotation, because it projects row vectors:
p = [X 1] · [R; T] · K.

Source: OpenCV samples camera_calibration.cpp and stereo_calib.cpp; JARVIS-AnnotationTool, extrinsicscalibrator.cpp
(`intrinsics.K.t()`, `extrinsics1.R.t()`, "Side Length [mm]"); JARVIS-HybridNet, reprojection.py.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.cameras.camera import Camera, Lens
from jaxfit.cameras.formats.kalibr import is_kalibr, parse_kalibr
from jaxfit.cameras.formats.storage import read_storage
from jaxfit.cameras.formats.values import (
    WHOLE_PIXELS,
    Parsed,
    Unit,
    camera_name,
    fail,
    image_size,
    make_camera,
    numbers,
    parsed,
    rotation_matrix,
    stated_unit,
)
from jaxfit.foundation.errors import InputError

_MATRIX = ("cameramatrix", "intrinsicmatrix", "intrinsics", "intrinsic", "k", "m", "mtx")
_DISTORTION = (
    "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "distcoefs", "distortions", "distortion",
    "dist", "d",
)  # fmt: skip
_ROTATION = ("r", "rotationmatrix", "rotation", "rot", "rvec", "rotationvector")
_TRANSLATION = ("t", "translationvector", "translation", "trans", "tvec")
_SIZE = ("imagesize", "size", "resolution")
_SIDES = (("1", "2"), ("left", "right"), ("l", "r"))
"""Ends of the names of the values of a stereo pair."""
_LENSES: dict[str, Lens] = {
    "plumbbob": "perspective",
    "rationalpolynomial": "perspective",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
"""Models of ROS and Kalibr → the lens."""
_REMEDY = "give a file with an intrinsic matrix: camera_matrix, K, cameraMatrix or intrinsicMatrix"


class _FileCamera(NamedTuple):
    """A camera with its unit, and whether the file states its pose."""

    camera: Camera
    unit: Unit | None
    posed: bool
    jarvis: bool = False


def read_opencv(path: Path) -> Parsed:
    """Read the cameras of a file of `cv2.FileStorage`.

    Raises:
        InputError: the file is damaged or too large, holds no camera, or a camera has an impossible value.
    """
    content = read_storage(path)
    if is_kalibr(content):
        return parse_kalibr(path, content)
    entries = list(_cameras(path, content, path.stem))
    if not entries:
        raise InputError(path, "holds no camera", _REMEDY)
    return _parsed(path, entries)


def read_opencv_folder(folder: Path, files: Sequence[Path]) -> Parsed:
    """Read a folder with one camera in each file, or with the intrinsics and the extrinsics of a stereo pair.

    A camera without a name of its own has the name of its file without the suffix.
    """
    contents = {path: read_storage(path) for path in files}
    merged: dict[str, Any] = {}
    for content in contents.values():
        merged |= content
    if _stereo_side(_plain(merged)) is not None:
        return _parsed(folder, list(_cameras(folder, merged, folder.name)))
    entries: list[_FileCamera] = []
    for path, content in contents.items():
        inside = list(_cameras(path, content, path.stem))
        if not inside:
            raise InputError(path, "holds no camera", f"{_REMEDY}, or remove the file from the folder")
        entries += inside
    return _parsed(folder, entries)


def _parsed(source: Path, entries: list[_FileCamera]) -> Parsed:
    units = {entry.unit for entry in entries}
    if len(units) > 1:
        raise InputError(source, "holds cameras with different units", "write all cameras in one unit")
    jarvis = all(entry.jarvis for entry in entries)
    cameras = [entry.camera for entry in entries]
    form, usual = ("JARVIS", "mm") if jarvis else ("OpenCV", None)
    absent = [entry.camera.name for entry in entries if not entry.posed]
    if len(absent) > 1:
        problem = f"lacks the poses of {len(absent)} cameras, such as {absent[0]}"
        raise InputError(source, problem, "add R and T of each camera, or read the files one by one")
    return parsed(source, cameras, form, entries[0].unit, usual)


def _plain(content: dict[str, Any]) -> dict[str, Any]:
    """Return a mapping with names in lower case, without spaces, dashes and underscores."""
    return {re.sub(r"[\s_-]", "", str(key)).lower(): value for key, value in content.items()}


def _first(values: dict[str, Any], names: Sequence[str], end: str = "") -> str | None:
    return next((name + end for name in names if values.get(name + end) is not None), None)


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list) or (isinstance(value, dict) and "data" in value)


def _stereo_side(values: dict[str, Any]) -> tuple[str, str] | None:
    if (single := _first(values, _MATRIX)) and _is_matrix(values[single]):
        return None
    for pair in _SIDES:
        keys = [_first(values, _MATRIX, end) for end in pair]
        if all(key is not None and _is_matrix(values[key]) for key in keys):
            return pair
    return None


def _cameras(path: Path, content: dict[str, Any], name: str) -> Iterator[_FileCamera]:
    """Yield the cameras of a mapping: the mapping itself, a stereo pair, or the cameras under its keys."""
    values = _plain(content)
    key = _first(values, _MATRIX)
    if key is not None and _is_matrix(values[key]):
        yield _camera(path, "", values, name)
        return
    if (pair := _stereo_side(values)) is not None:
        yield from _stereo(path, values, pair)
        return
    unit = stated_unit(path, "unit", values.get("unit"))
    for key, value in content.items():
        parts = [(key, key, value)]
        if _plain({key: 0}).keys() <= {"cameras"} and isinstance(value, dict | list):
            numbered = value.items() if isinstance(value, dict) else enumerate(value)
            parts = [(f"{key}.{i}", str(i) if isinstance(value, dict) else f"camera{i}", part) for i, part in numbered]
        for address, camera, part in parts:
            inside = _plain(part) if isinstance(part, dict) else {}
            matrix = _first(inside, _MATRIX)
            if matrix is not None and _is_matrix(inside[matrix]):
                yield _camera(path, str(address), {"unit": unit} | inside, str(camera))


def _camera(path: Path, field: str, values: dict[str, Any], name: str) -> _FileCamera:
    where = f"{field}." if field else ""
    name = camera_name(path, f"{where}name", values.get("cameraname", values.get("name", name)))
    key = _first(values, _MATRIX) or ""
    matrix = numbers(path, where + key, values[key], (3, 3))
    jarvis = key == "intrinsicmatrix" and not matrix[:2, 2].any() and bool(matrix[2, :2].any())
    pose = _pose(path, where, values)
    if jarvis:
        matrix, pose = matrix.T, None if pose is None else (pose[0].T, pose[1])
    distortion, lens = _distortion(path, where, values)
    size = _size(path, where, values)
    camera = make_camera(path, field, name, matrix, distortion, pose, size, WHOLE_PIXELS, lens)
    return _FileCamera(camera, stated_unit(path, f"{where}unit", values.get("unit")), pose is not None, jarvis)


def _stereo(path: Path, values: dict[str, Any], pair: tuple[str, str]) -> Iterator[_FileCamera]:
    unit = stated_unit(path, "unit", values.get("unit"))
    pose = _pose(path, "", values)
    if pose is None:
        raise InputError(path, "holds two cameras without R and T", "add R and T, from the first camera to the second")
    for end, camera_pose in zip(pair, ((np.eye(3), np.zeros(3)), pose), strict=True):
        key = _first(values, _MATRIX, end) or ""
        matrix = numbers(path, key, values[key], (3, 3))
        distortion, lens = _distortion(path, "", values, end)
        name = {"l": "left", "r": "right"}.get(end, end if end in ("left", "right") else f"camera{end}")
        size = _size(path, "", values)
        camera = make_camera(path, name, name, matrix, distortion, camera_pose, size, WHOLE_PIXELS, lens)
        yield _FileCamera(camera, unit, True)


def _distortion(path: Path, where: str, values: dict[str, Any], end: str = "") -> tuple[np.ndarray, Lens]:
    key = _first(values, _DISTORTION, end)
    coefficients = np.zeros(0) if key is None else numbers(path, where + key, values[key], (-1,))
    lens: Lens = "fisheye" if values.get("fisheye") or values.get("fisheyemodel") else "perspective"
    model = values.get("distortionmodel")
    if isinstance(model, str) and model:
        word = re.sub(r"[\s_-]", "", model).lower()
        if word not in _LENSES:
            fail(path, f"{where}distortion_model", f"is {model!r}", "calibrate with plumb_bob or fisheye")
        lens = _LENSES[word]
    return coefficients, lens


def _size(path: Path, where: str, values: dict[str, Any]) -> tuple[int, int] | None:
    sides = [values.get("imagewidth", values.get("width")), values.get("imageheight", values.get("height"))]
    if None not in sides:
        return image_size(path, f"{where}image_width and image_height", sides)
    key = _first(values, _SIZE)
    return None if key is None else image_size(path, where + key, values[key])


def _pose(path: Path, where: str, values: dict[str, Any]) -> tuple[np.ndarray, np.ndarray] | None:
    turn, shift = _first(values, _ROTATION), _first(values, _TRANSLATION)
    if turn is None and shift is None:
        return None
    if turn is None or shift is None:
        fail(path, where + (turn or shift or ""), "is only half of a pose", "add R and T, or remove both")
    transl = numbers(path, where + shift, values[shift], (3,))
    return rotation_matrix(path, where + turn, values[turn]), transl
