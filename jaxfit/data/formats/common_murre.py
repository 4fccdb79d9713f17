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
from jaxfit.foundation.reading import reading
from jaxfit.model.anatomy import skeleton_pairs
from jaxfit.video.pictures import image_files
from jaxfit.video.reader import read_frames

ANNOTATIONS, IMAGES = "annotations.npy", "images"
LICENSE = "CC-BY-NC-4.0"
NUM_KEYPOINTS = 20
OUTSIDE = 0.05
"""Largest fraction of keypoints outside their image."""
_REMEDY = "convert the annotations to COCO by hand"


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
    names = generic_names() if keypoint_names is None else tuple(keypoint_names)
    if len(names) != NUM_KEYPOINTS or len(set(names)) != len(names) or not all(names):
        problem = f"are {len(names)}, {len(set(names))} of them different"
        remedy = f"give {NUM_KEYPOINTS} different names, in the order of the array"
        raise InputError("names of keypoints", problem, remedy)
    array = load_npy(source)
    reader, files = read_frames(folder / IMAGES), image_files(folder / IMAGES)
    with progress("Reading images", len(files)) as report_progress:
        for _ in reader:
            report_progress(1, "")
    if reader.damaged:
        raise InputError(files[reader.damaged[0]], "cannot be read", "copy the image again")
    with reading(source, "an array of annotations", _REMEDY):
        return _read(array, names, keypoint_names is not None, files, reader.info.size_px)


def _read(
    array: np.ndarray, names: tuple[str, ...], given: bool, files: Sequence[Path], size_px: tuple[int, int]
) -> CommonMurre:
    """Return the observations of an array, and the readings.

    Raises:
        ValueError: the numbers have no consistent reading.
    """
    T = len(files)
    shape = array.shape
    if array.dtype.kind not in "fiu":
        raise ValueError(f"it holds {array.dtype}, not numbers")
    if len(shape) != 4 or shape[2:] != (NUM_KEYPOINTS, 3) or not array.size or (shape[0] == T) == (shape[1] == T):
        layout = f"(frames, birds, {NUM_KEYPOINTS}, 3) or (birds, frames, {NUM_KEYPOINTS}, 3)"
        raise ValueError(f"its shape {shape} is not {layout} with {T} images")
    check_memory(files[0].parent, "the annotations", 100 * array.size, "give the published file")
    axes = f"{shape}, inferred from the {T} images; then {NUM_KEYPOINTS} keypoints, 3 numbers each"
    readings = {"axes": f"frames, birds: {axes}" if shape[0] == T else f"birds, frames: {axes}"}
    table = (array.swapaxes(0, 1) if shape[0] == T else array).astype(np.float64)
    position, third = table[..., :2], np.nan_to_num(table[..., 2], nan=0)
    confidence, readings["third number"] = _confidence(third)
    if np.isinf(position).any() or (np.isnan(position).any(-1) != np.isnan(position).all(-1)).any():
        raise ValueError("it holds infinite positions, or only one of two coordinates")
    absent = np.isnan(position).any(-1) | (position == 0).all(-1)
    known = ~absent & (confidence > 0)
    if not known.any():
        raise ValueError("it holds no keypoint with a position")
    flagged, placed = int((confidence == 0).sum()), int((~absent & (confidence == 0)).sum())
    readings["missing"] = (
        f"{int((~known).sum())} of {known.size}: third number 0 ({flagged}, {placed} of them with a position), or NaN "
        f"or (0, 0) as position ({int((absent & (confidence > 0)).sum())} more)"
    )
    points, readings["position"] = _pixels(np.where(known[..., None], position, 0), known, np.array(size_px))
    readings["names"] = (
        f"{names[0]}, {names[1]}, …, as given"
        if given
        else "keypoint_00 …, since the order of the keypoints is not published; a fit needs the names of its model"
    )
    readings["frames"] = f"images of {IMAGES}/ in the order of their names; numbers in names are sorted by value"
    readings["tracks"] = "a bird keeps its position in the array (assumed)"
    readings["boxes"] = "around the keypoints, not the bird; there are no masks"
    present = np.asarray(known.any(-1))
    box = box_of_keypoints(points, known)
    box[..., 2:] = np.maximum(box[..., 2:], 1)
    observations = Observations(
        track_id=np.arange(1, len(table) + 1),
        frame_index=np.arange(T),
        present=present,
        keypoints_px=points,
        confidence=np.where(known, confidence, 0),
        box_px=np.where(present[..., None], box, 0),
        image_size_px=np.tile(size_px, (T, 1)),
        file_name=np.array([f"{IMAGES}/{file.name}" for file in files]),
        keypoint_names=names,
        skeleton=skeleton_pairs(names),
        # where the third number is COCO's visibility
        occluded=known & (third == 1) & (third.max() == 2),
    )
    return CommonMurre(observations, readings)


def _confidence(third: Float[np.ndarray, "N T K"]) -> tuple[Float[np.ndarray, "N T K"], str]:
    """Return the confidence from the third numbers, and the reading."""
    values = np.unique(third)
    if not third.any():
        raise ValueError("it has no visible keypoint: all third numbers are 0 or NaN")
    if np.isin(values, (0, 1)).all():
        text = "a flag: 1 annotated, 0 not annotated (as COCO's visibility, 1 would mean that all keypoints are hidden)"
        return third, text
    if np.isin(values, (0, 1, 2)).all():
        text = "COCO's visibility: 0 not annotated, 1 hidden, 2 visible; hidden keypoints are used"
        return (third > 0).astype(np.float64), text
    if values[0] < 0 or values[-1] > 1:
        raise ValueError(
            f"its third numbers of {values[0]:.4g} to {values[-1]:.4g} are neither flags of 0, 1, 2 nor fractions"
        )
    return third, f"a confidence, {values[0]:.3g} to {values[-1]:.3g}"


def _pixels(
    position: Float[np.ndarray, "N T K 2"], known: Bool[np.ndarray, "N T K"], size_px: np.ndarray
) -> tuple[Float[np.ndarray, "N T K 2"], str]:
    """Return the positions as x, y in pixels, and the reading."""
    there, size = position[known], f"{size_px[0]}×{size_px[1]}"
    if there.min() >= 0 and there.max() <= 1:
        return position * size_px, f"x, y as fractions of {size} (all numbers lie in 0 to 1; x first is assumed)"
    as_xy, as_yx = (((there < 0) | (there > edges)).any(-1).mean() for edges in (size_px, size_px[::-1]))
    if as_xy <= OUTSIDE:
        order = "x first is assumed; y, x would fit too" if as_yx <= OUTSIDE else "y, x would not fit"
        return position, f"x, y in pixels of {size} ({as_xy:.1%} outside; {order})"
    if as_yx <= OUTSIDE:
        return position[..., ::-1], f"y, x in pixels of {size} ({as_yx:.1%} outside; as x, y {as_xy:.1%} would be)"
    (low_0, low_1), (high_0, high_1) = there.min(0), there.max(0)
    places = f"{low_0:.4g} to {high_0:.4g} and {low_1:.4g} to {high_1:.4g}"
    raise ValueError(f"its positions of {places} are neither pixels of the images of {size} nor fractions")
