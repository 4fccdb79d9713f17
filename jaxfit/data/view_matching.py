"""Which tracks of several cameras are one bird: epipolar consistency of all keypoints over blocks of frames.

The frames are divided into blocks. In a block, the cost of two tracks of different cameras is the median epipolar error
of their common keypoints, relative to the size of the birds. Tracks are merged to birds in the order of their mean
cost; a bird has at most one track of a camera in a frame. Birds of consecutive blocks are joined by the tracks that
they share, so that a track that breaks, or that changes to another bird, in one camera is corrected by the others.
Birds of a single block are dropped.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.triangulation import epipolar_error_px, fundamental_matrix
from jaxfit.data.observations import Observations
from jaxfit.data.views import MAX_ERROR
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import read_text

BLOCK_FRAMES = 5
"""Frames of a block: a track that changes to another bird costs at most this many frames of one camera."""
MIN_PAIRS = 12
"""Two tracks with fewer common keypoints, counted over the frames of a block, are not compared."""
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


def matches_of_file(path: Path, cameras: Sequence[Camera], observations: Sequence[Observations]) -> BirdMatches:
    """Read the bird of each track from a CSV file with the columns `camera`, `track` and `bird`.

    Tracks that the file does not name show no bird. The errors of the matches are unknown (NaN).

    Raises:
        InputError: the file cannot be read, a column is missing, or a row names no bird, or an unknown camera or track.
    """
    text = read_text(path, "a CSV file")
    try:
        rows = list(csv.DictReader(io.StringIO(text)))
    except csv.Error as error:
        raise InputError(path, f"is not a CSV file: {error}", "write the columns camera, track, bird") from None
    names = [camera.name for camera in cameras]
    bird = [np.full(own.present.shape, -1) for own in observations]
    numbers: dict[str, int] = {}
    for line, row in enumerate(rows, start=2):
        try:
            v = names.index(row["camera"].strip())
            n = observations[v].track_id.tolist().index(int(row["track"]))
            number = numbers.setdefault(row["bird"].strip(), len(numbers))
        except (KeyError, ValueError, TypeError, AttributeError):  # a short row has None
            problem = f"line {line} names no camera and track of the observations: {dict(row)}"
            raise InputError(path, problem, f"write the columns camera ({', '.join(names)}), track, bird") from None
        bird[v][n] = np.where(observations[v].present[n], number, -1)
    unknown = np.full(len(numbers), np.nan)
    return BirdMatches(tuple(bird), len(numbers), unknown, np.zeros(len(numbers)))


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
    last: dict[tuple[int, int], int] = {}
    errors: dict[int, list[float]] = {}
    doubts: dict[int, list[bool]] = {}
    starts = range(0, max(T - BLOCK_FRAMES // 2, 1), BLOCK_FRAMES)  # the last block takes a short remainder
    for first in starts:
        frames = np.arange(first, T if first == starts[-1] else first + BLOCK_FRAMES)
        block = _block(cameras, observations, frames)
        groups = _groups(block, observations, frames)
        numbers = _continue_birds(
            [[block.nodes[m] for m in group] for group in groups], observations, frames, last, len(errors)
        )
        for number, group in zip(numbers, groups, strict=True):
            inside = block.cost[np.ix_(group, group)]
            errors.setdefault(number, []).append(float(np.nanmean(inside)))
            doubts.setdefault(number, []).append(_is_undecided(block, group))
            for m in group:
                v, n = block.nodes[m]
                bird[v][n, frames] = np.where(observations[v].present[n, frames], number, -1)
                last[v, n] = number
    # around the frame where a track changes to another bird, short remainders of tracks may match by chance
    kept = [b for b in range(len(errors)) if len(errors[b]) > 1 or len(starts) == 1]
    new = np.full(len(errors) + 1, -1)  # the last is for −1
    new[kept] = np.arange(len(kept))
    mean = np.array([np.mean(errors[b]) for b in kept])
    undecided = np.array([np.mean(doubts[b]) for b in kept])
    return BirdMatches(tuple(new[own] for own in bird), len(kept), mean, undecided)


def pair_costs(
    cameras: tuple[Camera, Camera], observations: tuple[Observations, Observations], frames: Int[np.ndarray, "F"]
) -> Float[np.ndarray, "N M"]:
    """Return the median epipolar error of each track of one camera with each track of another camera.

    Args:
        cameras, observations: two cameras without distortion, and their tracks.
        frames: positions of the frames that count.

    Returns:
        Errors relative to the side of the boxes; NaN for tracks with fewer than `MIN_PAIRS` common keypoints.
    """
    one, two = observations
    F = fundamental_matrix(*cameras)
    cost = np.full((one.num_tracks, two.num_tracks), np.nan)
    for n in np.flatnonzero(one.present[:, frames].any(1)).tolist():
        for m in np.flatnonzero(two.present[:, frames].any(1)).tolist():
            both = (one.confidence[n, frames] > 0) & (two.confidence[m, frames] > 0)
            if both.sum() < MIN_PAIRS:
                continue
            shown = (own.keypoints_px[k, frames][both].astype(np.float64) for own, k in ((one, n), (two, m)))
            sides = [own.box_px[k, frames][:, 2:].max(-1) for own, k in ((one, n), (two, m))]
            side = np.broadcast_to(np.sqrt(sides[0] * sides[1])[:, None], both.shape)[both]
            cost[n, m] = np.median(epipolar_error_px(F, *shown) / np.maximum(side, 1))
    return cost


def _block(cameras: Sequence[Camera], observations: Sequence[Observations], frames: np.ndarray) -> _Block:
    nodes = [
        (v, n) for v, own in enumerate(observations) for n in np.flatnonzero(own.present[:, frames].any(1)).tolist()
    ]
    cost = np.full((len(nodes), len(nodes)), np.nan)
    at = {node: i for i, node in enumerate(nodes)}
    for v, w in combinations(range(len(cameras)), 2):
        own = pair_costs((cameras[v], cameras[w]), (observations[v], observations[w]), frames)
        for n, m in np.argwhere(np.isfinite(own)).tolist():
            a, b = at[v, n], at[w, m]
            cost[a, b] = cost[b, a] = own[n, m]
    return _Block(nodes, cost)


def _groups(block: _Block, observations: Sequence[Observations], frames: np.ndarray) -> list[list[int]]:
    """Merge tracks in the order of their mean cost; a camera has at most one track of a group in a frame."""
    groups = [[m] for m in range(len(block.nodes))]
    present = [observations[v].present[n, frames] for v, n in block.nodes]

    def price(a: list[int], b: list[int]) -> float:
        for m in a:
            for k in b:
                if block.nodes[m][0] == block.nodes[k][0] and (present[m] & present[k]).any():
                    return np.inf
        between = block.cost[np.ix_(a, b)]
        return float(np.nanmean(between)) if np.isfinite(between).any() else np.inf

    prices = np.full((len(groups), len(groups)), np.inf)
    for a, b in combinations(range(len(groups)), 2):
        prices[a, b] = price(groups[a], groups[b])
    while len(groups) > 1:
        a, b = map(int, np.unravel_index(np.argmin(prices), prices.shape))
        if prices[a, b] > MAX_ERROR:
            break
        groups[a] += groups.pop(b)
        prices = np.delete(np.delete(prices, b, axis=0), b, axis=1)
        for c in range(len(groups)):
            if c != a:
                prices[min(a, c), max(a, c)] = price(groups[a], groups[c])
    return [group for group in groups if len({block.nodes[m][0] for m in group}) > 1]


def _continue_birds(
    groups: list[list[tuple[int, int]]],
    observations: Sequence[Observations],
    frames: np.ndarray,
    last: dict[tuple[int, int], int],
    known_birds: int,
) -> list[int]:
    """Return the number of the bird of each group: that of earlier groups with the same tracks, or a new number."""
    votes: list[Counter[int]] = [Counter() for _ in groups]
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
    fresh = known_birds
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
