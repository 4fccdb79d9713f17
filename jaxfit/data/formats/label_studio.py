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
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote
from xml.sax.saxutils import quoteattr

import numpy as np

from jaxfit.data.formats.fields import Field
from jaxfit.data.formats.keypoint_table import KeypointTable, check_table_size
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.limits import IMAGE_SIDE_PX

_log = logging.getLogger(__name__)

_BIRD, _IMAGE = "bird", "image"
_REMEDY = "export the project from Label Studio as JSON"


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


def read_label_studio(root: Field) -> KeypointTable:
    """Read the tasks of a JSON file of Label Studio.

    The labels of a task are its last annotation that is not cancelled, or else its last prediction. The scores of
    predictions are confidences. A key point without a parent belongs to the smallest rectangle around the key point. A
    task without labels is a frame without birds. A rectangle without the text `track N` is a bird of its own.

    Raises:
        InputError: the file is damaged, or is not a list of tasks.
    """
    if not len(root):
        root.fail("holds no task", _REMEDY)
    names: dict[str, None] = {}
    tasks = []
    for task in root:
        data = task["data"]
        for name in data["keypoints"] if data.has("keypoints") else ():
            names[name.text()] = None
        tasks.append(_Task(task, _labels(task)))
        names |= dict.fromkeys(name for bird in tasks[-1].birds for name in bird.points)
    sizes = {task.size_px for task in tasks if task.size_px}
    if len(sizes) > 1:
        shown = " and ".join(f"{w}×{h}" for w, h in sorted(sizes)[:2])
        raise InputError(root.source, f"has pictures of several sizes: {shown}", "export one project for every video")
    lost = sum(task.lost for task in tasks)
    if lost:
        _log.warning("%s: %d key points outside every rectangle belong to no bird and are skipped", root.source, lost)
    return _table(root, tasks, tuple(names), next(iter(sizes), None))


class _Bird:
    """A rectangle and its key points."""

    def __init__(self, track: int | None, box: tuple[float, float, float, float], score: float):
        self.track, self.box, self.score = track, box, score
        self.points: dict[str, tuple[float, float, float]] = {}

    def holds(self, x: float, y: float) -> bool:
        """Return whether a position lies in the rectangle."""
        left, top, width, height = self.box
        return 0 <= x - left <= width and 0 <= y - top <= height


class _Task:
    """The picture of a task and its birds."""

    def __init__(self, task: Field, labels: Field | None):
        data = task["data"]
        url = unquote(data[_IMAGE].text()).replace("\\", "/")
        self.picture = url.rpartition("/")[2].rpartition("?d=")[2]
        self.size_px: tuple[int, int] | None = None
        if data.has("width") and data.has("height"):
            self.size_px = _size(data, "width", "height")
        self.lost = 0
        self._predicted = labels is not None and labels.path.rpartition(".")[2].startswith("predictions")
        found: dict[int | str, _Bird] = {}
        results = list(labels["result"]) if labels is not None else []
        for result in results:
            if result.has("type") and result["type"].value == "rectanglelabels":
                found[result["id"].identifier()] = self._bird(result)
        for result in results:
            if result.has("type") and result["type"].value == "keypointlabels":
                self._add_point(result, found)
        self.birds = list(found.values())

    def _bird(self, result: Field) -> _Bird:
        width, height = self._size_of(result)
        value = result["value"]
        x, y, w, h = (value[key].number(-1e4, 1e4, "write percentages") for key in ("x", "y", "width", "height"))
        box = (x * width / 100, y * height / 100, w * width / 100, h * height / 100)
        texts = result["meta"]["text"].value if result.has("meta") and result["meta"].has("text") else None
        words = str(texts[0] if isinstance(texts, list) and texts else texts).split()
        numbered = len(words) == 2 and words[0] == "track" and words[1].isascii() and words[1].isdecimal()
        track = int(words[1]) if numbered and len(words[1]) < 16 else None
        return _Bird(track, box, self._score(result))

    def _add_point(self, result: Field, birds: dict[int | str, _Bird]) -> None:
        width, height = self._size_of(result)
        value = result["value"]
        x, y = (value[key].number(-1e4, 1e4, "write percentages") for key in ("x", "y"))
        x, y = x * width / 100, y * height / 100
        bird = birds.get(result["parentID"].identifier()) if result.has("parentID") else None
        around = [other for other in birds.values() if other.holds(x, y)]
        bird = bird or min(around, key=lambda other: other.box[2] * other.box[3], default=None)
        names = [name.text() for name in value["keypointlabels"]] if value.has("keypointlabels") else []
        if bird is None or not names:
            self.lost += 1
            return
        if names[0] in bird.points:
            result.fail(f"labels {names[0]} of a bird in {self.picture} twice", "remove one of the key points")
        bird.points[names[0]] = x, y, self._score(result)

    def _score(self, result: Field) -> float:
        """Return the score of a prediction; labels of a person are certain, also where they keep a score."""
        predicted = self._predicted and result.has("score")
        return result["score"].number(0, 1, "scale the scores to 0 to 1") if predicted else 1.0

    def _size_of(self, result: Field) -> tuple[int, int]:
        if self.size_px is None:
            self.size_px = _size(result, "original_width", "original_height")
        elif result.has("original_width") and result["original_width"].value != self.size_px[0]:
            problem = f"is {result['original_width'].value}, but {self.picture} is {self.size_px[0]} pixels wide"
            result["original_width"].fail(problem, "give Label Studio the pictures in the size that was written")
        return self.size_px


def _size(field: Field, width: str, height: str) -> tuple[int, int]:
    return field[width].integer(1, IMAGE_SIDE_PX), field[height].integer(1, IMAGE_SIDE_PX)


def _labels(task: Field) -> Field | None:
    """Return the annotation or prediction that holds the labels of a task."""
    for key in ("annotations", "predictions"):
        entries = list(task[key]) if task.has(key) else []
        entries = [entry for entry in entries if not (entry.has("was_cancelled") and entry["was_cancelled"].value)]
        if entries:
            return entries[-1]
    return None


def _table(root: Field, tasks: list[_Task], names: tuple[str, ...], size_px: tuple[int, int] | None) -> KeypointTable:
    """Return the table: birds with a track first, then every other bird as a track of its own."""
    tracks = sorted({bird.track for task in tasks for bird in task.birds if bird.track is not None})
    row = {track: n for n, track in enumerate(tracks)}
    loose = [bird for task in tasks for bird in task.birds if bird.track is None]
    N = len(tracks) + len(loose)
    if not N:
        root.fail("hold no bird", "label rectangles and key points, or choose another file")
    check_table_size(root.source, N, len(tasks), len(names))
    keypoints = np.full((N, len(tasks), len(names), 2), np.nan, np.float32)
    confidence, score = np.zeros(keypoints.shape[:-1], np.float32), np.zeros((N, len(tasks)), np.float32)
    column = {name: k for k, name in enumerate(names)}
    following = len(tracks)
    for t, task in enumerate(tasks):
        taken: set[int] = set()
        for bird in task.birds:
            n = following if bird.track is None else row[bird.track]
            following += bird.track is None
            if n in taken:
                root.fail(f"holds track {bird.track} twice in {task.picture}", "remove one bird, or its text")
            taken.add(n)
            score[n, t] = bird.score
            for name, (x, y, certainty) in bird.points.items():
                keypoints[n, t, column[name]] = x, y
                confidence[n, t, column[name]] = certainty
    birds = (*(f"track {track}" for track in tracks), *(f"untracked {i + 1}" for i in range(len(loose))))
    pictures = tuple(task.picture for task in tasks)
    return KeypointTable(names, birds, keypoints, confidence, pictures=pictures, score=score, size_px=size_px)
