"""Masks as run lengths, the format of pycocotools and of COCO files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np

__all__ = ["box_of_mask", "decode_mask", "encode_mask", "encode_patch"]


def box_of_mask(mask: np.ndarray) -> tuple[int, int, int, int] | None:
    """Return the tight box of an (H, W) mask: x, y of the first pixel, width, height; None for an empty mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    x0, y0 = int(columns[0]), int(rows[0])
    return x0, y0, int(columns[-1]) + 1 - x0, int(rows[-1]) + 1 - y0


def decode_mask(rle: Mapping[str, Any]) -> np.ndarray:
    """Return the mask of run lengths: (H, W) bool."""
    from pycocotools import mask as coco_mask

    return coco_mask.decode(cast(Any, rle)).view(bool)


def encode_mask(mask: Any) -> dict[str, Any]:
    """Return the run lengths of a mask, in the format of ``Observations.masks``.

    Args:
        mask: (H, W) bool, pixels of the image.

    Raises:
        ValueError: ``mask`` does not have two dimensions.
    """
    from pycocotools import mask as coco_mask

    mask = np.asarray(mask)
    if mask.ndim != 2:
        raise ValueError(f"mask must have shape (H, W), not {mask.shape}")
    return cast(Any, coco_mask.encode(np.asfortranarray(mask.astype(bool).astype(np.uint8))))


def encode_patch(mask: Any, x0: int, y0: int, width: int, height: int) -> dict[str, Any]:
    """Return the run lengths, over a whole image, of a mask that is given for a part of the image.

    The rest of the image is background. The bytes equal the result of ``encode_mask`` for the whole image, but the
    function reads only the part.

    Args:
        mask: (h, w) bool.
        x0: first column of the part, in the image.
        y0: first row of the part, in the image.
        width: width of the image.
        height: height of the image.

    Raises:
        ValueError: ``mask`` does not have two dimensions, or reaches beyond the image.
    """
    from pycocotools import mask as coco_mask

    mask = np.asarray(mask, bool)
    if mask.ndim != 2:
        raise ValueError(f"mask must have shape (h, w), not {mask.shape}")
    h, w = mask.shape
    if min(x0, y0) < 0 or x0 + w > width or y0 + h > height:
        raise ValueError(f"a mask of {w}×{h} pixels at ({x0}, {y0}) reaches beyond an image of {width}×{height}")
    edges = np.zeros((w, h + 2), np.int8)  # run lengths go column by column
    edges[:, 1:-1] = mask.T
    column, row = np.nonzero(np.diff(edges, axis=1))
    ends = (x0 + column) * height + y0 + row
    # a run at the bottom of a column and a run at the top of the next column are one run: remove the end and start
    continued = np.diff(ends, append=-1) == 0
    ends = ends[~(continued | np.roll(continued, 1))]
    runs = np.diff(ends, prepend=0, append=width * height)
    if len(ends) and not runs[-1]:
        runs = runs[:-1]
    counts = {"size": [height, width], "counts": runs.tolist()}
    return cast(Any, coco_mask.frPyObjects(cast(Any, counts), height, width))
