"""Masks in COCO files: run lengths, compressed or not, and polygons.

pycocotools does not check its input: corrupt run lengths make it read or write beyond its buffers. So every mask of a
file is checked here before pycocotools decodes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Int

_MASKS_AT_ONCE = 500
"""Masks that are checked at once, which bounds the memory."""


class MaskRuns(NamedTuple):
    """R runs of pixels of some masks."""

    mask: Int[np.ndarray, "R"]
    """Position of the mask."""
    pixels: Int[np.ndarray, "R 2"]
    """First pixel, and the pixel after the last; pixels are counted column by column."""
    areas: Int[np.ndarray, "M"]
    """Number of pixels of each mask."""

    @property
    def starts(self) -> Int[np.ndarray, "_"]:
        """First run of each mask, and the end of the last."""
        return np.searchsorted(self.mask, np.arange(len(self.areas) + 1))


def read_segmentation(segmentation: Any, height: int, width: int) -> dict[str, Any] | None:
    """Return the mask of a bird as compressed run lengths, which `first_invalid` still has to check.

    Args:
        segmentation: an object with ``size`` [height, width] and ``counts`` (text or a list), or a list of polygons
            [x0, y0, x1, y1, …] in image pixels. Polygons of fewer than three points are skipped.
        height: height of the image.
        width: width of the image.

    Returns:
        ``size`` and ``counts`` in the format of pycocotools; None for null and for a list without a polygon.

    Raises:
        ValueError: the mask does not have the size of its image, or run lengths or a polygon are invalid.
        LookupError, TypeError: the value has another form.
    """
    from pycocotools import mask as coco_mask

    if segmentation is None or isinstance(segmentation, list):
        polygons = [np.asarray(polygon, np.float64) for polygon in segmentation or ()]
        if any(polygon.ndim != 1 or len(polygon) % 2 for polygon in polygons):
            raise ValueError("segmentation must be a list of polygons [x0, y0, x1, y1, …]")
        polygons = [polygon for polygon in polygons if len(polygon) >= 6]
        if not polygons:
            return None
        points, size = np.concatenate(polygons).reshape(-1, 2), np.array([width, height])
        # pycocotools visits every pixel of an edge, also outside the image
        if not ((points >= -size) & (points <= 2 * size)).all():
            raise ValueError(f"segmentation lies far outside its image of {width}×{height} pixels")
        encoded = coco_mask.frPyObjects(cast(Any, [polygon.tolist() for polygon in polygons]), height, width)
        return cast(Any, coco_mask.merge(encoded))
    if list(segmentation["size"]) != [height, width]:
        problem = f"segmentation.size is {list(segmentation['size'])}, but its image is [{height}, {width}]"
        raise ValueError(f"{problem} (height, width)")
    counts = segmentation["counts"]
    if isinstance(counts, str):
        return {"size": [height, width], "counts": counts.encode("ascii", "replace")}
    runs = [int(run) for run in counts]
    if min(runs, default=-1) < 0 or sum(runs) != height * width or runs != list(counts):
        raise ValueError(f"segmentation.counts is corrupt: its runs do not cover the image's {height * width} pixels")
    return cast(Any, coco_mask.frPyObjects(cast(Any, {"size": [height, width], "counts": runs}), height, width))


def first_invalid(masks: Sequence[Mapping[str, Any]]) -> int | None:
    """Return the position of the first mask whose run lengths do not cover its image; None if all masks are valid."""
    for first in range(0, len(masks), _MASKS_AT_ONCE):
        some = masks[first : first + _MASKS_AT_ONCE]
        if not _are_valid(some):
            return first + next(i for i, mask in enumerate(some) if not _are_valid([mask]))
    return None


def _are_valid(masks: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether the run lengths of all masks cover their images."""
    codes, lengths = _codes(masks)
    if not lengths.all() or codes.min() < 0 or codes.max() > 63 or (codes[np.cumsum(lengths) - 1] & 32).any():
        return False  # a mask without text, other characters, or a text that ends within a number
    values, owner, _, characters = _run_lengths(codes, lengths)
    pixels = [mask["size"][0] * mask["size"][1] for mask in masks]
    covered = np.bincount(owner, values, len(masks)) == pixels
    return bool(covered.all() and values.min() >= 0 and characters.max() <= 7)  # 35 bits hold 32-bit numbers


def foreground_runs(masks: Sequence[Mapping[str, Any]]) -> MaskRuns:
    """Return the runs of the pixels of many masks, all at once.

    Args:
        masks: run lengths in the format of ``Observations.masks``, which are valid.
    """
    values, owner, place, _ = _run_lengths(*_codes(masks))
    end = _sums_within(values, owner)
    run = (place % 2 == 1) & (values > 0)
    owner, lengths, end = owner[run], values[run], end[run]
    areas = np.bincount(owner, lengths, len(masks)).astype(np.int64)
    return MaskRuns(owner, np.stack([end - lengths, end], axis=-1), areas)


def _codes(masks: Sequence[Mapping[str, Any]]) -> tuple[Int[np.ndarray, "C"], Int[np.ndarray, "M"]]:
    """Return the characters of all masks, one mask after the other, offset by "0"; and their numbers of characters."""
    texts = [mask["counts"] if isinstance(mask["counts"], bytes) else mask["counts"].encode() for mask in masks]
    codes = np.frombuffer(b"".join(texts), np.uint8).astype(np.int64) - 48
    return codes, np.array([len(text) for text in texts], np.int64)


def _run_lengths(codes: Int[np.ndarray, "C"], lengths: Int[np.ndarray, "M"]) -> tuple[np.ndarray, ...]:
    """Return the run lengths of many masks, with the mask and the place in the mask of each.

    A number is a sequence of characters with 5 bits each, the lowest bits first, offset by the character "0". Bit 6
    means that another character follows; the highest bit of the last character is the sign. From the fourth number on,
    the text holds the difference to the number two places before.

    Args:
        codes: the characters of all masks, offset by "0".
        lengths: number of characters of each mask.

    Returns:
        Run lengths, positions of their masks, positions in their masks, and numbers of their characters; (R,) each.

    Source: ``rleFrString`` of the COCO API's ``maskApi.c``.
    """
    last = (codes & 32) == 0
    starts = np.flatnonzero(np.concatenate([[True], last[:-1]])[: len(codes)])
    characters = np.diff(np.append(starts, codes.size))
    shift = 5 * (np.arange(codes.size) - np.repeat(starts, characters))
    values = np.add.reduceat((codes & 31) << shift, starts) if codes.size else codes
    values -= ((codes[last] & 16) != 0).astype(np.int64) << (5 * characters)
    owner = np.repeat(np.arange(len(lengths)), lengths)[np.cumsum(characters) - 1]
    place = np.arange(len(values)) - np.searchsorted(owner, np.arange(len(lengths)))[owner]
    for start in (1, 2):
        some = np.flatnonzero((place >= start) & (place % 2 == start % 2))
        values[some] = _sums_within(values[some], owner[some])
    return values, owner, place, characters


def _sums_within(values: Int[np.ndarray, "R"], owner: Int[np.ndarray, "R"]) -> Int[np.ndarray, "R"]:
    """Return the cumulative sums of the values of each owner; the owners increase."""
    sums = np.cumsum(values)
    counts = np.bincount(owner)
    before = np.concatenate([[0], sums])[np.cumsum(counts) - counts]  # of each owner: the sum of the earlier owners
    return sums - before[owner]
