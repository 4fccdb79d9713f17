"""Selection of uncertain frames that differ from each other."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

__all__ = ["choose", "shortlist", "thumbnail"]

THUMBNAIL_PX = (32, 20)
SHORTLIST = 4
"""Number of frames that are examined in detail, per frame to choose."""
SHARPNESS = 4.0
"""Exponent of the score against the distance from the chosen frames: 0 chooses by variety alone."""

LEAST_GAP = 0.25
"""Least distance in time of chosen frames, as a share of the mean distance of evenly spaced frames."""


def thumbnail(picture: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "D"]:
    """Return a small version of a picture as a vector; Euclidean distances tell how much pictures differ."""
    return cv2.resize(picture, THUMBNAIL_PX, interpolation=cv2.INTER_AREA).astype(np.float32).reshape(-1)


def shortlist(score: Float[np.ndarray, "T"], count: int) -> Int[np.ndarray, "M"]:
    """Return the positions of the frames to examine: half evenly spaced, half with the largest scores.

    Args:
        score: score of every frame.
        count: number of frames that will be chosen.

    Returns:
        M ≤ `SHORTLIST` · count increasing positions; all positions of a short video.
    """
    T, most = len(score), SHORTLIST * count
    if most >= T:
        return np.arange(T)
    taken = np.zeros(T, bool)
    taken[np.linspace(0, T - 1, most // 2).round().astype(int)] = True
    blocked = np.zeros(T, bool)
    reach = max(T // (2 * most), 1)  # neighbours look alike
    for t in np.argsort(-score, kind="stable").tolist():
        if taken.sum() >= most:
            break
        if not blocked[t]:
            taken[t] = True
            blocked[max(t - reach, 0) : t + reach + 1] = True
    return np.flatnonzero(taken)


def choose(
    score: Float[np.ndarray, "M"], thumbnails: Float[np.ndarray, "M D"], numbers: Int[np.ndarray, "M"], count: int
) -> list[int]:
    """Choose frames one after the other: every time the frame with the largest weighted distance.

    The weighted distance of a frame is score^`SHARPNESS` · (distance from the nearest chosen frame). The squared
    distance of two frames is the sum of two squared parts: the distance of the thumbnails, divided by its median over
    all pairs, and the distance in time, divided by the mean distance of `count` evenly spaced frames, at most 1. Frames
    that are closer in time to a chosen frame than a quarter of this mean distance are chosen last. The first frame is
    the frame with the largest score. Equal values choose the earlier frame.

    Args:
        score: in [0, 1].
        thumbnails: from `thumbnail`.
        numbers: increasing frame numbers.
        count: number of frames to choose, at most M.

    Returns:
        Positions in the order of the choice.

    Source: the greedy k-centre method (Gonzalez 1985; Sener and Savarese 2018 for active learning), with weights.
    """
    weight = np.maximum(score, 1e-3) ** SHARPNESS
    spacing = max(int(numbers[-1] - numbers[0]) / count, 1.0)
    scale = _median_distance(thumbnails)
    nearest = np.full(len(score), np.inf)
    chosen, crowded = [int(np.argmax(weight))], np.zeros(len(score), bool)
    while len(chosen) < count:
        last = chosen[-1]
        look = np.linalg.norm(thumbnails - thumbnails[last], axis=-1)
        gap = np.abs(numbers - numbers[last]) / spacing
        crowded |= gap < LEAST_GAP
        nearest = np.minimum(nearest, np.hypot(look / scale, np.minimum(gap, 1)))
        value = weight * nearest - np.where(crowded, 1e6, 0)
        value[chosen] = -np.inf
        chosen.append(int(np.argmax(value)))
    return chosen


def _median_distance(thumbnails: Float[np.ndarray, "M D"]) -> float:
    """Return the median distance of pairs of at most 200 evenly spaced frames; 1 for equal pictures."""
    some = thumbnails[np.unique(np.linspace(0, len(thumbnails) - 1, 200).astype(int))]
    distances = np.linalg.norm(some[:, None] - some[None], axis=-1)
    median = float(np.median(distances[np.triu_indices(len(some), 1)])) if len(some) > 1 else 0.0
    return median or 1.0
