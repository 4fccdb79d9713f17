"""Files of SLEAP: skeletons, tracks and videos of a project, labels and predictions, analysis files.

An HDF5 file with the tables `frames`, `instances`, `points` (labels) and `pred_points` (predictions), and JSON texts
about skeletons, tracks and videos. In a frame, a label replaces the prediction that it was made from, and the
prediction of the same track. Points that SLEAP marks as not visible are missing.

Source: the layout is that of sleap-io 0.9, formats 1.0 to 1.9.

Analysis files of SLEAP (`.analysis.h5`): one dense array of tracks. The attribute `dims` names the axes of an array.
Files without this attribute have the axes track, xy, node, frame. The position of a frame in the array is its number.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.data.formats.fields import Field
from jaxfit.data.formats.hdf5 import Hdf5Group
from jaxfit.data.formats.keypoint_table import KeypointTable, check_table_size
from jaxfit.foundation.errors import InputError

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
    """Position in the list of videos."""
    number: int
    """Number in the name of the data set of a package, else `index`."""
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
    found = re.fullmatch(r"video(\d{1,9})/video", dataset) if isinstance(dataset, str) else None
    number = int(found[1]) if found else index
    if size is None and isinstance(dataset, str) and file is None:
        size = _embedded_size(root, dataset)
    if size is None or not all(type(side) is int and side > 0 for side in size):
        return Video(index, number, file, None, pictures)
    return Video(index, number, file, size, pictures)


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


_log = logging.getLogger(__name__)

_USER, _PREDICTED = 0, 1
_CERTAIN = 0.2
"""Least score of a point that SLEAP keeps by default. The scores of good points are lower than in DeepLabCut."""
_FRAMES = ("video", "frame_idx", "instance_id_start", "instance_id_end")
_INSTANCES = (
    *("instance_id", "instance_type", "skeleton", "track", "from_predicted"),
    *("point_id_start", "point_id_end"),
)
_LARGEST = 2.0**53


def read_sleap_project(root: Hdf5Group, path: Path, video: Path | None = None) -> KeypointTable:
    """Read a project file of SLEAP.

    Args:
        root: the root of the HDF5 file.
        path: the file, for messages.
        video: the video whose birds are read, if the file has labels of several videos.

    Raises:
        InputError: the file is damaged, holds birds with several skeletons, or birds of several videos of which
            `video` is none.
    """
    frames = _integers(root, "frames", _FRAMES)
    instances = _integers(root, "instances", _INSTANCES)
    instances["score"] = root.columns("instances", {"score": "iuf"})["score"].astype(np.float64)
    instances["frame"] = _frame_of_instance(root, frames, len(instances["track"]))
    videos = read_videos(root)
    frames["video"] = _positions(frames["video"], videos)
    chosen = _choose_video(frames, instances["frame"], videos, path, video)
    rows = np.flatnonzero(frames["video"] == chosen.index)
    position = np.full(len(frames["video"]) + 1, -1)  # the last entry serves instances without a frame
    position[rows] = np.arange(len(rows))
    instances["frame"] = position[instances["frame"]]
    instances = _select(instances, instances["frame"] >= 0)
    skeleton = _skeleton(root, instances, path)
    instances = _without_replaced(instances, path)
    birds, names = _birds(instances, read_track_names(root), path)
    K = len(skeleton.names)
    check_table_size(path, len(names), len(rows), K)
    keypoints = np.full((len(names), len(rows), K, 2), np.nan, np.float32)
    confidence = np.ones((len(names), len(rows), K), np.float32)
    score = np.ones((len(names), len(rows)), np.float32)
    version = root.group("metadata").attribute("format_id")
    # before format 1.1, positions count from the corner of the first pixel instead of its centre
    shift = 0.5 if isinstance(version, float) and version < 1.1 else 0.0
    for kind, name in ((_USER, "points"), (_PREDICTED, "pred_points")):
        at = np.flatnonzero(instances["instance_type"] == kind)
        if not len(at):
            continue
        types = {"x": "f", "y": "f", "visible": "b"} | ({"score": "f"} if kind == _PREDICTED else {})
        points = root.columns(name, types)
        index = _point_rows(root, name, _select(instances, at), len(points["x"]), K)
        xy = np.stack([points["x"], points["y"]], -1)[index] - shift
        xy[~points["visible"][index]] = np.nan
        cell = birds[at], instances["frame"][at]
        keypoints[cell] = xy
        if kind == _PREDICTED:
            confidence[cell] = points["score"][index]
            score[cell] = instances["score"][at]
    numbers = frames["frame_idx"][rows]
    return KeypointTable(
        skeleton.names,
        names,
        keypoints,
        confidence,
        frame_index=numbers if chosen.pictures is None else None,
        pictures=None if chosen.pictures is None else _pictures_of_frames(chosen.pictures, numbers, path),
        score=score,
        skeleton=skeleton.edges,
        size_px=chosen.size_px,
        video=chosen.file,
        certain=_CERTAIN,
    )


def _integers(root: Hdf5Group, name: str, columns: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return columns of whole numbers; some programs write them as floating-point numbers."""
    values = {}
    for column, array in root.columns(name, dict.fromkeys(columns, "iuf")).items():
        exact = array.astype(np.float64)
        if not (np.abs(exact) < _LARGEST).all() or (exact != np.round(exact)).any():
            root.fail(name, f"holds a number in the column {column} that is not whole or is too large")
        values[column] = exact.astype(np.int64)
    return values


def _select(columns: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    return {name: array[rows] for name, array in columns.items()}


def _frame_of_instance(root: Hdf5Group, frames: dict[str, np.ndarray], count: int) -> np.ndarray:
    """Return the row of the frame of every instance; −1 for an instance that no frame lists."""
    first, last = frames["instance_id_start"], frames["instance_id_end"]
    if ((first < 0) | (last < first) | (last > count)).any() or (last - first).sum() > count:
        root.fail("frames", f"lists instances that are not among the {count} instances")
    frame = np.full(count, -1)
    for row in np.flatnonzero(last > first).tolist():
        frame[first[row] : last[row]] = row
    return frame


def _positions(ids: np.ndarray, videos: Sequence[Video]) -> np.ndarray:
    """Return the positions of the videos of frames, which packages may name by the numbers of their data sets."""
    position, named = {each.number: each.index for each in videos}, np.unique(ids).tolist()
    if named == list(range(len(videos))) or not position.keys() >= set(named):
        return ids  # they are positions
    return np.array([position[number] for number in ids.tolist()], ids.dtype)


def _choose_video(
    frames: dict[str, np.ndarray], frame_of_instance: np.ndarray, videos: list[Video], path: Path, video: Path | None
) -> Video:
    used = np.unique(frames["video"][frame_of_instance[frame_of_instance >= 0]]).tolist()
    if not used:
        raise InputError(path, "holds no labels and no predictions", "choose another file")
    found = [each for each in videos if each.index in used]
    if len(found) < len(used):
        raise InputError(path, f"has birds in a video that is not among its {len(videos)} videos", "save it again")
    if len(found) > 1:
        named = [each for each in found if video is not None and each.name == video.name]
        if len(named) != 1:
            names = ", ".join(each.name for each in found)
            raise InputError(path, f"holds birds of {len(found)} videos: {names}", "give one of them by --video")
        return named[0]
    return found[0]


def _pictures_of_frames(pictures: tuple[str, ...], numbers: np.ndarray, path: Path) -> tuple[str, ...]:
    """Return the pictures of frames, whose numbers are positions in the list of pictures.

    Pictures of one folder are named without the folder, because SLEAP stores long absolute paths.
    """
    wrong = numbers[(numbers < 0) | (numbers >= len(pictures))]
    if len(wrong):
        problem = f"has frame {wrong[0]}, but its video is a list of {len(pictures)} pictures, counted from 0"
        raise InputError(path, problem, "save the file again")
    named = [pictures[number].replace("\\", "/").rpartition("/") for number in numbers.tolist()]
    one_folder = len({folder for folder, _, _ in named}) == 1
    return tuple(name if one_folder else folder + slash + name for folder, slash, name in named)


def _skeleton(root: Hdf5Group, instances: dict[str, np.ndarray], path: Path) -> Skeleton:
    skeletons = read_skeletons(root)
    used = np.unique(instances["skeleton"]).tolist()
    if len(used) > 1:
        names = ", ".join(skeletons[i].name if 0 <= i < len(skeletons) else str(i) for i in used)
        problem = f"holds birds with {len(used)} skeletons: {names}"
        raise InputError(path, problem, "save the birds of each skeleton in a file of their own")
    if not 0 <= used[0] < len(skeletons):
        root.fail("instances", f"names skeleton {used[0]}, but the file has {len(skeletons)} skeletons")
    return skeletons[used[0]]


def _without_replaced(instances: dict[str, np.ndarray], path: Path) -> dict[str, np.ndarray]:
    """Return the instances without replaced predictions, with one instance for every track in every frame."""
    user = instances["instance_type"] == _USER
    replaced = np.isin(instances["instance_id"], instances["from_predicted"][user]) & ~user
    instances = _select(instances, ~replaced)
    # labels first, then predictions by their score
    score = np.nan_to_num(instances["score"])
    order = np.lexsort([-score, instances["instance_type"]])
    instances = _select(instances, order)
    tracked = instances["track"] >= 0
    pairs = np.stack([instances["track"], instances["frame"]], 1)
    first = np.zeros(len(pairs), bool)
    first[np.unique(pairs, axis=0, return_index=True)[1]] = True
    both_predicted = tracked & ~first & (instances["instance_type"] == _PREDICTED)
    kinds = dict(zip(map(tuple, pairs[first].tolist()), instances["instance_type"][first].tolist(), strict=True))
    twice = sum(kinds[tuple(pair)] == _PREDICTED for pair in pairs[both_predicted].tolist())
    twice += int((tracked & ~first & (instances["instance_type"] == _USER)).sum())
    if twice:
        _log.warning("%s: %d birds share a frame and a track with another bird and are skipped", path, twice)
    return _select(instances, first | ~tracked)


def _birds(instances: dict[str, np.ndarray], tracks: list[str], path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the bird of every instance and the names of the birds.

    Instances without a track are one bird if no frame holds two of them; otherwise every one is a bird of its own.
    """
    track = instances["track"]
    used = np.unique(track[track >= 0])
    if len(used) and used[-1] >= len(tracks):
        raise InputError(path, f"names track {used[-1]}, but has {len(tracks)} tracks", "save the file again")
    names = [tracks[i] or f"track {i}" for i in used.tolist()]
    bird = np.searchsorted(used, track)
    loose = np.flatnonzero(track < 0)
    if len(loose):
        alone = len(np.unique(instances["frame"][loose])) == len(loose)
        bird[loose] = len(names) + (0 if alone else np.arange(len(loose)))
        names += ["bird"] if alone else [f"untracked {i + 1}" for i in range(len(loose))]
        if not alone:
            _log.warning("%s: %d birds without a track; every one becomes a track of its own", path, len(loose))
    return bird, tuple(names)


def _point_rows(
    root: Hdf5Group, name: str, instances: dict[str, np.ndarray], points: int, keypoints: int
) -> np.ndarray:
    """Return the (instances, K) rows of the points of some instances."""
    first, last = instances["point_id_start"], instances["point_id_end"]
    if ((first < 0) | (last > points) | (last - first != keypoints)).any():
        root.fail("instances", f"lists points that are not {keypoints} of the {points} rows of {name}")
    return first[:, None] + np.arange(keypoints)


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
    skeleton = _analysis_edges(root, count) if "edge_inds" in root else ()
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
        certain=_CERTAIN,
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


def _analysis_edges(root: Hdf5Group, keypoints: int) -> tuple[tuple[int, int], ...]:
    edges = root.array("edge_inds", "iuf")  # SLEAP writes an empty list as floating-point numbers
    if not edges.size:
        return ()
    edges = edges.astype(np.int64)
    if edges.ndim != 2 or edges.shape[1] != 2 or edges.min() < 0 or edges.max() >= keypoints:
        root.fail("edge_inds", f"does not hold pairs of the {keypoints} keypoints")
    return tuple((int(a), int(b)) for a, b in edges.tolist())
