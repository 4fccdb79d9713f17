"""Project files of SLEAP (`.slp`): labels of persons and predictions.

An HDF5 file with the tables `frames`, `instances`, `points` (labels) and `pred_points` (predictions), and JSON texts
about skeletons, tracks and videos. In a frame, a label replaces the prediction that it was made from, and the
prediction of the same track. Points that SLEAP marks as not visible are missing.

Source: the layout is that of sleap-io 0.9, formats 1.0 to 1.9.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from jaxfit.data.formats.hdf5 import Hdf5Group
from jaxfit.data.formats.keypoint_table import KeypointTable, check_table_size
from jaxfit.data.formats.sleap.metadata import Skeleton, Video, read_skeletons, read_track_names, read_videos
from jaxfit.errors import InputError

__all__ = ["read_sleap_project"]

_log = logging.getLogger(__name__)

_USER, _PREDICTED = 0, 1
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
    chosen = _choose_video(frames, instances["frame"], read_videos(root), path, video)
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
        pictures=None if chosen.pictures is None else _pictures(chosen.pictures, numbers, path),
        score=score,
        skeleton=skeleton.edges,
        size_px=chosen.size_px,
        video=chosen.file,
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


def _pictures(pictures: tuple[str, ...], numbers: np.ndarray, path: Path) -> tuple[str, ...]:
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
