"""Cameras of Kalibr: a `camchain.yaml` with `cam0`, `cam1`, … in metres.

A camera has `intrinsics` [fx, fy, cx, cy], `distortion_coeffs` and `resolution`. Its pose is `T_cam_imu`, or
`T_cn_cnm1` from the camera before. Without `T_cam_imu` of all cameras, the first camera is the world.

Source: Kalibr wiki, "Yaml formats" (camchain.yaml); avian-mesh, utils/extrinsic_calib_v2.yaml.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.cameras.camera import Camera, Lens
from jaxfit.cameras.formats.values import WHOLE_PIXELS, Parsed, fail, image_size, make_camera, numbers, parsed

_LENSES: dict[str, Lens] = {"radtan": "perspective", "plumb_bob": "perspective", "equidistant": "fisheye"}


def is_kalibr(content: dict[str, Any]) -> bool:
    """Return whether the content of a YAML file is that of Kalibr."""
    cameras = [value for value in content.values() if isinstance(value, dict)]
    return bool(cameras) and all({"camera_model", "intrinsics"} <= camera.keys() for camera in cameras)


def parse_kalibr(path: Path, content: dict[str, Any]) -> Parsed:
    """Return the cameras of Kalibr; their unit is the metre.

    Raises:
        InputError: a camera lacks a value, has an impossible value, or has another model than `pinhole`.
    """
    sections = {name: value for name, value in content.items() if isinstance(value, dict)}
    in_common = all("T_cam_imu" in section for section in sections.values())
    pose = np.eye(4)
    cameras: list[Camera] = []
    for name, section in sections.items():
        key = "T_cam_imu" if in_common else "T_cn_cnm1"
        if in_common or cameras:
            if key not in section:
                fail(path, name, f"lacks its pose, {key}", "calibrate all cameras of the chain together")
            own = numbers(path, f"{name}.{key}", section[key], (4, 4))
            pose = own if in_common else own @ pose
        cameras.append(_camera(path, name, section, pose))
    return parsed(path, cameras, "Kalibr", None, "m")


def _camera(path: Path, name: str, section: dict[str, Any], pose: np.ndarray) -> Camera:
    remedy = "calibrate with pinhole-radtan or pinhole-equi"
    if section["camera_model"] != "pinhole":
        fail(
            path, f"{name}.camera_model", f"is {section['camera_model']!r}, a model of Kalibr that is not read", remedy
        )
    model = section.get("distortion_model", "none")
    if model not in (*_LENSES, "none"):
        fail(path, f"{name}.distortion_model", f"is {model!r}, a model of Kalibr that is not read", remedy)
    fx, fy, cx, cy = numbers(path, f"{name}.intrinsics", section["intrinsics"], (4,))
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    given = section.get("distortion_coeffs", []) if model != "none" else []
    distortion = numbers(path, f"{name}.distortion_coeffs", given, (-1,))
    size = image_size(path, f"{name}.resolution", section.get("resolution", []))
    lens = _LENSES.get(model, "perspective")
    return make_camera(path, name, name, matrix, distortion, (pose[:3, :3], pose[:3, 3]), size, WHOLE_PIXELS, lens)
