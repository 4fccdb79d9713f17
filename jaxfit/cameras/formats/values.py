"""Values of camera files: numbers, names and sizes with one-line errors, and the cameras that they make."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, NoReturn

import numpy as np

from jaxfit.cameras.camera import Camera, Lens
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import CAMERAS, NAME_CHARACTERS

Unit = Literal["m", "cm", "mm"]
"""Units of length of camera files."""

METRES: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Unit → its length in metres."""

WHOLE_PIXELS = 0.5
"""What to add to a principal point where pixel centres are at 0, 1, 2, …, as in OpenCV."""
MATLAB_PIXELS = -0.5
"""What to add to a principal point where pixel centres are at 1, 2, 3, …, as in MATLAB."""

LARGEST = 1e12
"""Largest absolute number of a camera; squares of larger numbers may overflow."""
_LONGEST = 100
"""Most numbers of one field of a camera."""
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
        InputError: there is no camera, there are more than `CAMERAS`, or two cameras have one name.
    """
    if not cameras:
        raise InputError(source, "holds no camera", "give a file of calibrated cameras")
    if len(cameras) > CAMERAS:
        raise InputError(source, f"holds {len(cameras):,} cameras, more than {CAMERAS:,}", "split the file")
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
    expected = " or ".join("a vector" if shape == (-1,) else "×".join(map(str, shape)) for shape in shapes)
    flat, shape = _flat(source, field, value)
    array = np.array(flat, np.float64)
    if not np.isfinite(array).all():
        fail(source, field, "holds a value that is not finite")
    if np.abs(array).max(initial=0) > LARGEST:
        fail(source, field, f"holds a number above {LARGEST:g}")
    sides = [side for side in shape if side != 1]
    for allowed in shapes:
        if (allowed == (-1,) and len(sides) <= 1) or sides == [side for side in allowed if side != 1]:
            return array.reshape(allowed)
    fail(source, field, f"must have the shape {expected}, not {'×'.join(map(str, shape)) or 'of one number'}")


def _flat(source: Path, field: str, value: Any) -> tuple[list[float], tuple[int, ...]]:
    """Return the numbers of nested lists, or of a matrix of OpenCV, and their shape."""
    if isinstance(value, dict) and "data" in value:
        flat, shape = _flat(source, f"{field}.data", value["data"])
        stated: Any = value.get("sizes", [value.get("rows"), value.get("cols")])
        stated = [stated] if type(stated) is int else stated  # XML has no lists of one entry
        sides = [side for side in stated if type(side) is int and 0 <= side <= _LONGEST] if type(stated) is list else []
        if not sides or sides != stated or math.prod(sides) != len(flat) or len(shape) > 1:
            fail(source, field, f"has {len(flat)} numbers, which is not rows × cols")
        return flat, tuple(sides)
    entries: Any = value.tolist() if isinstance(value, np.ndarray) else value
    return _nested(source, field, entries)


def _nested(source: Path, field: str, value: Any) -> tuple[list[float], tuple[int, ...]]:
    """Return the numbers of nested lists and their shape."""
    if type(value) in (int, float):
        try:
            return [float(value)], ()
        except OverflowError:
            fail(source, field, "holds a number that is too large")
    if not isinstance(value, list):
        kinds = {str: "text", dict: "a table", bool: "true or false"}
        fail(source, field, f"must hold numbers, not {kinds.get(type(value), 'another value')}")
    if len(value) > _LONGEST:
        fail(source, field, f"has {len(value):,} entries, more than {_LONGEST}")
    parts = [_nested(source, f"{field}[{i}]", part) for i, part in enumerate(value)]
    if len({shape for _, shape in parts}) > 1:
        fail(source, field, "has rows of different lengths")
    flat = [number for part, _ in parts for number in part]
    if len(flat) > _LONGEST:
        fail(source, field, f"has {len(flat):,} numbers, more than {_LONGEST}")
    return flat, (len(value), *(parts[0][1] if parts else ()))


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
    text = str(value)
    if not 0 < len(text) <= NAME_CHARACTERS:
        fail(source, field, f"must have 1 to {NAME_CHARACTERS} characters, not {len(text):,}", "name the camera")
    return text


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
