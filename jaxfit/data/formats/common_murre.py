"""The data set ``common_murre_temporal``: keypoints of common murres in 100 pictures of one video.

Its layout is not published. What is taken to be known is the size of its file: ``annotations.npy`` holds as many
numbers as 100 frames × 7 birds × 20 keypoints × 3. All else is inferred from the numbers and the pictures in
``images/``, each reading is told, and what no reading explains is refused. Nobody has compared the readings with the
authors' own.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.data.observations import Observations
from jaxfit.errors import InputError
from jaxfit.model.anatomy import skeleton_pairs
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.npz import load_npy
from jaxfit.video.reader import image_files, read_frames

__all__ = ["ANNOTATIONS", "IMAGES", "LICENSE", "NUM_KEYPOINTS", "CommonMurre", "generic_names", "read_common_murre"]

ANNOTATIONS, IMAGES = "annotations.npy", "images"
LICENSE = "CC-BY-NC-4.0"
NUM_KEYPOINTS = 20
OUTSIDE = 0.05
"""Share of the keypoints that may lie outside their picture."""
_REMEDY = "this reader knows no such layout: convert the annotations to COCO by hand"


class CommonMurre(NamedTuple):
    """The annotations, and how they were read."""

    observations: Observations
    """Keypoints, and boxes around them; no masks."""
    readings: dict[str, str]
    """Question → the answer that was chosen and what it rests on."""


def generic_names() -> tuple[str, ...]:
    """``keypoint_00`` …: the order of the data set's keypoints is not published."""
    return tuple(f"keypoint_{k:02}" for k in range(NUM_KEYPOINTS))


def read_common_murre(
    folder: str | Path, keypoint_names: Sequence[str] | None = None, progress: ProgressTask = silent
) -> CommonMurre:
    """Read the data set from its folder, which holds ``annotations.npy`` and ``images/``.

    Args:
        folder: the data set.
        keypoint_names: what its 20 keypoints are, in order, on the caller's word; None for ``generic_names``.
        progress: told of every picture, which are read to see how large they are.

    Raises:
        InputError: a file is missing or cannot be read, pictures of several sizes, another number of names, or numbers
            that no reading explains.
    """
    folder = Path(folder)
    source = folder / ANNOTATIONS
    names = _names(keypoint_names)
    array = load_npy(source)
    if array.dtype.kind not in "fiu":
        raise InputError(source, f"holds {array.dtype}, not numbers", "save it as an array of float64")
    files, (width, height) = _pictures(folder / IMAGES, progress)
    readings = {}
    table, readings["axes"] = _birds_first(array.astype(np.float64), len(files), source)
    confidence, readings["third number"] = _confidence(table[..., 2], source)
    known, readings["missing"] = _known(table[..., :2], confidence, source)
    points, readings["position"] = _pixels(np.where(known[..., None], table[..., :2], 0), known, width, height, source)
    if keypoint_names is None:
        readings["names"] = "keypoint_00 …, as their order is not published; a fit needs the names of its model"
    else:
        readings["names"] = f"{names[0]}, {names[1]}, …, on your word"
    readings["frames"] = f"pictures of {IMAGES}/ in the order of their names, the numbers in them by value"
    readings["tracks"] = "a bird keeps its place in the array (assumed)"
    readings["boxes"] = "around the keypoints, not the bird; there are no masks"
    present = np.asarray(known.any(-1))
    observations = Observations(
        track_id=np.arange(1, len(table) + 1),
        frame_index=np.arange(len(files)),
        present=present,
        keypoints_px=points.astype(np.float32),
        confidence=np.where(known, confidence, 0).astype(np.float32),
        box_px=_boxes(points, known).astype(np.float32),
        image_size_px=np.tile([width, height], (len(files), 1)),
        file_name=np.array([f"{IMAGES}/{file.name}" for file in files]),
        keypoint_names=names,
        skeleton=skeleton_pairs(names),
        occluded=known & (table[..., 2] == 1) & (np.nanmax(table[..., 2]) == 2),  # COCO's, where it is that
    )
    return CommonMurre(observations, readings)


def _names(names: Sequence[str] | None) -> tuple[str, ...]:
    names = generic_names() if names is None else tuple(names)
    if len(names) != NUM_KEYPOINTS or len(set(names)) != len(names) or not all(names):
        problem = f"are {len(names)}, {len(set(names))} of them different"
        raise InputError("names of keypoints", problem, f"give {NUM_KEYPOINTS} different ones, in the array's order")
    return names


def _pictures(folder: Path, progress: ProgressTask) -> tuple[list[Path], tuple[int, int]]:
    reader = read_frames(folder)
    files = image_files(folder)
    with progress("Reading pictures", len(files)) as report_progress:
        for _ in reader:
            report_progress(1, "")
    if reader.damaged:
        raise InputError(files[reader.damaged[0]], "cannot be read", "copy the picture again")
    return files, reader.info.size_px


def _birds_first(array: np.ndarray, frames: int, source: Path) -> tuple[Float[np.ndarray, "N T 20 3"], str]:
    if array.ndim != 4 or array.shape[2:] != (NUM_KEYPOINTS, 3) or not array.size:
        expected = f"(frames, birds, {NUM_KEYPOINTS} keypoints, 3) or (birds, frames, {NUM_KEYPOINTS} keypoints, 3)"
        raise InputError(source, f"has shape {array.shape}, expected {expected}", _REMEDY)
    first, second = array.shape[:2]
    if first == second:
        problem = f"has shape {array.shape}, which does not tell frames from birds"
        raise InputError(source, problem, _REMEDY)
    if frames not in (first, second):
        problem = f"has shape {array.shape}, but {IMAGES}/ holds {frames} pictures"
        raise InputError(source, problem, "give the folder with one picture for each frame")
    why = f"{array.shape}, told by the {frames} pictures; then {NUM_KEYPOINTS} keypoints, 3 numbers each"
    if first == frames:
        return array.swapaxes(0, 1), f"frames, birds: {why}"
    return array, f"birds, frames: {why}"


def _confidence(third: Float[np.ndarray, "N T K"], source: Path) -> tuple[Float[np.ndarray, "N T K"], str]:
    """NaN, where a keypoint is missing, is 0."""
    third = np.where(np.isnan(third), 0, third)
    values = np.unique(third)
    if values[-1] == 0 == values[0]:
        raise InputError(source, "calls no keypoint visible: the third number is 0 or NaN everywhere", _REMEDY)
    if np.isin(values, (0, 1)).all():
        return third, "a flag: 1 given, 0 not (COCO's 1, given but hidden, would mean no visible keypoint at all)"
    if np.isin(values, (0, 1, 2)).all():
        return (third > 0).astype(
            np.float64
        ), "COCO's visibility: 0 not given, 1 hidden, 2 visible; hidden ones are used"
    if values[0] >= 0 and values[-1] <= 1:
        return third, f"a confidence, {values[0]:.3g} to {values[-1]:.3g}"
    problem = f"has third numbers of {values[0]:.4g} to {values[-1]:.4g}: neither flags of 0, 1, 2 nor shares of 1"
    raise InputError(source, problem, _REMEDY)


def _known(
    position: Float[np.ndarray, "N T K 2"], confidence: Float[np.ndarray, "N T K"], source: Path
) -> tuple[Bool[np.ndarray, "N T K"], str]:
    """Where there is a keypoint."""
    if np.isinf(position).any():
        raise InputError(source, "holds infinite positions", _REMEDY)
    nowhere = np.isnan(position)
    if (nowhere.any(-1) != nowhere.all(-1)).any():
        raise InputError(source, "holds positions of which one number is NaN and the other is not", _REMEDY)
    absent = nowhere.any(-1) | (position == 0).all(-1)
    known = np.asarray(~absent & (confidence > 0))
    if not known.any():
        raise InputError(source, "holds no keypoint with a position", _REMEDY)
    flagged, placed = int((confidence == 0).sum()), int((~absent & (confidence == 0)).sum())
    unplaced = int((absent & (confidence > 0)).sum())
    answer = f"{int((~known).sum())} of {known.size}: third number 0 ({flagged}, {placed} of them with a position)"
    return known, f"{answer}, or NaN or (0, 0) as position ({unplaced} more)"


def _pixels(
    position: Float[np.ndarray, "N T K 2"], known: Bool[np.ndarray, "N T K"], width: int, height: int, source: Path
) -> tuple[Float[np.ndarray, "N T K 2"], str]:
    """Positions as x, y in pixels; (0, 0) where there is none."""
    size, there = np.array([width, height]), position[known]
    if there.min() >= 0 and there.max() <= 1:
        return position * size, f"x, y as shares of {width}×{height} (all lie in 0 to 1; that x comes first is assumed)"
    as_xy, as_yx = (_share_outside(there, edges) for edges in (size, size[::-1]))
    if as_xy <= OUTSIDE:
        order = "that x comes first is assumed, y, x would fit too" if as_yx <= OUTSIDE else "y, x would not fit"
        return position, f"x, y in pixels of {width}×{height} ({as_xy:.1%} outside; {order})"
    if as_yx <= OUTSIDE:
        answer = f"y, x in pixels of {width}×{height} ({as_yx:.1%} outside; as x, y {as_xy:.1%} would be)"
        return position[..., ::-1], answer
    (low_0, low_1), (high_0, high_1) = there.min(0), there.max(0)
    problem = (
        f"has positions of {low_0:.4g} to {high_0:.4g} and {low_1:.4g} to {high_1:.4g}, neither pixels of the pictures "
        f"of {width}×{height} nor shares of 1"
    )
    raise InputError(source, problem, _REMEDY)


def _share_outside(positions: Float[np.ndarray, "P 2"], edges: np.ndarray) -> float:
    return float(((positions < 0) | (positions > edges)).any(-1).mean())


def _boxes(points: Float[np.ndarray, "N T K 2"], known: Bool[np.ndarray, "N T K"]) -> Float[np.ndarray, "N T 4"]:
    """x, y, width, height around the known keypoints, at least a pixel wide; zeros where there is none."""
    low = np.where(known[..., None], points, np.inf).min(2)
    high = np.where(known[..., None], points, -np.inf).max(2)
    some = np.any(known, -1, keepdims=True)
    low, high = np.where(some, low, 0), np.where(some, high, 0)
    return np.where(some, np.concatenate([low, np.maximum(high - low, 1)], axis=-1), 0)
