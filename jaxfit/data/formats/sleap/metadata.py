"""Skeletons, tracks and videos of a SLEAP project file, which are JSON texts inside the HDF5 file."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from jaxfit.data.formats.fields import Field
from jaxfit.data.formats.hdf5 import Hdf5Group

__all__ = ["Skeleton", "Video", "read_skeletons", "read_track_names", "read_videos"]

_BODY_EDGE = 1
"""Type of an edge between neighbouring keypoints; the other type joins left and right keypoints."""


class Skeleton(NamedTuple):
    """Keypoints of an animal."""

    name: str
    names: tuple[str, ...]
    """Names of the keypoints."""
    edges: tuple[tuple[int, int], ...]
    """Pairs of keypoints that drawings connect."""


class Video(NamedTuple):
    """A video of a project."""

    index: int
    file: str | None
    """Path as SLEAP stores it; None for pictures inside the project file."""
    size_px: tuple[int, int] | None
    """Width and height, if the project stores them."""
    pictures: tuple[str, ...] | None = None
    """Paths of the pictures of a video that is a list of pictures; None for a video file."""

    @property
    def name(self) -> str:
        """The file name without folders."""
        return (self.file or f"video {self.index}").replace("\\", "/").rsplit("/", 1)[-1]


def read_skeletons(root: Hdf5Group) -> list[Skeleton]:
    """Return the skeletons of a project.

    Raises:
        InputError: a skeleton is damaged.
    """
    content = root.group("metadata").attribute("json")
    text = content.decode("utf-8", "replace") if isinstance(content, bytes) else ""
    metadata = _json(root, text, "metadata/json")
    nodes = [node["name"].text() for node in metadata["nodes"]]
    skeletons = []
    for skeleton in metadata["skeletons"]:
        graph = skeleton["nx_graph"] if "nx_graph" in skeleton else skeleton  # noqa: SIM401 - a Field has no `get`
        ids = [node["id"].integer(0, len(nodes) - 1) for node in graph["nodes"]]
        if len(set(ids)) < len(ids):
            graph["nodes"].fail("holds a node twice", "save the file again")
        name = graph["graph"]["name"] if "graph" in graph and "name" in graph["graph"] else None
        text = str(name.value) if name is not None else f"skeleton {len(skeletons)}"
        skeletons.append(Skeleton(text, tuple(nodes[i] for i in ids), _edges(graph, ids)))
    return skeletons


def _edges(graph: Field, ids: list[int]) -> tuple[tuple[int, int], ...]:
    """Return the pairs of neighbouring keypoints; links of unknown form are skipped, because only drawings use them."""
    known: dict[int, Any] = {}
    place = {node: i for i, node in enumerate(ids)}
    edges: list[Any] = []
    for link in graph["links"] if "links" in graph else ():  # noqa: SIM401 - a Field has no `get`
        if "type" not in link or not isinstance(link["type"].value, dict):
            continue
        kind = link["type"].value
        if "py/reduce" in kind:
            try:
                value = kind["py/reduce"][1]["py/tuple"][0]
            except (LookupError, TypeError):
                continue
            known[len(known) + 1] = value
        else:
            value = known.get(kind["py/id"], kind["py/id"]) if _is_id(kind.get("py/id")) else None
        ends = [place.get(link[end].value) for end in ("source", "target") if end in link and _is_id(link[end].value)]
        if value == _BODY_EDGE and len(ends) == 2 and None not in ends:
            edges.append((ends[0], ends[1]))
    return tuple(edges)


def _is_id(value: Any) -> bool:
    return type(value) is int


def read_track_names(root: Hdf5Group) -> list[str]:
    """Return the names of the tracks of a project.

    Raises:
        InputError: a track is damaged.
    """
    names = []
    for i, text in enumerate(root.texts("tracks_json") if "tracks_json" in root else []):
        track = _json(root, text, f"tracks_json[{i}]").value
        name = track[1] if isinstance(track, list) and len(track) > 1 else None
        names.append(name if isinstance(name, str) else f"track {i}")
    return names


def read_videos(root: Hdf5Group) -> list[Video]:
    """Return the videos of a project.

    Raises:
        InputError: a video is damaged.
    """
    return [_video(root, i, _json(root, text, f"videos_json[{i}]")) for i, text in enumerate(root.texts("videos_json"))]


def _video(root: Hdf5Group, index: int, entry: Field) -> Video:
    backend = entry["backend"]
    file = next(
        (each["filename"].value for each in (backend, entry) if "filename" in each),
        None,
    )
    pictures = _pictures(backend) or _pictures(entry)
    file = file if isinstance(file, str) and file != "." else None
    shape = backend["shape"].value if "shape" in backend else None
    size = (shape[2], shape[1]) if isinstance(shape, list) and len(shape) == 4 else None
    if size is None and "width_" in backend and "height_" in backend:
        size = backend["width_"].value, backend["height_"].value
    dataset = backend["dataset"].value if "dataset" in backend else None
    if size is None and isinstance(dataset, str) and file is None:
        size = _embedded_size(root, dataset)
    if size is None or not all(type(side) is int and side > 0 for side in size):
        return Video(index, file, None, pictures)
    return Video(index, file, size, pictures)


def _pictures(entry: Field) -> tuple[str, ...] | None:
    """Return the paths of pictures, which stand in `filenames` or, as a list, in `filename`."""
    for key in ("filenames", "filename"):
        value = entry[key].value if key in entry else None
        if isinstance(value, list) and value:
            return tuple(path.text() for path in entry[key])
    return None


def _embedded_size(root: Hdf5Group, dataset: str) -> Any:
    """Return width and height of pictures inside the project file, such as `video0/video`."""
    folder, _, name = dataset.partition("/")
    if not name or folder not in root or not root.is_group(folder) or name not in root.group(folder):
        return None
    sides = [root.group(folder).attribute(side, name) for side in ("width", "height")]
    return tuple(int(side) for side in sides if isinstance(side, float) and 0 < side < 1e9) if all(sides) else None


def _json(root: Hdf5Group, text: str, label: str) -> Field:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        root.fail(label, "is not valid JSON")
    return Field(root.source, label, value)
