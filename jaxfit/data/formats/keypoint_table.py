"""Keypoints as tracking programs store them, and their conversion to observations."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxfit.data.formats.coco_records import MAX_SCORE
from jaxfit.data.formats.image_sizes import CERTAIN, add_times, image_sizes
from jaxfit.data.masks import box_of_keypoints
from jaxfit.data.observations import Observations
from jaxfit.data.tracks import frame_numbers
from jaxfit.foundation.array_files import check_memory, observations_bytes
from jaxfit.foundation.errors import InputError, one_line, shortened

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class KeypointTable:
    """Keypoints of N birds in T frames, with K keypoints per bird."""

    keypoint_names: tuple[str, ...]
    bird_names: tuple[str, ...]
    """N names, for messages. The track ids count the birds from 1."""
    keypoints_px: np.ndarray
    """(N, T, K, 2): x, y in image pixels; NaN where a keypoint is missing."""
    confidence: np.ndarray | None
    """(N, T, K), or None for labels, which are certain."""
    frame_index: np.ndarray | None = None
    """(T,) frame numbers, or None if `pictures` names the frames."""
    pictures: tuple[str, ...] | None = None
    """(T,) file names of the labelled pictures, with their folders."""
    score: np.ndarray | None = None
    """(N, T) scores of the detections of the birds."""
    skeleton: tuple[tuple[int, int], ...] = ()
    size_px: tuple[int, int] | None = None
    """Width and height of the images, if the file stores them."""
    video: str | None = None
    """Path of the video, if the file stores it."""
    certain: float = CERTAIN
    """Keypoints from this confidence on determine the box of a bird."""
    rows_of_frames: bool = False
    """Whether the rows count the frames of the video, so that their number tells whether they do."""
    video_frames: int | None = None
    """Number of frames of the video, if the file stores it."""


def check_table_size(source: Path, birds: int, frames: int, keypoints: int) -> None:
    """Raise InputError if a file has no keypoints, or more birds, frames and keypoints than memory should hold."""
    if not (birds and keypoints):
        raise InputError(source, f"holds no {'keypoints' if birds else 'birds'}", "choose another file")
    size = f"{birds:,} birds × {frames:,} frames × {keypoints:,} keypoints"
    check_memory(source, f"tables of {size}", observations_bytes(birds, frames, keypoints), "split the file")


def table_observations(
    table: KeypointTable, source: Path, video: Path | None = None, size_px: tuple[int, int] | None = None
) -> Observations:
    """Return the observations of a table.

    Birds have the box of their certain keypoints. A bird is present in a frame where one keypoint is known. Pictures
    that are not frames of one video become photographs: every bird has frame 0 of a picture of its own.

    Args:
        table: the keypoints.
        source: the file of the table.
        video: the video or folder of pictures of the keypoints, for the size of the images and the times of the frames.
            None: the size is that of the file, of its pictures, or of a video beside the file.
        size_px: width and height of the images of a file that stores none.

    Raises:
        InputError: a confidence above 10, a frame twice, no image size, or a video that does not fit.
        ValueError: as `Observations`.
    """
    keypoints = np.asarray(table.keypoints_px, np.float32)
    known = np.isfinite(keypoints).all(-1)
    stored = np.ones(known.shape) if table.confidence is None else table.confidence
    stored = np.where(known & ~np.isnan(stored), stored, 0)
    if np.abs(stored).max(initial=0) > MAX_SCORE:
        raise InputError(source, f"holds a confidence of {np.abs(stored).max():g}", "scale the scores to 0 to 1")
    confidence = np.clip(stored, 0, 1).astype(np.float32)
    numbers = None if table.pictures is None else frame_numbers(table.pictures, video)
    frames = table.frame_index if table.pictures is None else numbers if numbers is None else np.array(numbers)
    sizes = image_sizes(table.size_px, table.pictures, table.video, source, video, size_px)
    order = np.arange(keypoints.shape[1]) if frames is None else np.argsort(frames, kind="stable")
    keypoints, confidence = keypoints[:, order], confidence[:, order]
    score = np.ones(1) if table.score is None else table.score[:, order]
    score = np.clip(np.where(np.isfinite(score), score, 1), 0, 1)  # a score that is not a number counts as 1
    names = _file_names(table, source, sizes.video, frames)[order]
    size = np.broadcast_to(sizes.size_px, (len(order), 2))[order]
    present = np.any(confidence > 0, axis=-1)
    certain = confidence >= table.certain
    certain = np.where(certain.any(-1, keepdims=True), certain, confidence > 0)
    box = box_of_keypoints(keypoints, certain)
    side = np.maximum(box[..., 2:], 1)  # a single keypoint has no area
    box = np.concatenate([box[..., :2] + (box[..., 2:] - side) / 2, side], axis=-1)
    parts = {
        "keypoints_px": np.where(confidence[..., None] > 0, keypoints, 0),
        "confidence": confidence,
        "present": present,
        "box_px": np.where(present[..., None], box, 0),
        "score": np.where(present, score, 0.0),
    }
    common = {"keypoint_names": table.keypoint_names, "skeleton": table.skeleton}
    if frames is None:  # every bird of every picture is a track in frame 0 of a picture of its own
        at = np.argwhere(present)
        own_images = {(i, 0): (str(names[t]), int(size[t][0]), int(size[t][1])) for i, (_, t) in enumerate(at.tolist())}
        return Observations(
            track_id=np.arange(1, len(at) + 1),
            frame_index=np.zeros(1, np.int64),
            image_size_px=size[:1].astype(np.int64),
            file_name=names[:1],
            own_images=own_images,
            **{name: array[at[:, 0], at[:, 1]][:, None] for name, array in parts.items()},
            **common,
        )
    numbers = np.asarray(frames, np.int64)[order]
    if (np.diff(numbers) == 0).any():
        twice = int(numbers[:-1][np.diff(numbers) == 0][0])
        raise InputError(source, f"holds frame {twice} twice", "remove one of its rows")
    if len(numbers) and numbers[0] < 0:
        raise InputError(source, f"holds frame {numbers[0]}", "number the frames from 0 on")
    sizes.check_frames(int(numbers[-1]) if len(numbers) else 0, source)
    in_video = table.video_frames or sizes.frames
    if table.rows_of_frames and in_video is not None and len(numbers) not in (0, in_video):
        text = "%s: holds %d rows for the %d frames of its video; its first row is taken for frame %d"
        _log.warning(text, source, len(numbers), in_video, numbers[0])
    track_id = np.arange(1, len(table.bird_names) + 1)
    if len(table.bird_names) > 1:
        tracks = ", ".join(f"{name} = {i}" for i, name in enumerate(table.bird_names, 1))
        _log.warning("%s: %d birds become tracks: %s", source, len(table.bird_names), shortened(one_line(tracks), 150))
    kept = np.any(present, axis=1)  # a bird without any keypoint is no track
    observations = Observations(
        track_id=track_id[kept],
        frame_index=numbers,
        image_size_px=size.astype(np.int64),
        file_name=names,
        **{name: array[kept] for name, array in parts.items()},
        **common,
    )
    return add_times(observations, sizes.video)


def _file_names(table: KeypointTable, source: Path, video: Path | None, frames: np.ndarray | None) -> np.ndarray:
    if table.pictures is not None:
        return np.array(table.pictures, str).reshape(-1)
    stored = (table.video or source.stem).replace("\\", "/").rpartition("/")[2]
    name = video.name if video is not None else stored
    return np.array([f"{name}#{frame}" for frame in (frames if frames is not None else ())], str).reshape(-1)
