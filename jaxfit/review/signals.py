"""Signals of uncertainty of every frame, and the choice of uncertain frames that differ.

Every signal is a mean over the birds of a frame, except `missing birds`, which counts birds. A signal has no unit in
common with another signal, so signals are combined by their ranks (`combine`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfit.data.flags import LARGEST_SHARE, keypoint_distances
from jaxfit.data.observations import Observations, mean_confidence
from jaxfit.data.solution import Solution
from jaxfit.data.tracks import frame_step, second_differences
from jaxfit.model.anatomy import mirror_pairs
from jaxfit.perception.network import Instance, KeypointDetector, Segmenter, instance_of

NEAR_FRAMES = 25
"""Number of frames before and after a frame that give the usual number of birds."""


def frame_signals(observations: Observations, solution: Solution | None = None) -> dict[str, Float[np.ndarray, "T"]]:
    """Return the signals of the frames of observations; NaN where a signal is unknown.

    - `low confidence`: 1 − mean confidence of the keypoints; a missing keypoint has confidence 0;
    - `low bird score`: 1 − score of the detection of the bird;
    - `jitter`: |p(t−1) − 2 p(t) + p(t+1)| / (longer side of the box), mean over the confident keypoints;
    - `missing birds`: tracks with birds before and after the frame, but not in the frame, and the difference of the
      number of birds from its median over `NEAR_FRAMES` frames on both sides; as a share of the birds;
    - `fit residual`: distance of the projected keypoints of a fit from the observed keypoints, as a share of the longer
      side of the box, weighted by confidence. Only with a solution.

    Args:
        observations: detected birds.
        solution: the fit of these birds; tracks and frames are matched by their numbers.

    Returns:
        Name of the signal → (T,).
    """
    present = observations.present
    signals = {
        "low confidence": mean_over_birds(1 - mean_confidence(observations.confidence), present),
        "low bird score": mean_over_birds(1 - cast(np.ndarray, observations.score), present),
        "jitter": mean_over_birds(_jitter(observations), present),
        "missing birds": _missing_birds(observations),
    }
    if solution is not None:
        signals["fit residual"] = mean_over_birds(keypoint_distances(observations, solution), present)
    return signals


def mean_over_birds(values: np.ndarray, present: np.ndarray) -> Float[np.ndarray, "T"]:
    """Return the mean of (N, T) values over the present birds with a value; NaN in frames without such a bird."""
    counted = present & np.isfinite(values)
    count = counted.sum(0)
    return np.where(count, np.where(counted, values, 0).sum(0) / np.maximum(count, 1), np.nan)


def ranks(values: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """Return the share of the known values that are smaller, with half of the equal values; 0.5 where unknown."""
    known = np.isfinite(values)
    ordered = np.sort(values[known])
    if not len(ordered):
        return np.full(len(values), 0.5)
    filled = np.where(known, values, ordered[0])
    below, through = (np.searchsorted(ordered, filled, side) for side in ("left", "right"))
    return np.where(known, (below + through) / (2 * len(ordered)), 0.5)


def combine(signals: Mapping[str, np.ndarray]) -> tuple[Float[np.ndarray, "T"], list[str]]:
    """Return the score of every frame, the mean of the ranks of its signals in [0, 1], and its strongest signal.

    A signal that is equal in all frames does not count. Without any other signal, all scores are 0.5 and the names are
    empty.
    """
    ranked = {name: ranks(values) for name, values in signals.items()}
    ranked = {name: rank for name, rank in ranked.items() if len(rank) and np.ptp(rank) > 0}
    count = len(next(iter(signals.values()), ()))
    if not ranked:
        return np.full(count, 0.5), [""] * count
    table = np.stack(list(ranked.values()))
    names = list(ranked)
    return table.mean(0), [names[i] for i in table.argmax(0)]


def _jitter(observations: Observations) -> Float[np.ndarray, "N T"]:
    differences = np.minimum(second_differences(observations), LARGEST_SHARE)
    jitter = np.full(observations.present.shape, np.nan)
    if observations.num_frames > 2 and observations.num_keypoints:
        known = np.isfinite(differences)
        total = np.where(known, differences, 0).sum(-1)
        jitter[:, 1:-1] = np.where(known.any(-1), total / np.maximum(known.sum(-1), 1), np.nan)
    return jitter


def _missing_birds(observations: Observations) -> Float[np.ndarray, "T"]:
    present, numbers = observations.present, observations.frame_index
    count = present.sum(0)
    before = np.logical_or.accumulate(present, axis=1)
    after = np.logical_or.accumulate(present[:, ::-1], axis=1)[:, ::-1]
    gaps = (before & after & ~present).sum(0)
    reach = NEAR_FRAMES * frame_step(numbers)
    first, last = np.searchsorted(numbers, numbers - reach), np.searchsorted(numbers, numbers + reach, "right")
    usual = np.array([np.median(count[a:b]) for a, b in zip(first, last, strict=True)])
    return (gaps + np.abs(count - usual)) / np.maximum(usual, 1)


THUMBNAIL_PX = (32, 20)
SHORTLIST = 4
"""Number of frames that are examined in detail, per frame to choose."""
SHARPNESS = 4.0
"""Exponent of the score against the distance from the chosen frames: 0 chooses by variety alone."""

MIN_GAP = 0.25
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
        crowded |= gap < MIN_GAP
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


def mirror_disagreement(
    picture: UInt8[np.ndarray, "H W 3"], observations: Observations, t: int, detector: KeypointDetector
) -> float:
    """Return the mean distance between the keypoints of a frame and the keypoints that a network detects mirrored.

    The network sees the mirrored picture with mirrored masks. The detected positions are mirrored back, and left and
    right keypoints are exchanged. Distances are shares of the longer side of the box, at most `LARGEST_SHARE`.

    Args:
        picture: the frame.
        observations: birds; a bird without a mask has its box as mask.
        t: position of the frame.
        detector: a network with the keypoint names of the observations, in any order.

    Returns:
        Mean over all keypoints with a confidence above 0 of all birds; NaN without such a keypoint.
    """
    width = picture.shape[1]
    rows, birds = [], []
    for n in np.flatnonzero(observations.present[:, t]).tolist():
        bird = _instance(observations, n, t)
        if bird is not None:
            rows.append(n)
            x0 = width - bird.x0 - bird.mask.shape[1]
            birds.append(bird._replace(mask=np.ascontiguousarray(bird.mask[:, ::-1]), x0=x0))
    if not birds:
        return float("nan")
    points, _ = detector(np.ascontiguousarray(picture[:, ::-1]), birds)
    points = np.stack([width - points[..., 0], points[..., 1]], axis=-1)
    names = detector.keypoint_names
    other = np.arange(len(names))
    for left, right in mirror_pairs(names):
        other[[left, right]] = right, left
    order = [names.index(name) for name in observations.keypoint_names]
    points = points[:, other][:, order]
    side = observations.box_px[rows, t, 2:].max(-1)[:, None]
    share = np.minimum(np.linalg.norm(points - observations.keypoints_px[rows, t], axis=-1) / side, LARGEST_SHARE)
    known = observations.confidence[rows, t] > 0
    return float(share[known].mean()) if known.any() else float("nan")


def segmenter_disagreement(
    picture: UInt8[np.ndarray, "H W 3"], observations: Observations, t: int, teacher: Segmenter
) -> float:
    """Return 1 − IoU of the pixels of all birds of a frame and of all birds that another segmenter detects.

    Args:
        picture: the frame.
        observations: birds; a bird without a mask has its box as mask.
        t: position of the frame.
        teacher: the other segmenter.
    """
    size_px = picture.shape[1], picture.shape[0]
    birds_of_frame = [_instance(observations, n, t) for n in np.flatnonzero(observations.present[:, t]).tolist()]
    nothing = np.zeros(picture.shape[:2], bool)
    first, second = (
        np.asarray(np.any([nothing, *(bird.whole(size_px) for bird in birds if bird is not None)], axis=0))
        for birds in (birds_of_frame, teacher(picture))
    )
    either = np.count_nonzero(first | second)
    return 1 - np.count_nonzero(first & second) / either if either else 0.0


def _instance(observations: Observations, n: int, t: int) -> Instance | None:
    """Return the bird as a segmenter would report the bird; None if the bird lies outside the picture."""
    score = float(cast(np.ndarray, observations.score)[n, t])
    mask = observations.mask(n, t)
    if mask is not None:
        return instance_of(mask, score, "bird")
    size = np.array(observations.image_size(n, t))
    low, extent = np.split(observations.box_px[n, t], 2)
    first, last = np.clip(np.floor(low), 0, size).astype(int), np.clip(np.ceil(low + extent), 0, size).astype(int)
    if (last <= first).any():
        return None
    width, height = (last - first).tolist()
    return Instance(np.ones((height, width), bool), int(first[0]), int(first[1]), score, "bird")
