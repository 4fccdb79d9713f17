"""Files of SLEAP, and files of other programs that sleap-io reads.

sleap-io reads projects of SLEAP (`.slp`), its analysis CSV, and AlphaTracker. The birds of the labels become a table of
keypoints: in a frame, a label of a person replaces the prediction that it was made from, and the prediction
of the same track. Points that are not visible are missing.

Analysis files of SLEAP (`.analysis.h5`) are read here, because sleap-io 0.9 rejects files without scores, which earlier
versions of SLEAP wrote. They hold dense arrays of tracks, frames, keypoints and coordinates. The attribute `dims` names
the axes of an array; files without this attribute have the axes track, xy, node, frame. The position of a frame in the
array is its number.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfit.data.formats.hdf5 import hdf5_text, open_hdf5
from jaxfit.data.formats.keypoint_table import KeypointTable, check_table_size
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.reading import reading

if TYPE_CHECKING:
    from sleap_io import Instance, LabeledFrame, Labels, Video

_log = logging.getLogger(__name__)

_CERTAIN = 0.2
"""Least score of a point that SLEAP keeps by default. The scores of good points are lower than in DeepLabCut."""
_AXES = ("track", "frame", "node", "xy")
_LEGACY_AXES = ("track", "xy", "node", "frame")


def read_with_sleap_io(
    path: Path, kind: str, load: Callable[[Any, str], Labels], video: Path | None = None
) -> KeypointTable:
    """Read a file by a function of sleap-io.

    Args:
        path: the file.
        kind: the kind of file with its article, for messages.
        load: returns the labels from the module sleap-io and the path.
        video: the video whose birds are read, if the file has birds of several videos.

    Raises:
        InputError: the extra `formats` is missing; the file is damaged, holds no birds, birds with several skeletons,
            or birds of several videos of which `video` is none.
    """
    require_extra("formats", str(path), "sleap-io")
    with reading(path, kind):
        import sleap_io

        return _labels_table(load(sleap_io, str(path)), path, video)


def read_sleap_project(path: Path, video: Path | None = None) -> KeypointTable:
    """Read a project of SLEAP; arguments and errors as `read_with_sleap_io`."""
    with open_hdf5(path, "a SLEAP project") as file:
        backends = [json.loads(text)["backend"] for text in file["videos_json"][()]]
    inside = [backend.get("dataset") for backend in backends if backend.get("filename") in (None, ".")]
    # Pictures inside the file are opened, because only they tell their size, and frames name them by the numbers of
    # their data sets. Other videos stay closed: the videos of merged packages share one name of a data set, for which
    # sleap-io 0.9 takes the last one.
    opened = bool(inside) and len(set(inside)) == len(inside)
    return read_with_sleap_io(path, "a SLEAP project", lambda sio, name: sio.load_slp(name, open_videos=opened), video)


def _labels_table(labels: Labels, path: Path, video: Path | None) -> KeypointTable:
    film = _chosen_video(labels, path, video)
    frames = [frame for frame in labels.labeled_frames if frame.video is film]
    skeletons = list({id(bird.skeleton): bird.skeleton for frame in frames for bird in frame.instances}.values())
    if len(skeletons) > 1:
        names = ", ".join(str(skeleton.name) for skeleton in skeletons)
        problem = f"holds birds with {len(skeletons)} skeletons: {names}"
        raise InputError(path, problem, "save the birds of each skeleton in a file of their own")
    (skeleton,) = skeletons
    birds = _without_replaced(frames, path)
    row, names = _rows(labels, birds, path)
    N, T, K = len(names), len(frames), len(skeleton.nodes)
    check_table_size(path, N, T, K)
    keypoints = np.full((N, T, K, 2), np.nan, np.float32)
    confidence, score = np.ones((N, T, K), np.float32), np.ones((N, T), np.float32)
    for n, (t, bird) in zip(row, birds, strict=True):
        keypoints[n, t] = np.where(bird.points["visible"][:, None], bird.points["xy"], np.nan)
        if hasattr(bird, "score"):  # a prediction
            confidence[n, t], score[n, t] = bird.points["score"], bird.score
    numbers = np.array([frame.frame_idx for frame in frames], np.int64)
    pictures = film.filename if isinstance(film.filename, list) else None
    shape = film.backend_metadata.get("shape") or film.shape
    return KeypointTable(
        tuple(skeleton.node_names),
        names,
        keypoints,
        confidence,
        frame_index=numbers if pictures is None else None,
        pictures=None if pictures is None else _pictures_of_frames(pictures, numbers, path),
        score=score,
        skeleton=tuple((int(a), int(b)) for a, b in skeleton.edge_inds),
        size_px=None if shape is None or not (shape[1] and shape[2]) else (int(shape[2]), int(shape[1])),
        video=_video_path(film, path),
        certain=_CERTAIN,
    )


def _video_path(video: Video, path: Path) -> str | None:
    """Return the path of a video; None for pictures inside the file itself."""
    name = video.filename[0] if isinstance(video.filename, list) else video.filename
    return None if name in ("", ".", str(path), path.as_posix()) else str(name)


def _chosen_video(labels: Labels, path: Path, video: Path | None) -> Video:
    """Return the video whose birds are read: the only one with birds, or the one with the name of `video`."""
    used = {id(frame.video) for frame in labels.labeled_frames if frame.instances}
    films = [film for film in labels.videos if id(film) in used]
    if not films:
        raise InputError(path, "holds no labels and no predictions", "choose another file")
    names = [
        (_video_path(film, path) or f"video {labels.videos.index(film)}").replace("\\", "/").rpartition("/")[2]
        for film in films
    ]
    if len(films) > 1:
        if video is None or names.count(video.name) != 1:
            problem = f"holds birds of {len(films)} videos: {', '.join(names)}"
            raise InputError(path, problem, "give one of them by --video")
        return films[names.index(video.name)]
    return films[0]


def _pictures_of_frames(pictures: list[Any], numbers: np.ndarray, path: Path) -> tuple[str, ...]:
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


def _without_replaced(frames: Sequence[LabeledFrame], path: Path) -> list[tuple[int, Instance]]:
    """Return position of the frame and bird, without replaced predictions, with one bird for every track in a frame.

    Labels come first, then predictions by their score.
    """
    kept: list[tuple[int, Instance]] = []
    skipped = 0
    for t, frame in enumerate(frames):
        predictions = sorted(frame.predicted_instances, key=lambda bird: -np.nan_to_num(bird.score))
        replaced = {id(label.from_predicted) for label in frame.user_instances}
        of_track: dict[int, Any] = {}
        for bird in (*frame.user_instances, *predictions):
            if id(bird) in replaced:
                continue
            first = of_track.setdefault(id(bird.track or bird), bird)
            if first is bird:
                kept.append((t, bird))
            else:
                skipped += type(first) is type(bird)  # a label that replaces a prediction needs no warning
    if skipped:
        _log.warning("%s: %d birds share a frame and a track with another bird and are skipped", path, skipped)
    return sorted(kept, key=lambda at: (hasattr(at[1], "score"), -np.nan_to_num(getattr(at[1], "score", 0.0))))


def _rows(labels: Labels, birds: Sequence[tuple[int, Instance]], path: Path) -> tuple[list[int], tuple[str, ...]]:
    """Return the row of every bird and the names of the rows.

    Birds without a track are one track if no frame holds two of them; otherwise every one is a track of its own.
    """
    used = {id(bird.track) for _, bird in birds}
    tracks = [track for track in labels.tracks if id(track) in used]
    names = [track.name or f"track {labels.tracks.index(track)}" for track in tracks]
    place = {id(track): n for n, track in enumerate(tracks)}
    loose = [t for t, bird in birds if bird.track is None]
    alone = len(set(loose)) == len(loose)
    if loose and not alone:
        _log.warning("%s: %d birds without a track; every one becomes a track of its own", path, len(loose))
    rows = []
    for _, bird in birds:
        if bird.track is not None:
            rows.append(place[id(bird.track)])
        else:
            rows.append(len(names))
            if not alone:
                names.append(f"untracked {len(names) - len(tracks) + 1}")
    return rows, (*names, *(["bird"] if loose and alone else []))


def read_sleap_analysis(file: Any, path: Path) -> KeypointTable:
    """Read an analysis file of SLEAP.

    Args:
        file: the open file.
        path: the file, for messages.

    Raises:
        InputError: the arrays do not agree.
    """
    keypoints = _ordered(file, "tracks", _LEGACY_AXES)
    birds, frames, count, _ = keypoints.shape
    names = [hdf5_text(name) for name in file["node_names"][()]]
    tracks = [hdf5_text(name) for name in file["track_names"][()]] if "track_names" in file else []
    check_table_size(path, birds, frames, count)
    confidence, score = None, None
    if "point_scores" in file:
        confidence = _ordered(file, "point_scores", [axis for axis in _LEGACY_AXES if axis != "xy"])
        # labels of a person have no score, and are certain
        confidence = np.where(np.isnan(confidence) & np.isfinite(keypoints).all(-1), 1, confidence)
    if "instance_scores" in file:
        score = _ordered(file, "instance_scores", ("track", "frame"))
    stored = json.loads(hdf5_text(file.attrs.get("video_backend_metadata", "{}"))).get("shape")
    edges = np.asarray(file["edge_inds"][()] if "edge_inds" in file else [], np.int64).reshape(-1, 2)
    return KeypointTable(
        tuple(names),
        tuple(tracks or (f"track {n}" for n in range(birds))),
        keypoints,
        confidence,
        frame_index=np.arange(frames),
        score=score,
        skeleton=tuple((int(a), int(b)) for a, b in edges),
        size_px=(stored[2], stored[1]) if stored else None,
        video=hdf5_text(file["video_path"][()]) or None if "video_path" in file else None,
        certain=_CERTAIN,
        rows_of_frames=True,  # SLEAP may leave out the frames before the first bird and after the last one
        video_frames=int(stored[0]) if stored and stored[0] else None,
    )


def _ordered(file: Any, name: str, legacy: Sequence[str]) -> np.ndarray:
    """Return an array with its axes in the order track, frame, node, xy."""
    stored = file[name].attrs.get("dims")
    axes = list(legacy) if stored is None else json.loads(hdf5_text(stored))
    return file[name][()].transpose([axes.index(axis) for axis in _AXES if axis in legacy]).astype(np.float32)
