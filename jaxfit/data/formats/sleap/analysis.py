"""Analysis files of SLEAP (`.analysis.h5`): one dense array of tracks.

The attribute `dims` names the axes of an array. Files without this attribute have the axes track, xy, node, frame. The
position of a frame in the array is its number.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxfit.data.formats.hdf5 import Hdf5Group
from jaxfit.data.formats.keypoint_table import KeypointTable, check_table_size

__all__ = ["read_sleap_analysis"]

_AXES = ("track", "frame", "node", "xy")
_LEGACY_AXES = ("track", "xy", "node", "frame")


def read_sleap_analysis(root: Hdf5Group, path: Path) -> KeypointTable:
    """Read an analysis file of SLEAP.

    Args:
        root: the root of the HDF5 file.
        path: the file, for messages.

    Raises:
        InputError: the file is damaged, or its arrays do not agree.
    """
    keypoints = _ordered(root, "tracks", _LEGACY_AXES)
    birds, frames, count, two = keypoints.shape
    if two != 2:
        root.fail("tracks", f"has {two} coordinates, not 2", "export the analysis file again")
    names = root.texts("node_names")
    if len(names) != count:
        root.fail("node_names", f"holds {len(names)} names for {count} keypoints")
    check_table_size(path, birds, frames, count)
    tracks = root.texts("track_names") if "track_names" in root else []
    if tracks and len(tracks) != birds:
        root.fail("track_names", f"holds {len(tracks)} names for {birds} tracks")
    confidence, score = None, None
    if "point_scores" in root:
        confidence = _ordered(root, "point_scores", [axis for axis in _LEGACY_AXES if axis != "xy"])
        # labels of a person have no score, and are certain
        confidence = np.where(np.isnan(confidence) & np.isfinite(keypoints).all(-1), 1, confidence)
    if "instance_scores" in root:
        score = _ordered(root, "instance_scores", ("track", "frame"))
    for name, array in (("point_scores", confidence), ("instance_scores", score)):
        if array is not None and array.shape != keypoints.shape[: array.ndim]:
            root.fail(name, "does not have the shape of tracks")
    video = root.texts("video_path")[:1] if "video_path" in root else []
    skeleton = _edges(root, count) if "edge_inds" in root else ()
    return KeypointTable(
        tuple(names),
        tuple(tracks or (f"track {i}" for i in range(birds))),
        keypoints,
        confidence,
        frame_index=np.arange(frames),
        score=score,
        skeleton=skeleton,
        size_px=_stored_size(root),
        video=(video or [""])[0] or None,
    )


def _ordered(root: Hdf5Group, name: str, legacy: Sequence[str]) -> np.ndarray:
    """Return an array with its axes in the order track, frame, node, xy."""
    array = root.array(name, "iuf", len(legacy))
    stored = root.attribute("dims", name)
    axes = list(legacy)
    if isinstance(stored, bytes):
        try:
            axes = json.loads(stored.decode("utf-8"))
        except (ValueError, RecursionError):
            axes = []
        if not isinstance(axes, list) or sorted(map(str, axes)) != sorted(legacy):
            root.fail(f"attribute dims of {name}", f"does not name the axes {', '.join(legacy)}")
    return array.transpose([axes.index(axis) for axis in _AXES if axis in legacy]).astype(np.float32)


def _stored_size(root: Hdf5Group) -> tuple[int, int] | None:
    """Return width and height of the video, if the file stores its shape (frames, height, width, channels)."""
    stored = root.attribute("video_backend_metadata")
    try:
        shape = json.loads(stored)["shape"] if isinstance(stored, bytes) else None
    except (ValueError, RecursionError, KeyError, TypeError):
        return None
    if not isinstance(shape, list) or len(shape) != 4 or not all(type(side) is int and side > 0 for side in shape):
        return None
    return shape[2], shape[1]


def _edges(root: Hdf5Group, keypoints: int) -> tuple[tuple[int, int], ...]:
    edges = root.array("edge_inds", "iuf")  # SLEAP writes an empty list as floating-point numbers
    if not edges.size:
        return ()
    edges = edges.astype(np.int64)
    if edges.ndim != 2 or edges.shape[1] != 2 or edges.min() < 0 or edges.max() >= keypoints:
        root.fail("edge_inds", f"does not hold pairs of the {keypoints} keypoints")
    return tuple((int(a), int(b)) for a, b in edges.tolist())
