"""Masks in COCO files: run lengths, compressed or not, and polygons.

pycocotools does not check its input: corrupt run lengths make it read or write beyond its buffers. So every mask is
checked here before pycocotools reads it. pycocotools visits every pixel of the edge of a polygon, also outside the
image, so the length of polygons is bounded.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from jaxfit.data.formats.fields import Field
from jaxfit.limits import POLYGON_LENGTH_PX, POLYGONS

__all__ = ["read_segmentation", "run_lengths"]

_REMEDY = "write the mask again with pycocotools, or leave segmentation out"


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
        runs = run_lengths(counts.value)
        if not runs:
            counts.fail("is corrupt: not the text that pycocotools writes for run lengths", _REMEDY)
        return runs
    if not isinstance(counts.value, list):
        counts.fail("must be text or a list of run lengths", _REMEDY)
    if len(counts.value) > pixels + 2:  # the first and the last run may be empty
        counts.fail(f"has {len(counts.value)} runs, more than the {pixels} pixels of its image", _REMEDY)
    if all(type(run) is int and 0 <= run <= pixels for run in counts.value):
        return counts.value
    return [run.integer(0, 2**31) for run in counts]


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
    last = (codes & 32) == 0
    starts = np.flatnonzero(np.concatenate([[True], last[:-1]]))
    lengths = np.diff(np.append(starts, codes.size))
    if lengths.max() > 7:  # 35 bits hold every 32-bit number
        return []
    shift = 5 * (np.arange(codes.size) - np.repeat(starts, lengths))
    values = np.add.reduceat((codes & 31) << shift, starts)
    values -= ((codes[last] & 16) != 0).astype(np.int64) << (5 * lengths)
    for start in (1, 2):
        values[start::2] = np.cumsum(values[start::2])
    return values.tolist() if values.min() >= 0 else []
