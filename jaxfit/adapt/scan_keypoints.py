"""Annotated 3D keypoints of a scan: vertex numbers or points in JSON, or points that MeshLab wrote (.pp)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from jaxfit.data.keypoint_names import propose_names
from jaxfit.errors import InputError
from jaxfit.limits import KEYPOINTS, KEYPOINTS_BYTES
from jaxfit.storage.json_file import parse_json
from jaxfit.storage.reading import read_text

__all__ = ["LEAST_KEYPOINTS", "read_scan_keypoints"]

LEAST_KEYPOINTS = 4
"""Fewer keypoints do not determine position, orientation and size, with a check of left and right."""


def read_scan_keypoints(
    path: str | Path, model_names: Sequence[str], numbered_vertices: Float[np.ndarray, "N 3"] | None
) -> tuple[dict[str, Float[np.ndarray, "3"]], tuple[str, ...]]:
    """Read the annotated keypoints of a scan.

    A JSON file is an object with the names of keypoints. A value is a vertex number (counted from 0, in the order of
    the scan's file) or a point [x, y, z] in the frame of the scan. Names are compared with those of the model by words.

    Args:
        path: a .json file, or a .pp file of MeshLab (picked points, whose names are those of the keypoints).
        model_names: names of the keypoints of the model.
        numbered_vertices: vertices of the scan in the order of its file; None if the scan has no such order.

    Returns:
        Name of the model → point, and the names of the file that the model lacks.

    Raises:
        InputError: the file cannot be read, a value is no vertex number and no point, or fewer than four keypoints of
            the model are given.
    """
    path = Path(path)
    text = read_text(path, KEYPOINTS_BYTES, "a file of keypoints")
    points = _picked_points(text, path) if path.suffix.lower() == ".pp" else _json_points(text, path, numbered_vertices)
    names = propose_names(list(points), model_names)
    if len(names.mapped) < LEAST_KEYPOINTS:
        problem = f"has {len(names.mapped)} keypoints of the model; a fit needs {LEAST_KEYPOINTS}"
        raise InputError(path, problem, f"the model has {', '.join(model_names)}")
    found = {model: points[own] for own, model in names.mapped.items()}
    spread = np.ptp(np.stack(list(found.values())), axis=0).max()
    if not spread > 0:
        raise InputError(path, "all keypoints are at one point", "annotate the keypoints again")
    return found, names.unmapped


def _json_points(text: str, path: Path, numbered: Float[np.ndarray, "N 3"] | None) -> dict[str, np.ndarray]:
    content = parse_json(text, path)
    if not isinstance(content, dict) or len(content) > KEYPOINTS:
        raise InputError(path, "is not an object of keypoints", 'write {"bill_tip": [x, y, z], "left_eye": 1234, …}')
    return {name: _json_point(name, value, path, numbered) for name, value in content.items()}


def _json_point(name: str, value: Any, path: Path, numbered: Float[np.ndarray, "N 3"] | None) -> np.ndarray:
    if isinstance(value, int) and not isinstance(value, bool):
        if numbered is None:
            problem = f"{name} is a vertex number, but the vertices of this scan have no fixed order"
            raise InputError(path, problem, "give points [x, y, z], or the scan as one mesh in .ply or .obj")
        if not 0 <= value < len(numbered):
            raise InputError(path, f"{name}: vertex {value} is outside 0…{len(numbered) - 1}", "count from 0")
        return numbered[value]
    return _point(name, value, path)


def _point(name: str, value: Any, path: Path) -> np.ndarray:
    try:
        point = np.array([float(number) for number in value], np.float64)
    except (TypeError, ValueError):
        point = np.zeros(0)
    if isinstance(value, str) or point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(path, f"{name} is not a point [x, y, z] and not a vertex number", "annotate it again")
    return point


def _picked_points(text: str, path: Path) -> dict[str, np.ndarray]:
    """Return the active points of a MeshLab file."""
    if "<!ENTITY" in text:  # entities can expand to any size
        raise InputError(path, "declares XML entities", "write the file with MeshLab")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(path, f"is not a file of picked points: {error}", "write the file with MeshLab") from None
    points: dict[str, np.ndarray] = {}
    for point in root.iter("point"):
        name = point.get("name", "")
        if point.get("active", "1") == "0":
            continue
        if not name or name in points:
            problem = f"has two points named {name}" if name else "has a point without a name"
            raise InputError(path, problem, "give every point the name of a keypoint in MeshLab")
        points[name] = _point(name, [point.get(axis) for axis in "xyz"], path)
    if len(points) > KEYPOINTS:
        raise InputError(path, f"has {len(points):,} points, more than {KEYPOINTS:,}", "pick keypoints only")
    return points
