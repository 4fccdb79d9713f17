"""Images, categories and annotations of a COCO file, also of annotation programs (CVAT, Label Studio).

COCO keypoints as annotation programs export them: CVAT, Label Studio and others. These files lack the keys of video:
`frame_index` of images and `track_id` of annotations. `complete_export` adds both keys before the file is read:

- The name of a picture gives the number of its frame (`frame_000012.png` → 12), as `picture_names` describes. Other
  pictures are photographs: `frame_index` is 0, and every bird is a track of its own.
- CVAT stores the track in `attributes.track_id`, or in `attributes.bird` for the label that `cvat` writes. Birds
  without a track are one track if no picture holds two of them; otherwise every one is a track of its own.
- A bird without a box with an area has the box of its keypoints. Birds without a keypoint, which CVAT writes where a
  track is outside the picture, are removed.

A file without any track, also a file with `frame_index`, can be read in two more ways (`Untracked`): for training
labels, every annotation is a bird of its own; for a fit, every image is also a photograph of its own.
"""

from __future__ import annotations

import logging
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxfit.data.footage import FootageIdentity, footage_of
from jaxfit.data.formats.fields import Field
from jaxfit.data.formats.rle import read_segmentation
from jaxfit.data.masks import box_of_keypoints
from jaxfit.data.tracks import frame_numbers
from jaxfit.foundation.limits import FRAMES_PER_S, IMAGE_SIDE_PX, KEYPOINTS, SECONDS_PER_FRAME, TIMESTAMP_S

_TRACK_REMEDY = "give every annotation the track_id of its bird; for photographs, a unique number"
_FRAME_REMEDY = "give every image the number of its frame in the video; for photographs, 0"


@dataclass(frozen=True)
class Image:
    """An entry of ``images``; width and height in pixels."""

    frame_index: int
    width: int
    height: int
    file_name: str
    timestamp_s: float = field(default=math.nan, compare=False)
    """Presentation time in seconds; NaN if unknown."""


@dataclass(frozen=True)
class Annotation:
    """An entry of ``annotations``: one bird in one image."""

    label: str
    """Name in messages."""
    track_id: int
    image: Image
    keypoints: np.ndarray
    """(K, 4): x, y in image pixels, confidence, 1 where the keypoint is hidden."""
    box: list[float]
    """x, y, width, height in image pixels."""
    rle: dict[str, Any] | None
    """Run lengths of the mask."""
    amodal_rle: dict[str, Any] | None
    """Run lengths of the mask of the whole bird, including hidden parts."""
    score: float
    """Score of the detection of the bird."""


def read_images(images: Field) -> dict[int | str, Image]:
    """Return image id → image.

    Raises:
        InputError: an entry is invalid, or an id occurs twice.
    """
    found: dict[int | str, Image] = {}
    where: dict[int | str, str] = {}
    for image in images:
        name = image["id"].identifier()
        if name in found:
            image["id"].fail(f"is {name!r}, as {where[name]} is", "give every image an id of its own")
        if "frame_index" not in image:
            image.fail("lacks the key frame_index", _FRAME_REMEDY)
        where[name] = f"{image.path}.id"
        found[name] = Image(
            frame_index=image["frame_index"].integer(0),
            width=image["width"].integer(1, IMAGE_SIDE_PX),
            height=image["height"].integer(1, IMAGE_SIDE_PX),
            file_name=image["file_name"].text(),
            timestamp_s=_timestamp(image),
        )
    if not found:
        images.fail("is empty", "add the images of the annotations")
    return found


def _timestamp(image: Field) -> float:
    if not image.has("timestamp_s"):
        return math.nan
    return image["timestamp_s"].number(-TIMESTAMP_S, TIMESTAMP_S, "give seconds, or remove timestamp_s")


def read_fps(root: Field) -> float | None:
    """Return ``info.fps``, the mean frame rate of the video in frames per second; None if the file lacks the rate.

    Raises:
        InputError: the rate is not a number, or is absurd.
    """
    if not isinstance(root.value.get("info"), dict) or not root["info"].has("fps"):
        return None
    return root["info"]["fps"].number(1 / SECONDS_PER_FRAME, FRAMES_PER_S, "give frames per second, or remove fps")


def read_info_footage(root: Field) -> FootageIdentity | None:
    """Return ``info.footage``, the identity of the video; None if the file lacks it.

    Raises:
        InputError: the object has other values than jaxfit writes.
    """
    if not isinstance(root.value.get("info"), dict) or not root["info"].has("footage"):
        return None
    return footage_of(root["info"]["footage"])


@dataclass(frozen=True)
class Categories:
    """The categories of birds, and their keypoints."""

    names: tuple[str, ...]
    skeleton: tuple[tuple[int, int], ...]
    """Pairs counted from 0."""
    birds: frozenset[int | str]
    """Ids of the categories of birds."""
    others: frozenset[int | str]
    """Ids of other categories."""


def read_categories(categories: Field) -> Categories:
    """Return the categories.

    Raises:
        InputError: an entry is invalid, or no category has keypoints.
    """
    names: tuple[str, ...] = ()
    skeleton: tuple[tuple[int, int], ...] = ()
    birds: set[int | str] = set()
    others: set[int | str] = set()
    for category in categories:
        name = category["id"].identifier()
        if name in birds | others:
            category["id"].fail(f"is {name!r} for the second time", "give every category an id of its own")
        if category.has("keypoints") and len(category["keypoints"]) > KEYPOINTS:
            category["keypoints"].fail(
                f"holds {len(category['keypoints'])} names, more than {KEYPOINTS}", "remove names"
            )
        its_names = tuple(k.text() for k in category["keypoints"]) if category.has("keypoints") else ()
        if len(set(its_names)) < len(its_names):
            category["keypoints"].fail("holds a name twice", "give every keypoint a name of its own")
        if its_names and not names:
            names = its_names
            skeleton = _read_skeleton(category, len(names))
        (birds if names and its_names == names else others).add(name)
    if not names:
        categories.fail("hold none with keypoints", "add the names of the keypoints to the category of the bird")
    return Categories(names, skeleton, frozenset(birds), frozenset(others))


def _read_skeleton(category: Field, num_keypoints: int) -> tuple[tuple[int, int], ...]:
    if not category.has("skeleton"):
        return ()
    pairs = [(edge, edge.numbers(2)) for edge in category["skeleton"]]
    first = 0 if any(0 in pair for _, pair in pairs) else 1
    for edge, pair in pairs:
        if any(k != int(k) or not first <= k < num_keypoints + first for k in pair):
            problem = f"is {list(pair)}, but the keypoints count from {first} to {num_keypoints - 1 + first}"
            edge.fail(problem, "correct the pair or remove skeleton")
    return tuple((int(a) - first, int(b) - first) for _, (a, b) in pairs)


def read_annotation(annotation: Field, images: Mapping[int | str, Image], names: Sequence[str]) -> Annotation:
    """Return one annotation of a bird.

    Raises:
        InputError: the annotation is invalid.
    """
    image_id = annotation["image_id"].identifier()
    if image_id not in images:
        annotation["image_id"].fail(f"is {image_id!r}, which no image has", "add the image or remove the annotation")
    if "track_id" not in annotation:
        annotation.fail("lacks the key track_id", _TRACK_REMEDY)
    image = images[image_id]
    box = annotation["bbox"].positions(4, " (x, y, width, height)")
    if min(box[2:]) <= 0:
        problem = f"has width {box[2]} and height {box[3]}, which must be above 0"
        annotation["bbox"].fail(problem, "give the box of the bird, or remove the annotation")
    rle, amodal_rle = (
        read_segmentation(annotation[key], image.height, image.width) if annotation.has(key) else None
        for key in ("segmentation", "amodal_segmentation")
    )
    crowd = annotation.has("iscrowd") and annotation["iscrowd"].integer(0, 1)
    label = f"id {annotation['id'].identifier()!r} ({annotation.path})" if annotation.has("id") else annotation.path
    return Annotation(
        label=label,
        track_id=annotation["track_id"].integer(),
        image=image,
        keypoints=_read_keypoints(annotation, len(names)),
        box=list(box),
        rle=None if crowd else rle,
        amodal_rle=None if crowd else amodal_rle,
        score=annotation["score"].number(0, 1, "scale the scores to 0 to 1") if annotation.has("score") else 1.0,
    )


def _read_keypoints(annotation: Field, num_keypoints: int) -> np.ndarray:
    why = f" (x, y, v for each of the category's {num_keypoints} keypoints)"
    values = annotation["keypoints"].positions(3 * num_keypoints, why)
    keypoints = np.zeros((num_keypoints, 4))
    keypoints[:, :3] = np.array(values, dtype=np.float64).reshape(-1, 3)
    visibility = keypoints[:, 2].copy()
    keypoints[:, 3] = visibility == 1
    if (visibility < 0).any():
        annotation["keypoints"].fail(f"has visibility {visibility.min()}", "write 0, 1 or 2")
    keypoints[:, 2] = 1
    if annotation.has("keypoint_scores"):
        scores = annotation["keypoint_scores"].numbers(num_keypoints, ", one for each keypoint")
        for i, score in enumerate(scores):
            if not 0 <= score <= 1:
                problem = f"holds {score} at [{i}], outside 0 to 1"
                annotation["keypoint_scores"].fail(problem, "scale the scores to 0 to 1")
        keypoints[:, 2] = scores
    keypoints[visibility == 0] = 0
    return keypoints


Untracked = Literal["video", "labels", "photographs"]
"""How a file without any track is read. `video`: by the rule of exports; a file with `frame_index` is not completed.
`labels`: every annotation is a bird of its own. `photographs`: the same, and all images have `frame_index` 0."""

_log = logging.getLogger(__name__)


def complete_export(root: Field, video: Path | None = None, untracked: Untracked = "video") -> Field:
    """Return the content of a COCO file with the keys of video.

    Args:
        root: the content. A file with a `frame_index` in any image is returned unchanged, except by `untracked`.
        video: the folder of pictures, if it is known.
        untracked: how a file without any track is read.

    Raises:
        InputError: the folder lacks some of the pictures.
    """
    if not isinstance(root.value, dict):
        return root
    images: Any = root.value.get("images")
    kept: Any = root.value.get("annotations")
    if not _is_table(images) or not _is_table(kept):
        return root
    is_export = not any("frame_index" in image for image in images)
    photographs = False
    if is_export:
        files = [image.get("file_name") for image in images]
        if not all(isinstance(file, str) for file in files):
            return root
        numbers = frame_numbers(files, video)
        photographs = numbers is None
        images = [image | {"frame_index": 0 if numbers is None else numbers[i]} for i, image in enumerate(images)]
        kept = [annotation for annotation in map(_with_box, kept) if not _is_outside(annotation)]
    if not any(annotation.get("track_id") is not None for annotation in kept):
        has_attributes = is_export and any(_track(annotation) is not None for annotation in kept)
        if untracked == "photographs" and kept and not has_attributes:
            images = [image | {"frame_index": 0} for image in images]
            _report_photographs(root, len(images), kept)
        if untracked != "video" and not has_attributes:
            kept = _numbered(kept, images)
        elif is_export:
            kept = _with_tracks(kept, photographs, root.source)
    return Field(root.source, root.path, root.value | {"images": images, "annotations": kept})


def _report_photographs(root: Field, images: int, annotations: list[dict[str, Any]]) -> None:
    birds = sum(bool(annotation.get("keypoints")) for annotation in annotations)
    text = (
        "%s: no annotation has a track_id, so the file is a set of photographs: each of the %d images is a photograph "
        "of its own, and each of the %d annotations is a bird of its own (for a video, give every annotation the "
        "track_id of its bird)"
    )
    _log.warning(text, root.source, images, birds)


def _numbered(annotations: list[dict[str, Any]], images: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the annotations with a `track_id` that counts the birds of a frame from 1.

    Few numbers keep the tables of observations small: the tables have a row for every track.
    """
    frames = {repr(image.get("id")): repr(image.get("frame_index")) for image in images}
    counts: Counter[str | None] = Counter()
    numbered = []
    for annotation in annotations:
        frame = frames.get(repr(annotation.get("image_id")))
        counts[frame] += bool(annotation.get("keypoints"))  # categories without keypoints are no birds
        numbered.append(annotation | {"track_id": counts[frame]})
    return numbered


def _is_table(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(entry, dict) for entry in value)


def _is_outside(annotation: dict[str, Any]) -> bool:
    """Return whether an annotation holds keypoints, but neither a mask nor a keypoint that is in the picture."""
    keypoints = annotation.get("keypoints")
    if not isinstance(keypoints, list) or "num_keypoints" not in annotation or annotation.get("segmentation"):
        return False
    return not any(isinstance(v, int | float) and v > 0 for v in keypoints[2::3])


def _with_box(annotation: dict[str, Any]) -> dict[str, Any]:
    """Return an annotation with the box of its keypoints if its own box has no area."""
    box, keypoints = annotation.get("bbox"), annotation.get("keypoints")
    sides = box[2:] if isinstance(box, list) and len(box) == 4 else [0, 0]
    if not isinstance(keypoints, list) or all(isinstance(side, int | float) and side > 0 for side in sides):
        return annotation
    if not keypoints or len(keypoints) % 3 or not all(type(v) in (int, float) and abs(v) < 1e9 for v in keypoints):
        return annotation
    points = np.array(keypoints, np.float64).reshape(-1, 3)
    if not (points[:, 2] > 0).any():
        return annotation
    x, y, width, height = box_of_keypoints(points[:, :2], points[:, 2] > 0).tolist()
    # a single keypoint has no area
    box = [x - max(1 - width, 0) / 2, y - max(1 - height, 0) / 2, max(width, 1.0), max(height, 1.0)]
    return annotation | {"bbox": box}


def _with_tracks(annotations: list[dict[str, Any]], photographs: bool, source: Path) -> list[dict[str, Any]]:
    """Return the annotations with a `track_id`."""
    birds = [annotation for annotation in annotations if annotation.get("keypoints")]
    tracks = [_track(annotation) for annotation in birds]
    known = {track for track in tracks if track is not None} if not photographs else set()
    loose = [photographs or track is None for track in tracks]
    pictures = Counter(str(bird.get("image_id")) for bird, alone in zip(birds, loose, strict=True) if alone)
    one_bird = not photographs and max(pictures.values(), default=0) <= 1
    following = max(known, default=0) + 1
    given: dict[int, int] = {}
    for i, track in enumerate(tracks):
        given[id(birds[i])] = following if loose[i] else track  # type: ignore[assignment]
        following += loose[i] and not one_bird
    if any(loose) and not one_bird and not photographs:
        _log.warning("%s: %d birds without a track; every one becomes a track of its own", source, sum(loose))
    return [annotation | {"track_id": given.get(id(annotation), following)} for annotation in annotations]


def _track(annotation: dict[str, Any]) -> int | None:
    attributes = annotation.get("attributes")
    if not isinstance(attributes, dict):
        return None
    track, text = attributes.get("track_id"), attributes.get("bird")
    if track is None and isinstance(text, str) and re.fullmatch(r"[0-9]{1,15}", text):
        return int(text)
    return track if type(track) is int and abs(track) < 2**62 else None
