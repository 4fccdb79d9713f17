"""Values of camera files: numbers, names and sizes with one-line errors, and the cameras that they make."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from jaxfit.cameras.camera import Camera, Lens
from jaxfit.foundation.errors import InputError

Unit = Literal["m", "cm", "mm"]
"""Units of length of camera files."""

METRES: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Unit → its length in metres."""

WHOLE_PIXELS = 0.5
"""What to add to a principal point where pixel centres are at 0, 1, 2, …, as in OpenCV."""
MATLAB_PIXELS = -0.5
"""What to add to a principal point where pixel centres are at 1, 2, 3, …, as in MATLAB."""

MAX_ANGLE_RAD = 100.0
"""Largest angle of a rotation vector; of larger angles, a file keeps too few digits."""

_REMEDY = "write the file again with the program that made it"


class Parsed(NamedTuple):
    """The cameras of a file, with pixel centres at i + 0.5 and lengths in the unit of the file."""

    cameras: tuple[Camera, ...]
    format: str
    """Name of the program that writes such files."""
    unit: Unit | None
    """Unit that the file states."""
    usual_unit: Unit | None
    """Unit that the program uses; None for programs without a usual unit."""


def parsed(source: Path, cameras: Sequence[Camera], form: str, unit: Unit | None, usual: Unit | None) -> Parsed:
    """Return the cameras of a file after the checks of the whole set.

    Args:
        source: the file or folder, for messages.
        cameras: cameras with lengths in the unit of the file.
        form: name of the program.
        unit: the unit that the file states.
        usual: the usual unit of the program.

    Raises:
        InputError: there is no camera, or two cameras have one name.
    """
    if not cameras:
        raise InputError(source, "holds no camera", "give a file of calibrated cameras")
    names = [camera.name for camera in cameras]
    for name in names:
        if names.count(name) > 1:
            raise InputError(source, f'holds two cameras with the name "{name}"', "give each camera its own name")
    return Parsed(tuple(cameras), form, unit, usual)


def make_camera(
    source: Path,
    field: str,
    name: str,
    matrix: np.ndarray,
    distortion: np.ndarray,
    pose: tuple[np.ndarray, np.ndarray] | None,
    size_px: tuple[int, int] | None,
    shift_px: float,
    lens: Lens = "perspective",
) -> Camera:
    """Return a camera with pixel centres at i + 0.5 from the values of a file.

    Args:
        source: the file, for messages.
        field: address of the camera in the file, for messages; empty where the file is the camera.
        name: name of the camera.
        matrix: intrinsic matrix of the file, (3, 3).
        distortion: coefficients in OpenCV's order.
        pose: rotation (3, 3) and translation (3,) world → camera; None without a pose.
        size_px: width and height.
        shift_px: `WHOLE_PIXELS`, `MATLAB_PIXELS` or 0.
        lens: model of the lens.

    Raises:
        InputError: a value is not possible; the message names the file, the camera and the field.
    """
    shifted = matrix + np.array([[0, 0, shift_px], [0, 0, shift_px], [0, 0, 0]])
    R, transl = (np.eye(3), np.zeros(3)) if pose is None else pose
    try:
        return Camera(name, shifted, distortion, R, transl, size_px, lens)
    except ValueError as error:
        raise InputError(source, f"{field}: {error}" if field else f"camera {name}: {error}", _REMEDY) from None


def fail(source: Path, field: str, problem: str, remedy: str = _REMEDY) -> NoReturn:
    """Raise InputError about a field of a file."""
    raise InputError(source, f"{field} {problem}", remedy)


def numbers(source: Path, field: str, value: Any, *shapes: tuple[int, ...]) -> np.ndarray:
    """Return finite numbers of a file as an array of one of some shapes.

    Args:
        source: the file, for messages.
        field: address of the value, for messages.
        value: nested lists, or a matrix of OpenCV: a mapping with `rows`, `cols` and `data`.
        shapes: allowed shapes. One that has as many numbers and is equal but for sides of 1 is taken; (-1,) stands for
            any vector.

    Raises:
        InputError: the value is of another kind or shape, or not finite.
    """
    is_matrix = isinstance(value, dict) and "data" in value
    try:
        array = np.asarray(value["data"] if is_matrix else value)
        if is_matrix:
            sides = value["sizes"] if "sizes" in value else (value["rows"], value["cols"])
            array = array.reshape(sides)
    except (ValueError, TypeError, LookupError, OverflowError):
        problem = "has another number of values than rows × cols" if is_matrix else "has rows of different lengths"
        fail(source, field, problem)
    if array.dtype.kind not in "fiu":
        fail(source, field, "must hold numbers")
    if not np.isfinite(array).all():
        fail(source, field, "holds a value that is not finite")
    sides = [side for side in array.shape if side != 1]
    for allowed in shapes:
        if (allowed == (-1,) and len(sides) <= 1) or sides == [side for side in allowed if side != 1]:
            return array.astype(np.float64).reshape(allowed)
    expected = " or ".join("a vector" if shape == (-1,) else "×".join(map(str, shape)) for shape in shapes)
    actual = "×".join(map(str, array.shape)) or "of one number"
    fail(source, field, f"must have the shape {expected}, not {actual}")


def rotation_matrix(source: Path, field: str, value: Any) -> np.ndarray:
    """Return the rotation (3, 3) of a rotation matrix or an axis-angle vector of a file.

    Raises:
        InputError: as `numbers`; or the angle of a vector is more than `MAX_ANGLE_RAD`.
    """
    rotation = numbers(source, field, value, (3, 3), (3,))
    if rotation.ndim == 2:
        return rotation
    angle = float(np.linalg.norm(rotation))
    if angle > MAX_ANGLE_RAD:
        fail(source, field, f"is a rotation of {angle:.3g} radians, more than {MAX_ANGLE_RAD:g}")
    return Rotation.from_rotvec(rotation).as_matrix()


def image_size(source: Path, field: str, value: Any) -> tuple[int, int] | None:
    """Return width and height of an image; None for an empty list.

    Raises:
        InputError: the value does not hold two whole numbers; `Camera` checks their range.
    """
    if isinstance(value, list) and not value:
        return None
    width, height = numbers(source, field, value, (2,)).tolist()
    if width != int(width) or height != int(height):
        fail(source, field, f"must hold two whole numbers, not {width:g} and {height:g}")
    return int(width), int(height)


def camera_name(source: Path, field: str, value: Any) -> str:
    """Return the name of a camera, which is text or a whole number in the file."""
    if type(value) not in (str, int):
        fail(source, field, "must be text", "name the camera")
    return str(value)


def stated_unit(source: Path, field: str, value: Any) -> Unit | None:
    """Return the unit of length that a file states; None without a value.

    Raises:
        InputError: the unit is unknown.
    """
    if value is None:
        return None
    for unit in ("m", "cm", "mm"):
        if value == unit:
            return unit
    fail(source, field, f"must be m, cm or mm, not {value!r}", "correct the unit")


def natural(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that puts `cam2` before `cam10`."""
    parts = re.findall(r"\d{1,15}|\D+|\d+", name)
    return [(0, int(part), "") if part.isdecimal() and len(part) < 16 else (1, 0, part) for part in parts]


def in_metres(camera: Camera, unit: Unit) -> Camera:
    """Return a camera of a file with lengths in metres."""
    return camera if unit == "m" else replace(camera, transl_cam=camera.transl_cam * METRES[unit])
