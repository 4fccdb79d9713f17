"""Which tracks of several cameras are one bird: epipolar consistency of all keypoints over blocks of frames.

The frames are divided into blocks. In a block, the cost of two tracks of different cameras is the median epipolar error
of their common keypoints, relative to the size of the birds. Tracks are merged to birds in the order of their mean
cost; a bird has at most one track of a camera in a frame. Birds of consecutive blocks are joined by the tracks that
they share, so that a track that breaks, or that changes to another bird, in one camera is corrected by the others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.triangulation import epipolar_error_px, fundamental_matrix
from jaxfit.data.observations import Observations

BLOCK_FRAMES = 25
"""Frames of a block: a track that changes to another bird costs at most this many frames of one camera."""
LEAST_PAIRS = 12
"""Two tracks with fewer common keypoints, counted over the frames of a block, are not compared."""
MOST_ERROR = 0.1
"""Tracks with a larger median error, relative to the longer side of their boxes, are not one bird."""
CLEAR_RATIO = 1.5
"""A match is undecided if another track of the same camera has an error less than this times larger."""


class BirdMatches(NamedTuple):
    """The bird of each track of each camera in each frame."""

    bird: tuple[Int[np.ndarray, "N T"], ...]
    """For each camera, number of the bird from 0; −1 where the bird is in no other camera, or without observation."""
    birds: int
    error: Float[np.ndarray, "B"]
    """For each bird, mean over blocks of the error of its tracks, relative to the side of the box."""
    undecided: Float[np.ndarray, "B"]
    """For each bird, share of its blocks in which another track fits almost as well."""


class _Block(NamedTuple):
    """The tracks of a block of frames, of all cameras."""

    nodes: list[tuple[int, int]]
    """(camera, track)."""
    cost: Float[np.ndarray, "M M"]
    """NaN for pairs that are not compared."""


def match_birds(cameras: Sequence[Camera], observations: Sequence[Observations]) -> BirdMatches:
    """Match the tracks of cameras without distortion, in observations with equal frames (`on_common_frames`)."""
    T = observations[0].num_frames
    bird = [np.full(own.present.shape, -1) for own in observations]
    F = {(i, j): fundamental_matrix(cameras[i], cameras[j]) for i, j in combinations(range(len(cameras)), 2)}
    last: dict[tuple[int, int], int] = {}
    errors: dict[int, list[float]] = {}
    doubts: dict[int, list[bool]] = {}
    for first in range(0, T, BLOCK_FRAMES):
        frames = np.arange(first, min(first + BLOCK_FRAMES, T))
        block = _block(observations, F, frames)
        groups = _groups(block, observations, frames)
        numbers = _continue_birds(
            [[block.nodes[m] for m in group] for group in groups], observations, frames, last, errors
        )
        for number, group in zip(numbers, groups, strict=True):
            inside = block.cost[np.ix_(group, group)]
            errors.setdefault(number, []).append(float(np.nanmean(inside)))
            doubts.setdefault(number, []).append(_is_undecided(block, group))
            for m in group:
                v, n = block.nodes[m]
                bird[v][n, frames] = np.where(observations[v].present[n, frames], number, -1)
                last[v, n] = number
    count = len(errors)
    mean = np.array([np.mean(errors[b]) for b in range(count)])
    undecided = np.array([np.mean(doubts[b]) for b in range(count)])
    return BirdMatches(tuple(bird), count, mean, undecided)


def _block(observations: Sequence[Observations], F: dict, frames: np.ndarray) -> _Block:
    nodes = [
        (v, n) for v, own in enumerate(observations) for n in np.flatnonzero(own.present[:, frames].any(1)).tolist()
    ]
    cost = np.full((len(nodes), len(nodes)), np.nan)
    for a, b in combinations(range(len(nodes)), 2):
        (v, n), (w, m) = nodes[a], nodes[b]
        if v == w:
            continue
        one, two = observations[v], observations[w]
        both = (one.confidence[n, frames] > 0) & (two.confidence[m, frames] > 0)
        if both.sum() < LEAST_PAIRS:
            continue
        error_px = epipolar_error_px(
            F[v, w],
            *(
                each.astype(np.float64)
                for each in (one.keypoints_px[n, frames][both], two.keypoints_px[m, frames][both])
            ),
        )
        sides = [own.box_px[k, frames][:, 2:].max(-1) for own, k in ((one, n), (two, m))]
        side = np.broadcast_to((np.sqrt(sides[0] * sides[1]))[:, None], both.shape)[both]
        cost[a, b] = cost[b, a] = np.median(error_px / np.maximum(side, 1))
    return _Block(nodes, cost)


def _groups(block: _Block, observations: Sequence[Observations], frames: np.ndarray) -> list[list[int]]:
    """Merge tracks in the order of their mean cost, while no camera has two tracks of a group in one frame."""
    groups = [[m] for m in range(len(block.nodes))]
    present = [observations[v].present[n, frames] for v, n in block.nodes]

    def price(a: list[int], b: list[int]) -> float:
        for m in a:
            for k in b:
                if block.nodes[m][0] == block.nodes[k][0] and (present[m] & present[k]).any():
                    return np.inf
        between = block.cost[np.ix_(a, b)]
        return float(np.nanmean(between)) if np.isfinite(between).any() else np.inf

    while len(groups) > 1:
        pairs = list(combinations(range(len(groups)), 2))
        prices = [price(groups[a], groups[b]) for a, b in pairs]
        best = int(np.argmin(prices))
        if prices[best] > MOST_ERROR:
            break
        a, b = pairs[best]
        groups[a] += groups.pop(b)
    return [group for group in groups if len({block.nodes[m][0] for m in group}) > 1]


def _continue_birds(groups, observations, frames, last, errors) -> list[int]:
    """Return the number of the bird of each group: that of earlier groups with the same tracks, or a new number."""
    votes = [Counter() for _ in groups]
    for count, group in zip(votes, groups, strict=True):
        for v, n in group:
            if (v, n) in last:
                count[last[v, n]] += int(observations[v].present[n, frames].sum())
    known = sorted({number for count in votes for number in count})
    gain = np.array([[count[number] for number in known] for count in votes], float).reshape(len(groups), len(known))
    rows, columns = linear_sum_assignment(-gain)
    numbers = [-1] * len(groups)
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        if gain[row, column] > 0:
            numbers[row] = known[column]
    fresh = len(errors)
    for g, number in enumerate(numbers):
        if number < 0:
            numbers[g], fresh = fresh, fresh + 1
    return numbers


def _is_undecided(block: _Block, group: list[int]) -> bool:
    """Return whether another track of a camera fits a group almost as well as its own track."""
    for m in group:
        others = [k for k in group if k != m]
        own = np.nanmean(block.cost[m, others]) if np.isfinite(block.cost[m, others]).any() else np.nan
        for k, (v, _) in enumerate(block.nodes):
            if k in group or v != block.nodes[m][0]:
                continue
            rival = block.cost[k, others]
            if np.isfinite(rival).any() and np.nanmean(rival) < CLEAR_RATIO * own:
                return True
    return False
