"""Which bird and frame of a result is which of the truth's: by track id or by place, and by the frame's number."""

from __future__ import annotations

import dataclasses
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution
from jaxfit.errors import InputError

__all__ = ["Matching", "follow", "match", "match_tracks"]

NEAR = 0.5
"""IoU of the boxes around the keypoints from which on a track is where a bird is."""
_FEWEST = 3
"""Annotated keypoints that a box needs."""


def match(
    solution: Solution, track_id: Int[np.ndarray, "M"], frame_index: Int[np.ndarray, "L"]
) -> tuple[Int[np.ndarray, "N 1"], Int[np.ndarray, "T"], Bool[np.ndarray, "N T"]]:
    """Positions in the truth of a result's tracks and frames.

    Returns:
        Positions of the tracks and of the frames, which together index an (M, L, …) array of the truth as
        (N, T, …), and whether the truth knows both; elsewhere the positions mean nothing.
    """
    rows = {int(track): n for n, track in enumerate(track_id)}
    columns = {int(frame): t for t, frame in enumerate(frame_index)}
    n_truth = np.array([rows.get(int(track), -1) for track in solution.track_id], int)
    t_truth = np.array([columns.get(int(frame), -1) for frame in solution.frame_index], int)
    return n_truth[:, None], t_truth, (n_truth >= 0)[:, None] & (t_truth >= 0)


class Matching(NamedTuple):
    """Whose track is whose."""

    by: Literal["ids", "overlap"]
    follows: dict[int, int]
    """The result's track → the true track."""
    strays: list[int]
    """Tracks of the result that follow nobody."""
    lost: list[int]
    """True tracks that none of the result follows."""


def match_tracks(
    solution: Solution,
    truth: Observations,
    how: Literal["auto", "ids", "overlap"] = "auto",
    source: object = "truth",
) -> tuple[Solution, Matching]:
    """Name the tracks of a result as the truth names the birds that they follow.

    Tracks that were fitted to annotations have the truth's ids; those that a tracker found have ids of its own. With
    ``auto`` the ids are believed unless some track follows another bird than the one of its id (see ``follow``), and
    where every bird stands in a photograph of its own.

    Args:
        solution: the result.
        truth: the annotations.
        how: by which the tracks are matched.
        source: what the truth was read from, for messages.

    Returns:
        The result with the truth's ids, for `evaluate`; strays have ids that the truth lacks. And what was matched.

    Raises:
        InputError: other keypoints than the result's, or photographs that should be matched by overlap.
    """
    own, true = solution.track_id.tolist(), truth.track_id.tolist()
    follows = {track: track for track in own if track in true}
    by: Literal["ids", "overlap"] = "ids"
    if how == "overlap" or (how == "auto" and not truth.own_images):
        near = follow(solution, truth, source)
        if how == "overlap" or any(track != bird for track, bird in near.items()):
            follows, by = near, "overlap"
    strays = [track for track in own if track not in follows]
    lost = [bird for bird in true if bird not in follows.values()]
    if by == "overlap":
        fresh = iter(range(max(true, default=0) + 1, max(true, default=0) + 1 + len(strays)))
        names = [follows[track] if track in follows else next(fresh) for track in own]
        solution = dataclasses.replace(solution, track_id=np.array(names, np.int64))
    return solution, Matching(by, follows, strays, lost)


def follow(solution: Solution, truth: Observations, source: object = "truth") -> dict[int, int]:
    """Which bird each track follows, one-to-one, so that most frames agree.

    A track and a bird agree in a frame where the boxes around their keypoints have an IoU of ``NEAR`` or more: those
    keypoints that are annotated in this frame, at least three. A track can only follow a bird with which it agrees in
    half of the frames that have both.

    Args:
        solution: the result.
        truth: the annotations.
        source: what they were read from, for messages.

    Returns:
        The result's track → the true track, for those that follow one.

    Raises:
        InputError: other keypoints than the result's, or every bird in a photograph of its own.
    """
    truth = check_keypoints(truth, solution.keypoint_names, source)
    if truth.own_images:
        raise InputError(source, "holds photographs, where no bird is followed", "match the birds by their ids")
    _, at_truth, at_own = np.intersect1d(truth.frame_index, solution.frame_index, return_indices=True)
    annotated = truth.confidence[:, at_truth] > 0
    boxed = annotated.sum(-1) >= _FEWEST
    boxes = _boxes(truth.keypoints_px[:, at_truth], annotated)
    agree = np.zeros((len(solution.track_id), truth.num_tracks), int)
    for n, points in enumerate(solution.keypoints_px[:, at_own]):
        both = boxed & solution.valid[n, at_own]
        near = both & (_iou(_boxes(np.broadcast_to(points, (*annotated.shape, 2)), annotated), boxes) >= NEAR)
        agree[n] = np.where(2 * near.sum(1) >= both.sum(1), near.sum(1), 0)
    pairs = zip(*linear_sum_assignment(agree, maximize=True), strict=True)
    return {int(solution.track_id[n]): int(truth.track_id[m]) for n, m in pairs if agree[n, m]}


def _boxes(points: Float[np.ndarray, "M T K 2"], counted: Bool[np.ndarray, "M T K"]) -> Float[np.ndarray, "M T 4"]:
    """Left, upper, right, lower edge."""
    low = np.where(counted[..., None], points, np.inf).min(2)
    high = np.where(counted[..., None], points, -np.inf).max(2)
    return np.concatenate([low, high], axis=-1)


def _iou(a: Float[np.ndarray, "M T 4"], b: Float[np.ndarray, "M T 4"]) -> Float[np.ndarray, "M T"]:
    """NaN where a box is none."""
    with np.errstate(invalid="ignore"):
        width, height = np.moveaxis(np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), -1, 0)
        shared = np.maximum(width, 0) * np.maximum(height, 0)
        area_a, area_b = ((box[..., 2:] - box[..., :2]).prod(-1) for box in (a, b))
        return shared / (area_a + area_b - shared)
