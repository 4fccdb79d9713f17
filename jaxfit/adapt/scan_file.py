"""Reading of scans: triangle meshes of PLY, OBJ, STL and glTF files, cleaned and of a limited size."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import trimesh
from jaxtyping import Float, Int

from jaxfit.errors import InputError
from jaxfit.limits import SCAN_BYTES, SCAN_FACES
from jaxfit.storage.reading import check_readable, open_file

__all__ = ["SCAN_FORMATS", "Scan", "read_scan"]

SCAN_FORMATS = (".ply", ".obj", ".stl", ".glb")
MOST_FACES = 150_000
"""Scans with more faces are decimated to about this number."""
LEAST_PART = 0.01
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
        InputError: the file cannot be read, has another format or no faces, is larger than the limits, or has
            coordinates that are not finite.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in SCAN_FORMATS:
        raise InputError(path, f"has the suffix {kind or 'of no format'}", f"give a scan as {', '.join(SCAN_FORMATS)}")
    size = check_readable(path, "a scan").stat().st_size
    if size > SCAN_BYTES:
        raise InputError(path, f"has {size:,} bytes, more than {SCAN_BYTES:,}", "decimate the scan")
    meshes = _meshes(path, kind)
    if not meshes:
        raise InputError(path, "has no faces", "give a mesh, not a point cloud: reconstruct a surface first")
    count = sum(len(mesh.faces) for mesh in meshes)
    if count > SCAN_FACES:
        raise InputError(path, f"has {count:,} faces, more than {SCAN_FACES:,}", "decimate the scan")
    numbered = np.array(meshes[0].vertices, np.float64) if len(meshes) == 1 and kind != ".stl" else None
    bare = [trimesh.Trimesh(m.vertices, m.faces, process=False) for m in meshes]
    mesh = cast(trimesh.Trimesh, trimesh.util.concatenate(bare))
    if not np.isfinite(mesh.vertices).all():
        raise InputError(path, "has vertices that are not finite", "write the scan again")
    if not np.ptp(np.asarray(mesh.vertices), axis=0).max() > 0 or not mesh.area > 0:
        raise InputError(path, "has no area: all its faces are points or lines", "write the scan again")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    remarks = []
    if count > MOST_FACES:
        mesh = _decimated(mesh)
        remarks.append(f"{count:,} faces were decimated to {len(mesh.faces):,}")
    mesh, remark = _without_small_parts(mesh)
    remarks += [remark] if remark else []
    return Scan(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces), numbered, tuple(remarks))


def _meshes(path: Path, kind: str) -> list[trimesh.Trimesh]:
    """Return the meshes with faces of a file, in one frame."""
    with open_file(path, "a scan") as file:
        try:
            # bytes without a resolver: no textures or other files are read
            content = trimesh.load(
                io.BytesIO(file.read()), file_type=kind[1:], process=False, maintain_order=True, skip_materials=True
            )
        except MemoryError:
            raise
        except Exception as error:  # the readers raise errors of every kind
            raise InputError(path, f"cannot be read as {kind[1:].upper()}: {error}", "write the scan again") from None
    found = content.dump() if isinstance(content, trimesh.Scene) else [content]
    return [mesh for mesh in found if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]


def _decimated(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh with at most `MOST_FACES` faces: all vertices in one cell of a grid become one of them."""
    cell = np.sqrt(2 * mesh.area / MOST_FACES)
    while True:
        coarse = trimesh.Trimesh(np.asarray(mesh.vertices) / cell, mesh.faces, process=False)
        coarse.merge_vertices(digits_vertex=0)
        coarse.update_faces(coarse.nondegenerate_faces() & coarse.unique_faces())
        if len(coarse.faces) <= MOST_FACES:
            coarse.remove_unreferenced_vertices()
            coarse.vertices = np.asarray(coarse.vertices) * cell
            return coarse
        cell *= 1.3


def _without_small_parts(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, str]:
    """Return the mesh without parts of less than `LEAST_PART` of the surface, and a remark about the parts."""
    label = trimesh.graph.connected_component_labels(mesh.edges, node_count=len(mesh.vertices))[mesh.faces[:, 0]]
    area = np.bincount(label, mesh.area_faces)
    share = area / area.sum()
    parts = np.flatnonzero(np.bincount(label) > 0)
    if len(parts) == 1:
        return mesh, ""
    kept = np.intersect1d(parts, np.flatnonzero(share >= LEAST_PART))
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
