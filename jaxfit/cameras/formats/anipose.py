"""Cameras of anipose and aniposelib as TOML, which is also the format that jaxfit writes.

Every section but `metadata` is a camera. Its values are OpenCV's: `matrix`, `distortions`, `rotation` (a rotation
vector) and `translation` world → camera; `fisheye` selects OpenCV's fisheye model. Pose2Sim and Caliscope write the
same sections, in metres and with `fisheye = false`, which aniposelib never writes. Where no camera has this value and
all cameras would lie within `NEAR_MM` millimetres, metres are assumed. Caliscope's own `camera_array.toml` has the
cameras under `cameras`, with rotation matrices, in metres.

Source: aniposelib 0.8, `CameraGroup.dump` and `CameraGroup.load`; Pose2Sim, `toml_write` of calibration.py; Caliscope,
`CameraArray.to_toml` and `CameraArray.to_aniposelib_toml`.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.formats.values import (
    WHOLE_PIXELS,
    Parsed,
    camera_name,
    fail,
    image_size,
    make_camera,
    numbers,
    parsed,
    rotation_matrix,
    stated_unit,
)
from jaxfit.foundation.reading import read_text, reading

NEAR_MM = 20.0
"""Two cameras are never this near: their housings are larger."""
_KEYS = ("matrix", "distortions", "rotation", "translation")


def read_anipose(path: Path) -> Parsed:
    """Read the cameras of a TOML file of anipose, of Pose2Sim or of `anipose_text`.

    Raises:
        InputError: the file is not valid TOML, or a camera lacks a value or holds an impossible value.
    """
    with reading(path, "a TOML file of cameras", "correct the file or write it again"):
        content = tomllib.loads(read_text(path, "a TOML file of cameras"))
    metadata = content.pop("metadata", {})
    if not isinstance(metadata, dict):
        fail(path, "metadata", "must be a table")
    unit = stated_unit(path, "metadata.unit", metadata.get("unit"))
    if isinstance(array := content.get("cameras"), dict):
        used = {key: part for key, part in array.items() if not (isinstance(part, dict) and part.get("ignore"))}
        cameras = [_camera(path, f"cameras.{key}", part, f"cam_{key}") for key, part in used.items()]
        return parsed(path, cameras, "Caliscope", unit, "m")
    cameras = [_camera(path, key, section, key) for key, section in content.items()]
    positions = np.array([camera.position_world for camera in cameras]).reshape(-1, 3)
    if any(section.get("fisheye") is False for section in content.values()):
        return parsed(path, cameras, "Pose2Sim or Caliscope", unit, "m")
    is_near = len(cameras) > 1 and bool((np.ptp(positions, axis=0) < NEAR_MM).all())
    return parsed(path, cameras, "anipose", unit, "m" if is_near else "mm")


def _camera(path: Path, key: str, section: Any, name: str) -> Camera:
    if not isinstance(section, dict):
        fail(path, key, "is not the table of a camera", "give a file of cameras, with sections [cam_0], [cam_1], …")
    missing = [name for name in _KEYS if name not in section]
    if missing:
        fail(path, f"[{key}]", f"lacks {', '.join(missing)}", "give a file of cameras, not of settings")
    fisheye = section.get("fisheye", False)
    if not isinstance(fisheye, bool):
        fail(path, f"{key}.fisheye", "must be true or false")
    name = camera_name(path, f"{key}.name", section.get("name", name))
    matrix = numbers(path, f"{key}.matrix", section["matrix"], (3, 3))
    distortion = numbers(path, f"{key}.distortions", section["distortions"], (-1,))
    R = rotation_matrix(path, f"{key}.rotation", section["rotation"])
    transl = numbers(path, f"{key}.translation", section["translation"], (3,))
    size_px = image_size(path, f"{key}.size", section.get("size", []))
    lens = "fisheye" if fisheye else "perspective"
    return make_camera(path, f"[{key}]", name, matrix, distortion, (R, transl), size_px, WHOLE_PIXELS, lens)


def anipose_text(cameras: Sequence[Camera]) -> str:
    """Return cameras as TOML that aniposelib reads, in metres.

    Every number has as many digits as it needs to be read back without loss. aniposelib sorts sections by name, so the
    numbers of sections have leading zeros where there are more than ten.
    """
    digits = len(str(len(cameras) - 1))
    sections = [_section(f"cam_{number:0{digits}d}", camera) for number, camera in enumerate(cameras)]
    return "\n".join([*sections, '[metadata]\nadjusted = false\nunit = "m"\n'])


def _section(key: str, camera: Camera) -> str:
    matrix = camera.matrix - np.array([[0, 0, WHOLE_PIXELS], [0, 0, WHOLE_PIXELS], [0, 0, 0]])
    distortion = camera.distortion
    if camera.lens == "fisheye" and not len(distortion):
        distortion = np.zeros(4)  # OpenCV requires four coefficients of a fisheye lens
    values = {
        "name": json.dumps(camera.name, ensure_ascii=False).replace("\x7f", "\\u007f"),
        "size": _list(camera.size_px or ()),
        "matrix": f"[{', '.join(map(_list, matrix.tolist()))}]",
        "distortions": _list(distortion.tolist()),
        "rotation": _list(Rotation.from_matrix(camera.R_cam_world).as_rotvec().tolist()),
        "translation": _list(camera.transl_cam.tolist()),
    }
    if camera.lens == "fisheye":
        values["fisheye"] = "true"
    return "\n".join([f"[{key}]", *(f"{name} = {value}" for name, value in values.items()), ""])


def _list(values: Sequence[float]) -> str:
    return f"[{', '.join(map(repr, values))}]"
