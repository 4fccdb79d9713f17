"""Filters keypoints, cuts tracks into windows, reads the targets of windows.

The masks of a window, which are read when the window is fitted. The masks of a long video never lie in memory together.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxfit.config.fit import FitConfig
from jaxfit.data.masks import decode_columns
from jaxfit.data.observations import FROM_LABEL, FrameMasks, Observations
from jaxfit.data.tracks import assumed_interval_s, frame_interval_s, frame_step
from jaxfit.fitting.crops import crop_squares, cut_mask, mark_unknown
from jaxfit.foundation.array_files import MAX_TABLE_GB, check_memory
from jaxfit.foundation.errors import InputError
from jaxfit.model.camera import CROP_PX, image_to_crop
from jaxfit.objective.posed_window import Targets, ViewMaps

MAX_UNROLLED = 8
"""Frames of the filter's window that are compared without a loop, which is several times faster."""


def weighted_median_filter(
    keypoints_px: Float[Array | np.ndarray, "T K 2"],
    confidence: Float[Array | np.ndarray, "T K"],
    window: int = 5,
) -> Float[Array, "T K 2"]:
    """Return the weighted median of each keypoint over a window of frames, separately for x and y.

    Let x_1 ≤ x_2 ≤ … be the sorted values of the window, and c_1, c_2, … their confidences. The filtered value is x_k
    with the smallest k for which c_1 + … + c_k ≥ ½ Σ c.

    The window is centred on the frame and is shorter at both ends of the array. A missing keypoint has confidence 0
    and does not contribute. Its filtered value is the median of its neighbours, but the caller keeps its confidence
    of 0, so the keypoint does not become a detection. If a keypoint is missing in all frames of the window, its input
    is returned.

    Args:
        keypoints_px: x, y in image pixels; any value where the confidence is 0.
        confidence: weight of each keypoint, 0 or more.
        window: number of consecutive frames, odd.

    Returns:
        Filtered x, y in image pixels.

    Raises:
        ValueError: `window` is not odd and positive.

    Source: Hägerlind et al. 2024, the filter over detected keypoints.
    """
    if window < 1 or window % 2 == 0:
        raise ValueError(f"window must be odd and positive, not {window}")
    T, half_window, unroll = len(keypoints_px), window // 2, min(window, MAX_UNROLLED)
    points = jnp.pad(jnp.asarray(keypoints_px), ((half_window, half_window), (0, 0), (0, 0)))
    weights = jnp.pad(jnp.asarray(confidence), ((half_window, half_window), (0, 0)))[..., None]

    def over_window(step, start):
        return jax.lax.fori_loop(0, window, step, start, unroll=unroll)

    def shifted(array, i):
        return jax.lax.dynamic_slice_in_dim(array, i, T)

    total = over_window(lambda i, total: total + shifted(weights, i), jnp.zeros_like(weights[:T]))
    # a sum of exactly half must pass in spite of rounding errors
    half = total * (0.5 - 4 * jnp.finfo(total.dtype).eps)

    def smaller(i, median):
        value = shifted(points, i)

        def add(j, below):
            return below + jnp.where(shifted(points, j) <= value, shifted(weights, j), 0)

        below = over_window(add, jnp.zeros_like(value))
        return jnp.where(below >= half, jnp.minimum(median, value), median)

    # comparing all pairs is many times faster than sorting: windows are short
    median = over_window(smaller, jnp.full_like(points[:T], jnp.inf))
    return jnp.where(total > 0, median, keypoints_px)


_filter_birds = jax.jit(jax.vmap(weighted_median_filter, (0, 0, None)), static_argnums=2)

_logger = logging.getLogger(__name__)

MAX_DISTANCE_IMAGE_SIDES = 1.0
"""Largest distance of a box or a keypoint outside its image, as a multiple of the image's longer side. A fit skips and
reports frames with a larger distance."""
_LISTED_FRAMES = 10
_PROBLEM = (
    f"a box or a keypoint lies more than {MAX_DISTANCE_IMAGE_SIDES:g} × the image's longer side outside the image"
)


def distant_birds(observations: Observations) -> Bool[np.ndarray, "N T"]:
    """Return where the box or a keypoint of a bird is far outside its image.

    The distance is measured in x and in y, from the nearest edge of the image. It is far if it exceeds
    `MAX_DISTANCE_IMAGE_SIDES` times the longer side of the image. Missing keypoints do not count.
    """
    size_px = observations.image_sizes_px()
    allowed_px = MAX_DISTANCE_IMAGE_SIDES * size_px.max(-1, keepdims=True)
    corner_px, extent_px = (observations.box_px[..., axes].astype(np.float64) for axes in (slice(2), slice(2, 4)))
    keypoints = (observations.keypoints_px[:, :, k] for k in range(observations.num_keypoints))  # (0, 0) if missing
    distant = np.zeros(observations.present.shape, bool)
    for points_px in (corner_px, corner_px + extent_px, *keypoints):
        distant |= ((points_px < -allowed_px) | (points_px > size_px + allowed_px)).any(-1)
    return distant & observations.present


def without_distant_birds(observations: Observations) -> Observations:
    """Return the observations without the birds of `distant_birds`, each in the frames in which it is distant."""
    distant = distant_birds(observations)
    if not distant.any():
        return observations
    confidence = np.where(distant[..., None], np.float32(0), observations.confidence)
    return replace(observations, present=observations.present & ~distant, confidence=confidence)


def report_distant_birds(observations: Observations, source: object) -> dict[int, tuple[str, ...]]:
    """Return track → text about its frames with a distant bird, as `Solution.failures`, and log one warning.

    Args:
        observations: the observations.
        source: name of the observations in the warning.
    """
    distant = distant_birds(observations)
    reports = {}
    for n in np.flatnonzero(distant.any(1)).tolist():
        frames = observations.frame_index[distant[n]].tolist()
        listed = ", ".join(map(str, frames[:_LISTED_FRAMES]))
        more = f" and {len(frames) - _LISTED_FRAMES} more" if len(frames) > _LISTED_FRAMES else ""
        text = f"{'frame' if len(frames) == 1 else 'frames'} {listed}{more} skipped: {_PROBLEM}"
        reports[int(observations.track_id[n])] = (text,)
    if reports:
        track, (text,) = next(iter(reports.items()))
        others = len(reports) - 1
        more = f" (and {others} more {'track' if others == 1 else 'tracks'})" if others else ""
        _logger.warning("%s: track %d, %s%s", source, track, text, more)
    return reports


class LoadedMasks(NamedTuple):
    """The masks of a window of T frames, as run lengths."""

    own: tuple[Mapping[str, Any] | None, ...]
    """The bird's mask in each image; None without a mask."""
    others: tuple[Mapping[str, Any] | Literal[False] | None, ...]
    """The masks of all other birds that reach into the crop; None without them. False where the pixels outside the
    bird's mask are background."""


class WindowMasks:
    """A reference to the masks of a window. A pickle holds the masks themselves, for workers.

    Args:
        load: returns the masks.
    """

    def __init__(self, load: Callable[[], LoadedMasks]):
        self.load = load

    def __reduce__(self) -> tuple[Any, ...]:
        return _loaded, (self.load(),)

    @classmethod
    def of(
        cls,
        frames: FrameMasks,
        n: int,
        frame: Int[np.ndarray, "T"],
        present: Bool[np.ndarray, "T"],
        crop: Float[np.ndarray, "T 3"],
        unknown_pixels: bool,
    ) -> WindowMasks:
        """Return the reference of one window.

        Args:
            frames: the masks of the video.
            n: position of the track.
            frame: positions of the frames.
            present: the frames that are fitted; other frames have no masks.
            crop: x0, y0, size in image pixels.
            unknown_pixels: whether the masks of other birds are needed.
        """

        def load() -> LoadedMasks:
            at = [t if there else -1 for t, there in zip(frame.tolist(), present.tolist(), strict=True)]
            own = tuple(None if t < 0 else frames.mask(n, t) for t in at)
            if not unknown_pixels:
                return LoadedMasks(own, (False,) * len(at))
            boxes = crop[:, [0, 1, 2, 2]]
            others = (None if t < 0 else frames.union_of_others(n, t, boxes[i]) for i, t in enumerate(at))
            return LoadedMasks(own, tuple(others))

        return cls(load)


def _loaded(masks: LoadedMasks) -> WindowMasks:
    return WindowMasks(lambda: masks)


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
    crop: Float[np.ndarray, "W T *V 3"]
    """(x0, y0, size) in image pixels; integers, with one size per window."""
    keypoints_px: Float[np.ndarray, "W T K 2"]
    """Crop pixels; 0 where the confidence is 0."""
    confidence: Float[np.ndarray, "W T K"]
    """In [0, 1]; 0 where a keypoint is missing."""
    has_mask: Bool[np.ndarray, "W T *V"]
    """Whether the bird has a mask in the frame."""
    masks: np.ndarray
    """(W,) objects: the `WindowMasks` of each window. `load_targets` reads and decodes the masks."""
    frame_s: Float[np.ndarray, "W"]
    """Time between consecutive frames of the window, in seconds; of a video of 25 frames/s if the rate is unknown."""
    all_orientations: Bool[np.ndarray, "W"] | None = None
    """Whether the initial poses are searched among all orientations; None: as `initialise.method` says."""
    views: ViewMaps | None = None
    """The cameras of several views. Then `keypoints_px` and `confidence` hold the keypoints of all views, one view
    after the other, and `has_mask`, `masks` and `crop` have an axis V after T (`masks`: after W)."""

    def __len__(self) -> int:
        return len(self.track)

    def __getitem__(self, rows: slice | np.ndarray) -> Windows:
        return Windows(**{name: jax.tree.map(lambda x: x[rows], array) for name, array in vars(self).items()})


def windows_key(config: FitConfig) -> tuple:
    """Return the part of the config that determines the windows and their targets."""
    frames = config.filter_window, config.window, config.overlap_frames, config.min_keypoints
    return *frames, config.crop, config.unknown_pixels


def window_content(windows: Windows, w: int) -> tuple:
    """Return the content of a window, which determines its fit under one config and model."""
    arrays = windows.frame, windows.present, windows.crop, windows.keypoints_px, windows.confidence, windows.frame_s
    masks: LoadedMasks = cast(Any, windows.masks[w]).load()
    lengths = tuple((tuple(rle["size"]), rle["counts"]) if rle else rle for rle in (*masks.own, *masks.others))
    around = windows.all_orientations is not None and bool(windows.all_orientations[w])
    return *(np.ascontiguousarray(each[w]).tobytes() for each in arrays), lengths, around


def window_hash(windows: Windows, w: int, more: bytes = b"") -> str:
    """Return the SHA-256 hash of the content of a window, and of further content."""
    return hashlib.sha256(repr(window_content(windows, w)).encode() + more).hexdigest()


def cut_windows(observations: Observations, config: FitConfig) -> Windows:
    """Cut every track into windows of `config.window` frames, from its first usable frame on.

    Consecutive windows share `config.overlap_frames` frame numbers. The frames of a window have consecutive frame
    numbers: if the file skips frame numbers, the window has missing frames, so that distant frames are not neighbours
    in the temporal terms. A track without a usable frame has no window.
    """
    prepared = prepare_observations(observations, config)
    return windows_at(prepared, config, window_starts(prepared, config))


def prepare_observations(observations: Observations, config: FitConfig) -> Observations:
    """Return the observations that windows are cut from.

    Frames with a box or a keypoint far outside the image (`distant_birds`) are not usable. Then the keypoints are
    filtered.
    """
    return filter_observations(without_distant_birds(observations), config.filter_window)


def window_starts(prepared: Observations, config: FitConfig) -> Int[np.ndarray, "W 3"]:
    """Return where the windows lie: position of the track; first position, and last usable position of the track.

    The two positions count the frame numbers from the first frame of the observations on, in the step of the file. The
    windows of a track begin at its first usable frame; a track without one has no windows.

    Args:
        prepared: the result of `prepare_observations`.
        config: the lengths of windows.
    """
    usable = prepared.usable(config.min_keypoints)
    line, stride = _timeline(prepared), config.window - config.overlap_frames
    starts: list[tuple[int, int, int]] = []
    for n in np.flatnonzero(usable.any(1)).tolist():
        at = np.flatnonzero((line >= 0) & usable[n, np.maximum(line, 0)])
        # only windows with a usable frame that no earlier window has
        wanted = np.unique(np.maximum(at - at[0] - config.overlap_frames, 0) // stride)
        starts += [(n, int(at[0]) + w * stride, int(at[-1])) for w in wanted.tolist()]
    return np.array(starts, int).reshape(-1, 3)


def window_frames(prepared: Observations, config: FitConfig, starts: Int[np.ndarray, "W 3"]) -> Int[np.ndarray, "W T"]:
    """Return the positions of the frames of windows, −1 where a window has no frame."""
    line = _timeline(prepared)
    frame = np.full((len(starts), config.window), -1)
    for w, (_, first, last) in enumerate(starts.tolist()):
        piece = line[first : min(first + config.window, last + 1)]
        frame[w, : len(piece)] = piece
    return frame


def windows_at(prepared: Observations, config: FitConfig, starts: Int[np.ndarray, "W 3"]) -> Windows:
    """Return the windows at some places, as `window_starts` returns them."""
    usable = prepared.usable(config.min_keypoints)
    needed = len(starts) * config.window * (80 + 60 * prepared.num_keypoints)
    what = f"the arrays of {len(starts):,} windows of {config.window:,} frames"
    check_memory("observations", what, needed, "lower `window` in the config", max(MAX_TABLE_GB, config.memory_gb))
    track = starts[:, 0]
    frame = window_frames(prepared, config, starts)
    rows, columns = track[:, None], np.maximum(frame, 0)
    present = (frame >= 0) & usable[rows, columns]
    crop = crop_squares(prepared, track, frame, present, config.crop)
    confidence = np.zeros((*frame.shape, prepared.num_keypoints), np.float32)
    keypoints_px = np.zeros((*confidence.shape, 2), np.float32)
    frames, masks, has_mask = FrameMasks(prepared), np.empty(len(track), object), np.zeros(frame.shape, bool)
    for w, n in enumerate(track.tolist()):
        confidence[w] = prepared.confidence[n, columns[w]] * present[w, :, None]
        points_px = image_to_crop(prepared.keypoints_px[n, columns[w]], crop[w])
        keypoints_px[w] = np.where(confidence[w, ..., None] > 0, points_px, 0)
        if prepared.masks:
            has_mask[w] = present[w] & [(n, t) in prepared.masks for t in frame[w].tolist()]
        masks[w] = WindowMasks.of(frames, n, frame[w], present[w], crop[w], config.unknown_pixels)
    numbers = prepared.frame_index
    frame_s = frame_interval_s(numbers, prepared.timestamp_s, prepared.fps)
    return Windows(
        track=track,
        track_id=prepared.track_id[track],
        frame=frame,
        present=present,
        crop=crop,
        keypoints_px=keypoints_px,
        confidence=confidence,
        has_mask=has_mask,
        masks=masks,
        frame_s=np.full(len(starts), frame_s or assumed_interval_s(numbers), np.float32),
    )


def filter_observations(observations: Observations, window: int) -> Observations:
    """Smooth every track with the weighted median filter. Missing frame numbers count as frames without keypoints.

    Keypoints that a person has placed stay as they are.
    """
    if window == 1 or observations.num_frames == 1:
        return observations
    line = _timeline(observations)
    at = np.maximum(line, 0)
    known = line >= 0
    bird_bytes = 40 * len(line) * observations.num_keypoints
    what = f"the arrays of the filter over {len(line):,} frame numbers"
    check_memory("observations", what, bird_bytes, "number the frames consecutively")
    at_once = max(int(FILTER_BYTES / max(bird_bytes, 1)), 1)
    filtered = np.empty_like(observations.keypoints_px)
    for first in range(0, observations.num_tracks, at_once):
        some = slice(first, first + at_once)
        confidence = np.where(known[None, :, None], observations.confidence[some, at], 0)
        filtered[some] = np.asarray(_filter_birds(observations.keypoints_px[some, at], confidence, window))[:, known]
    is_label = (cast(np.ndarray, observations.keypoint_origin) == FROM_LABEL)[..., None] & (
        observations.confidence == 1
    )
    filtered[is_label] = observations.keypoints_px[is_label]
    return observations.with_keypoints(filtered, observations.confidence)


def load_targets(windows: Windows, mask_px: int) -> Targets:
    """Decode the masks of some windows, and return the targets as NumPy arrays with a leading axis W.

    Args:
        windows: the windows. All their masks must fit into memory.
        mask_px: side of the masks in pixels. 0: the masks are empty and nothing is decoded.
    """
    mask = np.zeros((*windows.has_mask.shape, mask_px, mask_px), np.uint8)
    W, T = windows.frame.shape
    V = 1 if windows.views is None else windows.has_mask.shape[2]
    has_mask, crops, masks = windows.has_mask.reshape(W, T, V), windows.crop.reshape(W, T, V, 3), windows.masks
    cuts = mask.reshape(W, T, V, mask_px, mask_px)
    needed = np.flatnonzero(has_mask.any((1, 2)) & (mask_px > 0))
    for w in needed[np.argsort(windows.frame[needed].max(1), kind="stable")]:  # masks of a frame lie together in files
        for v, reference in enumerate([masks[w]] if windows.views is None else masks[w]):
            if has_mask[w, :, v].any():
                _cut_masks(cast(Any, reference).load(), has_mask[w, :, v], crops[w, :, v], cuts[w, :, v])
    return Targets(
        keypoints_px=windows.keypoints_px,
        confidence=windows.confidence,
        mask=mask,
        has_mask=windows.has_mask,
        present=windows.present,
        corner_px=(windows.crop[..., :2] * CROP_PX / windows.crop[..., 2:]).astype(np.float32),
        frame_s=windows.frame_s,
        views=windows.views,
    )


def _cut_masks(
    masks: LoadedMasks,
    has_mask: Bool[np.ndarray, "T"],
    crop: Float[np.ndarray, "T 3"],
    cuts: UInt8[np.ndarray, "T S S"],
) -> None:
    """Write the crops of the masks of one window in one view to `cuts`."""
    rows = np.flatnonzero(has_mask).tolist()
    own, others = {t: cast(Any, masks.own[t]) for t in rows}, {t: masks.others[t] for t in rows}
    near = {t: mask for t, mask in others.items() if isinstance(mask, Mapping)}
    columns = {t: (int(crop[t, 0]), int(crop[t, 0] + crop[t, 2])) for t in rows}
    decoded = decode_columns([*own.values(), *near.values()], [columns[t] for t in (*own, *near)])
    for t in rows:
        cuts[t] = cut_mask(next(decoded), crop[t], cuts.shape[-1])
    for t in rows:
        if others[t] is not False:
            mark_unknown(cuts[t], next(decoded) if t in near else None, tuple(own[t]["size"]), crop[t])


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
