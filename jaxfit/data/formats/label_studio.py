"""Tasks of Label Studio: written with predictions for correction, and read after the export as JSON.

A task is a picture. A bird is a rectangle with the label `bird`, and its keypoints are key points with the names of the
keypoints as labels. `parentID` of a key point names its rectangle. Positions are percentages of the picture. Label
Studio keeps `meta.text` of a rectangle, which names the track, and the keys of `data`, which hold the names of all
keypoints and the number of the frame. Label Studio has no place for hidden keypoints.

The export as COCO is read too (`coco_exports`), but Label Studio rounds its positions to whole pixels.

Source: https://labelstud.io/guide/task_format, https://labelstud.io/tags/keypointlabels.
"""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote
from xml.sax.saxutils import quoteattr

import numpy as np

from jaxfit.data.formats.keypoint_table import KeypointTable, check_table_size
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole

_log = logging.getLogger(__name__)

_BIRD, _IMAGE = "bird", "image"


def write_label_studio(
    observations: Observations, urls: Sequence[str], tasks: str | Path, config: str | Path, model: str = "jaxfit"
) -> None:
    """Write observations as tasks with predictions, and the labelling configuration that the tasks need.

    Args:
        observations: the predictions.
        urls: T addresses of the pictures of the frames, as Label Studio shall fetch them.
        tasks: JSON file to write, for the import of Label Studio.
        config: XML file to write, for the labelling interface of Label Studio.
        model: name of the predictions in Label Studio.

    Raises:
        InputError: a file cannot be written.
    """
    names = list(observations.keypoint_names)
    content = []
    for t, url in enumerate(urls):
        width, height = observations.image_size_px[t].tolist()
        data = {_IMAGE: url, "frame": int(observations.frame_index[t]), "width": width, "height": height}
        present = np.flatnonzero(observations.present[:, t]).tolist()
        results = [part for n in present for part in _results(observations, n, t)]
        prediction = {"model_version": model, "result": results}
        content.append({"data": data | {"keypoints": names}, "predictions": [prediction]})
    write_whole(tasks, json.dumps(content, allow_nan=False).encode())
    labels = "".join(
        f'    <Label value={quoteattr(name)} model_index="{k}" hint={quoteattr(name)}/>\n'
        for k, name in enumerate(names)
    )
    text = f"""<View>
  <Image name="{_IMAGE}" value="${_IMAGE}" zoom="true" zoomControl="true"/>
  <RectangleLabels name="birds" toName="{_IMAGE}">
    <Label value="{_BIRD}"/>
  </RectangleLabels>
  <KeyPointLabels name="keypoints" toName="{_IMAGE}" strokeWidth="4">
{labels}  </KeyPointLabels>
</View>
"""
    write_whole(config, text.encode())


def _results(observations: Observations, n: int, t: int) -> list[dict[str, Any]]:
    """Return the rectangle and the key points of a bird."""
    width, height = observations.image_size_px[t].tolist()
    track = int(observations.track_id[n])
    common = {"to_name": _IMAGE, "original_width": width, "original_height": height, "image_rotation": 0}
    x, y, w, h = observations.box_px[n, t].astype(np.float64).tolist()
    place = {"x": x / width * 100, "y": y / height * 100, "width": w / width * 100, "height": h / height * 100}
    bird = f"bird{track}frame{observations.frame_index[t]}"
    rectangle = {"id": bird, "type": "rectanglelabels", "from_name": "birds", "meta": {"text": [f"track {track}"]}}
    rectangle |= {"value": place | {"rotation": 0, "rectanglelabels": [_BIRD]}}
    results = [rectangle | common | {"score": float(cast(np.ndarray, observations.score)[n, t])}]
    points = observations.keypoints_px[n, t].astype(np.float64)
    for k in np.flatnonzero(observations.confidence[n, t] > 0).tolist():
        x, y = (points[k] / (width, height) * 100).tolist()
        value = {"x": x, "y": y, "width": 0.5, "keypointlabels": [observations.keypoint_names[k]]}
        point = {"id": f"{bird}point{k}", "parentID": bird, "type": "keypointlabels", "from_name": "keypoints"}
        results.append(point | {"value": value} | common | {"score": float(observations.confidence[n, t, k])})
    return results


def read_label_studio(tasks: Sequence[Mapping[str, Any]], source: Path) -> KeypointTable:
    """Return the keypoints of the tasks of a JSON file of Label Studio.

    The labels of a task are its last annotation that is not cancelled, or else its last prediction. The scores of
    predictions are confidences. A key point without a parent belongs to the smallest rectangle around the key point,
    and in a task without rectangles to the only bird. A task without labels is a frame without birds. A rectangle
    without the text `track N` is a bird of its own.

    sleap-io 0.9 does not replace this reader: its reader needs the key `meta.video`, which only its own files have.

    Args:
        tasks: the content of the file.
        source: the file, for messages.

    Raises:
        InputError: pictures of several sizes, a keypoint or a track twice, or no bird.
        LookupError, TypeError: the content is not that of Label Studio.
    """
    pictures = [_Picture(task) for task in tasks]
    stored = [name for task in tasks for name in task["data"].get("keypoints", ())]
    names = list(dict.fromkeys([*stored, *(name for p in pictures for bird in p.birds for name in bird.points)]))
    sizes = sorted({picture.size_px for picture in pictures if picture.size_px})
    if len(sizes) > 1:
        shown = " and ".join(f"{w}×{h}" for w, h in sizes[:2])
        raise InputError(source, f"has pictures of several sizes: {shown}", "export one project for every video")
    lost = sum(picture.lost for picture in pictures)
    if lost:
        _log.warning("%s: %d key points outside every rectangle belong to no bird and are skipped", source, lost)
    tracks = sorted({bird.track for p in pictures for bird in p.birds if bird.track is not None})
    untracked = [bird for picture in pictures for bird in picture.birds if bird.track is None]
    if not (tracks or untracked):
        raise InputError(source, "holds no bird", "label rectangles and key points, or choose another file")
    N, T, K = len(tracks) + len(untracked), len(pictures), len(names)
    check_table_size(source, N, T, K)
    keypoints, confidence = np.full((N, T, K, 2), np.nan, np.float32), np.zeros((N, T, K), np.float32)
    score = np.zeros((N, T), np.float32)
    following = len(tracks)
    for t, picture in enumerate(pictures):
        for bird in picture.birds:
            if bird.track is None:
                n, following = following, following + 1
            else:
                n = tracks.index(bird.track)
                if score[n, t]:
                    problem = f"holds track {bird.track} twice in {picture.name}"
                    raise InputError(source, problem, "remove one bird, or its text")
            score[n, t] = bird.score
            for name, (x, y, certainty) in bird.points.items():
                keypoints[n, t, names.index(name)] = x, y
                confidence[n, t, names.index(name)] = certainty
    return KeypointTable(
        tuple(names),
        (*(f"track {track}" for track in tracks), *(f"untracked {i + 1}" for i in range(len(untracked)))),
        keypoints,
        confidence,
        pictures=tuple(picture.name for picture in pictures),
        score=score,
        size_px=sizes[0] if sizes else None,
    )


@dataclass
class _Bird:
    """A rectangle and its key points."""

    track: int | None
    box: tuple[float, float, float, float]
    score: float
    points: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """Name → x, y, confidence."""


class _Picture:
    """The picture of a task and its birds."""

    def __init__(self, task: Mapping[str, Any]):
        data = task["data"]
        url = unquote(data[_IMAGE]).replace("\\", "/")
        self.name = url.rpartition("/")[2].rpartition("?d=")[2]
        self.size_px = (data["width"], data["height"]) if data.get("width") and data.get("height") else None
        self.lost = 0
        labels: list[Mapping[str, Any]] = []
        for kind in ("predictions", "annotations"):
            valid = [entry for entry in task.get(kind) or () if not entry.get("was_cancelled")]
            if valid:
                # labels of a person are certain, also where they keep the score of a prediction
                scored = kind == "predictions"
                labels = [part if scored else {**part, "score": 1.0} for part in valid[-1]["result"]]
        rectangles = {part["id"]: self._bird(part) for part in labels if part.get("type") == "rectanglelabels"}
        points = [part for part in labels if part.get("type") == "keypointlabels"]
        if points and not rectangles:  # the template `Keypoint Labeling` has no rectangles
            rectangles[None] = _Bird(None, (-math.inf, -math.inf, math.inf, math.inf), 1.0)
        for part in points:
            self._add_point(part, rectangles)
        self.birds = list(rectangles.values())

    def _bird(self, part: Mapping[str, Any]) -> _Bird:
        width, height = self._size_of(part)
        value = part["value"]
        sides = zip(("x", "y", "width", "height"), (width, height, width, height), strict=True)
        x, y, w, h = (value[name] * size / 100 for name, size in sides)
        texts = (part.get("meta") or {}).get("text") or ""
        track = re.fullmatch(r"track ([0-9]{1,15})", str(texts[0] if isinstance(texts, list) else texts))
        return _Bird(int(track[1]) if track else None, (x, y, w, h), float(part.get("score", 1.0)))

    def _add_point(self, part: Mapping[str, Any], birds: Mapping[Any, _Bird]) -> None:
        width, height = self._size_of(part)
        x, y = part["value"]["x"] * width / 100, part["value"]["y"] * height / 100
        names = part["value"].get("keypointlabels")
        around = [
            bird
            for bird in birds.values()
            if bird.box[0] <= x <= bird.box[0] + bird.box[2] and bird.box[1] <= y <= bird.box[1] + bird.box[3]
        ]
        bird = birds.get(part.get("parentID")) or min(
            around, key=lambda other: other.box[2] * other.box[3], default=None
        )
        if bird is None or not names:
            self.lost += 1
            return
        if names[0] in bird.points:
            raise ValueError(f"{names[0]} of a bird in {self.name} is labelled twice; remove one of the key points")
        bird.points[names[0]] = x, y, float(part.get("score", 1.0))

    def _size_of(self, part: Mapping[str, Any]) -> tuple[int, int]:
        stored = part["original_width"], part["original_height"]
        if self.size_px is not None and stored[0] != self.size_px[0]:
            raise ValueError(
                f"{self.name} is {self.size_px[0]} pixels wide, but a label says {stored[0]}; give Label Studio the "
                "pictures in the size that was written"
            )
        self.size_px = self.size_px or stored
        return self.size_px
