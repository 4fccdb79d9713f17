"""Signals of uncertainty: for every frame of a video, numbers that are large where the networks may be wrong.

Every signal is a mean over the birds of a frame, except `missing birds`, which counts birds. A signal has no unit in
common with another signal, so signals are combined by their ranks (`combine`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import numpy as np
from jaxtyping import Float

from jaxfit.data.frame_numbers import frame_step
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.data.track_quality import second_differences

__all__ = ["combine", "frame_signals", "mean_over_birds", "ranks"]

LARGEST_SHARE = 0.5
"""Upper bound of distances as shares of the longer side of the box; farther keypoints are wrong all the same."""
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
    side = np.where(present, observations.box_px[..., 2:].max(-1), np.nan)
    signals = {
        "low confidence": mean_over_birds(1 - observations.confidence.mean(-1), present),
        "low bird score": mean_over_birds(1 - cast(np.ndarray, observations.score), present),
        "jitter": mean_over_birds(_jitter(observations), present),
        "missing birds": _missing_birds(observations),
    }
    if solution is not None:
        signals["fit residual"] = mean_over_birds(_residual(observations, solution, side), present)
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


def _residual(
    observations: Observations, solution: Solution, side: Float[np.ndarray, "N T"]
) -> Float[np.ndarray, "N T"]:
    residual = np.full(observations.present.shape, np.nan)
    names = [name for name in observations.keypoint_names if name in solution.keypoint_names]
    own, fitted = ([seen.keypoint_names.index(name) for name in names] for seen in (observations, solution))
    tracks = np.intersect1d(observations.track_id, solution.track_id, return_indices=True)[1:]
    frames = np.intersect1d(observations.frame_index, solution.frame_index, return_indices=True)[1:]
    if not (names and len(tracks[0]) and len(frames[0])):
        return residual
    here, there = np.ix_(tracks[0], frames[0]), np.ix_(tracks[1], frames[1])
    offset = observations.keypoints_px[here][:, :, own] - solution.keypoints_px[there][:, :, fitted]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.minimum(np.linalg.norm(offset, axis=-1) / side[here][..., None], LARGEST_SHARE)
        weight = observations.confidence[here][:, :, own]
        values = np.where(weight > 0, share * weight, 0).sum(-1) / weight.sum(-1)
    residual[here] = np.where(solution.valid[there], values, np.nan)
    return residual
