"""Birds that are too long for the input of a network: detections in a smaller input replace their parts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxfit.perception.instances import Instance

__all__ = ["length_px", "replace_parts"]

MIN_SHARE = 0.5
"""Least share of a part that lies in the whole bird, and least share of a whole bird that hides it."""


def length_px(bird: Instance) -> int:
    """Return the longer side of a bird's box, in image pixels."""
    return max(bird.mask.shape)


def replace_parts(
    birds: Sequence[Instance], birds_of_smaller_input: Sequence[Instance], least_length_px: float
) -> list[Instance]:
    """Return the birds of a frame, in which long birds of a smaller input replace their parts.

    A long bird replaces all birds of which at least half lies in its mask. A bird that reaches beyond the long bird and
    that contains at least half of it stays, and the long bird is dropped. The scores do not count: parts can have high
    scores.

    Args:
        birds: birds of the usual input.
        birds_of_smaller_input: birds of the same frame in a smaller input.
        least_length_px: shorter birds of the smaller input are dropped, image pixels.
    """
    kept = list(birds)
    for whole in birds_of_smaller_input:
        if length_px(whole) < least_length_px:
            continue
        common = [_common_pixels(bird, whole) for bird in kept]
        is_part = [n >= MIN_SHARE * np.count_nonzero(bird.mask) for n, bird in zip(common, kept, strict=True)]
        least = MIN_SHARE * np.count_nonzero(whole.mask)
        if any(n >= least and not part for n, part in zip(common, is_part, strict=True)):
            continue
        kept = [bird for bird, part in zip(kept, is_part, strict=True) if not part] + [whole]
    return kept


def _common_pixels(first: Instance, second: Instance) -> int:
    """Count the pixels that belong to both birds."""
    corners = [(i.x0, i.y0, i.x0 + i.mask.shape[1], i.y0 + i.mask.shape[0]) for i in (first, second)]
    (x0, y0), (x1, y1) = np.max(corners, 0)[:2].tolist(), np.min(corners, 0)[2:].tolist()
    if x0 >= x1 or y0 >= y1:
        return 0
    parts = [i.mask[y0 - i.y0 : y1 - i.y0, x0 - i.x0 : x1 - i.x0] for i in (first, second)]
    return int(np.count_nonzero(parts[0] & parts[1]))
