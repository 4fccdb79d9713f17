"""Models of COLMAP as text: cameras.txt and images.txt.

COLMAP has pixel centres at i + 0.5, and its poses are world → camera. The unit of length is arbitrary, because a
reconstruction from images alone has no scale. Every image is one view.

Source: COLMAP, "Output Format" (text format) and src/colmap/sensor/models.h (models and the order of their parameters).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from jaxfit.cameras.camera import Camera, Lens
from jaxfit.cameras.formats.values import Parsed, make_camera, parsed
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import read_text

_REMEDY = "export the model from COLMAP again, as text"


class _Model(NamedTuple):
    """A camera model of COLMAP."""

    focal_lengths: int
    coefficients: int
    """Number of coefficients, in OpenCV's order; the missing ones are 0."""
    lens: Lens = "perspective"


_MODELS = {
    "SIMPLE_PINHOLE": _Model(1, 0),
    "PINHOLE": _Model(2, 0),
    "SIMPLE_RADIAL": _Model(1, 1),
    "RADIAL": _Model(1, 2),
    "OPENCV": _Model(2, 4),
    "FULL_OPENCV": _Model(2, 8),
    "SIMPLE_FISHEYE": _Model(1, 0, "fisheye"),
    "FISHEYE": _Model(2, 0, "fisheye"),
    "SIMPLE_RADIAL_FISHEYE": _Model(1, 1, "fisheye"),
    "RADIAL_FISHEYE": _Model(1, 2, "fisheye"),
    "OPENCV_FISHEYE": _Model(2, 4, "fisheye"),
}


class _Intrinsics(NamedTuple):
    matrix: np.ndarray
    distortion: np.ndarray
    size_px: tuple[int, int]
    lens: Lens


def read_colmap(folder: Path) -> Parsed:
    """Read the cameras of a COLMAP model: one camera for every image.

    A camera has the name of its image without the suffix. If every image is in its own folder, the camera has the name
    of the folder.

    Args:
        folder: the folder of cameras.txt and images.txt.

    Raises:
        InputError: a file is missing, damaged or too large, or a camera has a model that OpenCV does not have.
    """
    intrinsics = _intrinsics(folder / "cameras.txt")
    source = folder / "images.txt"
    images = list(_images(source))
    names = _names([name for _, name, _, _ in images])
    cameras: list[Camera] = []
    for (line, _, number, pose), name in zip(images, names, strict=True):
        if number not in intrinsics:
            _fail(source, line, f"names camera {number}, which cameras.txt lacks")
        matrix, distortion, size_px, lens = intrinsics[number]
        cameras.append(make_camera(source, f"line {line}", name, matrix, distortion, pose, size_px, 0.0, lens))
    return parsed(folder, cameras, "COLMAP", None, None)


def _intrinsics(path: Path) -> dict[int, _Intrinsics]:
    intrinsics: dict[int, _Intrinsics] = {}
    for line, text in enumerate(read_text(path, "cameras.txt of COLMAP").splitlines(), 1):
        words = text.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5:
            _fail(path, line, "has fewer than 5 entries")
        if words[1] not in _MODELS:
            known = ", ".join(_MODELS)
            raise InputError(path, f"line {line}: the camera model {words[1]} is not supported", f"use one of {known}")
        model = _MODELS[words[1]]
        number, width, height = _numbers(path, line, [words[0], *words[2:4]], int)
        values = _numbers(path, line, words[4:], float)
        if len(values) != model.focal_lengths + 2 + model.coefficients:
            count = model.focal_lengths + 2 + model.coefficients
            _fail(path, line, f"has {len(values)} parameters; {words[1]} has {count}")
        if number in intrinsics:
            _fail(path, line, f"holds camera {number} a second time")
        fx, fy = values[0], values[model.focal_lengths - 1]
        cx, cy, *coefficients = values[model.focal_lengths :]
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        padded = coefficients + [0.0] * (-len(coefficients) % 4)
        intrinsics[number] = _Intrinsics(matrix, np.array(padded, np.float64), (width, height), model.lens)
    return intrinsics


def _images(path: Path) -> Iterator[tuple[int, str, int, tuple[np.ndarray, np.ndarray]]]:
    """Yield line, name, number of the camera, and pose of each image."""
    lines = enumerate(read_text(path, "images.txt of COLMAP").split("\n"), 1)
    for line, text in lines:
        words = text.split(maxsplit=9)
        if not words or words[0].startswith("#"):
            continue
        next(lines, None)  # the line of the image's points, which may be empty
        if len(words) < 10:
            _fail(path, line, "has fewer than 10 entries; each image has two lines")
        values = _numbers(path, line, words[1:8], float)
        (camera,) = _numbers(path, line, words[8:9], int)
        try:
            R = Rotation.from_quat(np.roll(values[:4], -1)).as_matrix()  # COLMAP has the real part first
        except ValueError:
            _fail(path, line, "has a quaternion that is no rotation")
        yield line, words[9].strip(), camera, (R, np.array(values[4:]))


def _names(images: list[str]) -> list[str]:
    """Return names of cameras for names of images."""
    paths = [PurePosixPath(name.replace("\\", "/")) for name in images]
    folders = [path.parent.as_posix() for path in paths]
    if len(paths) > 1 and "." not in folders and max(Counter(folders).values()) == 1:
        return folders
    return [path.with_suffix("").as_posix() for path in paths]


def _numbers(path: Path, line: int, words: list[str], kind: type[int] | type[float]) -> list[Any]:
    try:
        return [kind(word) for word in words]
    except ValueError:
        _fail(path, line, "holds text where numbers are expected")


def _fail(path: Path, line: int, problem: str) -> NoReturn:
    raise InputError(path, f"line {line} {problem}", _REMEDY)
