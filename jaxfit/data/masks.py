"""Masks as run lengths, which pycocotools keeps and COCO files hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np

__all__ = ["box_of_mask", "decode_mask", "encode_mask", "encode_patch"]


def box_of_mask(mask: np.ndarray) -> tuple[int, int, int, int] | None:
    """The tight box of an (H, W) mask: x, y of its first pixel, width, height; None of an empty mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    x0, y0 = int(columns[0]), int(rows[0])
    return x0, y0, int(columns[-1]) + 1 - x0, int(rows[-1]) + 1 - y0


def decode_mask(rle: Mapping[str, Any]) -> np.ndarray:
    """The mask that run lengths stand for: (H, W) bool."""
    from pycocotools import mask as coco_mask

    return coco_mask.decode(cast(Any, rle)).view(bool)


def encode_mask(mask: Any) -> dict[str, Any]:
    """Run lengths of a mask, as ``Observations.masks`` holds them.

    Args:
        mask: (H, W) bool, pixels of the image.

    Raises:
        ValueError: ``mask`` has not two dimensions.
    """
    from pycocotools import mask as coco_mask

    mask = np.asarray(mask)
    if mask.ndim != 2:
        raise ValueError(f"mask must have shape (H, W), not {mask.shape}")
    return cast(Any, coco_mask.encode(np.asfortranarray(mask.astype(bool).astype(np.uint8))))


def encode_patch(mask: Any, x0: int, y0: int, width: int, height: int) -> dict[str, Any]:
    """Run lengths over a whole image of a mask that is given as a part of it; the rest is background.

    They are the bytes that ``encode_mask`` gives of the whole image, without visiting it.

    Args:
        mask: (h, w) bool.
        x0: column of the image in which the part begins.
        y0: row of the image in which the part begins.
        width: of the image.
        height: of the image.

    Raises:
        ValueError: ``mask`` has not two dimensions, or reaches out of the image.
    """
    from pycocotools import mask as coco_mask

    mask = np.asarray(mask, bool)
    if mask.ndim != 2:
        raise ValueError(f"mask must have shape (h, w), not {mask.shape}")
    h, w = mask.shape
    if min(x0, y0) < 0 or x0 + w > width or y0 + h > height:
        raise ValueError(f"a mask of {w}×{h} pixels at ({x0}, {y0}) reaches out of an image of {width}×{height}")
    edges = np.zeros((w, h + 2), np.int8)  # column by column, as run lengths go
    edges[:, 1:-1] = mask.T
    column, row = np.nonzero(np.diff(edges, axis=1))
    ends = (x0 + column) * height + y0 + row
    # a run that fills a column to the bottom goes on at the top of the next: such an end and start fall away
    goes_on = np.diff(ends, append=-1) == 0
    ends = ends[~(goes_on | np.roll(goes_on, 1))]
    runs = np.diff(ends, prepend=0, append=width * height)
    if len(ends) and not runs[-1]:
        runs = runs[:-1]
    counts = {"size": [height, width], "counts": runs.tolist()}
    return cast(Any, coco_mask.frPyObjects(cast(Any, counts), height, width))
