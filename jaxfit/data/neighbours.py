"""The masks of the other birds of an image."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from jaxtyping import Float, Int

from jaxfit.data.observations import Observations

__all__ = ["masks_of_others"]


def masks_of_others(
    observations: Observations,
    track: Int[np.ndarray, "W"],
    frame: Int[np.ndarray, "W T"],
    region: Float[np.ndarray, "W T 3"],
) -> np.ndarray:
    """Return the masks of the other birds that reach into the regions of some birds.

    Args:
        observations: the birds.
        track: position of each bird.
        frame: positions of frames, for each bird; −1 for frames that are not needed.
        region: x0, y0 and size of a square, image pixels.

    Returns:
        (W, T) objects: run lengths of the union of the masks, or None where no other mask reaches into the region.
    """
    from pycocotools import mask as coco_mask

    birds: dict[int, list[int]] = {}  # position of a frame → birds that share its image
    for n, t in observations.masks:
        if (n, t) not in observations.own_images:
            birds.setdefault(t, []).append(n)
    rles = {t: [cast(Any, observations.masks[n, t]) for n in rows] for t, rows in birds.items()}
    boxes = {t: np.asarray(coco_mask.toBbox(cast(Any, rles[t]))).reshape(-1, 4) for t in birds}
    union = np.full(frame.shape, None, object)
    for w, i in np.argwhere(frame >= 0).tolist():
        n, t = int(track[w]), int(frame[w, i])
        if t not in birds or (n, t) in observations.own_images:
            continue
        x0, y0, size = region[w, i]
        x, y, width, height = boxes[t].T
        near = (x < x0 + size) & (x + width > x0) & (y < y0 + size) & (y + height > y0) & (np.array(birds[t]) != n)
        if near.any():
            union[w, i] = coco_mask.merge([rles[t][other] for other in np.flatnonzero(near)])
    return union
