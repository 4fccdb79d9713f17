"""Observations in COCO json, as used for video instance data.

The file is an object with

- ``info``, optional: ``fps``, the mean frame rate of the video in frames per second; ``footage``, the identity of the
  video (``jaxfit.data.footage.FootageIdentity.entries``);
- ``images``: ``id``, ``width``, ``height``, ``file_name``, ``frame_index`` (0 for photographs), optionally
  ``timestamp_s`` (presentation time of the frame in seconds);
- ``categories``: ``id``, ``keypoints`` (names), optionally ``skeleton`` (pairs counted from 1, as COCO does;
  from 0 where a 0 occurs);
- ``annotations``: ``image_id``, ``category_id``, ``track_id``, ``bbox`` [x, y, width, height] and
  ``keypoints`` [x, y, v, …] in image pixels, optionally ``segmentation`` (run lengths or polygons),
  ``keypoint_scores`` (K numbers in [0, 1]), ``score`` (of the bird as a whole, in [0, 1]), ``keypoint_origin``
  (``label`` or ``flow``), ``iscrowd``, ``id``.

A written file also has ``tracks``, for people who open the file: ``id``, ``category_id`` and the fields of
``jaxfit.data.tracks.TrackQuality``. The reader ignores ``tracks``, which follow from the annotations.

Conventions of the reader:

- The confidence of a keypoint is its score where ``v > 0``, and 0 where ``v = 0``, since COCO writes a missing keypoint
  at (0, 0) with any score. Without scores, the confidence is 1 where ``v > 0``. Without ``score``, the score of an
  annotation is 1.
- Only 0, 1 and 2 are visibilities. A file with other numbers holds scores in their place, as MMPose and detectron2
  write them.
- The first category with keypoints is the bird. Categories with the same keypoints in the same order are birds too, of
  other species. Annotations of other categories are skipped, and one warning reports their number.
- A file without annotations is a video without birds. A file with annotations of other categories only is rejected.
- A crowd (``iscrowd`` 1) has no mask, since its region covers several birds.
- Several images may share a ``frame_index`` (photographs, several videos); each track keeps its own image.
- Unknown keys are ignored.
- Files of annotation programs lack ``frame_index`` and ``track_id``; ``coco_exports`` adds both. A fit reads a file
  without any ``track_id`` as a set of photographs.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from jaxfit.data.footage import footage_of
from jaxfit.data.formats.coco_records import (
    MAX_SCORE,
    Annotation,
    Image,
    Untracked,
    complete_export,
    errors_of,
    read_annotations,
    read_categories,
    read_images,
)
from jaxfit.data.formats.fields import Field, read_json
from jaxfit.data.formats.rle import first_invalid
from jaxfit.data.observations import KEYPOINT_ORIGINS, Observations
from jaxfit.data.tracks import track_quality
from jaxfit.foundation.array_files import check_memory, observations_bytes
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole

_log = logging.getLogger(__name__)


def read_coco(path: str | Path, video: Path | None = None, untracked: Untracked = "video") -> Observations:
    """Read observations from a COCO json, in the format that the module describes.

    Args:
        path: the file.
        video: the folder of pictures of a file without frame numbers, if it is known; see ``coco_exports``.
        untracked: how a file without any ``track_id`` is read; see ``coco_exports``.

    Returns:
        Observations with the tracks in the order of ``track_id`` and the frames in the order of ``frame_index``,
        including frames without a bird. There may be no track.

    Raises:
        InputError: the file cannot be read, or its content is invalid; the message names file, field and remedy.
    """
    return coco_observations(complete_export(read_json(Path(path)), video, untracked))


def coco_observations(root: Field) -> Observations:
    """Return the observations of the content of a COCO file, as `complete_export` returns the content.

    Raises:
        InputError: as `read_coco`.
    """
    images = read_images(root)
    categories = read_categories(root)
    birds, others = read_annotations(root, images, categories)
    if others:
        _log.warning("%s: skipped %d annotations of categories without the keypoints of the bird", root.source, others)
        if not birds:
            problem = f"annotations hold no bird ({others} of other categories)"
            remedy = "run detection on footage with a bird in it, or choose another file"
            raise InputError(root.source, problem, remedy)
    first_image: dict[int, Image] = {}
    for image in images.values():
        first_image.setdefault(image.frame_index, image)
    frames = sorted(first_image)
    tracks = sorted({bird.track_id for bird in birds})
    N, T, K = len(tracks), len(frames), len(categories.names)
    check_memory(
        root.source,
        f"annotations of {N:,} tracks over {T:,} frames with {K} keypoints",
        observations_bytes(N, T, K, max(len(image.file_name) for image in images.values())),
        "split the file; for photographs, give every image frame_index 0",
    )
    row = {track: n for n, track in enumerate(tracks)}
    column = {frame: t for t, frame in enumerate(frames)}
    cells = [(row[bird.track_id], column[bird.image.frame_index]) for bird in birds]
    holder = dict(zip(cells, birds, strict=True))
    if len(holder) < len(birds):
        i = next(i for i, cell in enumerate(cells) if holder[cell] is not birds[i])
        bird, other = birds[i], holder[cells[i]]
        problem = f"annotations hold track_id {bird.track_id} twice in frame_index {bird.image.frame_index}: "
        raise InputError(root.source, f"{problem}{bird.label} and {other.label}", "give one of them another track_id")
    at = tuple(np.array(cells, np.int64).reshape(-1, 2).T)
    keypoints = np.array([bird.keypoints for bird in birds], np.float64).reshape(-1, K, 3)
    visibility = keypoints[..., 2]
    confidence = (visibility > 0).astype(np.float32)
    for i, bird in enumerate(birds):
        if bird.scores is not None:
            confidence[i] = np.where(visibility[i] > 0, bird.scores, 0)

    occluded = visibility == 1
    if not np.isin(visibility, (0, 1, 2)).all():
        confidence, occluded = _scores(root, visibility, birds), np.zeros(visibility.shape, bool)

    def placed(values: Any, *shape: int, dtype: Any = np.float32) -> np.ndarray:
        array = np.zeros((N, T, *shape), dtype)
        with np.errstate(over="ignore"):  # a number that is too large becomes infinite
            array[at] = np.reshape(values, (len(birds), *shape))
        return array

    masks = {
        name: {cell: rle for cell, bird in holder.items() if (rle := getattr(bird, name)) is not None}
        for name in ("rle", "amodal_rle")
    }
    for rles in masks.values():
        invalid = first_invalid([*rles.values()])
        if invalid is not None:
            label = holder[[*rles][invalid]].label
            problem = f"{label}: segmentation.counts is corrupt: its runs do not cover the image"
            raise InputError(root.source, problem, "write the mask again with pycocotools, or leave segmentation out")
    info = root.value.get("info")
    info = Field(root.source, "info", info if isinstance(info, dict) else {})
    with errors_of(root, "the content"):
        return Observations(
            track_id=np.array(tracks, np.int64),
            frame_index=np.array(frames),
            present=placed(np.ones(len(birds), bool), dtype=bool),
            keypoints_px=placed(np.where(visibility[..., None] != 0, keypoints[..., :2], 0), K, 2),
            confidence=placed(confidence, K),
            box_px=placed([bird.box for bird in birds], 4),
            image_size_px=np.array([[first_image[f].width, first_image[f].height] for f in frames]),
            file_name=np.array([first_image[f].file_name for f in frames]),
            keypoint_names=categories.names,
            skeleton=categories.skeleton,
            masks=masks["rle"],
            amodal_masks=masks["amodal_rle"],
            occluded=placed(occluded, K, dtype=bool),
            score=placed([bird.score for bird in birds]),
            keypoint_origin=placed([bird.origin for bird in birds], dtype=np.int8),
            timestamp_s=np.array([first_image[f].timestamp_s for f in frames]),
            fps=float(info["fps"].value) if info.has("fps") else None,
            footage=footage_of(info["footage"]) if info.has("footage") else None,
            species={bird.track_id: bird.species for bird in birds}
            if len({bird.species for bird in birds}) > 1
            else {},
            own_images={
                cell: (bird.image.file_name, bird.image.width, bird.image.height)
                for cell, bird in holder.items()
                if bird.image[:4] != first_image[bird.image.frame_index][:4]
            },
        )


def _scores(root: Field, third: np.ndarray, birds: Sequence[Annotation]) -> np.ndarray:
    """Return confidences from the third numbers of keypoints, which are scores; `keypoint_scores` replace them.

    Raises:
        InputError: a number is neither a visibility nor a score.
    """
    wrong = np.argwhere(~((third >= 0) & (third <= MAX_SCORE)))
    if len(wrong):
        i, k = wrong[0].tolist()
        problem = f"{birds[i].label}: the third number of keypoint {k} is {third[i, k]:g}, which is no visibility (0, 1"
        raise InputError(root.source, f"{problem}, 2) and no score", "write visibilities, or scores from 0 to 1")
    _log.warning("%s: holds scores in place of visibilities, which are read as confidences", root.source)
    given = [third[i] if bird.scores is None else bird.scores * (third[i] > 0) for i, bird in enumerate(birds)]
    return np.minimum(given, 1).astype(np.float32)


def write_coco(observations: Observations, path: str | Path, info: Mapping[str, str] | None = None) -> None:
    """Write observations as COCO json, completely or not at all.

    ``read_coco`` reads the same observations, except that the tracks are sorted by ``track_id`` and tracks without a
    detection are missing.

    Args:
        observations: the observations.
        path: the file; an existing file is replaced.
        info: COCO's ``info`` about the file: ``description``, ``license``, …; ``fps`` and ``footage`` are added.

    Raises:
        InputError: the file cannot be written.
    """
    from pycocotools import mask as coco_mask

    images: dict[tuple, dict[str, Any]] = {}
    timestamp_s = cast(np.ndarray, observations.timestamp_s).tolist()

    def image_id(t: int, file_name: str, width: int, height: int) -> int:
        image = {"id": len(images), "width": width, "height": height, "file_name": file_name}
        image["frame_index"] = int(observations.frame_index[t])
        if math.isfinite(timestamp_s[t]):
            image["timestamp_s"] = timestamp_s[t]
        return images.setdefault((t, file_name, width, height), image)["id"]

    for t, (width, height) in enumerate(observations.image_size_px.tolist()):
        # the image of the frame comes before other images of the same frame
        image_id(t, str(observations.file_name[t]), width, height)
    annotations = []
    masks, species = observations.masks, observations.species
    names = sorted({species.get(track, "bird") for track in observations.track_id.tolist()} or {"bird"})
    category_of = {track: names.index(species.get(track, "bird")) + 1 for track in observations.track_id.tolist()}
    # one at a time: pycocotools fails for a list of more than 255 masks
    areas = {place: int(coco_mask.area(cast(Any, mask))) for place, mask in masks.items()}
    scores, origin = cast(np.ndarray, observations.score), cast(np.ndarray, observations.keypoint_origin)
    for n, t in zip(*(axis.tolist() for axis in np.nonzero(observations.present)), strict=True):
        confidence = observations.confidence[n, t]
        hidden = cast(np.ndarray, observations.occluded)[n, t]
        visible = np.where(confidence > 0, np.where(hidden, 1.0, 2.0), 0.0)
        keypoints = np.concatenate([_shortest(observations.keypoints_px[n, t]), visible[:, None]], axis=-1)
        annotation = {
            "id": len(annotations) + 1,
            "image_id": image_id(t, observations.image_file(n, t), *observations.image_size(n, t)),
            "category_id": category_of[int(observations.track_id[n])],
            "track_id": int(observations.track_id[n]),
            "bbox": _shortest(observations.box_px[n, t]).tolist(),
            "iscrowd": 0,
            "keypoints": keypoints.reshape(-1).tolist(),
            "keypoint_scores": _shortest(confidence).tolist(),
            "num_keypoints": int((confidence > 0).sum()),
        }
        if scores[n, t] != 1:
            annotation["score"] = float(_shortest(scores[n, t]))
        if origin[n, t]:
            annotation["keypoint_origin"] = KEYPOINT_ORIGINS[origin[n, t]]
        if (n, t) in masks:
            annotation["segmentation"] = _json_rle(masks[n, t])
        if (n, t) in observations.amodal_masks:
            annotation["amodal_segmentation"] = _json_rle(observations.amodal_masks[n, t])
        if (n, t) in areas:
            annotation["area"] = areas[n, t]
        annotations.append(annotation)
    skeleton = [[a + 1, b + 1] for a, b in observations.skeleton]
    keypoints = {"keypoints": list(observations.keypoint_names), "skeleton": skeleton}
    content: dict[str, Any] = {
        "images": list(images.values()),
        "categories": [{"id": i + 1, "name": name, **keypoints} for i, name in enumerate(names)],
        "annotations": annotations,
        "tracks": _tracks(observations, category_of),
    }
    about: dict[str, Any] = dict(info or {}) | ({} if observations.fps is None else {"fps": observations.fps})
    about |= {} if observations.footage is None else {"footage": observations.footage.entries()}
    if about:
        content = {"info": about, **content}
    write_whole(path, json.dumps(content, allow_nan=False).encode())


def _json_rle(rle: Mapping[str, Any]) -> dict[str, Any]:
    """Return the compressed run lengths of a mask as JSON values."""
    counts = rle["counts"].decode("ascii") if isinstance(rle["counts"], bytes) else rle["counts"]
    return {"size": [int(side) for side in rle["size"]], "counts": counts}


def _tracks(observations: Observations, category_of: Mapping[int, int]) -> list[dict[str, Any]]:
    """Return the entries of ``tracks``."""
    tracks = []
    for quality in track_quality(observations):
        values = quality._asdict()
        track_id = values.pop("track_id")
        track = {"id": track_id, "category_id": category_of[track_id]}
        tracks.append(track | {key: round(v, 6) if isinstance(v, float) else v for key, v in values.items()})
    return tracks


def _shortest(values: np.ndarray) -> np.ndarray:
    """Return float64 values with the fewest digits that still give the same float32."""
    return values.astype(str).astype(np.float64)
