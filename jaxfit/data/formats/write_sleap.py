"""Project files of SLEAP (`.slp`) with predictions on pictures or on a video, for correction in SLEAP.

SLEAP shows a prediction, and a double click turns the prediction into a label. Every picture is also a suggestion, so
that SLEAP lists the pictures without a bird too. SLEAP has no place for hidden keypoints, boxes and masks.

Source: the layout is that of sleap-io 0.9, format 1.2.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np

from jaxfit.data.observations import Observations
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.files import write_whole

_FORMAT = 1.2
_PREDICTED = 1
_FRAME = [("frame_id", "u8"), ("video", "u4"), ("frame_idx", "u8")]
_FRAME += [("instance_id_start", "u8"), ("instance_id_end", "u8")]
_INSTANCE = [("instance_id", "i8"), ("instance_type", "u1"), ("frame_id", "u8"), ("skeleton", "u4"), ("track", "i4")]
_INSTANCE += [("from_predicted", "i8"), ("score", "f4"), ("point_id_start", "u8"), ("point_id_end", "u8")]
_INSTANCE += [("tracking_score", "f4")]
_POINT = [("x", "f8"), ("y", "f8"), ("visible", "?"), ("complete", "?")]


def write_sleap_project(observations: Observations, footage: Sequence[str] | str, path: str | Path) -> None:
    """Write observations as the predictions of a SLEAP project.

    Args:
        observations: the predictions; tracks without a bird are left out.
        footage: T paths of the pictures of the frames, all of one size; or the path of a video, in which a frame has
            its number. SLEAP looks for relative paths in the folder where it was started.
        path: the file; an existing file is replaced.

    Raises:
        InputError: the extra `formats` is not installed, or the file cannot be written.
    """
    require_extra("formats", str(path), "h5py")
    import h5py

    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        on_video = isinstance(footage, str)
        for name, table in _tables(observations, on_video).items():
            file[name] = table
        kept = observations.present.any(1)
        texts = {
            "videos_json": [_video(observations, footage) if on_video else _pictures(observations, footage)],
            "tracks_json": [[0, f"bird {track}"] for track in observations.track_id[kept].tolist()],
            "suggestions_json": [
                {"video": "0", "frame_idx": t, "group": 0} for t in range(0 if on_video else len(footage))
            ],
            "sessions_json": [],
        }
        for name, values in texts.items():
            data = np.array([json.dumps(value) for value in values], dtype=object)
            file.create_dataset(name, data=data, dtype=h5py.string_dtype())
        group = file.create_group("metadata")
        group.attrs["format_id"] = np.float64(_FORMAT)
        group.attrs["json"] = np.bytes_(json.dumps(_metadata(observations)).encode())
    write_whole(path, content.getvalue())


def _tables(observations: Observations, on_video: bool) -> dict[str, np.ndarray]:
    """Return the tables of frames, instances and points. Frames of a video have their numbers, pictures are counted."""
    T, K = observations.num_frames, observations.num_keypoints
    row = np.cumsum(observations.present.any(1)) - 1  # the track of SLEAP
    t, n = np.nonzero(observations.present.T)  # frame by frame
    ends = np.cumsum(observations.present.sum(0))
    frames = np.zeros(T, _FRAME)
    frames["frame_id"] = np.arange(T)
    frames["frame_idx"] = observations.frame_index if on_video else np.arange(T)
    frames["instance_id_start"], frames["instance_id_end"] = ends - observations.present.sum(0), ends
    instances = np.zeros(len(n), _INSTANCE)
    instances["instance_id"], instances["instance_type"] = np.arange(len(n)), _PREDICTED
    instances["frame_id"], instances["track"], instances["from_predicted"] = t, row[n], -1
    instances["score"] = cast(np.ndarray, observations.score)[n, t]
    instances["point_id_start"] = np.arange(len(n)) * K
    instances["point_id_end"] = instances["point_id_start"] + K
    points = np.zeros(len(n) * K, [*_POINT, ("score", "f8")])
    confidence = observations.confidence[n, t].reshape(-1)
    known = confidence > 0
    points["x"], points["y"] = np.where(known, observations.keypoints_px[n, t].reshape(-1, 2).T, np.nan)
    points["visible"], points["score"] = known, confidence
    return {"frames": frames, "instances": instances, "points": np.zeros(0, _POINT), "pred_points": points}


def _video(observations: Observations, video: str) -> dict:
    width, height = observations.image_size_px[0].tolist()
    shape = [int(observations.frame_index[-1]) + 1, height, width, 3]
    backend = {"type": "MediaVideo", "shape": shape, "filename": video, "grayscale": False, "bgr": True}
    return {"filename": video, "backend": backend | {"dataset": "", "input_format": ""}}


def _pictures(observations: Observations, pictures: Sequence[str]) -> dict:
    width, height = observations.image_size_px[0].tolist()
    shape = [len(pictures), height, width, 3]
    backend = {"type": "ImageVideo", "shape": shape, "filename": pictures[0], "filenames": list(pictures)}
    backend |= {"height_": height, "width_": width, "channels_": 3, "grayscale": False}
    return {"filename": list(pictures), "backend": backend}


def _metadata(observations: Observations) -> dict:
    """Return the skeleton, with types of edges as jsonpickle writes them: the first in full, others by its number."""
    first = {"py/reduce": [{"py/type": "sleap.skeleton.EdgeType"}, {"py/tuple": [1]}]}
    links = [
        {"edge_insert_idx": i, "key": 0, "source": a, "target": b, "type": {"py/id": 1} if i else first}
        for i, (a, b) in enumerate(observations.skeleton)
    ]
    graph = {"name": "bird", "num_edges_inserted": len(links)}
    nodes = [{"id": k} for k in range(observations.num_keypoints)]
    skeleton = {"directed": True, "graph": graph, "links": links, "multigraph": True, "nodes": nodes}
    names = [{"name": name, "weight": 1.0} for name in observations.keypoint_names]
    empty = {"videos": [], "tracks": [], "suggestions": [], "negative_anchors": {}, "provenance": {}}
    return {"version": "2.0.0", "skeletons": [skeleton], "nodes": names, **empty}
