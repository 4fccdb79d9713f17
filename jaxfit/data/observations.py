"""`Observations`: keypoints, masks and boxes of the birds of a video, and the masks near a bird."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import chain
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Float, Real

from jaxfit.data.footage import FootageIdentity
from jaxfit.data.masks import decode_mask
from jaxfit.foundation.array_files import validate_arrays
from jaxfit.foundation.errors import InputError

_LAYOUT = {
    "track_id": ("N", np.int64),
    "frame_index": ("T", np.int64),
    "present": ("N T", np.bool_),
    "keypoints_px": ("N T K 2", np.float32),
    "confidence": ("N T K", np.float32),
    "occluded": ("N T K", np.bool_),
    "score": ("N T", np.float32),
    "keypoint_origin": ("N T", np.int8),
    "box_px": ("N T 4", np.float32),
    "image_size_px": ("T 2", np.int64),
    "file_name": ("T", np.str_),
    "keypoint_names": ("K", np.str_),
    "timestamp_s": ("T", np.float64),
}
CELLS = tuple(name for name, (shape, _) in _LAYOUT.items() if shape.startswith("N T"))
"""Arrays with a value for every track and frame."""
LARGEST_POSITION_PX = 1e6
"""Largest absolute image position; greater numbers overflow or have a wrong unit."""
KEYPOINT_ORIGINS = "", "label", "flow", "outline"
"""Where the keypoints of a bird in a frame come from: a detector or a file that does not say so; a person; a person's
label in another frame, by optical flow; the network that sees the mask alone."""
FROM_LABEL, FROM_FLOW, FROM_OUTLINE = 1, 2, 3
MIN_KEYPOINTS = 3
"""Fewer keypoints do not determine the orientation of a bird."""
MAPPINGS = ("masks", "amodal_masks", "own_images")
"""Values of some tracks and frames, by their positions."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Keypoints, boxes and masks of N tracks over T frames, with K keypoints per bird.

    The arrays are read-only NumPy arrays and are never traced. All positions are in image pixels: x right, y down;
    the centre of pixel (i, j) is at (i + 0.5, j + 0.5).

    Raises:
        ValueError: the shapes do not agree, ``skeleton`` names an absent keypoint, a ``track_id`` occurs twice,
            ``frame_index`` does not increase, a confidence or score is outside [0, 1], a confidence is above 0 where
            the bird is not present, a position is not finite, a time stamp is infinite, ``fps`` is not positive and
            finite, or a mask does not have the size of its image.
    """

    track_id: np.ndarray
    """(N,) int64: unique ids of the tracks."""
    frame_index: np.ndarray
    """(T,) int64: numbers of the frames in the video, increasing; the file lacks the frames in the gaps."""
    present: np.ndarray
    """(N, T) bool: the bird has an annotation in this frame."""
    keypoints_px: np.ndarray
    """(N, T, K, 2) float32: x, y in image pixels; 0 where the confidence is 0."""
    confidence: np.ndarray
    """(N, T, K) float32 in [0, 1]: confidence of each keypoint; 0 means missing."""
    box_px: np.ndarray
    """(N, T, 4) float32: x, y of the upper left corner, width, height, image pixels; 0 where not present."""
    image_size_px: np.ndarray
    """(T, 2) int64: width, height of the image of the frame; see ``own_images``."""
    file_name: np.ndarray
    """(T,) str: file name of the image of the frame; see ``own_images``."""
    keypoint_names: tuple[str, ...]
    """K names in the order of the arrays."""
    skeleton: tuple[tuple[int, int], ...] = ()
    """Pairs of keypoints, counted from 0, that drawings connect by a line."""
    masks: Mapping[tuple[int, int], Mapping[str, Any]] = field(default_factory=dict)
    """(n, t) → run lengths of the mask of the bird, in the format of pycocotools; ``mask`` decodes a mask."""
    own_images: Mapping[tuple[int, int], tuple[str, int, int]] = field(default_factory=dict)
    """(n, t) → file name, width, height, where the image of a bird is not the image of the frame: in sets of
    photographs, every bird has frame 0 of an image of its own. Empty for video."""
    species: Mapping[int, str] = field(default_factory=dict)
    """Track id → name of the species. Tracks without a name are of one species. Empty if all tracks are."""
    occluded: np.ndarray | None = None
    """(N, T, K) bool: the keypoint is hidden, but its position is known. None means that no keypoint is hidden."""
    amodal_masks: Mapping[tuple[int, int], Mapping[str, Any]] = field(default_factory=dict)
    """(n, t) → run lengths of the whole bird including hidden parts, where they are known (simulated truth)."""
    score: np.ndarray | None = None
    """(N, T) float32 in [0, 1]: score of the detection of the bird; 0 where not present. None means 1 where
    present."""
    keypoint_origin: np.ndarray | None = None
    """(N, T) int8: where the keypoints come from, as a position in `KEYPOINT_ORIGINS`. None means 0."""
    timestamp_s: np.ndarray | None = None
    """(T,) float64: presentation times of the frames in seconds, as ``jaxfit.video.reader.Frame.time_s``; NaN where the
    time is unknown. None means that no time is known."""
    fps: float | None = None
    """Mean frame rate of the whole video in frames per second, as its container states; None if unknown."""
    footage: FootageIdentity | None = None
    """Identity of the whole video; None if unknown."""

    def __post_init__(self):
        occluded = np.zeros(np.shape(self.confidence), bool) if self.occluded is None else self.occluded
        score = np.asarray(self.present, np.float32) if self.score is None else self.score
        timestamp_s = np.full(np.shape(self.frame_index), np.nan) if self.timestamp_s is None else self.timestamp_s
        origin = np.zeros(np.shape(self.present), np.int8) if self.keypoint_origin is None else self.keypoint_origin
        values = {**vars(self), "keypoint_names": list(self.keypoint_names), "occluded": occluded, "score": score}
        arrays = validate_arrays(values | {"timestamp_s": timestamp_s, "keypoint_origin": origin}, _LAYOUT)
        check_times(arrays["timestamp_s"], self.fps)
        names = tuple(str(name) for name in arrays.pop("keypoint_names"))
        twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
        if twice is not None or not all(names):
            raise ValueError(
                f"keypoint_names must be different names, but hold {twice!r} twice"
                if twice
                else "keypoint_names must not hold an empty name"
            )
        if any(not 0 <= k < len(names) for pair in self.skeleton for k in pair):
            raise ValueError(f"skeleton names keypoints outside 0…{len(names) - 1}")
        if len(np.unique(arrays["track_id"])) < len(arrays["track_id"]):
            raise ValueError(f"track_id must name each track once, not {arrays['track_id'].tolist()}")
        if (np.diff(arrays["frame_index"]) <= 0).any():
            raise ValueError("frame_index must increase")
        confidence, present = arrays["confidence"], arrays["present"]
        for name in ("confidence", "score"):
            if not ((arrays[name] >= 0) & (arrays[name] <= 1)).all():
                raise ValueError(f"{name} must lie in [0, 1]")
        if confidence[~present].any():
            raise ValueError("confidence must be 0 where present is False")
        if (arrays["occluded"] & (confidence <= 0)).any():
            arrays["occluded"] = arrays["occluded"] & (confidence > 0)
            arrays["occluded"].flags.writeable = False
        needed = {"keypoints_px": confidence[..., None] > 0, "box_px": present[..., None], "score": present}
        for name, there in needed.items():
            # absent values become 0, so that a NaN among them cannot reach a sum
            values = arrays[name]
            if (~there & (values != 0)).any():
                values = np.where(there, values, np.float32(0))
            if not np.isfinite(values).all():
                raise ValueError(f"{name} must be finite where it is not missing")
            if np.abs(values).max(initial=0) > LARGEST_POSITION_PX:
                raise ValueError(f"{name} holds {np.abs(values).max():g}, which is no position in an image in pixels")
            values.flags.writeable = False
            arrays[name] = values
        for name, value in (arrays | {"keypoint_names": names}).items():
            object.__setattr__(self, name, value)
        for name in ("masks", "amodal_masks"):
            masks = getattr(self, name)
            for (n, t), rle in masks.items():
                width, height = self.image_size(n, t)
                if tuple(rle["size"]) != (height, width):
                    problem = f"{name}[{n}, {t}] is {rle['size']}, its image {[height, width]} (height, width)"
                    raise ValueError(problem)

    @property
    def num_tracks(self) -> int:
        """N."""
        return len(self.track_id)

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.frame_index)

    @property
    def num_keypoints(self) -> int:
        """K."""
        return len(self.keypoint_names)

    @property
    def photographs(self) -> int:
        """Number of photographs; 0 for video, where all birds of a frame share an image."""
        if not self.own_images:
            return 0
        return len({self.image_file(n, t) for n, t in np.argwhere(self.present).tolist()})

    def _position(self, n: int, t: int) -> tuple[int, int]:
        # negative positions count from the end; IndexError outside
        return range(self.num_tracks)[n], range(self.num_frames)[t]

    def mask(self, n: int, t: int) -> np.ndarray | None:
        """Return the mask of a bird; each call decodes the mask.

        Args:
            n: position of the track.
            t: position of the frame.

        Returns:
            (H, W) bool, pixels of the image of the bird; None where there is no mask.
        """
        rle = self.masks.get(self._position(n, t))
        return None if rle is None else decode_mask(rle)

    def whole_mask(self, n: int, t: int) -> np.ndarray | None:
        """Return the mask of the whole bird including hidden parts where it is known, else ``mask``."""
        rle = self.amodal_masks.get(self._position(n, t))
        return self.mask(n, t) if rle is None else decode_mask(rle)

    def image_size(self, n: int, t: int) -> tuple[int, int]:
        """Return the width and height in pixels of the image of track ``n`` at frame ``t``."""
        n, t = self._position(n, t)
        image = self.own_images.get((n, t))
        return image[1:] if image else (int(self.image_size_px[t, 0]), int(self.image_size_px[t, 1]))

    def image_sizes_px(self) -> np.ndarray:
        """Return the width and height in pixels of the images of all tracks and frames, (N, T, 2) int64."""
        sizes = np.broadcast_to(self.image_size_px, (*self.present.shape, 2))
        if self.own_images:
            sizes = sizes.copy()
            for at, (_, width, height) in self.own_images.items():
                sizes[at] = width, height
        return sizes

    def image_file(self, n: int, t: int) -> str:
        """Return the file name of the image of track ``n`` at frame ``t``."""
        n, t = self._position(n, t)
        image = self.own_images.get((n, t))
        return image[0] if image else str(self.file_name[t])

    def usable(self, min_keypoints: int = MIN_KEYPOINTS) -> np.ndarray:
        """Return where a bird can be fitted, (N, T) bool: it is present with ``min_keypoints``.

        With 0, a bird without any keypoint can be fitted if it has a mask, and its track a keypoint in another frame.
        """
        known = (self.confidence > 0).sum(-1)
        usable = self.present & (known >= min_keypoints)
        for n, t in np.argwhere(usable & (known == 0)).tolist():
            usable[n, t] = (n, t) in self.masks and known[n].any()
        return usable

    def select(self, tracks: Any = None, frames: Any = None) -> Observations:
        """Return the observations of some tracks and frames.

        Args:
            tracks: positions along N as a NumPy index: a slice, integers or bools; None keeps all.
            frames: positions along T as a NumPy index, in increasing order; None keeps all.
        """
        rows = np.arange(self.num_tracks)[slice(None) if tracks is None else tracks].reshape(-1)
        columns = np.arange(self.num_frames)[slice(None) if frames is None else frames].reshape(-1)
        new_row = {old: new for new, old in enumerate(rows.tolist())}
        new_column = {old: new for new, old in enumerate(columns.tolist())}

        def moved(mapping):
            kept = ((n, t) for n, t in mapping if n in new_row and t in new_column)
            return {(new_row[n], new_column[t]): mapping[n, t] for n, t in kept}

        picked = {}
        for name, (shape, _) in _LAYOUT.items():
            array = getattr(self, name)
            if shape.startswith("N"):
                array = array[rows]
            if "T" in shape:
                array = array.take(columns, axis=shape.split().index("T"))
            picked[name] = array
        mappings = {name: moved(getattr(self, name)) for name in MAPPINGS}
        return replace(self, **picked, **mappings)

    def with_keypoints(self, keypoints_px: Any, confidence: Any) -> Observations:
        """Return the same birds with other keypoints, for example filtered keypoints.

        Args:
            keypoints_px: (N, T, K, 2) image pixels.
            confidence: (N, T, K) in [0, 1].

        Raises:
            ValueError: as for the class.
        """
        return replace(self, keypoints_px=np.asarray(keypoints_px), confidence=np.asarray(confidence))


def check_times(timestamp_s: np.ndarray, fps: float | None) -> None:
    """Raise ValueError if a time stamp is infinite, or a frame rate is not positive and finite."""
    if np.isinf(timestamp_s).any():
        raise ValueError("timestamp_s must be finite, or NaN where it is unknown")
    if fps is not None and not 0 < fps < math.inf:
        raise ValueError(f"fps must be positive and finite, or None, not {fps}")


def reorder_keypoints(observations: Observations, names: Sequence[str]) -> Observations:
    """Return the observations with the keypoints in the order of ``names``.

    Raises:
        ValueError: ``names`` is not a permutation of the observations' names.
    """
    old = observations.keypoint_names
    if sorted(names) != sorted(old):
        raise ValueError(f"names must be a permutation of {list(old)}, not {list(names)}")
    if tuple(names) == old:
        return observations
    order = [old.index(name) for name in names]
    new = {k: position for position, k in enumerate(order)}
    return replace(
        observations,
        keypoint_names=tuple(names),
        keypoints_px=observations.keypoints_px[:, :, order],
        confidence=observations.confidence[:, :, order],
        occluded=cast(np.ndarray, observations.occluded)[:, :, order],
        skeleton=tuple((new[a], new[b]) for a, b in observations.skeleton),
    )


def check_keypoints(observations: Observations, names: Sequence[str], source: object) -> Observations:
    """Return the observations with the keypoints in the order of the model, after a check that the names agree.

    Args:
        observations: observations with any order of keypoints.
        names: the K keypoint names of the model.
        source: the file, for the error message.

    Raises:
        InputError: a keypoint of the model is missing, or the model lacks a keypoint of the observations.
    """
    missing = [name for name in names if name not in observations.keypoint_names]
    extra = [name for name in observations.keypoint_names if name not in names]
    if missing or extra:
        parts = [f"lack {', '.join(missing)}"] if missing else []
        parts += [f"have {', '.join(extra)}, unknown to the model"] if extra else []
        problem = f"keypoints {' and '.join(parts)}"
        raise InputError(source, problem, "rename the keypoints as in the model, or choose another model")
    return reorder_keypoints(observations, names)


def mean_confidence(confidence: Float[np.ndarray, "*B K"]) -> Float[np.ndarray, "*B"]:
    """Return the mean over the keypoints, except those without a confidence anywhere, which the network lacks."""
    known = confidence.any(axis=tuple(range(confidence.ndim - 1)))
    return confidence[..., known].mean(-1) if known.any() else np.zeros(confidence.shape[:-1], confidence.dtype)


_KEPT = 1024
"""Number of frames whose masks stay in memory."""


class BirdsOfFrame(NamedTuple):
    """The masks of the birds that share the image of a frame."""

    tracks: tuple[int, ...]
    """Positions of the tracks."""
    masks: tuple[Mapping[str, Any], ...]
    """Run lengths."""
    boxes_px: Float[np.ndarray, "birds 4"]
    """x, y, width, height of the masks."""


class FrameMasks:
    """The masks of the birds of a video, by frame. Masks of frames that were used lately stay in memory.

    Args:
        observations: the birds.
    """

    def __init__(self, observations: Observations):
        self._masks, self._own_images = observations.masks, observations.own_images
        cells = np.fromiter(chain.from_iterable(self._masks), np.int64, 2 * len(self._masks)).reshape(-1, 2)
        cells = cells[np.argsort(cells[:, 1], kind="stable")].astype(np.int32)
        self._tracks, self._frames = cells.T.copy()
        self.birds = lru_cache(_KEPT)(self._birds)

    def _birds(self, t: int) -> BirdsOfFrame:
        """Return the birds with a mask in the frame at position `t`, without birds that have an image of their own."""
        from pycocotools import mask as coco_mask

        some = slice(*np.searchsorted(self._frames, [t, t + 1]).tolist())
        tracks = tuple(n for n in self._tracks[some].tolist() if (n, t) not in self._own_images)
        masks = [self._masks[n, t] for n in tracks]
        boxes = coco_mask.toBbox(cast(Any, masks)) if masks else np.zeros((0, 4))
        return BirdsOfFrame(tracks, tuple(masks), np.asarray(boxes, np.float64).reshape(-1, 4))

    def mask(self, n: int, t: int) -> Mapping[str, Any] | None:
        """Return the run lengths of the mask of a bird; None without a mask."""
        if (n, t) in self._own_images:
            return self._masks.get((n, t))
        birds = self.birds(t)
        return birds.masks[birds.tracks.index(n)] if n in birds.tracks else None

    def others(self, n: int, t: int, box_px: Real[np.ndarray, "4"]) -> list[Mapping[str, Any]]:
        """Return the masks of the other birds in the image of a bird that reach into a box.

        Args:
            n: position of the track.
            t: position of the frame.
            box_px: x, y, width, height.
        """
        if (n, t) in self._own_images:
            return []
        birds, (x0, y0, w, h) = self.birds(t), box_px
        x, y, width, height = birds.boxes_px.T
        near = (x < x0 + w) & (x + width > x0) & (y < y0 + h) & (y + height > y0)
        return [birds.masks[i] for i in np.flatnonzero(near).tolist() if birds.tracks[i] != n]

    def union_of_others(self, n: int, t: int, box_px: Real[np.ndarray, "4"]) -> Mapping[str, Any] | None:
        """Return the union of the masks of `others`; None without such a mask."""
        from pycocotools import mask as coco_mask

        masks = self.others(n, t, box_px)
        return cast(Any, coco_mask.merge(cast(Any, masks))) if masks else None
