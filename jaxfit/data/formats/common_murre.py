"""The data set ``common_murre_temporal``: keypoints of common murres in 100 images of one video.

The layout of the data set is not published. Only the size of the file is known: ``annotations.npy`` holds
100 frames × 7 birds × 20 keypoints × 3 numbers. The reader infers the meaning of the numbers from the numbers and from
the images in ``images/``. It reports each inference (a "reading"), and rejects data without a consistent reading. The
readings have not been compared with the code of the authors.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.data.masks import box_of_keypoints
from jaxfit.data.observations import Observations
from jaxfit.foundation.array_files import check_memory, load_npy
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.model.anatomy import skeleton_pairs
from jaxfit.video.pictures import image_files
from jaxfit.video.reader import read_frames

ANNOTATIONS, IMAGES = "annotations.npy", "images"
LICENSE = "CC-BY-NC-4.0"
NUM_KEYPOINTS = 20
OUTSIDE = 0.05
"""Largest fraction of keypoints outside their image."""
_REMEDY = "the reader does not know this layout: convert the annotations to COCO by hand"


class CommonMurre(NamedTuple):
    """The annotations, and the readings of their layout."""

    observations: Observations
    """Keypoints, and boxes around the keypoints; no masks."""
    readings: dict[str, str]
    """Property of the layout → the inferred value and its reason."""


def generic_names() -> tuple[str, ...]:
    """Return ``keypoint_00`` …, since the order of the keypoints of the data set is not published."""
    return tuple(f"keypoint_{k:02}" for k in range(NUM_KEYPOINTS))


def read_common_murre(
    folder: str | Path, keypoint_names: Sequence[str] | None = None, progress: ProgressTask = silent
) -> CommonMurre:
    """Read the data set from a folder with ``annotations.npy`` and ``images/``.

    Args:
        folder: the folder of the data set.
        keypoint_names: names of the 20 keypoints, in the order of the array, which the reader cannot check; None for
            ``generic_names``.
        progress: shows the progress over images; the images are read for their size.

    Raises:
        InputError: a file is missing or cannot be read, the images have several sizes, the number of names is not 20,
            or the numbers have no consistent reading.
    """
    folder = Path(folder)
    source = folder / ANNOTATIONS
    names = _names(keypoint_names)
    array = load_npy(source)
    if array.dtype.kind not in "fiu":
        raise InputError(source, f"holds {array.dtype}, not numbers", "save it as an array of float64")
    files, (width, height) = _images(folder / IMAGES, progress)
    readings = {}
    array, readings["axes"] = _birds_first(array, len(files), source)
    check_memory(source, "the annotations", 100 * array.size, "give the published file")
    table = array.astype(np.float64)
    confidence, readings["third number"] = _confidence(table[..., 2], source)
    known, readings["missing"] = _known(table[..., :2], confidence, source)
    points, readings["position"] = _pixels(np.where(known[..., None], table[..., :2], 0), known, width, height, source)
    if keypoint_names is None:
        readings["names"] = (
            "keypoint_00 …, since the order of the keypoints is not published; a fit needs the names of its model"
        )
    else:
        readings["names"] = f"{names[0]}, {names[1]}, …, as given"
    readings["frames"] = f"images of {IMAGES}/ in the order of their names; numbers in names are sorted by value"
    readings["tracks"] = "a bird keeps its position in the array (assumed)"
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
        # where the third number is COCO's visibility
        occluded=known & (table[..., 2] == 1) & (np.nanmax(table[..., 2]) == 2),
    )
    return CommonMurre(observations, readings)


def _names(names: Sequence[str] | None) -> tuple[str, ...]:
    names = generic_names() if names is None else tuple(names)
    if len(names) != NUM_KEYPOINTS or len(set(names)) != len(names) or not all(names):
        problem = f"are {len(names)}, {len(set(names))} of them different"
        raise InputError(
            "names of keypoints", problem, f"give {NUM_KEYPOINTS} different names, in the order of the array"
        )
    return names


def _images(folder: Path, progress: ProgressTask) -> tuple[list[Path], tuple[int, int]]:
    reader = read_frames(folder)
    files = image_files(folder)
    with progress("Reading images", len(files)) as report_progress:
        for _ in reader:
            report_progress(1, "")
    if reader.damaged:
        raise InputError(files[reader.damaged[0]], "cannot be read", "copy the image again")
    return files, reader.info.size_px


def _birds_first(array: np.ndarray, frames: int, source: Path) -> tuple[np.ndarray, str]:
    if array.ndim != 4 or array.shape[2:] != (NUM_KEYPOINTS, 3) or not array.size:
        expected = f"(frames, birds, {NUM_KEYPOINTS} keypoints, 3) or (birds, frames, {NUM_KEYPOINTS} keypoints, 3)"
        raise InputError(source, f"has shape {array.shape}, expected {expected}", _REMEDY)
    first, second = array.shape[:2]
    if first == second:
        problem = f"has shape {array.shape}, in which frames and birds cannot be distinguished"
        raise InputError(source, problem, _REMEDY)
    if frames not in (first, second):
        problem = f"has shape {array.shape}, but {IMAGES}/ holds {frames} images"
        raise InputError(source, problem, "give the folder with one image for each frame")
    why = f"{array.shape}, inferred from the {frames} images; then {NUM_KEYPOINTS} keypoints, 3 numbers each"
    if first == frames:
        return array.swapaxes(0, 1), f"frames, birds: {why}"
    return array, f"birds, frames: {why}"


def _confidence(third: Float[np.ndarray, "N T K"], source: Path) -> tuple[Float[np.ndarray, "N T K"], str]:
    """Return the confidence from the third numbers; NaN, which means a missing keypoint, becomes 0."""
    third = np.where(np.isnan(third), 0, third)
    values = np.unique(third)
    if values[-1] == 0 == values[0]:
        raise InputError(source, "has no visible keypoint: all third numbers are 0 or NaN", _REMEDY)
    if np.isin(values, (0, 1)).all():
        return (
            third,
            "a flag: 1 annotated, 0 not annotated (as COCO's visibility, 1 would mean that all keypoints are hidden)",
        )
    if np.isin(values, (0, 1, 2)).all():
        return (third > 0).astype(
            np.float64
        ), "COCO's visibility: 0 not annotated, 1 hidden, 2 visible; hidden keypoints are used"
    if values[0] >= 0 and values[-1] <= 1:
        return third, f"a confidence, {values[0]:.3g} to {values[-1]:.3g}"
    problem = f"has third numbers of {values[0]:.4g} to {values[-1]:.4g}: neither flags of 0, 1, 2 nor fractions"
    raise InputError(source, problem, _REMEDY)


def _known(
    position: Float[np.ndarray, "N T K 2"], confidence: Float[np.ndarray, "N T K"], source: Path
) -> tuple[Bool[np.ndarray, "N T K"], str]:
    """Return where a keypoint is known."""
    if np.isinf(position).any():
        raise InputError(source, "holds infinite positions", _REMEDY)
    missing = np.isnan(position)
    if (missing.any(-1) != missing.all(-1)).any():
        raise InputError(source, "holds positions with only one of the two coordinates (the other is NaN)", _REMEDY)
    absent = missing.any(-1) | (position == 0).all(-1)
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
    """Return the positions as x, y in pixels; (0, 0) for a missing keypoint."""
    size, there = np.array([width, height]), position[known]
    if there.min() >= 0 and there.max() <= 1:
        return position * size, f"x, y as fractions of {width}×{height} (all numbers lie in 0 to 1; x first is assumed)"
    as_xy, as_yx = (_fraction_outside(there, edges) for edges in (size, size[::-1]))
    if as_xy <= OUTSIDE:
        order = "x first is assumed; y, x would fit too" if as_yx <= OUTSIDE else "y, x would not fit"
        return position, f"x, y in pixels of {width}×{height} ({as_xy:.1%} outside; {order})"
    if as_yx <= OUTSIDE:
        answer = f"y, x in pixels of {width}×{height} ({as_yx:.1%} outside; as x, y {as_xy:.1%} would be)"
        return position[..., ::-1], answer
    (low_0, low_1), (high_0, high_1) = there.min(0), there.max(0)
    problem = (
        f"has positions of {low_0:.4g} to {high_0:.4g} and {low_1:.4g} to {high_1:.4g}, neither pixels of the images "
        f"of {width}×{height} nor fractions"
    )
    raise InputError(source, problem, _REMEDY)


def _fraction_outside(positions: Float[np.ndarray, "P 2"], edges: np.ndarray) -> float:
    return float(((positions < 0) | (positions > edges)).any(-1).mean())


def _boxes(points: Float[np.ndarray, "N T K 2"], known: Bool[np.ndarray, "N T K"]) -> Float[np.ndarray, "N T 4"]:
    """Return the boxes of the known keypoints: x, y, width, height, at least one pixel wide; 0 without a keypoint."""
    boxes = box_of_keypoints(points, known)
    boxes[..., 2:] = np.maximum(boxes[..., 2:], 1)
    return np.where(known.any(-1, keepdims=True), boxes, 0)
