"""Masks as run lengths; boxes.

Boxes in an image: tight boxes of keypoints, and intersection over union. A box is x and y of the upper left corner,
width and height, in image pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.data.formats.rle import foreground_runs

MAX_IMAGE_SIDE_PX = 16_384
"""Longest side of an image. The run lengths of larger masks overflow the buffers of pycocotools."""


def box_of_mask(mask: np.ndarray) -> tuple[int, int, int, int] | None:
    """Return the tight box of an (H, W) mask: x, y of the first pixel, width, height; None for an empty mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    x0, y0 = int(columns[0]), int(rows[0])
    return x0, y0, int(columns[-1]) + 1 - x0, int(rows[-1]) + 1 - y0


def decode_mask(rle: Mapping[str, Any]) -> np.ndarray:
    """Return the mask of run lengths in the format of ``Observations.masks``, which are valid: (H, W) bool."""
    from pycocotools import mask as coco_mask

    return coco_mask.decode(cast(Any, rle)).view(bool)


def decode_columns(
    masks: Sequence[Mapping[str, Any]], columns: Sequence[tuple[int, int]]
) -> Iterator[Bool[np.ndarray, "H W"]]:
    """Yield masks of run lengths of which only some columns are decoded; the others are background.

    A bird covers a small part of a large image, and the time is that of the part.

    Args:
        masks: as for `decode_mask`.
        columns: the first column, and the column after the last, of each mask.
    """
    runs = foreground_runs(masks)
    starts = runs.starts
    for i, (rle, wanted) in enumerate(zip(masks, columns, strict=True)):
        height, width = rle["size"]
        left, right = (min(max(column, 0), width) * height for column in wanted)
        mask = np.zeros((width, height), bool)  # run lengths go column by column; untouched rows take no memory
        pixels = mask.reshape(-1)
        for start, end in np.clip(runs.pixels[slice(*starts[i : i + 2])], left, right).tolist():
            pixels[start:end] = True
        yield mask.T


def box_of_rle(rle: Mapping[str, Any]) -> tuple[int, int, int, int] | None:
    """Return `box_of_mask` of run lengths, without decoding them. Runs without pixels may make the box larger."""
    from pycocotools import mask as coco_mask

    if not coco_mask.area(cast(Any, rle)):
        return None
    x0, y0, width, height = (int(value) for value in coco_mask.toBbox(cast(Any, rle)))
    return x0, y0, width, height


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


def box_iou(boxes_a_px: Float[np.ndarray, "*#B 4"], boxes_b_px: Float[np.ndarray, "*#B 4"]) -> Float[np.ndarray, "*B"]:
    """Intersection over union |A ∩ B| / |A ∪ B| of boxes; NaN where a box is NaN or both boxes have no area.

    The leading axes are broadcast: `box_iou(a[:, None], b[None])` compares every box of `a` with every box of `b`.

    Args:
        boxes_a_px: x, y, width, height; image pixels.
        boxes_b_px: x, y, width, height; image pixels.
    """
    low = np.maximum(boxes_a_px[..., :2], boxes_b_px[..., :2])
    high = np.minimum(
        boxes_a_px[..., :2] + boxes_a_px[..., 2:],
        boxes_b_px[..., :2] + boxes_b_px[..., 2:],
    )
    intersection = np.maximum(high - low, 0).prod(-1)
    union = boxes_a_px[..., 2:].prod(-1) + boxes_b_px[..., 2:].prod(-1) - intersection
    with np.errstate(invalid="ignore"):
        return intersection / union


def box_of_keypoints(
    keypoints_px: Float[np.ndarray, "*B K 2"], known: Bool[np.ndarray, "*B K"]
) -> Float[np.ndarray, "*B 4"]:
    """The tight boxes of the known keypoints: x, y, width, height; NaN where no keypoint is known.

    Args:
        keypoints_px: positions (x, y), image pixels.
        known: whether a keypoint counts.
    """
    low = np.where(known[..., None], keypoints_px, np.inf).min(-2)
    high = np.where(known[..., None], keypoints_px, -np.inf).max(-2)
    boxes = np.concatenate([low, high - low], axis=-1)
    return np.where(known.any(-1, keepdims=True), boxes, np.nan)
