"""Scans, and their annotated 3D keypoints: JSON, MeshLab."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree

import numpy as np
import trimesh
from jaxtyping import Float, Int

from jaxfit.data.keypoint_names import propose_names
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import read_json_file, reading

SCAN_FORMATS = (".ply", ".obj", ".stl", ".glb")
MAX_FACES = 150_000
"""Scans with more faces are decimated to about this number."""
MAX_COORDINATE = 1e9
"""Largest coordinate, in any unit: the areas of larger scans are not exact."""
MIN_PART = 0.01
"""Parts with a smaller share of the surface are skipped."""


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan: one triangle mesh in the unit and frame of its file."""

    vertices: Float[np.ndarray, "P 3"]
    faces: Int[np.ndarray, "Q 3"]
    numbered_vertices: Float[np.ndarray, "N 3"] | None
    """The vertices in the order of the file, for keypoints that are vertex numbers; None for formats and files without
    such an order (STL, several meshes)."""
    remarks: tuple[str, ...]
    """What was changed, one sentence each: skipped parts, decimation."""


def read_scan(path: str | Path) -> Scan:
    """Read a scan.

    Equal vertices are merged, and parts with less than 1 % of the surface are skipped. A scan of more than 150,000
    faces is decimated.

    Args:
        path: a .ply, .obj, .stl or .glb file.

    Raises:
        InputError: the file cannot be read, has another format or no faces, a face names an absent vertex, or
            coordinates are not finite or beyond `MAX_COORDINATE`.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in SCAN_FORMATS:
        raise InputError(path, f"has the suffix {kind or 'of no format'}", f"give a scan as {', '.join(SCAN_FORMATS)}")
    with reading(path, "a scan"):
        # bytes without a resolver: no textures or other files are read
        file = io.BytesIO(path.read_bytes())
        content = trimesh.load(file, file_type=kind[1:], process=False, maintain_order=True, skip_materials=True)
        parts = content.dump() if isinstance(content, trimesh.Scene) else [content]
        meshes = [part for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not meshes:
        raise InputError(path, "has no faces", "give a mesh, not a point cloud: reconstruct a surface first")
    for mesh in meshes:
        last, named = len(mesh.vertices) - 1, np.asarray(mesh.faces)
        if named.min() < 0 or named.max() > last:
            wrong = named.min() if named.min() < 0 else named.max()
            raise InputError(path, f"has a face that names vertex {wrong}, not 0…{last}", "write the scan again")
        if not (np.abs(mesh.vertices) <= MAX_COORDINATE).all():  # NaN too
            problem = f"has vertices that are not finite, or beyond {MAX_COORDINATE:g}"
            raise InputError(path, problem, "write the scan again")
    numbered = np.array(meshes[0].vertices, np.float64) if len(meshes) == 1 and kind != ".stl" else None
    bare = [trimesh.Trimesh(m.vertices, m.faces, process=False) for m in meshes]
    mesh = cast(trimesh.Trimesh, trimesh.util.concatenate(bare))
    if not mesh.area > 0:
        raise InputError(path, "has no area: all its faces are points or lines", "write the scan again")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    remarks, count = [], len(mesh.faces)
    if count > MAX_FACES:
        mesh = _decimated(mesh)
        remarks.append(f"{count:,} faces were decimated to {len(mesh.faces):,}")
    mesh, remark = _without_small_parts(mesh)
    remarks += [remark] if remark else []
    return Scan(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces), numbered, tuple(remarks))


def _decimated(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh with at most `MAX_FACES` faces: all vertices in one cell of a grid become one of them."""
    cell = np.sqrt(2 * mesh.area / MAX_FACES)
    while True:
        coarse = trimesh.Trimesh(np.asarray(mesh.vertices) / cell, mesh.faces, process=False)
        coarse.merge_vertices(digits_vertex=0)
        coarse.update_faces(coarse.nondegenerate_faces() & coarse.unique_faces())
        if len(coarse.faces) <= MAX_FACES:
            coarse.remove_unreferenced_vertices()
            coarse.vertices = np.asarray(coarse.vertices) * cell
            return coarse
        cell *= 1.3


def _without_small_parts(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, str]:
    """Return the mesh without parts of less than `MIN_PART` of the surface, and a remark about the parts."""
    label = trimesh.graph.connected_component_labels(mesh.edges, node_count=len(mesh.vertices))[mesh.faces[:, 0]]
    area = np.bincount(label, mesh.area_faces)
    share = area / area.sum()
    parts = np.flatnonzero(np.bincount(label) > 0)
    if len(parts) == 1:
        return mesh, ""
    kept = np.intersect1d(parts, np.flatnonzero(share >= MIN_PART))
    if not len(kept):
        return mesh, f"the scan has {len(parts):,} parts, all of them small; all are used"
    mesh.update_faces(np.isin(label, kept))
    mesh.remove_unreferenced_vertices()
    skipped = len(parts) - len(kept)
    remark = f"the scan has {len(parts):,} parts; the largest has {100 * share.max():.0f} % of the surface"
    if skipped:
        lost = 100 * (1 - share[kept].sum())
        remark += f"; {skipped:,} with less than 1 % each are skipped ({lost:.1f} % together)"
    return mesh, remark


MIN_KEYPOINTS = 4
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
    if path.suffix.lower() == ".pp":
        content = _picked_points(path)
    else:
        content = read_json_file(path)
        if not isinstance(content, dict):
            example = 'write {"bill_tip": [x, y, z], "left_eye": 1234, …}'
            raise InputError(path, "is not an object of keypoints", example)
    points = {name: _point(name, value, path, numbered_vertices) for name, value in content.items()}
    names = propose_names(list(points), model_names)
    if len(names.mapped) < MIN_KEYPOINTS:
        problem = f"has {len(names.mapped)} keypoints of the model; a fit needs {MIN_KEYPOINTS}"
        raise InputError(path, problem, f"the model has {', '.join(model_names)}")
    by_model = {model: points[name] for name, model in names.mapped.items()}
    if not np.ptp(np.stack(list(by_model.values())), axis=0).max() > 0:
        raise InputError(path, "all keypoints are at one point", "annotate the keypoints again")
    return by_model, names.unmapped


def _point(name: str, value: Any, path: Path, numbered: Float[np.ndarray, "N 3"] | None) -> np.ndarray:
    """Return the point of a value: a vertex number, or three coordinates."""
    if type(value) is int:
        if numbered is None:
            problem = f"{name} is a vertex number, but the vertices of this scan have no fixed order"
            raise InputError(path, problem, "give points [x, y, z], or the scan as one mesh in .ply or .obj")
        if not 0 <= value < len(numbered):
            raise InputError(path, f"{name}: vertex {value} is outside 0…{len(numbered) - 1}", "count from 0")
        return numbered[value]
    try:
        point = np.array(value, np.float64)
    except (TypeError, ValueError):
        point = np.zeros(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(path, f"{name} is not a point [x, y, z] and not a vertex number", "annotate it again")
    if np.abs(point).max() > MAX_COORDINATE:
        raise InputError(path, f"{name} is a point beyond {MAX_COORDINATE:g}", "annotate it again")
    return point


def _picked_points(path: Path) -> dict[str, list[str | None]]:
    """Return the active points of a MeshLab file."""
    with reading(path, "a file of picked points", "write the file with MeshLab"):
        picked = [point for point in ElementTree.parse(path).iter("point") if point.get("active", "1") != "0"]
    names = Counter(point.get("name", "") for point in picked)
    name, count = max(names.items(), key=lambda item: (not item[0], item[1]), default=("-", 1))
    if not name or count > 1:
        problem = f"has two points named {name}" if name else "has a point without a name"
        raise InputError(path, problem, "give every point the name of a keypoint in MeshLab")
    return {point.get("name", ""): [point.get(axis) for axis in "xyz"] for point in picked}
