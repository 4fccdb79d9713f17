"""Repair of left-right flips: frames in which the detector exchanged left and right keypoints.

The cue is the vector from the left to the right keypoint of a pair. The vector of a turning bird changes slowly; a flip
reverses the vector within one frame, and reverses it again later. For each bird, dynamic programming chooses the states
of all frames (as detected, or flipped) together: first with all pairs in the same state, then for each pair on its own.
Let v be the vector, s = ±1 the state, w the lower confidence of the two keypoints, and m the median of |v(t) − v(t−1)|
over the track. The transition from frame t' to frame t, at most MAX_FRAMES frames later, costs

    min(w(t), w(t')) · min(|s(t) v(t) − s(t') v(t')| / (m √(t − t')), MAX_CHANGE),

plus STATE_CHANGE_COST if the state changes, plus MAX_CHANGE · w for each frame in between that is skipped as an
outlier, plus FLIP_COST · w for each flipped frame. Across a longer gap no transition is compared and only the last term
remains: without neighbours, the detected sides are kept. If two parts of a track contradict each other, the part with
the smaller sum of w is flipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.data.frame_numbers import frame_step
from jaxfit.data.observations import Observations

__all__ = ["repair_left_right_flips"]

MAX_FRAMES = 8
"""Largest distance, in frames, between two frames that are compared."""
MAX_CHANGE = 6.0
"""Upper bound of the change of the vector, in units of its median change."""
STATE_CHANGE_COST = 1.0
"""Cost of a change of state, in units of the median change of the vector."""
FLIP_COST = 0.2
"""Cost of a flipped frame. A long flip is more probably a bird that turned around."""
MIN_MEDIAN_CHANGE = 0.005
"""Lower bound of the median change of the vector, as a share of the longer side of the box."""


def repair_left_right_flips(
    observations: Observations, keypoint_pairs: Sequence[tuple[int, int]]
) -> tuple[Observations, Bool[np.ndarray, "N T P"]]:
    """Exchange left and right keypoints in the frames in which the detector flipped them.

    Args:
        observations: the detections.
        keypoint_pairs: P pairs (left, right) of keypoint indices.

    Returns:
        The observations with the flipped keypoints (positions, confidences, occlusion) exchanged back, and the mask of
        the flipped pairs. A frame without detections between two flipped frames counts as flipped.
    """
    N, T = observations.present.shape
    pairs = np.array(keypoint_pairs, int).reshape(-1, 2)
    P = len(pairs)
    if not N or T < 2 or not P:
        return observations, np.zeros((N, T, P), bool)
    side_px = np.where(observations.present, observations.box_px[..., 2:].max(-1), 1)
    ends = observations.keypoints_px[:, :, pairs].astype(np.float64)  # N T P 2 xy
    vector = (ends[..., 1, :] - ends[..., 0, :]) / np.maximum(side_px, 1)[..., None, None]
    weight = observations.confidence[:, :, pairs].min(-1).astype(np.float64)
    numbers = observations.frame_index
    time = (numbers - numbers[0]) // frame_step(numbers)
    median_change = _median_change(vector, weight, time)

    common = _flipped_frames(vector, weight, time, median_change)[..., None]
    vector = np.where(common[..., None], -vector, vector)
    single_vectors = np.moveaxis(vector, 2, 1).reshape(N * P, T, 1, 2)
    single_weights = np.moveaxis(weight, 2, 1).reshape(N * P, T, 1)
    single = _flipped_frames(single_vectors, single_weights, time, median_change.reshape(N * P, 1)).reshape(N, P, T)
    flipped = common ^ np.moveaxis(single, 1, 2)
    return _exchange(observations, pairs, flipped), flipped


def _median_change(
    vector: Float[np.ndarray, "N T P 2"], weight: Float[np.ndarray, "N T P"], time: Int[np.ndarray, "T"]
) -> Float[np.ndarray, "N P"]:
    """Compute the median change of the vector between consecutive frames."""
    known = (weight[:, 1:] > 0) & (weight[:, :-1] > 0) & (np.diff(time) == 1)[:, None]
    change = np.where(known, np.linalg.norm(np.diff(vector, axis=1), axis=-1), np.nan)
    change[:, 0] = np.where(known.any(1), change[:, 0], 1)  # no consecutive frames: the size of the box
    return np.maximum(np.nanmedian(change, axis=1), MIN_MEDIAN_CHANGE)


def _flipped_frames(
    vector: Float[np.ndarray, "B T P 2"],
    weight: Float[np.ndarray, "B T P"],
    time: Int[np.ndarray, "T"],
    median_change: Float[np.ndarray, "B P"],
) -> Bool[np.ndarray, "B T"]:
    """Choose the flipped frames of each of B problems by dynamic programming; the P pairs of a problem flip together.

    `cost[:, t, s]` is the cost of the best path that ends in frame t and state s. `previous` holds the frame and state
    before, and `compared` whether the transition was compared. `best_cost` and `best_end` hold the best path so far.
    """
    B, T, _ = weight.shape
    problems, total_weight = np.arange(B), weight.sum(-1)
    skip_cost = np.concatenate([np.zeros((B, 1)), np.cumsum(MAX_CHANGE * total_weight, axis=1)], axis=1)
    cost = np.zeros((B, T, 2))
    previous = np.full((B, T, 2, 2), -1)
    compared = np.zeros((B, T, 2), bool)
    best_cost, best_end = np.zeros(B), np.full((B, 2), -1)
    signs, change_cost = np.array([1.0, -1.0]), np.array([0.0, STATE_CHANGE_COST])
    for t in range(T):
        first = int(np.searchsorted(time, time[t] - MAX_FRAMES))
        restart_cost = best_cost + MAX_CHANGE * total_weight[:, t]
        cost[:, t], previous[:, t] = restart_cost[:, None], best_end[:, None]
        if first < t:
            # shapes: `change` (B, earlier, P, state), then (B, earlier, state); `path` (B, earlier, now, then)
            both = np.minimum(weight[:, t, None], weight[:, first:t])
            unit = median_change[:, None] * np.sqrt(time[t] - time[first:t])[None, :, None]
            difference = vector[:, t, None, :, None] - signs[:, None] * vector[:, first:t, :, None]
            change = np.minimum(np.linalg.norm(difference, axis=-1) / unit[..., None], MAX_CHANGE)
            change = (both[..., None] * change).sum(2) + change_cost
            skipped = skip_cost[:, t, None] - skip_cost[:, first + 1 : t + 1]
            path = cost[:, first:t, None] + skipped[..., None, None] + change[..., [[0, 1], [1, 0]]]
            path[~both.any(axis=-1)] = np.inf
            path = np.moveaxis(path, 2, 1).reshape(B, 2, -1)
            best = path.argmin(-1)
            lowest = np.take_along_axis(path, best[..., None], -1)[..., 0]
            compared[:, t] = lowest <= restart_cost[:, None]
            origin = np.stack([first + best // 2, best % 2], axis=-1)
            cost[:, t] = np.where(compared[:, t], lowest, cost[:, t])
            previous[:, t] = np.where(compared[:, t, :, None], origin, previous[:, t])
        cost[:, t, 1] += FLIP_COST * total_weight[:, t]
        state = cost[:, t].argmin(-1)
        ends_here = (total_weight[:, t] > 0) & (cost[problems, t, state] <= restart_cost)
        best_cost = np.where(ends_here, cost[problems, t, state], restart_cost)
        best_end = np.where(ends_here[:, None], np.stack([np.full(B, t), state], axis=-1), best_end)
    return np.stack([_trace_back(best_end[b], previous[b], compared[b]) for b in range(B)])


def _trace_back(end: np.ndarray, previous: np.ndarray, compared: np.ndarray) -> Bool[np.ndarray, "T"]:
    """Follow the best path back from its end; skipped frames between two flipped frames are flipped too."""
    flipped = np.zeros(len(previous), bool)
    t, state = end
    while t >= 0:
        earlier, earlier_state = previous[t, state]
        if state:
            flipped[earlier + 1 if compared[t, state] and earlier_state else t : t + 1] = True
        t, state = earlier, earlier_state
    return flipped


def _exchange(
    observations: Observations, pairs: Int[np.ndarray, "P 2"], flipped: Bool[np.ndarray, "N T P"]
) -> Observations:
    """Exchange the two keypoints of each flipped pair."""
    changed = {}
    for name in ("keypoints_px", "confidence", "occluded"):
        array = cast(np.ndarray, getattr(observations, name)).copy()
        when = flipped.reshape(*flipped.shape, *[1] * (array.ndim - 3))
        left, right = array[:, :, pairs[:, 0]], array[:, :, pairs[:, 1]]
        array[:, :, pairs[:, 0]], array[:, :, pairs[:, 1]] = np.where(when, right, left), np.where(when, left, right)
        changed[name] = array
    return replace(observations, **changed)
