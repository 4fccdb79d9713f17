"""Labelled frames for training: pictures, the bird of every pixel, keypoints and scale, as files of one folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxfit.data.keypoint_names import propose_names
from jaxfit.data.observations import LARGEST_POSITION_PX
from jaxfit.foundation.array_files import load_npy, load_npz
from jaxfit.foundation.errors import InputError
from jaxfit.model.anatomy import MURRE_KEYPOINTS

MARKER = "frames.npz"
"""The file of the labels; every folder of labelled frames contains this file."""
MAX_BIRDS = 254
"""Largest number of birds in a frame."""
UNKNOWN_OWNER = 255
"""Owner of a pixel that may be bird or background: the pixel does not count in the training of a segmenter."""
UNKNOWN = 3
"""Visibility of a keypoint without a label: the keypoint does not count in the training."""
SPREAD_UNITS = 14.0
"""Least distance of the wingtips of spread wings in the picture, model units; a murre is 20 units long."""
_LABELS = {"keypoints_px": "S N K 2", "visibility": "S N K", "pixels_per_unit": "S"}
"""The arrays of the labels, and their shapes."""


class LabelledFrames(NamedTuple):
    """S frames; the large arrays are memory-mapped files."""

    pictures: UInt8[np.ndarray, "S H W 3"]
    """Blue, green, red."""
    owner: UInt8[np.ndarray, "S H W"]
    """Number of the bird of each pixel, from 1; 0 for no bird; `UNKNOWN_OWNER` for a pixel without a label."""
    keypoints_px: Float[np.ndarray, "S N K 2"]
    """x, y of every keypoint, also if it is occluded or outside the picture."""
    visibility: UInt8[np.ndarray, "S N K"]
    """2 if the keypoint is visible, 1 if it is occluded, 0 if it is outside the picture, the labels leave it out as not
    visible, or the bird does not exist; `UNKNOWN` if the keypoint may be anywhere."""
    pixels_per_unit: Float[np.ndarray, "S"]
    """Scale of the picture: pixels per model unit (2 cm). For labelled footage, the scale that the networks assume."""
    keypoint_names: tuple[str, ...] = MURRE_KEYPOINTS
    """K names."""

    @property
    def known(self) -> Bool[np.ndarray, "S N K"]:
        """Whether a keypoint has a label and lies in the picture, also if it is occluded."""
        return (self.visibility == 1) | (self.visibility == 2)

    def with_keypoints(self, names: Sequence[str]) -> LabelledFrames:
        """Return the frames with other keypoints: keypoints of the same name are kept, all others are `UNKNOWN`."""
        if tuple(names) == self.keypoint_names:
            return self
        S, N, _ = self.visibility.shape
        points = np.zeros((S, N, len(names), 2), np.float32)
        visibility = np.where((self.visibility > 0).any(-1, keepdims=True), UNKNOWN, 0)
        visibility = np.repeat(visibility, len(names), axis=-1).astype(np.uint8)
        for new_name, old_name in propose_names(names, self.keypoint_names).mapped.items():
            new, k = list(names).index(new_name), self.keypoint_names.index(old_name)
            points[:, :, new], visibility[:, :, new] = self.keypoints_px[:, :, k], self.visibility[:, :, k]
        return self._replace(keypoints_px=points, visibility=visibility, keypoint_names=tuple(names))


def birds_with_spread_wings(frames: LabelledFrames) -> Int[np.ndarray, "M 2"]:
    """Return frame and bird of all birds whose wingtips are far apart in the picture and that are not hidden."""
    if not {"left_wingtip", "right_wingtip"} <= set(frames.keypoint_names):
        return np.zeros((0, 2), int)
    left, right = (frames.keypoint_names.index(f"{side}_wingtip") for side in ("left", "right"))
    span_px = np.linalg.norm(frames.keypoints_px[:, :, left] - frames.keypoints_px[:, :, right], axis=-1)
    known = frames.known
    both = known[:, :, left] & known[:, :, right] & (frames.visibility == 2).any(-1)
    return np.argwhere(both & (span_px > SPREAD_UNITS * frames.pixels_per_unit[:, None]))


def draw_bird(rng: np.random.Generator, frames: LabelledFrames, spread_share: float) -> tuple[int, int | None]:
    """Draw a frame for a sample: with probability `spread_share`, a frame and its bird with spread wings.

    Returns:
        Index of the frame, and index of the bird with spread wings; None for a random frame.
    """
    spread = birds_with_spread_wings(frames) if rng.random() < spread_share else np.zeros((0, 2), int)
    if len(spread):
        s, n = rng.choice(spread).tolist()
        return s, n
    return int(rng.integers(len(frames.pictures))), None


def save_labels(
    folder: Path,
    keypoints_px: Float[np.ndarray, "S N K 2"],
    visibility: UInt8[np.ndarray, "S N K"],
    pixels_per_unit: Float[np.ndarray, "S"],
    keypoint_names: Sequence[str] = MURRE_KEYPOINTS,
) -> None:
    """Write the labels, the last file of a folder of labelled frames; arguments as in `LabelledFrames`.

    A bird that flies past the camera has keypoints very far outside the picture: their positions are clipped to the
    range that `load_frames` accepts.
    """
    clipped_px = np.clip(keypoints_px, -LARGEST_POSITION_PX, LARGEST_POSITION_PX)
    keypoints_px = np.where(visibility[..., None] == 0, clipped_px, keypoints_px).astype(np.float32)
    np.savez(
        folder / MARKER,
        keypoints_px=keypoints_px,
        visibility=visibility,
        pixels_per_unit=pixels_per_unit,
        keypoint_names=np.array(keypoint_names, str),
    )


def load_frames(*folders: str | Path) -> LabelledFrames:
    """Load the frames of folders as one. A picture is read when it is indexed: index one frame at a time.

    Args:
        folders: folders of frames of the same size with the same keypoints.

    Raises:
        InputError: the frames cannot be read, an earlier version wrote them, or the labels hold impossible values.
    """
    parts = [_load_folder(Path(folder)) for folder in folders]
    birds = max(part.visibility.shape[1] for part in parts)

    def joined(name: str) -> np.ndarray:
        arrays = [getattr(part, name) for part in parts]
        missing = [(0, birds - array.shape[1]) for array in arrays]
        return np.concatenate(
            [np.pad(a, [(0, 0), more, *[(0, 0)] * (a.ndim - 2)]) for a, more in zip(arrays, missing, strict=True)]
        )

    return parts[0]._replace(
        pictures=cast(Any, _Frames([frame for part in parts for frame in cast(Any, part.pictures).files])),
        owner=cast(Any, _Frames([frame for part in parts for frame in cast(Any, part.owner).files])),
        keypoints_px=joined("keypoints_px"),
        visibility=joined("visibility"),
        pixels_per_unit=np.concatenate([part.pixels_per_unit for part in parts]),
    )


class _Frames(Sequence[np.ndarray]):
    """Frames of files in their order, each the path of a file and the position in the file."""

    def __init__(self, files: list[tuple[Path, int]]):
        self.files = files

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self), *self[0].shape)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, s: Any) -> Any:
        path, place = self.files[s]
        return np.load(path, mmap_mode="r")[place]


def _load_folder(folder: Path) -> LabelledFrames:
    labels = load_npz(folder / MARKER, _LABELS, optional={"keypoint_names": "K"})
    points, visibility, scale = (labels[name] for name in _LABELS)
    pictures = load_npy(folder / "pictures.npy", f"{len(scale)} H W 3", mapped=True)
    owner = load_npy(folder / "owner.npy", " ".join(map(str, pictures.shape[:3])), mapped=True)
    names = tuple(str(name) for name in labels.get("keypoint_names", MURRE_KEYPOINTS))
    frames = LabelledFrames(pictures, owner, points, visibility, scale, names)
    _check_labels(frames, folder)
    pictures, owner = (
        cast(Any, _Frames([(folder / name, s) for s in range(len(scale))])) for name in ("pictures.npy", "owner.npy")
    )
    return frames._replace(pictures=pictures, owner=owner)


def _check_labels(frames: LabelledFrames, folder: Path) -> None:
    integers = all(array.dtype == np.uint8 for array in (frames.pictures, frames.owner, frames.visibility))
    numbers = all(array.dtype == np.float32 for array in (frames.keypoints_px, frames.pixels_per_unit))
    holds = {"type of numbers": integers and numbers}
    if integers and numbers:
        holds |= {
            "number of keypoints": frames.visibility.shape[2] == len(frames.keypoint_names),
            "number of birds": frames.visibility.shape[1] <= MAX_BIRDS,
            "number of frames": len(frames.pictures) > 0,
            "position of a keypoint": bool((np.abs(frames.keypoints_px) <= LARGEST_POSITION_PX).all()),
            "visibility": bool((frames.visibility <= UNKNOWN).all()),
            "scale": bool(((frames.pixels_per_unit > 0.01) & (frames.pixels_per_unit < 1e4)).all()),
        }
    for name, is_right in holds.items():
        if not is_right:
            problem = f"holds frames with a wrong {name}"
            raise InputError(folder, problem, "remove the folder, to make the frames again")
