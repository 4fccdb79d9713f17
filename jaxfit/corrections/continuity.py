"""Which tracks of two ranges of frames are the same bird: by place and size, with a confidence.

For a track that ends and a track that begins `g` frames later, let d be the distance of the box centres in body lengths
and s the change of the logarithm of the size. Birds of the two ranges move by σ_g and change their size by τ_g (RMS) in
`g` frames. The evidence for the same bird is the ratio r of the density N(d; σ_g) N(s; τ_g) and the density of a new
bird, which is uniform over the image (in squared body lengths) and over one unit of the logarithm of the size. The
confidence of a pair is r / (1 + the sum of r over all pairs with one of the two tracks).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from jaxfit.data.frame_numbers import frame_step
from jaxfit.data.observations import Observations

__all__ = ["LEAST_CONFIDENCE", "Link", "link_tracks"]

LEAST_CONFIDENCE = 0.5
"""Pairs with a lower confidence are different tracks."""
LEAST_SPREAD = 0.05
"""Least σ and τ: the noise of boxes."""
LEAST_PAIRS = 20
"""Number of pairs of frames that determine σ and τ."""
LARGEST_LOG_RATIO = 300.0


class Link(NamedTuple):
    """A track of the earlier range and a track of the later range that are one bird."""

    before: int
    """Position of the track in the earlier observations."""
    after: int
    """Position of the track in the later observations."""
    missing: int
    """Number of frames without the bird between the two ranges."""
    confidence: float
    """In [0.5, 1]."""


def link_tracks(before: Observations, after: Observations, most_missing: int) -> list[Link]:
    """Return the pairs of tracks that are one bird.

    Args:
        before: observations of the earlier frames.
        after: observations of later frames of the same video.
        most_missing: largest number of frames without the bird, in steps of the frame numbers.
    """
    step = frame_step(np.concatenate([before.frame_index, after.frame_index]))
    old, new = _boxes(before), _boxes(after)
    log_ratio = np.full((before.num_tracks, after.num_tracks), -np.inf)
    missing = np.zeros(log_ratio.shape, int)
    spread = cache(lambda gap: _spread((old, new), gap, step))
    for a, b in np.ndindex(log_ratio.shape):
        if not (old.present[a].any() and new.present[b].any()):
            continue
        end, start = int(np.flatnonzero(old.present[a])[-1]), int(np.flatnonzero(new.present[b])[0])
        gap = int(new.numbers[start] - old.numbers[end]) // step
        missing[a, b] = gap - 1
        if gap - 1 <= most_missing:
            width, height = after.image_size(b, start)
            places = (old.centre[a, end], old.size[a, end]), (new.centre[b, start], new.size[b, start])
            log_ratio[a, b] = _log_ratio(*places, spread(gap), width * height)
    gain = np.maximum(log_ratio, 0)
    ratio = np.exp(np.minimum(log_ratio, LARGEST_LOG_RATIO))
    total = ratio.sum(0) + ratio.sum(1, keepdims=True) - ratio
    links = []
    for a, b in zip(*linear_sum_assignment(gain, maximize=True), strict=True):
        confidence = float(ratio[a, b] / (1 + total[a, b]))
        if confidence >= LEAST_CONFIDENCE:
            links.append(Link(int(a), int(b), int(missing[a, b]), confidence))
    return links


class _Boxes(NamedTuple):
    """Boxes of N tracks over T frames."""

    numbers: Int[np.ndarray, "T"]
    present: Bool[np.ndarray, "N T"]
    centre: Float[np.ndarray, "N T 2"]
    """Image pixels."""
    size: Float[np.ndarray, "N T"]
    """Body length: the square root of the area, image pixels."""


def _boxes(observations: Observations) -> _Boxes:
    box = observations.box_px.astype(np.float64)
    size = np.sqrt(np.maximum(box[..., 2] * box[..., 3], 1.0))
    return _Boxes(observations.frame_index, observations.present, box[..., :2] + box[..., 2:] / 2, size)


def _spread(ranges: Sequence[_Boxes], gap: int, step: int) -> tuple[float, float]:
    """Return σ and τ after `gap` steps. Without enough pairs of frames, the variances grow linearly with the gap."""
    for lag in range(gap, 0, -1):
        moves, growths = (np.concatenate(each) for each in zip(*(_changes(r, lag * step) for r in ranges), strict=True))
        if len(growths) >= LEAST_PAIRS:
            scale = np.sqrt(gap / lag)
            sigma, tau = (scale * np.sqrt(np.mean(each**2)) for each in (moves, growths))
            return max(sigma, LEAST_SPREAD), max(tau, LEAST_SPREAD)
    return LEAST_SPREAD * np.sqrt(gap), LEAST_SPREAD * np.sqrt(gap)


def _changes(boxes: _Boxes, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """Return moves (body lengths, for each axis) and changes of log size of all tracks between frames `lag` apart."""
    numbers = boxes.numbers
    later = np.minimum(np.searchsorted(numbers, numbers + lag), len(numbers) - 1)
    first = np.flatnonzero(numbers[later] == numbers + lag)
    second = later[first]
    both = boxes.present[:, first] & boxes.present[:, second]
    move = (boxes.centre[:, second] - boxes.centre[:, first]) / boxes.size[:, first, None]
    return move[both].ravel(), np.log(boxes.size[:, second] / boxes.size[:, first])[both]


def _log_ratio(
    end: tuple[np.ndarray, float], start: tuple[np.ndarray, float], spread: tuple[float, float], image_px2: float
) -> float:
    """Return log r for centre and size at the end of a track and at the start of another track."""
    (centre, size), (later_centre, later_size) = end, start
    length = np.sqrt(size * later_size)
    distance, growth = np.linalg.norm(later_centre - centre) / length, np.log(later_size / size)
    sigma, tau = spread
    same = -0.5 * (distance / sigma) ** 2 - np.log(2 * np.pi * sigma**2)
    same += -0.5 * (growth / tau) ** 2 - 0.5 * np.log(2 * np.pi * tau**2)
    return float(same + np.log(image_px2 / length**2))
