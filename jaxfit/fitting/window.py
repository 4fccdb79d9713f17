"""From observations to windows: which frames are fitted together, cut out how."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.config.fit import CropConfig, FitConfig
from jaxfit.data.observations import Observations
from jaxfit.errors import InputError
from jaxfit.fitting.filtering import weighted_median_filter
from jaxfit.model.camera import image_to_crop
from jaxfit.objective.posed_window import Targets

__all__ = ["Windows", "cut_windows", "filter_observations", "load_keypoints", "load_targets"]


@dataclass(frozen=True)
class Windows:
    """W windows of T frames, each of one track, as positions in the observations."""

    track: Int[np.ndarray, "W"]
    """Position of the window's track."""
    frame: Int[np.ndarray, "W T"]
    """Position of each frame; −1 where the video has no such frame (a gap, or past its end)."""
    present: Bool[np.ndarray, "W T"]
    """Whether the bird was seen well enough to be fitted in that frame."""
    crop: Float[np.ndarray, "W T 3"]
    """(x0, y0, size) in image pixels; whole numbers, one size a window."""

    def __len__(self) -> int:
        return len(self.track)

    def __getitem__(self, rows: slice | np.ndarray) -> Windows:
        return Windows(self.track[rows], self.frame[rows], self.present[rows], self.crop[rows])


def filter_observations(observations: Observations, window: int) -> Observations:
    """Smooth every track by the weighted median filter, over frame numbers (a gap stays a gap)."""
    if window == 1 or observations.num_frames == 1:
        return observations
    line = _timeline(observations)
    at = np.maximum(line, 0)
    seen = line >= 0
    confidence = np.where(seen[None, :, None], observations.confidence[:, at], 0)
    smooth = jax.vmap(weighted_median_filter, (0, 0, None))
    filtered = np.asarray(smooth(observations.keypoints_px[:, at], confidence, window))
    return observations.with_keypoints(filtered[:, seen], observations.confidence)


def cut_windows(observations: Observations, config: FitConfig) -> Windows:
    """Cut every track into consecutive windows of `config.window` frames, from its first usable frame on.

    Frames follow each other by number: where the file skips numbers, the window holds missing frames, so
    that no term takes distant frames for neighbours. Tracks without a usable frame get no window.
    """
    usable = observations.usable(config.min_keypoints)
    line = _timeline(observations)
    tracks, frames = [], []
    for n in range(observations.num_tracks):
        at = np.flatnonzero((line >= 0) & usable[n, np.maximum(line, 0)])
        if len(at) == 0:
            continue
        for first in range(at[0], at[-1] + 1, config.window):
            window = np.full(config.window, -1)
            piece = line[first : min(first + config.window, at[-1] + 1)]
            window[: len(piece)] = piece
            if ((window >= 0) & usable[n, np.maximum(window, 0)]).any():
                tracks.append(n)
                frames.append(window)
    track = np.array(tracks, int)
    frame = np.array(frames, int).reshape(len(tracks), config.window)
    present = (frame >= 0) & usable[track[:, None], np.maximum(frame, 0)]
    crop = (
        np.stack(
            [_crops(observations, int(n), f, p, config.crop) for n, f, p in zip(track, frame, present, strict=True)]
        )
        if len(track)
        else np.zeros((0, config.window, 3))
    )
    return Windows(track, frame, present, crop)


def load_targets(observations: Observations, windows: Windows, size_px: int) -> Targets:
    """Keypoints and masks of some windows in crop pixels (NumPy, with a leading W axis)."""
    keypoints_px, confidence = load_keypoints(observations, windows, size_px)
    mask = np.zeros((*windows.frame.shape, size_px, size_px), np.uint8)
    has_mask = np.zeros(windows.frame.shape, bool)
    for w, t in zip(*np.nonzero(windows.present), strict=True):
        full = observations.mask(int(windows.track[w]), int(windows.frame[w, t]))
        if full is not None:
            mask[w, t] = cut_mask(full, windows.crop[w, t], size_px)
            has_mask[w, t] = True
    return Targets(
        keypoints_px=keypoints_px,
        confidence=confidence,
        mask=mask,
        has_mask=has_mask,
        present=windows.present,
        corner_px=(windows.crop[..., :2] * size_px / windows.crop[..., 2:]).astype(np.float32),
    )


def load_keypoints(
    observations: Observations, windows: Windows, size_px: int
) -> tuple[Float[np.ndarray, "W T K 2"], Float[np.ndarray, "W T K"]]:
    """Keypoints of some windows in crop pixels, 0 where not seen, and their confidence."""
    track, frame = windows.track[:, None], np.maximum(windows.frame, 0)
    keypoints_px = image_to_crop(observations.keypoints_px[track, frame], windows.crop, size_px)
    confidence = observations.confidence[track, frame] * windows.present[..., None]
    seen = np.where(confidence[..., None] > 0, keypoints_px, 0)
    return seen.astype(np.float32), confidence.astype(np.float32)


def cut_mask(mask: Bool[np.ndarray, "H W"], crop: Float[np.ndarray, "3"], size_px: int) -> np.ndarray:
    """A mask's crop, (size_px, size_px) of 0 and 1: a pixel counts where at least half of it is covered."""
    x0, y0, size = (int(v) for v in crop)
    cut = np.zeros((size, size), np.uint8)
    rows, columns = mask.shape
    top, left, bottom, right = max(y0, 0), max(x0, 0), min(y0 + size, rows), min(x0 + size, columns)
    if top < bottom and left < right:
        cut[top - y0 : bottom - y0, left - x0 : right - x0] = mask[top:bottom, left:right]
    if size == size_px:
        return cut
    method = cv2.INTER_AREA if size > size_px else cv2.INTER_LINEAR
    covered = cv2.resize(cut * np.uint8(255), (size_px, size_px), interpolation=method)
    return (covered >= 128).astype(np.uint8)


def _timeline(observations: Observations) -> Int[np.ndarray, "L"]:
    """Position of every frame number from first to last, in the file's own step; −1 where it has none."""
    numbers = observations.frame_index
    step = int(np.gcd.reduce(np.diff(numbers))) if len(numbers) > 1 else 1
    if len(numbers) and (numbers[-1] - numbers[0]) // step > 100 * len(numbers):
        raise InputError(
            "observations",
            f"frame_index runs to {numbers[-1]} but holds {len(numbers)} frames",
            "number the frames consecutively",
        )
    at = (numbers - numbers[0]) // step if len(numbers) else np.zeros(0, int)
    line = np.full(int(at[-1]) + 1 if len(at) else 0, -1)
    line[at] = np.arange(len(at))
    return line


def _crops(observations: Observations, n: int, frame, present, config: CropConfig) -> Float[np.ndarray, "T 3"]:
    if config.mode == "image":
        sizes = {observations.image_size(n, int(t)) for t in frame[present]}
        if len(sizes) > 1 or any(width != height for width, height in sizes):
            raise InputError(
                "crop.mode: image",
                f"needs square images of one size, not {sorted(sizes)} (width, height)",
                "use crop.mode: box",
            )
        return np.broadcast_to([0.0, 0.0, sizes.pop()[0]], (len(frame), 3))
    corner = np.zeros((len(frame), 4))
    for i in np.flatnonzero(present):
        box, seen = observations.box_px[n, frame[i]], observations.confidence[n, frame[i]] > 0
        points = observations.keypoints_px[n, frame[i]][seen]
        if min(box[2:]) > 0:  # the box is the bird; keypoints may stray
            corner[i] = [*box[:2], *(box[:2] + box[2:])]
        else:
            corner[i] = [*points.min(0), *points.max(0)]
    longest = (corner[:, 2:] - corner[:, :2]).max()
    size = max(np.ceil(longest * (1 + 2 * config.padding)), 16.0)
    centre = (corner[:, :2] + corner[:, 2:]) / 2
    nearest = np.abs(np.arange(len(frame))[:, None] - np.flatnonzero(present)).argmin(1)
    centre = centre[np.flatnonzero(present)[nearest]]  # a missing frame looks where its neighbour did
    return np.concatenate([np.round(centre - size / 2), np.full((len(frame), 1), size)], axis=1)
