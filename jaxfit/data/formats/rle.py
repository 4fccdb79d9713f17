"""Masks in COCO files: run lengths, compressed or not, and polygons.

pycocotools does not check its input: corrupt run lengths make it read or write beyond its buffers. So every mask is
checked here before pycocotools reads it. pycocotools visits every pixel of the edge of a polygon, also outside the
image, so the length of polygons is bounded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Int, UInt8

from jaxfit.data.formats.fields import Field
from jaxfit.foundation.limits import MASK_RUNS, POLYGON_LENGTH_PX, POLYGONS

_MASKS_AT_ONCE = 500
"""Masks that are checked at once, which bounds the memory."""
_REMEDY = "write the mask again with pycocotools, or leave segmentation out"


class MaskRuns(NamedTuple):
    """R runs of pixels of some masks."""

    mask: Int[np.ndarray, "R"]
    """Position of the mask."""
    pixels: Int[np.ndarray, "R 2"]
    """First pixel, and the pixel after the last; pixels are counted column by column."""
    areas: Int[np.ndarray, "M"]
    """Number of pixels of each mask."""


def read_segmentation(segmentation: Field, height: int, width: int) -> dict[str, Any] | None:
    """Return the mask of a bird as compressed run lengths.

    Args:
        segmentation: the field: an object with ``size`` [height, width] and ``counts`` (text or a list), or a
            list of polygons [x0, y0, x1, y1, …] in image pixels.
        height: height of the image.
        width: width of the image.

    Returns:
        ``size`` and ``counts`` in the format of pycocotools; None for null or an empty list.

    Raises:
        InputError: the mask does not have the size of its image, or run lengths or a polygon are invalid.
    """
    from pycocotools import mask as coco_mask

    if segmentation.value is None or segmentation.value == []:
        return None
    if isinstance(segmentation.value, list):
        polygons = _polygons(segmentation, height, width)
        return cast(Any, coco_mask.merge(coco_mask.frPyObjects(cast(Any, polygons), height, width)))
    if not isinstance(segmentation.value, dict):
        segmentation.fail("must be run lengths (an object) or a list of polygons", _REMEDY)
    size = segmentation["size"].numbers(2)
    if tuple(size) != (height, width):
        segmentation["size"].fail(
            f"is {list(size)}, but its image is [{height}, {width}] (height, width)",
            "write the masks again at the images' size",
        )
    runs = _runs(segmentation["counts"], height * width)
    if sum(runs) != height * width:
        problem = f"is corrupt: its runs cover {sum(runs)} pixels of the image's {height * width}"
        segmentation["counts"].fail(problem, _REMEDY)
    # encoded again from the checked numbers, so that pycocotools never reads text of the file
    return cast(Any, coco_mask.frPyObjects(cast(Any, {"size": [height, width], "counts": runs}), height, width))


def _polygons(segmentation: Field, height: int, width: int) -> list[list[float]]:
    remedy = "simplify the outline, or write run lengths"
    if len(segmentation.value) > POLYGONS:
        segmentation.fail(f"has {len(segmentation.value)} polygons, more than {POLYGONS}", remedy)
    polygons = [_polygon(polygon, height, width) for polygon in segmentation]
    length_px = sum(np.abs(points - np.roll(points, 1, axis=0)).max(1).sum() for points in polygons)
    if length_px > POLYGON_LENGTH_PX:
        problem = f"has outlines of {length_px:.3g} pixels in length, more than {POLYGON_LENGTH_PX:,}"
        segmentation.fail(problem, remedy)
    return [points.reshape(-1).tolist() for points in polygons]


def _polygon(polygon: Field, height: int, width: int) -> np.ndarray:
    """Return the points (P, 2) of a polygon."""
    if not isinstance(polygon.value, list):
        polygon.fail("must be a list of x, y pairs", "write [[x0, y0, x1, y1, …], …], one list a polygon")
    values = polygon.positions()
    if len(values) % 2 or len(values) < 6:
        problem = f"has {len(values)} numbers; a polygon needs an even count, 6 or more"
        polygon.fail(problem, "write x0, y0, x1, y1, x2, y2, …")
    points = np.array(values, dtype=np.float64).reshape(-1, 2)
    size = np.array([width, height])
    if ((points < -size) | (points > 2 * size)).any():
        polygon.fail(f"lies far outside its image of {width}×{height} pixels", "give image pixels")
    return points


def _runs(counts: Field, pixels: int) -> list[int]:
    if isinstance(counts.value, str):
        codes = np.frombuffer(counts.value.encode("ascii", "replace"), np.uint8) - np.uint8(48)
        _check_number_of_runs(counts, int(np.count_nonzero(codes & 32 == 0)))
        runs = run_lengths(counts.value)
        if not runs:
            counts.fail("is corrupt: not the text that pycocotools writes for run lengths", _REMEDY)
        return runs
    if not isinstance(counts.value, list):
        counts.fail("must be text or a list of run lengths", _REMEDY)
    if len(counts.value) > pixels + 2:  # the first and the last run may be empty
        counts.fail(f"has {len(counts.value)} runs, more than the {pixels} pixels of its image", _REMEDY)
    _check_number_of_runs(counts, len(counts.value))
    if all(type(run) is int and 0 <= run <= pixels for run in counts.value):
        return counts.value
    return [run.integer(0, 2**31) for run in counts]


def _check_number_of_runs(counts: Field, runs: int) -> None:
    if runs > MASK_RUNS:
        counts.fail(
            f"has {runs:,} runs, more than {MASK_RUNS:,}", "remove the noise of the mask, or leave segmentation out"
        )


def run_lengths(text: str) -> list[int]:
    """Return the run lengths of COCO's compressed text; empty where the text is corrupt.

    A number is a sequence of characters with 5 bits each, the lowest bits first, offset by the character "0". Bit 6
    means that another character follows; the highest bit of the last character is the sign. From the fourth number on,
    the text holds the difference to the number two places before.

    Args:
        text: ``counts`` of a compressed mask.

    Source: ``rleFrString`` of the COCO API's ``maskApi.c``.
    """
    try:
        codes = np.frombuffer(text.encode("ascii"), np.uint8).astype(np.int64) - 48
    except UnicodeEncodeError:
        return []
    if not codes.size or codes.min() < 0 or codes.max() > 63 or codes[-1] & 32:
        return []
    values, lengths = _differences(codes)
    if lengths.max() > 7:  # 35 bits hold every 32-bit number
        return []
    for start in (1, 2):
        values[start::2] = np.cumsum(values[start::2])
    return values.tolist() if values.min() >= 0 else []


def foreground_runs(masks: Sequence[Mapping[str, Any]]) -> MaskRuns:
    """Return the runs of the pixels of many masks, all at once.

    Args:
        masks: run lengths in the format of ``Observations.masks``, which are valid.
    """
    texts = [rle["counts"] if isinstance(rle["counts"], bytes) else rle["counts"].encode() for rle in masks]
    codes = np.frombuffer(b"".join(texts), np.uint8).astype(np.int64) - 48
    values, owner, place, _ = _run_lengths(codes, np.array([len(text) for text in texts], np.int64))
    end = _sums_within(values, owner)
    run = (place % 2 == 1) & (values > 0)
    owner, lengths, end = owner[run], values[run], end[run]
    areas = np.bincount(owner, lengths, len(masks)).astype(np.int64)
    return MaskRuns(owner, np.stack([end - lengths, end], axis=-1), areas)


def mask_areas(masks: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the number of pixels of each mask; the masks are as for ``foreground_runs``."""
    areas = []
    for first in range(0, len(masks), _MASKS_AT_ONCE):
        areas += foreground_runs(masks[first : first + _MASKS_AT_ONCE]).areas.tolist()
    return areas


def valid_texts(
    text: UInt8[np.ndarray, "C"], lengths: Int[np.ndarray, "M"], pixels: Int[np.ndarray, "M"]
) -> Bool[np.ndarray, "M"]:
    """Return which of many compressed masks are valid, all at once: their runs cover their images.

    Args:
        text: the characters of all masks, one mask after the other.
        lengths: number of characters of each mask, above 0.
        pixels: pixels of the image of each mask.

    Returns:
        False for every mask where any mask has characters that are no run lengths; ``run_lengths`` tells them apart.
    """
    valid = np.zeros(len(lengths), bool)
    ends = np.cumsum(lengths)
    for first in range(0, len(lengths), _MASKS_AT_ONCE):
        some = slice(first, first + _MASKS_AT_ONCE)
        codes = text[ends[first] - lengths[first] : ends[some][-1]].astype(np.int64) - 48
        if codes.min() < 0 or codes.max() > 63 or (codes[np.cumsum(lengths[some]) - 1] & 32).any():
            return np.zeros(len(lengths), bool)
        values, owner, _, characters = _run_lengths(codes, lengths[some])
        wrong = np.bincount(owner, (values < 0) | (characters > 7), len(lengths[some]))  # 35 bits hold 32-bit numbers
        valid[some] = (np.bincount(owner, values, len(lengths[some])) == pixels[some]) & (wrong == 0)
    return valid


def _run_lengths(codes: Int[np.ndarray, "C"], lengths: Int[np.ndarray, "M"]) -> tuple[np.ndarray, ...]:
    """Return the run lengths of many masks, with the mask and the place in the mask of each.

    Args:
        codes: the characters of all masks, offset by "0".
        lengths: number of characters of each mask.

    Returns:
        Run lengths, positions of their masks, positions in their masks, and numbers of their characters; (R,) each.
    """
    values, characters = _differences(codes)
    owner = np.repeat(np.arange(len(lengths)), lengths)[np.cumsum(characters) - 1]
    place = np.arange(len(values)) - np.searchsorted(owner, np.arange(len(lengths)))[owner]
    for start in (1, 2):
        some = np.flatnonzero((place >= start) & (place % 2 == start % 2))
        values[some] = _sums_within(values[some], owner[some])
    return values, owner, place, characters


def _differences(codes: Int[np.ndarray, "C"]) -> tuple[Int[np.ndarray, "R"], Int[np.ndarray, "R"]]:
    """Return the numbers that some characters stand for, and the number of characters of each number."""
    last = (codes & 32) == 0
    starts = np.flatnonzero(np.concatenate([[True], last[:-1]])[: len(codes)])
    lengths = np.diff(np.append(starts, codes.size))
    if not codes.size:
        return codes, lengths
    shift = 5 * (np.arange(codes.size) - np.repeat(starts, lengths))
    values = np.add.reduceat((codes & 31) << shift, starts)
    values -= ((codes[last] & 16) != 0).astype(np.int64) << (5 * lengths)
    return values, lengths


def _sums_within(values: Int[np.ndarray, "R"], owner: Int[np.ndarray, "R"]) -> Int[np.ndarray, "R"]:
    """Return the cumulative sums of the values of each owner; the owners increase."""
    sums = np.cumsum(values)
    counts = np.bincount(owner)
    before = np.concatenate([[0], sums])[np.cumsum(counts) - counts]  # of each owner: the sum of the earlier owners
    return sums - before[owner]
