"""Left and right exchanged back where a detector mixed them up for some frames.

What tells a swap is the arrow from the left keypoint of a pair to the right one: a bird turns it little by little, a
swap all at once, and back again. For each bird the states of all frames, as detected or exchanged, are chosen together
by dynamic programming, first for all pairs at once, then for each pair by itself. With v the arrow, s = ±1 the state, w
the lower of two keypoints' confidences, and m the median of |v(t) − v(t−1)| over the track, going from frame t' to
frame t, at most REACH frames later, costs

    min(w(t), w(t')) · min(|s(t) v(t) − s(t') v(t')| / (m √(t − t')), FAR),

with SWITCH more where the state changes, FAR · w for each frame in between that is passed over as an outlier, and
SWAPPED · w for each frame that is exchanged. What a long gap parts has nothing in common but that last one: without
a neighbour to tell, the sides are as detected, and of two halves that contradict each other the longer and more
trusted one is right.
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

REACH = 8
"""Frames over which a bird may be compared with itself."""
FAR = 6.0
"""Beyond so many times the usual change of the arrow, how far does not matter."""
SWITCH = 1.0
"""What a change of state costs, in usual changes of the arrow."""
SWAPPED = 0.2
"""What an exchanged frame costs: a swap that lasts for long is no swap but the bird that has turned."""
STILL = 0.005
"""Least usual change of the arrow, in longer sides of the box."""


def repair_left_right_flips(
    observations: Observations, keypoint_pairs: Sequence[tuple[int, int]]
) -> tuple[Observations, Bool[np.ndarray, "N T P"]]:
    """Exchange the keypoints of left and right in those frames in which the others say so.

    Args:
        observations: as detected.
        keypoint_pairs: P pairs (left, right), counted from 0.

    Returns:
        The observations with such keypoints exchanged, confidences and all, and which pairs of which bird and frame
        those are. A frame between two that are exchanged is too, even if it says nothing itself.
    """
    N, T = observations.present.shape
    pairs = np.array(keypoint_pairs, int).reshape(-1, 2)
    P = len(pairs)
    if not N or T < 2 or not P:
        return observations, np.zeros((N, T, P), bool)
    side = np.where(observations.present, observations.box_px[..., 2:].max(-1), 1)
    ends = observations.keypoints_px[:, :, pairs].astype(np.float64)  # N T P 2 xy
    arrow = (ends[..., 1, :] - ends[..., 0, :]) / np.maximum(side, 1)[..., None, None]
    weight = observations.confidence[:, :, pairs].min(-1).astype(np.float64)
    numbers = observations.frame_index
    at = (numbers - numbers[0]) // frame_step(numbers)
    usual = _usual_change(arrow, weight, at)

    whole = _states(arrow, weight, at, usual)[..., None]
    arrow = np.where(whole[..., None], -arrow, arrow)
    alone = np.moveaxis(arrow, 2, 1).reshape(N * P, T, 1, 2), np.moveaxis(weight, 2, 1).reshape(N * P, T, 1)
    single = _states(*alone, at, usual.reshape(N * P, 1)).reshape(N, P, T)
    swapped = whole ^ np.moveaxis(single, 1, 2)
    return _exchanged(observations, pairs, swapped), swapped


def _usual_change(
    arrow: Float[np.ndarray, "N T P 2"], weight: Float[np.ndarray, "N T P"], at: Int[np.ndarray, "T"]
) -> Float[np.ndarray, "N P"]:
    """Median change of the arrow from one frame to the next."""
    known = (weight[:, 1:] > 0) & (weight[:, :-1] > 0) & (np.diff(at) == 1)[:, None]
    change = np.where(known, np.linalg.norm(np.diff(arrow, axis=1), axis=-1), np.nan)
    change[:, 0] = np.where(known.any(1), change[:, 0], 1)  # nothing to compare: the whole box
    return np.maximum(np.nanmedian(change, axis=1), STILL)


def _states(
    arrow: Float[np.ndarray, "L T P 2"],
    weight: Float[np.ndarray, "L T P"],
    at: Int[np.ndarray, "T"],
    usual: Float[np.ndarray, "L P"],
) -> Bool[np.ndarray, "L T"]:
    """Which frames to exchange, all P arrows together, for each of L lanes by itself."""
    L, T, _ = weight.shape
    rows, total = np.arange(L), weight.sum(-1)
    passed = np.concatenate([np.zeros((L, 1)), np.cumsum(FAR * total, axis=1)], axis=1)
    cost = np.zeros((L, T, 2))  # of the best way that ends in this frame and state
    before = np.full((L, T, 2, 2), -1)  # frame and state that this way came from
    linked = np.zeros((L, T, 2), bool)  # whether it was compared with them
    done, end = np.zeros(L), np.full((L, 2), -1)  # the best way so far, wherever it ends, and where
    signs, switch = np.array([1.0, -1.0]), np.array([0.0, SWITCH])
    for t in range(T):
        first = int(np.searchsorted(at, at[t] - REACH))
        anew = done + FAR * total[:, t]
        cost[:, t], before[:, t] = anew[:, None], end[:, None]
        if first < t:
            both = np.minimum(weight[:, t, None], weight[:, first:t])  # L E P
            reach = usual[:, None] * np.sqrt(at[t] - at[first:t])[None, :, None]
            far = arrow[:, t, None, :, None] - signs[:, None] * arrow[:, first:t, :, None]
            change = np.minimum(np.linalg.norm(far, axis=-1) / reach[..., None], FAR)  # L E P same/other
            change = (both[..., None] * change).sum(2) + switch
            between = passed[:, t, None] - passed[:, first + 1 : t + 1]
            way = cost[:, first:t, None] + between[..., None, None] + change[..., [[0, 1], [1, 0]]]  # L E now then
            way[~both.any(axis=-1)] = np.inf
            way = np.moveaxis(way, 2, 1).reshape(L, 2, -1)
            best = way.argmin(-1)  # L now
            least = np.take_along_axis(way, best[..., None], -1)[..., 0]
            linked[:, t] = least <= anew[:, None]
            came = np.stack([first + best // 2, best % 2], axis=-1)
            cost[:, t] = np.where(linked[:, t], least, cost[:, t])
            before[:, t] = np.where(linked[:, t, :, None], came, before[:, t])
        cost[:, t, 1] += SWAPPED * total[:, t]
        state = cost[:, t].argmin(-1)
        ends = (total[:, t] > 0) & (cost[rows, t, state] <= anew)
        done = np.where(ends, cost[rows, t, state], anew)
        end = np.where(ends[:, None], np.stack([np.full(L, t), state], axis=-1), end)
    return np.stack([_trace(end[lane], before[lane], linked[lane]) for lane in range(L)])


def _trace(end: np.ndarray, before: np.ndarray, linked: np.ndarray) -> Bool[np.ndarray, "T"]:
    """The states on the best way, from its end back; what it passes over between exchanged frames is exchanged too."""
    swapped = np.zeros(len(before), bool)
    t, state = end
    while t >= 0:
        earlier, r = before[t, state]
        if state:
            swapped[earlier + 1 if linked[t, state] and r else t : t + 1] = True
        t, state = earlier, r
    return swapped


def _exchanged(
    observations: Observations, pairs: Int[np.ndarray, "P 2"], swapped: Bool[np.ndarray, "N T P"]
) -> Observations:
    """The same with both keypoints of a pair in each other's place where `swapped` says so."""
    changed = {}
    for name in ("keypoints_px", "confidence", "occluded"):
        array = cast(np.ndarray, getattr(observations, name)).copy()
        when = swapped.reshape(*swapped.shape, *[1] * (array.ndim - 3))
        left, right = array[:, :, pairs[:, 0]], array[:, :, pairs[:, 1]]
        array[:, :, pairs[:, 0]], array[:, :, pairs[:, 1]] = np.where(when, right, left), np.where(when, left, right)
        changed[name] = array
    return replace(observations, **changed)
