"""Correspondence of tracks and frames between a result and the truth: by track id or overlap, and by frame number."""

from __future__ import annotations

import dataclasses
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Int
from scipy.optimize import linear_sum_assignment

from jaxfit.data.boxes import box_iou, box_of_keypoints
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution
from jaxfit.errors import InputError
from jaxfit.evaluation.truth import Truth

__all__ = ["Matching", "match", "match_by_overlap", "match_tracks"]

LEAST_IOU = 0.5
"""A track and a bird agree in a frame where the boxes of their keypoints have at least this IoU."""
_LEAST_KEYPOINTS = 3
"""Fewest annotated keypoints of a box."""


def match(
    solution: Solution, track_id: Int[np.ndarray, "M"], frame_index: Int[np.ndarray, "L"]
) -> tuple[Int[np.ndarray, "N 1"], Int[np.ndarray, "T"], Bool[np.ndarray, "N T"]]:
    """Return the positions in the truth of the tracks and frames of a result.

    Args:
        solution: the result, N tracks over T frames.
        track_id: ids of the M tracks of the truth.
        frame_index: numbers of the L frames of the truth.

    Returns:
        Positions of the tracks, positions of the frames, and whether the truth has both the track and the frame.
        Together, the positions index an (M, L, …) array of the truth as an (N, T, …) array; positions are arbitrary
        where the truth lacks the track or the frame.
    """
    rows = {int(track): n for n, track in enumerate(track_id)}
    columns = {int(frame): t for t, frame in enumerate(frame_index)}
    n_truth = np.array([rows.get(int(track), -1) for track in solution.track_id], int)
    t_truth = np.array([columns.get(int(frame), -1) for frame in solution.frame_index], int)
    return n_truth[:, None], t_truth, (n_truth >= 0)[:, None] & (t_truth >= 0)


class Matching(NamedTuple):
    """Correspondence between the tracks of a result and the birds of the truth."""

    by: Literal["ids", "overlap"]
    """How the tracks were matched."""
    follows: dict[int, int]
    """Track of the result → the bird that the track follows, as a track id of the truth."""
    unmatched: list[int]
    """Tracks of the result that follow no bird."""
    missed: list[int]
    """Birds of the truth that no track follows."""


def match_tracks(
    solution: Solution, truth: Truth | Observations, how: Literal["auto", "ids", "overlap"] = "auto"
) -> tuple[Solution, Matching]:
    """Replace the track ids of a result by the ids of the birds that the tracks follow.

    A fit to annotations keeps the ids of the truth; a tracker makes ids of its own. With ``auto``, tracks are matched
    by id unless a track follows another bird than the bird with the track's id (see `match_by_overlap`). ``auto``
    also matches photographs by id, where every bird has an image of its own.

    Args:
        solution: the result.
        truth: the annotations.
        how: ``ids``, ``overlap`` or ``auto``.

    Returns:
        The result with the ids of the truth, for `evaluate`, and the matching. Unmatched tracks get ids that the truth
        does not use.

    Raises:
        InputError: the truth has other keypoints than the result, or photographs cannot be matched by overlap.
    """
    truth = Truth.of(truth)
    own, true = solution.track_id.tolist(), truth.observations.track_id.tolist()
    follows = {track: track for track in own if track in true}
    by: Literal["ids", "overlap"] = "ids"
    if how == "overlap" or (how == "auto" and not truth.observations.own_images):
        overlapping = match_by_overlap(solution, truth)
        if how == "overlap" or any(track != bird for track, bird in overlapping.items()):
            follows, by = overlapping, "overlap"
    unmatched = [track for track in own if track not in follows]
    missed = [bird for bird in true if bird not in follows.values()]
    if by == "overlap":
        unused = iter(range(max(true, default=0) + 1, max(true, default=0) + 1 + len(unmatched)))
        ids = [follows[track] if track in follows else next(unused) for track in own]
        solution = dataclasses.replace(solution, track_id=np.array(ids, np.int64))
    return solution, Matching(by, follows, unmatched, missed)


def match_by_overlap(solution: Solution, truth: Truth | Observations) -> dict[int, int]:
    """Match tracks and birds one-to-one, such that they agree in the greatest total number of frames.

    A track and a bird agree in a frame where the boxes around their keypoints have an IoU of at least ``LEAST_IOU``.
    Both boxes enclose the keypoints that are annotated in this frame, at least three. A track can follow a bird only
    if the two agree in at least half of the frames that have both.

    Args:
        solution: the result.
        truth: the annotations.

    Returns:
        Track of the result → bird of the truth, for the matched tracks.

    Raises:
        InputError: the truth has other keypoints than the result, or every bird has a photograph of its own.
    """
    truth = Truth.of(truth)
    seen = check_keypoints(truth.observations, solution.keypoint_names, truth.source)
    if seen.own_images:
        remedy = "match the birds by their ids"
        raise InputError(truth.source, "holds photographs, in which no bird can be followed", remedy)
    _, at_truth, at_own = np.intersect1d(seen.frame_index, solution.frame_index, return_indices=True)
    annotated = seen.confidence[:, at_truth] > 0
    has_box = annotated.sum(-1) >= _LEAST_KEYPOINTS
    boxes_px = box_of_keypoints(seen.keypoints_px[:, at_truth], annotated)
    agree = np.zeros((len(solution.track_id), seen.num_tracks), int)
    for n, keypoints in enumerate(solution.keypoints_px[:, at_own]):
        both = has_box & solution.valid[n, at_own]
        own_boxes_px = box_of_keypoints(np.broadcast_to(keypoints, (*annotated.shape, 2)), annotated)
        overlapping = (both & (box_iou(own_boxes_px, boxes_px) >= LEAST_IOU)).sum(1)
        agree[n] = np.where(2 * overlapping >= both.sum(1), overlapping, 0)
    pairs = zip(*linear_sum_assignment(agree, maximize=True), strict=True)
    return {int(solution.track_id[n]): int(seen.track_id[m]) for n, m in pairs if agree[n, m]}
