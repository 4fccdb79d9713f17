"""A binary copy of a long COCO file, so that the file opens fast and its masks need no memory.

The folder `birds.parts` beside `birds.json` holds numbered `.npz` files of some hundred frames each, and
`record.json` with the SHA-256 of the COCO file. The copy is used only if this hash is that of the present file, so the
COCO file may be edited, and the folder may be removed at any time. Masks are read when they are needed.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from jaxfit.data.footage import FootageIdentity, footage_of
from jaxfit.data.formats.fields import Field
from jaxfit.data.formats.rle import read_segmentation, valid_texts
from jaxfit.data.masks import LazyMasks
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import new_folder
from jaxfit.foundation.reading import open_file
from jaxfit.foundation.unfinished import RECORD, Parts, read_record

PARTS_FROM = 10_000
"""Least number of detections of a file with a copy. Shorter files open in about two seconds without a copy."""
_FRAMES = 500
"""Frames of a part."""
_FORMAT_VERSION = 2
"""A copy of another version is not read. Version 1 lacks the identity of the footage."""
_LOADED = 4
"""Number of parts whose masks stay in memory."""

_VALUES = {
    "keypoints_px": ("D K 2", np.float32),
    "confidence": ("D K", np.float32),
    "occluded": ("D K", np.bool_),
    "box_px": ("D 4", np.float32),
    "score": ("D", np.float32),
}
"""Arrays of the D detections of a part."""
_FRAME_VALUES = {"frame_index": "F", "image_size_px": "F 2", "file_name": "F", "timestamp_s": "F"}
_MASKS = ("masks", "amodal_masks")
_LAYOUT = (
    {"track": "D", "frame": "D", **{name: shape for name, (shape, _) in _VALUES.items()}}
    | _FRAME_VALUES
    | {f"{name}_length": "D" for name in _MASKS}  # bytes of the text of each mask; 0 without a mask
)
_HEAD = {"track_id": "N", "keypoint_names": "K", "skeleton": "pairs 2", "fps": "", "parts": ""}
_HEAD |= {"footage_frames": "", "footage_first_frame": "P"}  # −1 and empty where unknown
"""Arrays of the first part only."""


def parts_folder(path: Path) -> Path:
    """Return the folder of the copy of a COCO file."""
    return path.parent / f"{path.stem}.parts"


def write_coco_parts(
    observations: Observations, masks: Mapping[str, Mapping[tuple[int, int], Any]], path: Path, content: bytes
) -> None:
    """Write the copy of a COCO file that has just been written, if the file is long; remove an earlier copy.

    Args:
        observations: the observations of the file.
        masks: the `masks` and `amodal_masks` of the observations, in memory.
        path: the COCO file.
        content: the bytes of the COCO file.

    Raises:
        InputError: the folder cannot be written.
    """
    folder = parts_folder(path)
    if _has_record(folder) and "coco_sha256" in read_record(folder):
        shutil.rmtree(folder)
    if observations.present.sum() < PARTS_FROM or observations.own_images or folder.exists():
        return
    order = np.argsort(observations.track_id)
    rows = order[observations.present[order].any(1)]
    starts, footage = range(0, observations.num_frames, _FRAMES), observations.footage or FootageIdentity()
    head = {
        "track_id": observations.track_id[rows],
        "keypoint_names": np.array(observations.keypoint_names),
        "skeleton": np.array(observations.skeleton, np.int64).reshape(-1, 2),
        "fps": np.array(np.nan if observations.fps is None else observations.fps),
        "parts": np.array(len(starts)),
        "footage_frames": np.array(-1 if footage.frames is None else footage.frames),
        "footage_first_frame": np.frombuffer(footage.first_frame or b"", np.uint8),
    }
    with new_folder(folder) as part_folder:
        parts = Parts(part_folder, _record(hashlib.sha256(content).hexdigest()))
        for start in starts:
            parts.add(_arrays(observations, masks, rows, start) | (head if start == 0 else {}))


def read_coco_parts(path: Path) -> Observations | None:
    """Return the observations of a COCO file from its copy; None without a copy, or if the file was changed.

    Raises:
        InputError: the copy is damaged.
    """
    folder = parts_folder(path)
    if not _has_record(folder):
        return None
    record = _record(_hash(path))
    try:
        return _observations(Parts(folder, record), folder) if read_record(folder) == record else None
    except InputError as error:
        raise _damaged(error) from error


def _has_record(folder: Path) -> bool:
    try:
        return (folder / RECORD).is_file()
    except OSError:  # the name with the other ending is too long
        return False


def _observations(parts: Parts, folder: Path) -> Observations:
    head = parts.load(0, _HEAD)
    if parts.numbers != [*range(int(head["parts"]))]:
        raise InputError(folder, f"lacks parts: it holds {len(parts.numbers)} of {int(head['parts'])}")
    loaded = [parts.load(number, _LAYOUT) for number in parts.numbers]
    N, K = len(head["track_id"]), len(head["keypoint_names"])
    frames: dict[str, Any] = {name: np.concatenate([each[name] for each in loaded]) for name in _FRAME_VALUES}
    first = np.cumsum([0, *(len(each["frame_index"]) for each in loaded)])
    T = int(first[-1])
    present = np.zeros((N, T), bool)
    values: dict[str, Any] = {
        name: np.zeros((N, T, *({"K": K, "2": 2, "4": 4}[size] for size in shape.split()[1:])), dtype)
        for name, (shape, dtype) in _VALUES.items()
    }
    cells, texts = {name: [] for name in _MASKS}, {name: [] for name in _MASKS}
    for number, arrays in enumerate(loaded):
        track, frame = arrays["track"], arrays["frame"]
        F = len(arrays["frame_index"])
        if not (((track >= 0) & (track < N)).all() and ((frame >= 0) & (frame < F)).all()):
            raise parts.damaged(number, "holds tracks or frames that do not exist")
        at = track, frame + first[number]
        present[at] = True
        for name in _VALUES:
            values[name][at] = arrays[name]
        for name in _MASKS:
            length = arrays[f"{name}_length"]
            ends = np.cumsum(length)
            has = length > 0
            cells[name].append(np.stack(at, -1)[has])
            sizes = arrays["image_size_px"][frame[has]]
            texts[name].append(np.column_stack([np.full(has.sum(), number), (ends - length)[has], ends[has], sizes]))
    for array in (present, *values.values(), *frames.values()):
        array.flags.writeable = False  # so that `Observations` needs no copy
    try:
        return Observations(
            track_id=head["track_id"],
            present=present,
            keypoint_names=tuple(head["keypoint_names"].tolist()),
            skeleton=tuple((a, b) for a, b in head["skeleton"].tolist()),
            fps=None if np.isnan(head["fps"]) else float(head["fps"]),
            footage=_footage(head, folder),
            **_lazy_masks(parts, folder, cells, texts),
            **values,
            **frames,
        )
    except ValueError as error:
        raise InputError(folder, str(error)) from error


def _lazy_masks(
    parts: Parts, folder: Path, cells: Mapping[str, list[np.ndarray]], texts: Mapping[str, list[np.ndarray]]
) -> dict[str, Any]:
    """Return the masks of a copy from their cells, and from part, start, end, width and height of their texts."""
    firsts = {name: np.cumsum([0, *map(len, texts[name])]) for name in _MASKS}

    @lru_cache(_LOADED)
    def load(number: int, name: str) -> tuple[bytes, np.ndarray]:
        """Return the texts of the masks of a part, and which of them are valid."""
        text, at = parts.load(number, {name: "bytes"})[name], texts[name][number]
        valid = np.zeros(len(at), bool)
        if len(at) and len(text) == at[-1, 2]:
            valid = valid_texts(text, at[:, 2] - at[:, 1], at[:, 3] * at[:, 4])
        return text.tobytes(), valid

    def lazy(name: str) -> LazyMasks | dict:
        places = np.concatenate(texts[name])

        def read(i: int) -> Mapping[str, Any]:
            number, start, end, width, height = places[i].tolist()
            try:
                text, valid = load(number, name)
                counts = text[start:end]
                if valid[i - firsts[name][number]]:
                    return {"size": [height, width], "counts": counts}
                rle = Field(folder, name, {"size": [height, width], "counts": counts.decode("ascii", "replace")})
                return cast(Any, read_segmentation(rle, height, width))
            except InputError as error:
                raise _damaged(error) from error

        return LazyMasks(np.concatenate(cells[name]), read) if len(places) else {}

    return {name: lazy(name) for name in _MASKS}


def _footage(head: Mapping[str, np.ndarray], folder: Path) -> FootageIdentity | None:
    frames, first_frame = int(head["footage_frames"]), head["footage_first_frame"].astype(np.uint8).tobytes()
    footage = FootageIdentity(None if frames < 0 else frames, first_frame or None)
    return None if footage == FootageIdentity() else footage_of(Field(folder, "footage", footage.entries()))


def _arrays(
    observations: Observations, masks: Mapping[str, Any], rows: np.ndarray, start: int
) -> dict[str, np.ndarray]:
    """Return the arrays of the part that begins at the frame with position `start`."""
    frames = slice(start, start + _FRAMES)
    track, frame = np.nonzero(observations.present[rows, frames])
    order = np.lexsort((track, frame))
    track, frame = track[order], frame[order]
    at = rows[track], frame + start
    arrays = {"track": track, "frame": frame} | {name: getattr(observations, name)[at] for name in _VALUES}
    arrays |= {name: getattr(observations, name)[frames] for name in _FRAME_VALUES}
    for name in _MASKS:
        texts = [_text(masks[name].get(cell)) for cell in zip(*(axis.tolist() for axis in at), strict=True)]
        arrays[f"{name}_length"] = np.array([len(text) for text in texts], np.int64)
        arrays[name] = np.frombuffer(b"".join(texts), np.uint8)
    return arrays


def _text(rle: Mapping[str, Any] | None) -> bytes:
    if rle is None:
        return b""
    return rle["counts"] if isinstance(rle["counts"], bytes) else rle["counts"].encode()


def _record(sha256: str) -> dict[str, Any]:
    return {"coco_sha256": sha256, "format_version": _FORMAT_VERSION}


def _hash(path: Path) -> str:
    with open_file(path, "a COCO file") as file:
        return hashlib.file_digest(cast(Any, file), "sha256").hexdigest()


def _damaged(error: InputError) -> InputError:
    remedy = "remove this .parts folder; jaxfit then reads the COCO file of the same name"
    return InputError(error.source, error.problem, remedy)
