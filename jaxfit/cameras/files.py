"""Files of calibrated cameras: reading of the formats of other programs, and writing.

The content of a file tells its format. Every format has its own pixel convention and unit; the result has pixel centres
at i + 0.5 and metres.

| program         | files                                     | pixel centres | unit without `unit`              |
|-----------------|-------------------------------------------|---------------|----------------------------------|
| OpenCV          | .yaml, .xml or .json of `cv2.FileStorage` | i             | must be given: any unit is usual |
| anipose         | .toml                                     | i             | `[metadata] unit`, else mm       |
| Pose2Sim        | .toml with `fisheye = false`              | i             | `[metadata] unit`, else m        |
| Caliscope       | .toml, with `fisheye = false` or `cameras`| i             | m                                |
| Kalibr          | camchain.yaml                             | i             | m                                |
| JARVIS          | Camera_X.yaml with transposed matrices    | i             | mm                               |
| DANNCE, Label3D | .mat                                      | i + 1         | mm                               |
| COLMAP          | cameras.txt and images.txt                | i + 0.5       | must be given: arbitrary scale   |

Evidence of the units: anipose's config.toml has "mm" beside every length of the board. Pose2Sim converts to metres.
JARVIS asks for "Side Length [mm]". MATLAB's calibration has mm by default. OpenCV's documents call the unit of the
board user-defined.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, get_args

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.formats.anipose import anipose_text, read_anipose
from jaxfit.cameras.formats.colmap import read_colmap
from jaxfit.cameras.formats.dannce import read_dannce, read_dannce_folder
from jaxfit.cameras.formats.matlab import MAT_SIGNATURES
from jaxfit.cameras.formats.opencv import read_opencv, read_opencv_folder
from jaxfit.cameras.formats.values import Parsed, Unit, in_metres, natural
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.reading import check_folder, open_file

_FORMATS = (
    "give OpenCV .yaml, .xml or .json, anipose or Caliscope .toml, DANNCE .mat, JARVIS or Kalibr .yaml, or a folder of "
    "COLMAP's text files"
)
_COLMAP_FILES = ("cameras.txt", "images.txt")
_STORAGE_SUFFIXES = (".yaml", ".yml", ".xml")


class CameraFile(NamedTuple):
    """The cameras of a file, and how the file was understood."""

    cameras: tuple[Camera, ...]
    """Cameras with pixel centres at i + 0.5 and lengths in metres."""
    format: str
    """Program that writes such files, such as OpenCV."""
    unit: Unit | None
    """Unit of length in the file; None if no camera has a translation, so that no unit is needed."""
    unit_assumed: bool
    """Whether the unit is only the usual unit of the program: neither the file nor the caller states it."""


def read_cameras(path: str | Path, unit: Unit | None = None) -> tuple[Camera, ...]:
    """Return the cameras of a file or folder, in metres; arguments and errors as `read_camera_file`."""
    return read_camera_file(path, unit).cameras


def read_camera_file(path: str | Path, unit: Unit | None = None) -> CameraFile:
    """Read the calibrated cameras of a file or a folder of a program of the table above.

    Args:
        path: a file of one or several cameras, or a folder: the text files of a COLMAP model, one file for each camera,
            or one file of several cameras.
        unit: unit of length in the file. None: the unit that the file states, or else the usual unit of the program.

    Returns:
        The cameras in the order of the file, in metres, with the unit of the file. A single camera without a pose is
        the world: R_cam_world is the identity, transl_cam is 0.

    Raises:
        InputError: the file cannot be read, is of no known format, is damaged, a camera lacks a value or has an
            impossible value, two cameras have one name, or the unit is unknown or contradicts the file.
        ValueError: `unit` is not m, cm or mm.
    """
    if unit is not None and unit not in get_args(Unit):
        raise ValueError(f"unit must be one of {', '.join(get_args(Unit))} or None, not {unit!r}")
    path = Path(path)
    content = _read_folder(path) if path.is_dir() else _reader(path)(path)
    if unit is not None and content.unit is not None and unit != content.unit:
        raise InputError(
            path, f"states the unit {content.unit}, not {unit}", f"read the file with the unit {content.unit}"
        )
    known: Unit | None = unit or content.unit or content.usual_unit
    if known is None:
        if any(camera.transl_cam.any() for camera in content.cameras):
            problem = f"is a file of {content.format}, which does not state its unit of length"
            raise InputError(path, problem, "give the unit of the file: m, cm or mm")
        return CameraFile(content.cameras, content.format, None, False)
    cameras = tuple(in_metres(camera, known) for camera in content.cameras)
    return CameraFile(cameras, content.format, known, unit is None and content.unit is None)


def write_cameras(cameras: Sequence[Camera], path: str | Path) -> None:
    """Write cameras as TOML in the format of anipose, in metres.

    aniposelib reads the file (`CameraGroup.load`). `read_cameras` returns the same cameras: distortion and translation
    exactly, matrix and rotation up to the rounding of floats, because anipose has other pixel centres and stores
    rotation vectors. Only a fisheye lens without coefficients gets four zeros.

    Args:
        cameras: cameras with different names.
        path: the file; an existing file is replaced.

    Raises:
        ValueError: there is no camera, or two cameras have one name.
        InputError: the system rejects the write.
    """
    names = [camera.name for camera in cameras]
    if not names:
        raise ValueError("cameras must hold at least one camera")
    if len(set(names)) < len(names):
        raise ValueError(f"cameras must have different names, not {names}")
    write_whole(path, anipose_text(cameras).encode("utf-8"))


def _reader(path: Path) -> Callable[[Path], Parsed]:
    """Return the function that reads a file, from the first bytes of the file and from its name."""
    with open_file(path, "a file of cameras", "check the path; `jaxfit cameras calibrate` writes cameras") as file:
        start = file.read(4096)
    if not start.strip():
        raise InputError(path, "is empty", _FORMATS)
    if start.startswith(MAT_SIGNATURES) or path.suffix.lower() == ".mat":
        return read_dannce
    name = path.name.lower()
    if name in _COLMAP_FILES or start.startswith((b"# Camera list with", b"# Image list with")):
        return lambda file: read_colmap(file.parent)
    if name in ("cameras.bin", "images.bin"):
        raise _binary_colmap(path)
    text = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    if b"\0" in text:
        raise InputError(path, "is of no known format", _FORMATS)
    if text.startswith((b"%YAML", b"<?xml", b"<opencv_storage", b"{")):
        return read_opencv
    if path.suffix.lower() == ".toml" or re.search(rb"^\s*\[[^\[\],]+\]\s*(#.*)?$", text, re.MULTILINE):
        return read_anipose
    if path.suffix.lower() in _STORAGE_SUFFIXES or re.match(rb"(---|#|[A-Za-z_]\w*:(\s|$))", text):
        return read_opencv
    raise InputError(path, "is of no known format", _FORMATS)


def _read_folder(folder: Path) -> Parsed:
    check_folder(folder)
    files = sorted((path for path in folder.iterdir() if path.is_file()), key=lambda path: natural(path.name))
    names = [path.name for path in files]
    if all(name in names for name in _COLMAP_FILES):
        return read_colmap(folder)
    if "cameras.bin" in names and "images.bin" in names:
        raise _binary_colmap(folder)
    kinds = {
        "TOML files": [path for path in files if path.suffix.lower() == ".toml"],
        ".mat files": [path for path in files if path.suffix.lower() == ".mat"],
        "YAML or XML files": [path for path in files if path.suffix.lower() in _STORAGE_SUFFIXES],
    }
    present = {kind: paths for kind, paths in kinds.items() if paths}
    if not present:
        present = {"JSON files": [path for path in files if path.suffix.lower() == ".json"]}
    if len(present) > 1:
        raise InputError(folder, f"holds {' and '.join(present)}", "name the file of the cameras, or clear the folder")
    ((kind, chosen),) = present.items()
    if not chosen:
        raise InputError(folder, "holds no file of cameras", _FORMATS)
    if len(chosen) == 1:
        return _reader(chosen[0])(chosen[0])
    if kind == "TOML files":
        raise InputError(folder, f"holds {len(chosen)} TOML files", "name the file of the cameras")
    if kind == ".mat files":
        single = [path for path in chosen if path.stem.lower().endswith("_params")]
        return read_dannce_folder(folder, single or chosen)
    return read_opencv_folder(folder, chosen)


def _binary_colmap(path: Path) -> InputError:
    remedy = "run colmap model_converter --output_type TXT, and give the folder of the text files"
    return InputError(path, "is a binary model of COLMAP", remedy)
