"""Images, categories and annotations of a COCO file, also of annotation programs (CVAT, Label Studio).

Annotation programs export files without the keys of video: `frame_index` of images and `track_id` of annotations.
`complete_export` adds both keys before the file is read:

- `frame_id` of CocoVID is the number of the frame, and `instance_id` is the track; a file of several videos is an
  error.
- Otherwise, the name of a picture gives the number of its frame (`frame_000012.png` → 12), as
  `jaxfit.data.tracks.frame_numbers` describes. Other pictures are photographs: `frame_index` is 0, and every bird is a
  track of its own.
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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxfit.data.formats.fields import Field
from jaxfit.data.formats.rle import read_segmentation
from jaxfit.data.masks import MAX_IMAGE_SIDE_PX, box_of_keypoints
from jaxfit.data.observations import KEYPOINT_ORIGINS
from jaxfit.data.tracks import frame_numbers
from jaxfit.foundation.errors import InputError

_log = logging.getLogger(__name__)

_REMEDIES = {
    "track_id": "give every annotation the track_id of its bird; for photographs, a unique number",
    "frame_index": "give every image the number of its frame in the video; for photographs, 0",
}
MAX_SCORE = 10
"""Scores between 1 and this limit count as 1: peaks of a network may lie above 1."""
Untracked = Literal["video", "labels", "photographs"]
"""How a file without any track is read. `video`: by the rule of exports; a file with `frame_index` is not completed.
`labels`: every annotation is a bird of its own. `photographs`: the same, and all images have `frame_index` 0."""


@contextmanager
def errors_of(root: Field, address: str) -> Iterator[None]:
    """Convert the errors of reading an entry to InputError, which names the entry, as a context manager."""
    try:
        yield
    except InputError:
        raise
    except KeyError as error:
        key = str(error.args[0])
        raise InputError(root.source, f"{address} lacks the key {key}", _REMEDIES.get(key, f"add {key}")) from error
    except (AttributeError, LookupError, OverflowError, TypeError, ValueError) as error:
        raise InputError(root.source, f"{address}: {error}", "correct it, or write the file again") from error


class Image(NamedTuple):
    """An entry of ``images``; width and height in pixels."""

    frame_index: int
    width: int
    height: int
    file_name: str
    timestamp_s: float
    """Presentation time in seconds; NaN if unknown."""


class Annotation(NamedTuple):
    """An entry of ``annotations``: one bird in one image."""

    label: str
    """Name in messages."""
    track_id: int
    species: str
    """Name of the category."""
    image: Image
    keypoints: np.ndarray
    """(K, 3): x, y in image pixels, visibility."""
    scores: np.ndarray | None
    """(K,) scores of the keypoints."""
    box: np.ndarray
    """x, y, width, height in image pixels."""
    rle: dict[str, Any] | None
    """Run lengths of the mask, not checked."""
    amodal_rle: dict[str, Any] | None
    """Run lengths of the mask of the whole bird, including hidden parts, not checked."""
    score: float
    """Score of the detection of the bird."""
    origin: int
    """Position in `KEYPOINT_ORIGINS`."""


def read_images(root: Field) -> dict[int | str, Image]:
    """Return image id → image.

    Raises:
        InputError: an entry is invalid, or an id occurs twice.
    """
    images: dict[int | str, Image] = {}
    for i, entry in enumerate(_table(root, "images")):
        with errors_of(root, f"images[{i}]"):
            if entry["id"] in images:
                raise ValueError(f"id {entry['id']!r} occurs for the second time")
            width, height = _whole(entry["width"]), _whole(entry["height"])
            if not (min(width, height) >= 1 and max(width, height) <= MAX_IMAGE_SIDE_PX):
                raise ValueError(f"a size of {width}×{height} is outside 1 to {MAX_IMAGE_SIDE_PX:,} pixels")
            time = entry.get("timestamp_s")
            time = math.nan if time is None else float(time)
            images[entry["id"]] = Image(_whole(entry["frame_index"]), width, height, str(entry["file_name"]), time)
    if not images:
        raise InputError(root.source, "images is empty", "add the images of the annotations")
    return images


def _table(root: Field, key: str) -> list[dict[str, Any]]:
    """Return a list of objects of the file."""
    entries = root[key].value
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(root.source, f"{key} must be a list of objects", "give a COCO json")
    return entries


def _whole(value: Any) -> int:
    """Return a whole number; 3.0 counts as 3."""
    if isinstance(value, bool) or not isinstance(value, int | float) or value != int(value):
        raise ValueError(f"{value!r} must be a whole number")
    return int(value)


class Categories(NamedTuple):
    """The categories of birds, and their keypoints."""

    names: tuple[str, ...]
    skeleton: tuple[tuple[int, int], ...]
    """Pairs counted from 0."""
    species: dict[int | str, str | None]
    """Id of a category → its name if its keypoints are those of the bird, else None."""


def read_categories(root: Field) -> Categories:
    """Return the categories. The first category with keypoints is the bird.

    Raises:
        InputError: an entry is invalid, or no category has keypoints.
    """
    names: tuple[str, ...] = ()
    skeleton: tuple[tuple[int, int], ...] = ()
    species: dict[int | str, str | None] = {}
    for i, category in enumerate(_table(root, "categories")):
        with errors_of(root, f"categories[{i}]"):
            if category["id"] in species:
                raise ValueError(f"id {category['id']!r} occurs for the second time")
            own_names = tuple(category.get("keypoints") or ())
            if not all(isinstance(name, str) for name in own_names):
                raise ValueError("keypoints must be names")
            if own_names and not names:
                names = own_names
                pairs = [(_whole(a), _whole(b)) for a, b in category.get("skeleton") or ()]
                first = 0 if any(0 in pair for pair in pairs) else 1  # COCO counts from 1
                skeleton = tuple((a - first, b - first) for a, b in pairs)
                if any(not 0 <= k < len(names) for pair in skeleton for k in pair):
                    raise ValueError(
                        f"skeleton {pairs} names keypoints that are not {first} to {len(names) + first - 1}"
                    )
            is_bird = bool(names) and own_names == names
            species[category["id"]] = str(category.get("name") or "") if is_bird else None
    if not names:
        remedy = "add the names of the keypoints to the category of the bird"
        raise InputError(root.source, "categories hold none with keypoints", remedy)
    return Categories(names, skeleton, species)


def read_annotations(
    root: Field, images: Mapping[int | str, Image], categories: Categories
) -> tuple[list[Annotation], int]:
    """Return the annotations of birds, and the number of annotations of other categories.

    Raises:
        InputError: an annotation is invalid.
    """
    birds: list[Annotation] = []
    others = 0
    for i, entry in enumerate(_table(root, "annotations")):
        with errors_of(root, f"annotations[{i}]"):
            if entry["category_id"] not in categories.species:
                raise ValueError(f"category_id is {entry['category_id']!r}, which no category has")
            species = categories.species[entry["category_id"]]
            if species is not None:
                birds.append(_annotation(entry, f"annotations[{i}]", species, images, len(categories.names)))
            else:
                others += 1
    return birds, others


def _annotation(
    entry: dict[str, Any], label: str, species: str, images: Mapping[int | str, Image], num_keypoints: int
) -> Annotation:
    if entry["image_id"] not in images:
        raise ValueError(f"image_id is {entry['image_id']!r}, which no image has")
    image = images[entry["image_id"]]
    numbers = {}
    for key, size in (("keypoints", 3 * num_keypoints), ("keypoint_scores", num_keypoints), ("bbox", 4)):
        value = entry.get(key) if key == "keypoint_scores" else entry[key]
        if value is not None:
            numbers[key] = np.array(value)
            if numbers[key].dtype.kind not in "iuf":
                raise ValueError(f"{key} must be numbers")
            if numbers[key].shape != (size,):
                raise ValueError(f"{key} has {len(value)} numbers, not {size}")
    if not numbers["bbox"][2:].min() > 0:
        raise ValueError(f"bbox has width {entry['bbox'][2]} and height {entry['bbox'][3]}, which must be above 0")
    crowd = entry.get("iscrowd") == 1
    rle, amodal_rle = (
        None if crowd else read_segmentation(entry.get(key), image.height, image.width)
        for key in ("segmentation", "amodal_segmentation")
    )
    score = 1.0 if entry.get("score") is None else float(entry["score"])
    keypoints = numbers["keypoints"].reshape(-1, 3)
    scores = numbers.get("keypoint_scores")
    return Annotation(
        f"id {entry['id']!r} ({label})" if "id" in entry else label,
        _whole(entry["track_id"]),
        species,
        image,
        keypoints,
        scores,
        numbers["bbox"],
        rle,
        amodal_rle,
        score,
        KEYPOINT_ORIGINS.index(entry.get("keypoint_origin", "")),
    )


def complete_export(root: Field, video: Path | None = None, untracked: Untracked = "video") -> Field:
    """Return the content of a COCO file with the keys of video.

    Args:
        root: the content. A file with a `frame_index` in any image is returned unchanged, except by `untracked`.
        video: the folder of pictures, if it is known.
        untracked: how a file without any track is read.

    Raises:
        InputError: the file is no COCO file, or the folder lacks some of the pictures.
    """
    if not isinstance(root.value, dict):
        raise InputError(root.source, "must hold an object with images, categories and annotations", "give a COCO json")
    _refuse_other_programs(root)
    images, birds = _table(root, "images"), _table(root, "annotations")
    is_export = not any("frame_index" in image for image in images)
    photographs = False
    if is_export:
        with errors_of(root, "images"):
            in_folder = video is not None and video.is_dir()  # which numbers its pictures by their positions
            if images and not in_folder and all("frame_id" in image for image in images):  # CocoVID
                videos = {image.get("video_id") for image in images}
                if len(videos) > 1:
                    named = {video.get("id"): video.get("name") for video in root.value.get("videos") or ()}
                    names = ", ".join(sorted(str(named.get(video) or video) for video in videos))
                    problem = f"holds {len(videos)} videos (video_id): {names}"
                    raise InputError(root.source, problem, "give every video a file of its own")
                numbers = [_whole(image["frame_id"]) for image in images]
            else:
                numbers = frame_numbers([image["file_name"] for image in images], video)
                sizes = {(image.get("width"), image.get("height")) for image in images}
                if numbers is not None and video is None and len(sizes) > 1:
                    numbers = None
                    text = "%s: the images have %d sizes, so they are read as photographs, not as frames of one video"
                    _log.warning(text, root.source, len(sizes))
        photographs = numbers is None
        images = [image | {"frame_index": 0 if numbers is None else numbers[i]} for i, image in enumerate(images)]
        with errors_of(root, "annotations"):
            birds = [_with_box(bird) for bird in birds if not _is_outside(bird)]
    if not any(bird.get("track_id") is not None for bird in birds):
        has_attributes = is_export and any(_track(bird) is not None for bird in birds)
        if untracked == "photographs" and birds and not has_attributes:
            images = [image | {"frame_index": 0} for image in images]
            text = (
                "%s: no annotation has a track_id, so the file is a set of photographs: each of the %d images is a "
                "photograph of its own, and each of the %d annotations is a bird of its own (for a video, give every "
                "annotation the track_id of its bird)"
            )
            _log.warning(text, root.source, len(images), sum(bool(bird.get("keypoints")) for bird in birds))
        if untracked != "video" and not has_attributes:
            birds = _numbered(birds, images)
        elif is_export:
            birds = _with_tracks(birds, photographs, root.source)
    return Field(root.source, root.path, root.value | {"images": images, "annotations": birds})


def _refuse_other_programs(root: Field) -> None:
    """Raise InputError for the JSON files of two programs for labels whose own format is not read."""
    if "shapes" in root.value and "imagePath" in root.value:
        raise InputError(root.source, "is a file of LabelMe", "convert the folder to COCO, as labelme2coco does")
    images = root.value.get("_via_img_metadata", root.value)
    if isinstance(images, dict) and any(isinstance(image, dict) and "regions" in image for image in images.values()):
        remedy = "in VIA, choose Annotation > Export Annotations (COCO format)"
        raise InputError(root.source, "is a file of the VGG Image Annotator (VIA)", remedy)


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


def _is_outside(annotation: dict[str, Any]) -> bool:
    """Return whether an annotation holds keypoints, but neither a mask nor a keypoint that is in the picture."""
    keypoints = annotation.get("keypoints")
    if keypoints is None or "num_keypoints" not in annotation or annotation.get("segmentation"):
        return False
    return not any(visibility > 0 for visibility in keypoints[2::3])


def _with_box(annotation: dict[str, Any]) -> dict[str, Any]:
    """Return an annotation with the box of its keypoints if its own box has no area."""
    box = annotation.get("bbox") or [0, 0, 0, 0]
    points = np.array(annotation.get("keypoints") or [], np.float64).reshape(-1, 3)
    if min(box[2:]) > 0 or not (points[:, 2] > 0).any():
        return annotation
    x, y, width, height = box_of_keypoints(points[:, :2], points[:, 2] > 0).tolist()
    # a single keypoint has no area
    box = [x - max(1 - width, 0) / 2, y - max(1 - height, 0) / 2, max(width, 1.0), max(height, 1.0)]
    return annotation | {"bbox": box}


def _with_tracks(annotations: list[dict[str, Any]], photographs: bool, source: Path) -> list[dict[str, Any]]:
    """Return the annotations with a `track_id`."""
    birds = [annotation for annotation in annotations if annotation.get("keypoints")]
    tracks = [None if photographs else _track(bird) for bird in birds]
    loose = [bird for bird, track in zip(birds, tracks, strict=True) if track is None]
    one_bird = not photographs and max(Counter(str(bird.get("image_id")) for bird in loose).values(), default=0) <= 1
    if loose and not one_bird and not photographs:
        _log.warning("%s: %d birds without a track; every one becomes a track of its own", source, len(loose))
    following = max((track for track in tracks if track is not None), default=0) + 1
    given: dict[int, int] = {}
    for bird, track in zip(birds, tracks, strict=True):
        given[id(bird)] = following if track is None else track
        following += track is None and not one_bird
    return [annotation | {"track_id": given.get(id(annotation), following)} for annotation in annotations]


def _track(annotation: dict[str, Any]) -> int | None:
    attributes = annotation.get("attributes")
    if not isinstance(attributes, dict):
        instance = annotation.get("instance_id")
        return instance if type(instance) is int else None
    track, text = attributes.get("track_id"), attributes.get("bird")
    if track is None and isinstance(text, str) and re.fullmatch(r"[0-9]{1,15}", text):
        return int(text)
    return track if type(track) is int else None
