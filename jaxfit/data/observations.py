"""What was seen of the birds of one video: the container where perception and fitting meet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from jaxfit.data.masks import decode_mask
from jaxfit.errors import InputError
from jaxfit.storage.arrays import validate_arrays

__all__ = ["Observations", "check_keypoints", "reorder_keypoints"]

_LAYOUT = {
    "track_id": ("N", np.int64),
    "frame_index": ("T", np.int64),
    "present": ("N T", np.bool_),
    "keypoints_px": ("N T K 2", np.float32),
    "confidence": ("N T K", np.float32),
    "occluded": ("N T K", np.bool_),
    "score": ("N T", np.float32),
    "box_px": ("N T 4", np.float32),
    "image_size_px": ("T 2", np.int64),
    "file_name": ("T", np.str_),
    "keypoint_names": ("K", np.str_),
}


@dataclass(frozen=True, eq=False)
class Observations:
    """Keypoints, boxes and masks of N tracks over T frames; K keypoints a bird.

    NumPy arrays, read-only and never traced. All positions are image pixels: x right, y down, the centre of
    pixel (i, j) at (i + 0.5, j + 0.5).

    Raises:
        ValueError: shapes that contradict each other, a ``track_id`` twice, a ``frame_index`` that does not
            increase, a confidence or score outside [0, 1], a confidence where nothing is present, a position that
            is not finite, a mask that is not of its image's size.
    """

    track_id: np.ndarray
    """(N,) int64: the tracks' names, each once."""
    frame_index: np.ndarray
    """(T,) int64: the frames' numbers in the video, increasing; gaps are frames that the file lacks."""
    present: np.ndarray
    """(N, T) bool: the bird has an annotation in this frame."""
    keypoints_px: np.ndarray
    """(N, T, K, 2) float32: x, y in image pixels; 0 where the confidence is 0."""
    confidence: np.ndarray
    """(N, T, K) float32 in [0, 1]: trust in each keypoint; 0 means missing."""
    box_px: np.ndarray
    """(N, T, 4) float32: x, y of the upper left corner, width, height, image pixels; 0 where not present."""
    image_size_px: np.ndarray
    """(T, 2) int64: width, height of the frame's image; see ``own_images``."""
    file_name: np.ndarray
    """(T,) str: the frame's image; see ``own_images``."""
    keypoint_names: tuple[str, ...]
    """K names in the order of the arrays."""
    skeleton: tuple[tuple[int, int], ...] = ()
    """Pairs of keypoints, counted from 0, that a drawing connects."""
    masks: Mapping[tuple[int, int], Mapping[str, Any]] = field(default_factory=dict)
    """(n, t) → run lengths of that bird's mask as pycocotools keeps them; use ``mask`` to read one."""
    own_images: Mapping[tuple[int, int], tuple[str, int, int]] = field(default_factory=dict)
    """(n, t) → file name, width, height, where a bird stands in another image than the frame's first: sets of
    photographs, in which every bird is frame 0 of an image of its own. Empty for video."""
    occluded: np.ndarray | None = None
    """(N, T, K) bool: the keypoint's place is known although something hides it. None stands for nowhere."""
    amodal_masks: Mapping[tuple[int, int], Mapping[str, Any]] = field(default_factory=dict)
    """(n, t) → run lengths of the whole bird, hidden parts included, where that is known: in simulated truth."""
    score: np.ndarray | None = None
    """(N, T) float32 in [0, 1]: a detector's trust in the bird as a whole; 0 where not present. None stands for 1
    where present."""

    def __post_init__(self):
        occluded = np.zeros(np.shape(self.confidence), bool) if self.occluded is None else self.occluded
        score = np.asarray(self.present, np.float32) if self.score is None else self.score
        values = {**vars(self), "keypoint_names": list(self.keypoint_names), "occluded": occluded, "score": score}
        arrays = validate_arrays(values, _LAYOUT)
        names = tuple(str(name) for name in arrays.pop("keypoint_names"))
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
        arrays["occluded"] = arrays["occluded"] & (confidence > 0)
        arrays["occluded"].flags.writeable = False
        needed = {"keypoints_px": confidence[..., None] > 0, "box_px": present[..., None], "score": present}
        for name, there in needed.items():
            # absent values are 0, so that no NaN of theirs can reach a sum
            values = np.where(there, arrays[name], np.float32(0))
            if not np.isfinite(values).all():
                raise ValueError(f"{name} must be finite where it is not missing")
            values.flags.writeable = False
            arrays[name] = values
        for name, value in (arrays | {"keypoint_names": names}).items():
            object.__setattr__(self, name, value)
        for name in ("masks", "amodal_masks"):
            for (n, t), rle in getattr(self, name).items():
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

    def _position(self, n: int, t: int) -> tuple[int, int]:
        return range(self.num_tracks)[n], range(self.num_frames)[t]  # counts from the end too; IndexError outside

    def mask(self, n: int, t: int) -> np.ndarray | None:
        """The bird's mask, decoded at each call.

        Args:
            n: position of the track.
            t: position of the frame.

        Returns:
            (H, W) bool in the pixels of its image, or None where there is no mask.
        """
        rle = self.masks.get(self._position(n, t))
        return None if rle is None else decode_mask(rle)

    def whole_mask(self, n: int, t: int) -> np.ndarray | None:
        """The mask of the bird with its hidden parts, where that is known; else ``mask``."""
        rle = self.amodal_masks.get(self._position(n, t))
        return self.mask(n, t) if rle is None else decode_mask(rle)

    def image_size(self, n: int, t: int) -> tuple[int, int]:
        """Width and height in pixels of the image that track ``n`` stands in at frame ``t``."""
        n, t = self._position(n, t)
        own = self.own_images.get((n, t))
        return own[1:] if own else (int(self.image_size_px[t, 0]), int(self.image_size_px[t, 1]))

    def image_file(self, n: int, t: int) -> str:
        """File name of the image that track ``n`` stands in at frame ``t``."""
        n, t = self._position(n, t)
        own = self.own_images.get((n, t))
        return own[0] if own else str(self.file_name[t])

    def usable(self, min_keypoints: int = 3, min_confidence: float = 0.0) -> np.ndarray:
        """Where there is enough to fit.

        Args:
            min_keypoints: fewest confident keypoints; fewer than three leave the orientation undetermined.
            min_confidence: a keypoint is confident above this.

        Returns:
            (N, T) bool: present and with at least ``min_keypoints`` confident keypoints.
        """
        return self.present & ((self.confidence > min_confidence).sum(-1) >= min_keypoints)

    def select(self, tracks: Any = None, frames: Any = None) -> Observations:
        """Some tracks and frames.

        Args:
            tracks: positions along N: a slice, integers or bools as NumPy indexes; None keeps all.
            frames: the same along T, in increasing order.

        Returns:
            Observations of those alone.
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
        mappings = {name: moved(getattr(self, name)) for name in ("masks", "amodal_masks", "own_images")}
        return replace(self, **picked, **mappings)

    def with_keypoints(self, keypoints_px: Any, confidence: Any) -> Observations:
        """The same birds with other keypoints, such as filtered ones.

        Args:
            keypoints_px: (N, T, K, 2) image pixels.
            confidence: (N, T, K) in [0, 1].

        Raises:
            ValueError: as the class does.
        """
        return replace(self, keypoints_px=np.asarray(keypoints_px), confidence=np.asarray(confidence))


def reorder_keypoints(observations: Observations, names: Sequence[str]) -> Observations:
    """The same keypoints in the order of ``names``.

    Raises:
        ValueError: ``names`` is not a permutation of the observations' names.
    """
    old = observations.keypoint_names
    if sorted(names) != sorted(old):
        raise ValueError(f"names must be a permutation of {list(old)}, not {list(names)}")
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
    """Observations whose keypoints are the model's, in the model's order.

    Args:
        observations: as read.
        names: the model's K keypoint names.
        source: the file, for the message.

    Raises:
        InputError: a name is missing or there is one that the model does not know.
    """
    missing = [name for name in names if name not in observations.keypoint_names]
    extra = [name for name in observations.keypoint_names if name not in names]
    if missing or extra:
        parts = [f"lack {', '.join(missing)}"] if missing else []
        parts += [f"have {', '.join(extra)}, unknown to the model"] if extra else []
        problem = f"keypoints {' and '.join(parts)}"
        raise InputError(source, problem, "rename the keypoints as the model has them, or choose another model")
    return reorder_keypoints(observations, names)
