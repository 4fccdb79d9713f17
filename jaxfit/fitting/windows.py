"""Windows: the frames of one bird that are fitted together, with their keypoints and masks in crop pixels."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.config.fit import FitConfig
from jaxfit.data.frame_numbers import assumed_interval_s, frame_interval_s, frame_step
from jaxfit.data.masks import decode_mask
from jaxfit.data.neighbours import FrameMasks
from jaxfit.data.observations import Observations
from jaxfit.data.tables import check_memory
from jaxfit.errors import InputError
from jaxfit.fitting.crops import crop_squares, cut_mask, grow_mask, mark_unknown
from jaxfit.fitting.distant import without_distant_birds
from jaxfit.fitting.filtering import weighted_median_filter
from jaxfit.fitting.window_masks import LoadedMasks, WindowMasks
from jaxfit.limits import TABLE_GB
from jaxfit.model.camera import CROP_PX, image_to_crop
from jaxfit.objective.posed_window import Targets

__all__ = [
    "Windows",
    "cut_windows",
    "filter_observations",
    "first_frames",
    "load_targets",
    "prepare_observations",
    "window_content",
    "window_hash",
    "window_starts",
    "windows_at",
    "windows_key",
]

FILTER_BYTES = 50_000_000
"""Memory for the birds that are filtered at once."""


@dataclass(frozen=True)
class Windows:
    """W windows of T frames and K keypoints; a window belongs to one track."""

    track: Int[np.ndarray, "W"]
    """Position of the window's track in the observations."""
    track_id: Int[np.ndarray, "W"]
    """Id of the window's track."""
    frame: Int[np.ndarray, "W T"]
    """Position of each frame in the observations; −1 for frame numbers without a frame (a gap, or after the end)."""
    present: Bool[np.ndarray, "W T"]
    """Whether the bird has enough confident keypoints in the frame for a fit."""
    crop: Float[np.ndarray, "W T 3"]
    """(x0, y0, size) in image pixels; integers, with one size per window."""
    keypoints_px: Float[np.ndarray, "W T K 2"]
    """Crop pixels; 0 where the confidence is 0."""
    confidence: Float[np.ndarray, "W T K"]
    """In [0, 1]; 0 where a keypoint is missing."""
    has_mask: Bool[np.ndarray, "W T"]
    """Whether the bird has a mask in the frame."""
    masks: np.ndarray
    """(W,) objects: the `WindowMasks` of each window. `load_targets` reads and decodes the masks."""
    frame_s: Float[np.ndarray, "W"]
    """Time between consecutive frames of the window, in seconds; of a video of 25 frames/s if the rate is unknown."""

    def __len__(self) -> int:
        return len(self.track)

    def __getitem__(self, rows: slice | np.ndarray) -> Windows:
        return Windows(**{name: array[rows] for name, array in vars(self).items()})


def windows_key(config: FitConfig) -> tuple:
    """Return the part of the config that determines the windows and their targets."""
    frames = config.filter_window, config.window, config.overlap_frames, config.min_keypoints
    return *frames, config.crop, config.unknown_pixels, config.grow_masks_px


def window_content(windows: Windows, w: int) -> tuple:
    """Return the content of a window, which determines its fit under one config and model."""
    arrays = windows.frame, windows.present, windows.crop, windows.keypoints_px, windows.confidence, windows.frame_s
    masks: LoadedMasks = cast(Any, windows.masks[w]).load()
    lengths = tuple((tuple(rle["size"]), rle["counts"]) if rle else rle for rle in (*masks.own, *masks.others))
    return *(np.ascontiguousarray(each[w]).tobytes() for each in arrays), lengths


def window_hash(windows: Windows, w: int) -> str:
    """Return the SHA-256 hash of the content of a window."""
    return hashlib.sha256(repr(window_content(windows, w)).encode()).hexdigest()


def cut_windows(observations: Observations, config: FitConfig) -> Windows:
    """Cut every track into windows of `config.window` frames, from its first usable frame on.

    Consecutive windows share `config.overlap_frames` frame numbers. The frames of a window have consecutive frame
    numbers: if the file skips frame numbers, the window has missing frames, so that distant frames are not neighbours
    in the temporal terms. A track without a usable frame has no window.
    """
    prepared = prepare_observations(observations, config)
    return windows_at(prepared, config, window_starts(prepared, config, first_frames(prepared, config)))


def prepare_observations(observations: Observations, config: FitConfig) -> Observations:
    """Return the observations that windows are cut from.

    Frames with a box or a keypoint far outside the image (`distant_birds`) are not usable. Then the keypoints are
    filtered.
    """
    return filter_observations(without_distant_birds(observations), config.filter_window)


def first_frames(prepared: Observations, config: FitConfig) -> dict[int, int]:
    """Return track → number of its first usable frame, for the tracks with such a frame."""
    usable = prepared.usable(config.min_keypoints)
    some = np.flatnonzero(usable.any(1))
    first = prepared.frame_index[usable[some].argmax(1)]
    return dict(zip(prepared.track_id[some].tolist(), first.tolist(), strict=True))


def window_starts(prepared: Observations, config: FitConfig, first_frame: Mapping[int, int]) -> Int[np.ndarray, "W 3"]:
    """Return where the windows lie: position of the track; first position, and last usable position of the track.

    The two positions count the frame numbers from the first frame of the observations on, in the step of the file.

    Args:
        prepared: the result of `prepare_observations`.
        config: the lengths of windows.
        first_frame: track → frame number where its windows begin, which may lie before the observations. Other tracks
            have no windows.
    """
    usable = prepared.usable(config.min_keypoints)
    line, step = _timeline(prepared), frame_step(prepared.frame_index)
    starts: list[tuple[int, int, int]] = []
    for n, track in enumerate(prepared.track_id.tolist()):
        at = np.flatnonzero((line >= 0) & usable[n, np.maximum(line, 0)])
        if len(at) == 0 or track not in first_frame:
            continue
        begin = (first_frame[track] - int(prepared.frame_index[0])) // step
        stride = config.window - config.overlap_frames
        # only windows with a usable frame that no earlier window has
        wanted = np.unique(np.maximum(at - begin - config.overlap_frames, 0) // stride)
        starts += [(n, begin + w * stride, int(at[-1])) for w in wanted.tolist()]
    return np.array(starts, int).reshape(-1, 3)


def windows_at(prepared: Observations, config: FitConfig, starts: Int[np.ndarray, "W 3"]) -> Windows:
    """Return the windows at some places, as `window_starts` returns them."""
    line, usable = _timeline(prepared), prepared.usable(config.min_keypoints)
    needed = len(starts) * config.window * (80 + 60 * prepared.num_keypoints)
    what = f"the arrays of {len(starts):,} windows of {config.window:,} frames"
    check_memory("observations", what, needed, "lower `window` in the config", max(TABLE_GB, config.memory_gb))
    track = starts[:, 0]
    frame = np.full((len(starts), config.window), -1)
    for w, (_, first, last) in enumerate(starts.tolist()):
        piece = line[first : min(first + config.window, last + 1)]
        frame[w, : len(piece)] = piece
    rows, columns = track[:, None], np.maximum(frame, 0)
    present = (frame >= 0) & usable[rows, columns]
    crop = crop_squares(prepared, track, frame, present, config.crop)
    confidence = (prepared.confidence[rows, columns] * present[..., None]).astype(np.float32)
    keypoints_px = image_to_crop(prepared.keypoints_px[rows, columns], crop)
    frames, masks = FrameMasks(prepared), np.empty(len(track), object)
    for w, n in enumerate(track.tolist()):
        masks[w] = WindowMasks.of(frames, n, frame[w], present[w], crop[w], config.unknown_pixels)
    numbers = prepared.frame_index
    frame_s = frame_interval_s(numbers, prepared.timestamp_s, prepared.fps)
    return Windows(
        track=track,
        track_id=prepared.track_id[track],
        frame=frame,
        present=present,
        crop=crop,
        keypoints_px=np.where(confidence[..., None] > 0, keypoints_px, 0).astype(np.float32),
        confidence=confidence,
        has_mask=_has_mask(prepared, track, frame, present),
        masks=masks,
        frame_s=np.full(len(starts), frame_s or assumed_interval_s(numbers), np.float32),
    )


def _has_mask(
    observations: Observations,
    track: Int[np.ndarray, "W"],
    frame: Int[np.ndarray, "W T"],
    present: Bool[np.ndarray, "W T"],
) -> Bool[np.ndarray, "W T"]:
    """Return whether a bird has a mask, for the frames of some windows."""
    has_mask = np.zeros(frame.shape, bool)
    if observations.masks:
        for w, t in np.argwhere(present).tolist():
            has_mask[w, t] = (int(track[w]), int(frame[w, t])) in observations.masks
    return has_mask


def filter_observations(observations: Observations, window: int) -> Observations:
    """Smooth every track with the weighted median filter. Missing frame numbers count as frames without keypoints."""
    if window == 1 or observations.num_frames == 1:
        return observations
    line = _timeline(observations)
    at = np.maximum(line, 0)
    known = line >= 0
    bird_bytes = 40 * len(line) * window * observations.num_keypoints
    what = f"the windows of the filter over {len(line):,} frame numbers"
    check_memory("observations", what, bird_bytes, "lower `filter_window`, or number the frames consecutively")
    at_once = max(int(FILTER_BYTES / max(bird_bytes, 1)), 1)
    smooth = jax.vmap(weighted_median_filter, (0, 0, None))
    filtered = np.empty_like(observations.keypoints_px)
    for first in range(0, observations.num_tracks, at_once):
        some = slice(first, first + at_once)
        confidence = np.where(known[None, :, None], observations.confidence[some, at], 0)
        filtered[some] = np.asarray(smooth(observations.keypoints_px[some, at], confidence, window))[:, known]
    return observations.with_keypoints(filtered, observations.confidence)


def load_targets(windows: Windows, mask_px: int, grow_px: float = 0.0) -> Targets:
    """Decode the masks of some windows, and return the targets as NumPy arrays with a leading axis W.

    Args:
        windows: the windows. All their masks must fit into memory.
        mask_px: side of the masks in pixels. 0: the masks are empty and nothing is decoded.
        grow_px: distance by which the masks are enlarged, in pixels of a 256-pixel crop.
    """
    mask = np.zeros((*windows.frame.shape, mask_px, mask_px), np.uint8)
    needed = np.flatnonzero(windows.has_mask.any(1) & (mask_px > 0))
    for w in needed[np.argsort(windows.frame[needed].max(1), kind="stable")]:  # masks of a frame lie together in files
        masks: LoadedMasks = cast(Any, windows.masks[w]).load()
        for t in np.flatnonzero(windows.has_mask[w]).tolist():
            full = decode_mask(cast(Any, masks.own[t]))
            mask[w, t] = cut_mask(full, windows.crop[w, t], mask_px)
            others = masks.others[t]
            if others is not False:
                others = None if others is None else decode_mask(others)
                mark_unknown(mask[w, t], others, cast(Any, full.shape), windows.crop[w, t])
            if grow_px:
                grow_mask(mask[w, t], grow_px)
    return Targets(
        keypoints_px=windows.keypoints_px,
        confidence=windows.confidence,
        mask=mask,
        has_mask=windows.has_mask,
        present=windows.present,
        corner_px=(windows.crop[..., :2] * CROP_PX / windows.crop[..., 2:]).astype(np.float32),
        frame_s=windows.frame_s,
    )


def _timeline(observations: Observations) -> Int[np.ndarray, "L"]:
    """Return the positions of all frame numbers from first to last, in the file's step; −1 for missing numbers."""
    numbers = observations.frame_index
    step = frame_step(numbers)
    if len(numbers) and (numbers[-1] - numbers[0]) // step > 100 * len(numbers):
        raise InputError(
            "observations",
            f"frame_index ends at {numbers[-1]}, but the file has only {len(numbers)} frames",
            "number the frames consecutively",
        )
    at = (numbers - numbers[0]) // step if len(numbers) else np.zeros(0, int)
    line = np.full(int(at[-1]) + 1 if len(at) else 0, -1)
    line[at] = np.arange(len(at))
    return line
