"""Observations of several calibrated cameras: without distortion, on common frames, one row for each bird."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.triangulation import Triangulated, triangulate_robustly
from jaxfit.data.masks import decode_mask, encode_patch
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent

MAX_CANVAS = 2.0
"""Longest side of the picture without distortion, as a multiple of that of the image."""
MAX_ERROR = 0.1
"""Largest error of a keypoint that agrees with other views, relative to the longer side of the box of the bird."""
WHOLE_FRAME = 0.02
"""Times that differ by less, in frames, are one frame."""
LONGEST_GAP_S = 0.25
"""Keypoints are interpolated between stored frames at most this far apart, seconds; at unknown rates, 25 frames/s."""

_logger = logging.getLogger(__name__)


class Views(NamedTuple):
    """What V cameras observe of N birds in T frames."""

    cameras: tuple[Camera, ...]
    """Cameras without distortion (`straightened`)."""
    lenses: tuple[Camera, ...]
    """The same cameras as they film."""
    observations: tuple[Observations, ...]
    """Pixels of these cameras, with equal frames and tracks: row n is the same bird in all views."""


class ViewKeypoints(NamedTuple):
    """The keypoints of N birds in all V views."""

    px: Float[np.ndarray, "V N T K 2"]
    """Pixels without distortion."""
    confidence: Float[np.ndarray, "V N T K"]
    side_px: Float[np.ndarray, "V N T K"]
    """Longer side of the box of the bird, at least 1."""

    def triangulated(self, cameras: Sequence[Camera]) -> Triangulated:
        """Triangulate; a pixel agrees if its error is at most `MAX_ERROR` of the side of the box."""
        return triangulate_robustly(cameras, self.px, self.confidence, MAX_ERROR * self.side_px)

    def of_views(self, views: Sequence[int]) -> ViewKeypoints:
        """Return the keypoints of some views."""
        return ViewKeypoints(*(values[list(views)] for values in self))


def stacked_keypoints(observations: Sequence[Observations]) -> ViewKeypoints:
    """Return the keypoints of the same birds in all views, float64."""
    px, confidence, box_px = (
        np.stack([getattr(own, name) for own in observations]).astype(np.float64)
        for name in ("keypoints_px", "confidence", "box_px")
    )
    side_px = np.maximum(box_px[..., 2:].max(-1), 1)
    return ViewKeypoints(px, confidence, np.broadcast_to(side_px[..., None], confidence.shape))


def assign_cameras(
    cameras: Sequence[Camera], observations: Sequence[Observations], sources: Sequence[object]
) -> tuple[Camera, ...]:
    """Return the camera of each file of observations, with the size of its images.

    If every file, or its folder, has the name of a camera, names decide, and the other cameras are not used. Else the
    order decides, and there must be one file for each camera.

    Raises:
        InputError: the numbers differ, or a camera has another size than its images.
    """
    by_name = {camera.name: camera for camera in cameras}
    named = [camera for source in sources if (camera := _named(source, by_name))]
    if len(named) == len(sources) == len({camera.name for camera in named}):
        cameras = named
    if len(cameras) != len(observations):
        problem = f"{len(cameras)} cameras ({', '.join(by_name)}), but {len(observations)} files of observations"
        remedy = (
            "give each file, or its folder, the name of its camera; or give one file for each camera, in their order"
        )
        raise InputError("--cameras", problem, remedy)
    assigned = []
    for camera, own, source in zip(cameras, observations, sources, strict=True):
        sizes = {(int(w), int(h)) for w, h in own.image_size_px}
        if len(sizes) > 1 or own.own_images:
            raise InputError(source, "holds images of several sizes", "a calibrated camera has one image size")
        expected = camera.size_px
        size = next(iter(sizes), expected)
        if size and expected and size != expected:
            problem = f"has images of {size[0]}×{size[1]}, but camera {camera.name} has {expected[0]}×{expected[1]}"
            raise InputError(source, problem, "check the order of the files, or calibrate with the size of the video")
        assigned.append(replace(camera, size_px=size))
    return tuple(assigned)


def _named(source: object, cameras: Mapping[str, Camera]) -> Camera | None:
    parts = str(source).replace("\\", "/").split("/")
    stem = parts[-1].partition(".")[0]
    return cameras.get(stem) or (cameras.get(parts[-2]) if len(parts) > 1 else None)


def straightened(
    camera: Camera, observations: Observations, progress: ProgressTask = silent
) -> tuple[Camera, Observations]:
    """Return a camera without distortion, and the observations in its pixels.

    The picture of the new camera holds the whole image, at most `MAX_CANVAS` times its size. Keypoints that the lens
    model cannot show are missing. Masks are resampled, with half a pixel as the threshold.
    """
    if camera.is_pinhole:
        return camera.pinhole(), observations
    width, height = camera.size_px or (0, 0)
    x, y = np.linspace(0, width, 65), np.linspace(0, height, 65)
    edges = [(x, 0 * x), (x, 0 * x + height), (0 * y, y), (0 * y + width, y)]
    border = np.concatenate([np.stack(edge, axis=1) for edge in edges])
    straight = camera.undistort(border)
    straight = straight[np.isfinite(straight).all(-1)]
    margin = (MAX_CANVAS - 1) / 2 * np.array([width, height])
    low = np.floor(np.maximum(straight.min(axis=0, initial=0), -margin)).astype(int)
    high = np.ceil(np.minimum(straight.max(axis=0, initial=0), margin + np.array([width, height]))).astype(int)
    matrix = camera.matrix.copy()
    matrix[:2, 2] -= low
    size = int(high[0] - low[0]), int(high[1] - low[1])
    new = replace(camera.pinhole(), matrix=matrix, size_px=size)
    grid = np.stack(np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5), axis=-1)
    source_px = np.nan_to_num(camera.distort(grid) - 0.5, nan=-1e4).astype(np.float32)

    found = observations.confidence > 0
    points_px = camera.undistort(observations.keypoints_px.astype(np.float64)) - low
    kept = found & np.isfinite(points_px).all(-1)
    x0, y0, w, h = np.moveaxis(observations.box_px.astype(np.float64), -1, 0)
    corners = np.stack([np.stack([x0 + i * w, y0 + j * h], -1) for i in (0, 0.5, 1) for j in (0, 0.5, 1)], axis=-2)
    corners = camera.undistort(corners) - low
    first, last = np.fmin.reduce(corners, axis=-2), np.fmax.reduce(corners, axis=-2)
    boxes = np.where(observations.present[..., None], np.concatenate([first, last - first], axis=-1), 0)
    boxes = np.nan_to_num(boxes)
    masks: dict[tuple[int, int], Mapping[str, Any]] = {}
    with progress(f"Removing the distortion of {camera.name}", len(observations.masks)) as report_progress:
        for (n, t), rle in observations.masks.items():
            mask = _straight_mask(rle, source_px, boxes[n, t], size)
            if mask is not None:
                masks[n, t] = mask
            report_progress(1, "")
    return new, replace(
        observations,
        keypoints_px=np.where(kept[..., None], points_px, 0).astype(np.float32),
        confidence=np.where(kept, observations.confidence, 0).astype(np.float32),
        box_px=boxes.astype(np.float32),
        image_size_px=np.tile(size, (observations.num_frames, 1)),
        masks=masks,
        amodal_masks={},
    )


def _straight_mask(
    rle: Mapping[str, Any], source_px: Float[np.ndarray, "H W 2"], box: np.ndarray, size: tuple[int, int]
) -> Mapping[str, Any] | None:
    """Return a mask in the picture without distortion, which lies within a box and its neighbourhood."""
    x, y, w, h = box
    margin = 4 + 0.1 * max(w, h)
    x0, y0 = (max(int(v - margin), 0) for v in (x, y))
    x1, y1 = min(int(x + w + margin) + 1, size[0]), min(int(y + h + margin) + 1, size[1])
    if x1 <= x0 or y1 <= y0:
        return None
    source = decode_mask(rle).astype(np.uint8) * np.uint8(255)
    patch = source_px[y0:y1, x0:x1]
    cut = cv2.remap(source, patch[..., 0], patch[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return encode_patch(cut >= 128, x0, y0, *size)


def on_common_frames(
    observations: Sequence[Observations], offset_frames: Sequence[float] | None = None
) -> tuple[Observations, ...]:
    """Return observations in the frames of the first camera, linear in between.

    Frame r of the first camera is at frame r·ρ + offset of another camera, with ρ the ratio of their frame rates (1 if
    a rate is unknown). Where both have time stamps and different rates, the time stamps take the place of r·ρ.

    Args:
        observations: one for each camera.
        offset_frames: for each camera, its frame number at frame 0 of the first camera. None: 0.

    Returns:
        Observations with the `frame_index` of the first camera.

    Raises:
        InputError: the cameras have no common time.
    """
    offsets = [0.0] * len(observations) if offset_frames is None else list(offset_frames)
    first = observations[0]
    numbers = first.frame_index
    if len(numbers) == 0:
        raise InputError("observations", "of the first camera hold no frame", "give cameras that see birds")
    moved = []
    for v, (own, offset) in enumerate(zip(observations, offsets, strict=True)):
        at = _own_numbers(first, own) + offset if own.num_frames else np.zeros(0)
        if not ((own.frame_index[:1] <= at) & (at <= own.frame_index[-1:])).any():
            problem = f"of camera {v + 1} have no time in common with those of the first camera"
            raise InputError("observations", problem, "check the frame numbers, the rates and the offsets")
        moved.append(own if own is first and not offset else _at_frames(own, at, first, v + 1))
    return tuple(moved)


def own_steps(observations: Sequence[Observations]) -> list[float]:
    """Return the number of frames of each camera between two frames of the first camera."""
    first = observations[0]
    numbers = [_own_numbers(first, own) for own in observations]
    return [float(np.median(np.diff(each))) if len(each) > 1 else 1.0 for each in numbers]


def _own_numbers(first: Observations, own: Observations) -> Float[np.ndarray, "T"]:
    """Return the frame number of a camera at each frame of the first camera."""
    numbers = first.frame_index.astype(np.float64)
    if own is first or first.fps is None or own.fps is None or abs(own.fps / first.fps - 1) < 1e-6:
        return numbers
    times, own_times = first.timestamp_s, own.timestamp_s
    if times is not None and own_times is not None and np.isfinite(times).all() and np.isfinite(own_times).all():
        known = np.interp(times, own_times, own.frame_index)
        outside = np.where(times < own_times[0], times - own_times[0], np.maximum(times - own_times[-1], 0))
        return known + outside * own.fps
    return numbers * own.fps / first.fps


def _at_frames(own: Observations, at: Float[np.ndarray, "T"], first: Observations, number: int) -> Observations:
    """Return observations at fractional frame numbers, as frames of the first camera."""
    numbers, last = own.frame_index, own.num_frames - 1
    i = np.searchsorted(numbers, at + WHOLE_FRAME, side="right") - 1  # the stored frame before, or the frame itself
    whole = np.abs(at - numbers[np.maximum(i, 0)]) < WHOLE_FRAME
    j = np.where(whole, i, i + 1)
    inside = (i >= 0) & (j <= last)
    i, j = np.clip(i, 0, last), np.clip(j, 0, last)
    gap = numbers[j] - numbers[i]
    known = inside & (gap <= max(1, LONGEST_GAP_S * (own.fps or 25)))
    lost = int((inside & ~known).sum())
    if lost:
        text = "camera %d lacks %d of %d frames: its own are more than %g s apart (track it with a smaller --step)"
        _logger.warning(text, number, lost, len(at), LONGEST_GAP_S)
    share = np.where(whole | (gap == 0), 0, (at - numbers[i]) / np.maximum(gap, 1)).astype(np.float32)

    def mixed(values: np.ndarray) -> np.ndarray:
        w = share.reshape(1, -1, *(1,) * (values.ndim - 2))
        return (1 - w) * values[:, i] + w * values[:, j]

    present, score = own.present[:, i] & own.present[:, j] & known, np.asarray(own.score)
    confidence = np.where(present[..., None], np.minimum(own.confidence[:, i], own.confidence[:, j]), 0)
    nearest = np.where(share < 0.5, i, j)
    masks = {}
    for n, t in np.argwhere(present).tolist():
        if (n, int(nearest[t])) in own.masks:
            masks[n, t] = own.masks[n, int(nearest[t])]
    return replace(
        own,
        frame_index=first.frame_index,
        present=present,
        keypoints_px=np.where(confidence[..., None] > 0, mixed(own.keypoints_px), 0).astype(np.float32),
        confidence=confidence.astype(np.float32),
        box_px=np.where(present[..., None], mixed(own.box_px), 0).astype(np.float32),
        score=np.where(present, np.minimum(score[:, i], score[:, j]), 0).astype(np.float32),
        occluded=None,
        keypoint_origin=None,
        image_size_px=np.broadcast_to(own.image_size_px[:1], (len(at), 2)),
        file_name=own.file_name[nearest],
        timestamp_s=first.timestamp_s,
        fps=first.fps,
        masks=masks,
        amodal_masks={},
    )


def birds_in_rows(observations: Observations, bird: Int[np.ndarray, "N T"], bird_ids: Sequence[int]) -> Observations:
    """Return the observations with one row for each bird.

    Args:
        observations: tracks of one camera.
        bird: number of the bird that each track shows in each frame, a position in `bird_ids`; −1 without a bird.
        bird_ids: new track ids.
    """
    T, B = observations.num_frames, len(bird_ids)
    row, best, own_score = np.full((B, T), -1), np.full((B, T), -1.0), np.asarray(observations.score)
    for n, t in np.argwhere((bird >= 0) & observations.present).tolist():
        b = bird[n, t]
        if own_score[n, t] > best[b, t]:
            row[b, t], best[b, t] = n, own_score[n, t]
    known, at, frames = row >= 0, np.maximum(row, 0), np.arange(T)

    def taken(values: np.ndarray) -> np.ndarray:
        if not observations.num_tracks:
            return np.zeros((B, T, *values.shape[2:]), values.dtype)
        picked = values[at, frames]
        return np.where(known.reshape(*known.shape, *(1,) * (picked.ndim - 2)), picked, 0)

    masks = {
        (b, t): observations.masks[int(row[b, t]), t]
        for b, t in np.argwhere(known).tolist()
        if (int(row[b, t]), t) in observations.masks
    }
    arrays = {name: taken(getattr(observations, name)) for name in ("keypoints_px", "confidence", "box_px", "score")}
    return replace(
        observations,
        track_id=np.asarray(bird_ids, np.int64),
        present=known,
        occluded=None,
        keypoint_origin=None,
        masks=masks,
        amodal_masks={},
        **arrays,
    )
