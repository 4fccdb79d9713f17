"""COCO keypoints as annotation programs export them: CVAT, Label Studio and others.

These files lack the keys of video: `frame_index` of images and `track_id` of annotations. `complete_export` adds both
keys before the file is read:

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
import re
from collections import Counter
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxfit.data.boxes import box_of_keypoints
from jaxfit.data.formats.fields import Field
from jaxfit.data.formats.picture_names import frame_numbers

__all__ = ["Untracked", "complete_export"]

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
    """Return whether an annotation holds keypoints, but none of them is in the picture."""
    keypoints = annotation.get("keypoints")
    if not isinstance(keypoints, list) or "num_keypoints" not in annotation:
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
