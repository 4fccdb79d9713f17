"""Images, categories and annotations of a COCO json, checked while they are read."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxfit.data.footage import FootageIdentity, footage_of
from jaxfit.data.formats.fields import Field
from jaxfit.data.formats.rle import read_segmentation
from jaxfit.limits import FRAMES_PER_S, IMAGE_SIDE_PX, KEYPOINTS, SECONDS_PER_FRAME, TIMESTAMP_S

__all__ = [
    "Annotation",
    "Categories",
    "Image",
    "read_annotation",
    "read_categories",
    "read_fps",
    "read_images",
    "read_info_footage",
]

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
