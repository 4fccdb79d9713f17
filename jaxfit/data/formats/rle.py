"""Masks in COCO files: run lengths, compressed or not, and polygons.

pycocotools trusts what it is given and reads or writes past its buffers where run lengths are corrupt, so
every mask is checked here before pycocotools sees it.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from jaxfit.data.formats.fields import Field

__all__ = ["read_segmentation", "run_lengths"]

_REMEDY = "write the mask again with pycocotools, or leave segmentation out"


def read_segmentation(segmentation: Field, height: int, width: int) -> dict[str, Any] | None:
    """One bird's mask as compressed run lengths.

    Args:
        segmentation: the field: an object with ``size`` [height, width] and ``counts`` (text or a list), or a
            list of polygons [x0, y0, x1, y1, …] in image pixels.
        height: of the image.
        width: of the image.

    Returns:
        ``size`` and ``counts`` as pycocotools keeps them; None for null or an empty list.

    Raises:
        InputError: a mask of another size than its image, corrupt run lengths, a polygon that is none.
    """
    from pycocotools import mask as coco_mask

    if segmentation.value is None or segmentation.value == []:
        return None
    if isinstance(segmentation.value, list):
        polygons = [_polygon(polygon, height, width) for polygon in segmentation]
        return cast(Any, coco_mask.merge(coco_mask.frPyObjects(cast(Any, polygons), height, width)))
    if not isinstance(segmentation.value, dict):
        segmentation.fail("must be run lengths (an object) or a list of polygons", _REMEDY)
    size = segmentation["size"].numbers(2)
    if tuple(size) != (height, width):
        segmentation["size"].fail(
            f"is {list(size)}, but its image is [{height}, {width}] (height, width)",
            "write the masks again at the images' size",
        )
    runs = _runs(segmentation["counts"])
    if sum(runs) != height * width:
        problem = f"is corrupt: its runs cover {sum(runs)} pixels of the image's {height * width}"
        segmentation["counts"].fail(problem, _REMEDY)
    # written anew from the checked numbers, so that pycocotools never reads the file's own text
    return cast(Any, coco_mask.frPyObjects(cast(Any, {"size": [height, width], "counts": runs}), height, width))


def _polygon(polygon: Field, height: int, width: int) -> list[float]:
    if not isinstance(polygon.value, list):
        polygon.fail("must be a list of x, y pairs", "write [[x0, y0, x1, y1, …], …], one list a polygon")
    values = polygon.positions()
    if len(values) % 2 or len(values) < 6:
        problem = f"has {len(values)} numbers; a polygon needs an even count, 6 or more"
        polygon.fail(problem, "write x0, y0, x1, y1, x2, y2, …")
    points = np.array(values, dtype=np.float64).reshape(-1, 2)
    size = np.array([width, height])
    if ((points < -size) | (points > 2 * size)).any():
        # the rasteriser walks every pixel of an edge, however far out
        polygon.fail(f"lies far outside its image of {width}×{height} pixels", "give image pixels")
    return points.reshape(-1).tolist()


def _runs(counts: Field) -> list[int]:
    if isinstance(counts.value, str):
        runs = run_lengths(counts.value)
        if not runs:
            counts.fail("is corrupt: not the text that pycocotools writes for run lengths", _REMEDY)
        return runs
    if not isinstance(counts.value, list):
        counts.fail("must be text or a list of run lengths", _REMEDY)
    return [run.integer(0, 2**31) for run in counts]


def run_lengths(text: str) -> list[int]:
    """The run lengths in COCO's compressed text, empty where the text is corrupt.

    Each number is written in characters of 5 bits, lowest first, from "0" on; bit 6 says that more follow,
    and the highest bit of the last one is the sign. From the fourth number on each is the difference to the
    one two before.

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
