"""Flags of single poses: what speaks against the pose of a bird in a frame.

A doubt is one reason; the bits of `Solution.flags.doubts` name the doubts of a pose. The flag follows from them:
`contradicted` (the detections speak against the pose), else `unsure` (the detections do not determine the pose), else
`ok`. A flag compares the pose with what was detected. Where detections are wrong and agree with each other, the flag is
`ok` all the same.

Two measures compare a pose with its detections: the mean distance of the keypoints, weighted by their confidence, as a
share of the longer side of the box; and 1 − IoU of the mesh and the mask. A pose is contradicted if a measure is an
outlier among all poses of the result, so that the limit follows from the noise of the user's detections; or if it is
larger than any good pose allows, which also holds where most poses are wrong.

Keypoints and mask of a bird can also contradict each other: confident keypoints lie far outside a mask that lacks a
wing. Such a pose is contradicted, too.

Source: Iglewicz and Hoaglin 1993, *How to detect and handle outliers* (modified z-score, limit 3.5); for the IoU of
½, the usual limit of a matching detection (Everingham et al. 2010, *The PASCAL visual object classes challenge*).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from jaxfit.data.formats.rle import foreground_runs
from jaxfit.data.mask_comparison import compare_masks
from jaxfit.data.observations import Observations, mean_confidence
from jaxfit.data.solution import Solution
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.model.bird import Bird, rest_length

FLAGS = OK, UNSURE, CONTRADICTED = "ok", "unsure", "contradicted"


class Doubt(NamedTuple):
    """One reason to doubt a pose."""

    flag: str
    text: str


DOUBTS = (
    Doubt(CONTRADICTED, "keypoints far from the pose"),
    Doubt(CONTRADICTED, "mask unlike the mesh"),
    Doubt(UNSURE, "a second pose fits almost as well"),
    Doubt(UNSURE, "error bars above 10 % of the length"),
    Doubt(UNSURE, "keypoints with low confidence"),
    Doubt(CONTRADICTED, "keypoints outside the mask"),
)
"""The doubts; doubt i has the value 2^i in `Solution.flags.doubts`."""
WRONG_SHARE = 0.1
"""A pose whose keypoints are wrong by more than this share of the length of the bird counts as wrong."""
MIN_IOU = 0.5
MIN_CONFIDENCE = 0.5
"""Mean confidence of all keypoints of a bird, below which they are doubtful; missing keypoints count as 0, except those
that are missing everywhere."""
OUTSIDE_SHARE = 0.1
"""Keypoints and mask contradict each other if more than this share of the keypoints lies outside the mask by more than
`WRONG_SHARE` of the longer side of the box. Masks often lack one or two of 20 keypoints: bill and feet are thin."""
OUTLIER_Z = 3.5
MIN_POSES = 20
"""Fewer poses have no outliers."""
LARGEST_SHARE = 0.5
"""Upper bound of distances as shares of the longer side of the box; farther keypoints are wrong all the same."""


def keypoint_distances(observations: Observations, solution: Solution) -> Float[np.ndarray, "N T"]:
    """Return the mean distance between the keypoints of the poses and of the observations, weighted by confidence.

    Distances are shares of the longer side of the box, at most `LARGEST_SHARE`. Tracks, frames and keypoints are
    matched by track id, frame number and name; NaN where there is nothing to compare.

    Args:
        observations: N tracks over T frames.
        solution: a fit of these birds.
    """
    distance = np.full(observations.present.shape, np.nan)
    names = [name for name in observations.keypoint_names if name in solution.keypoint_names]
    own, fitted = ([seen.keypoint_names.index(name) for name in names] for seen in (observations, solution))
    tracks = np.intersect1d(observations.track_id, solution.track_id, return_indices=True)[1:]
    frames = np.intersect1d(observations.frame_index, solution.frame_index, return_indices=True)[1:]
    if not (names and len(tracks[0]) and len(frames[0])):
        return distance
    here, there = np.ix_(tracks[0], frames[0]), np.ix_(tracks[1], frames[1])
    offset = observations.keypoints_px[here][:, :, own] - solution.keypoints.px[there][:, :, fitted]
    side = observations.box_px[here][..., 2:].max(-1)
    weight = observations.confidence[here][:, :, own]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.minimum(np.linalg.norm(offset, axis=-1) / side[..., None], LARGEST_SHARE)
        values = np.where(weight > 0, share * weight, 0).sum(-1) / weight.sum(-1)
    counted = solution.valid[there] & observations.present[here] & (side > 0)
    distance[here] = np.where(counted, values, np.nan)
    return distance


def contradict_masks(
    observations: Observations, cells: Int[np.ndarray, "M 2"], progress: ProgressTask = silent
) -> Bool[np.ndarray, "N T"]:
    """Return where the keypoints of a bird contradict its mask (`OUTSIDE_SHARE`).

    Keypoints with a confidence below `MIN_CONFIDENCE` do not count.

    Args:
        observations: N tracks over T frames.
        cells: n and t of the birds that are compared; birds without a mask contradict nothing.
        progress: reports every bird.
    """
    contradicts = np.zeros(observations.present.shape, bool)
    compared = [(n, t) for n, t in cells.tolist() if (n, t) in observations.masks]
    with progress("Comparing keypoints with masks", len(compared)) as report_progress:
        for some in (compared[i : i + _MASKS] for i in range(0, len(compared), _MASKS)):
            contradicts[tuple(np.transpose(some))] = _contradict(observations, some)
            report_progress(len(some), "")
    return contradicts


_MASKS = 1000
"""Masks that are compared at once, which bounds the memory."""


def _contradict(observations: Observations, cells: Sequence[tuple[int, int]]) -> Bool[np.ndarray, "D"]:
    """Return whether the keypoints of D birds with masks contradict their masks."""
    index = tuple(np.transpose(cells))
    masks = [observations.masks[cell] for cell in cells]
    runs, bird = foreground_runs(masks), np.arange(len(masks))[:, None]
    height, width = np.array([mask["size"] for mask in masks]).T[..., None]
    column, row = np.moveaxis(np.floor(observations.keypoints_px[index]).astype(int), -1, 0)
    sure = observations.confidence[index] >= MIN_CONFIDENCE
    pixel, after_all = column * height + row, int((height * width).max()) + 1
    run = np.searchsorted(runs.mask * after_all + runs.pixels[:, 0], bird * after_all + pixel, side="right") - 1
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    inside &= (run >= 0) & (runs.mask[run] == bird) & (pixel < runs.pixels[run, 1]) if len(runs.mask) else False
    beside = sure & ~inside

    def too_many(outside: Bool[np.ndarray, "D K"]) -> Bool[np.ndarray, "D"]:
        return outside.sum(1) / np.maximum(sure.sum(1), 1) > OUTSIDE_SHARE

    starts, limit_px = runs.starts, WRONG_SHARE * observations.box_px[index][:, 2:].max(1).astype(np.float64)
    for d in np.flatnonzero(too_many(beside)).tolist():  # the keypoints of most birds lie in their masks
        own = runs.pixels[slice(*starts[d : d + 2])]
        k = np.flatnonzero(beside[d])
        if len(own):
            distance_px = _distances_px(column[d, k], row[d, k], own, int(height[d, 0]))
            beside[d, k] = distance_px > float(limit_px[d])
        else:
            beside[d] = False  # an empty mask says nothing
    return too_many(beside)


def _distances_px(
    column: Int[np.ndarray, "M"], row: Int[np.ndarray, "M"], runs: Int[np.ndarray, "R 2"], height: int
) -> Float[np.ndarray, "M"]:
    """Return the distances of pixels to the nearest pixel of a mask.

    Args:
        column, row: the pixels, which may lie outside the image.
        runs: the pixels of the mask, as `MaskRuns.pixels`.
        height: height of the image.
    """
    first, last = runs[:, 0] // height, (runs[:, 1] - 1) // height
    count = last - first + 1  # a run may reach into further columns
    at = np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())
    low, high = (np.clip(np.repeat(ends, count) - at * height, 0, height) for ends in runs.T)
    down = np.maximum(np.maximum(low - row[:, None], row[:, None] - high + 1), 0)
    return np.sqrt(((at - column[:, None]) ** 2 + down**2).min(1).astype(np.float32))


def with_doubts(
    solution: Solution, observations: Observations, bird: Bird, progress: ProgressTask = silent
) -> Solution:
    """Return a solution with the doubts about each pose (`Solution.flags.doubts`).

    Args:
        solution: the poses.
        observations: the observations that were fitted: the same tracks, frames and keypoints.
        bird: the model.
        progress: shows the progress of the comparison with masks.
    """
    return with_doubts_of_views(solution, [(solution, observations)], bird, progress)


def with_doubts_of_views(
    solution: Solution,
    views: Iterable[tuple[Solution, Observations]],
    bird: Bird,
    progress: ProgressTask = silent,
) -> Solution:
    """Return a solution with the doubts about each pose, from the detections of one or several views.

    Each measure is its median over the views that have it, so that wrong detections in one of three views do not
    condemn a pose that the other two support; with two views, the median is the mean. Keypoints lie outside the mask
    if they do in more than half of the views. Two views determine a point in space, so the confidence of a keypoint
    is that of its second-best view, and 0 where only one of several views detects the bird.

    Args:
        solution: the poses.
        views: for each view, the same poses in the frame of its camera, and its observations: the same tracks, frames
            and keypoints.
        bird: the model.
        progress: shows the progress of the comparison with masks.
    """
    compared = [_compare(posed, observations, bird, progress) for posed, observations in views]
    far, overlap, outside = (_median_of_views([getattr(own, name) for own in compared]) for name in _MEASURES)
    confidence = np.sort(np.stack([own.confidence for own in compared]), axis=0)[-2:][0]
    doubtful = (
        is_outlier(far) | (far > WRONG_SHARE),
        is_outlier(1 - overlap) | (overlap < MIN_IOU),
        solution.flags.ambiguity_deg > 0,
        expected_error(solution, bird) > WRONG_SHARE,
        mean_confidence(confidence) < MIN_CONFIDENCE,
        outside > 0.5,
    )
    doubts = sum(where.astype(np.int8) << i for i, where in enumerate(doubtful))
    return solution.with_arrays(doubts=doubts)


_MEASURES = "far", "overlap", "outside"


class _Comparison(NamedTuple):
    """Poses and detections of one view; NaN where a view does not measure."""

    far: Float[np.ndarray, "N T"]
    """`keypoint_distances`."""
    overlap: Float[np.ndarray, "N T"]
    """IoU of mesh and mask."""
    outside: Float[np.ndarray, "N T"]
    """1 where the keypoints contradict the mask, else 0."""
    confidence: Float[np.ndarray, "N T K"]


def _compare(solution: Solution, observations: Observations, bird: Bird, progress: ProgressTask) -> _Comparison:
    N, T = solution.valid.shape
    has_mask = np.zeros((N, T), bool)
    if observations.masks:
        for n, t in np.argwhere(solution.valid).tolist():
            has_mask[n, t] = (n, t) in observations.masks
    overlap = np.full((N, T), np.nan)
    if has_mask.any():
        at = np.arange(N)[:, None], np.arange(T)
        overlap = compare_masks(solution, bird, observations, has_mask, at, progress).iou
    far = keypoint_distances(observations, solution)
    outside = np.where(has_mask, contradict_masks(observations, np.argwhere(has_mask), progress), np.nan)
    return _Comparison(far, overlap, outside, observations.confidence)


def _median_of_views(values: Sequence[Float[np.ndarray, "N T"]]) -> Float[np.ndarray, "N T"]:
    """Return the median over the views that measure; NaN without one."""
    stacked = np.stack(values)
    known = np.isfinite(stacked).any(axis=0)
    median = np.full(known.shape, np.nan)
    median[known] = np.nanmedian(stacked[:, known], axis=0)
    return median


def is_outlier(values: Float[np.ndarray, "N T"]) -> Bool[np.ndarray, "N T"]:
    """Return where values are outliers above the median of all values; NaN is no outlier.

    The modified z-score of a value x is 0.6745·(x − m)/MAD, with the median m and the median absolute deviation MAD.
    Values of equal rounding are no outliers, and fewer than `MIN_POSES` values have none.
    """
    known = values[np.isfinite(values)]
    if len(known) < MIN_POSES:
        return np.zeros(values.shape, bool)
    median = np.median(known)
    deviation = np.median(np.abs(known - median))
    with np.errstate(invalid="ignore"):
        return 0.6745 * (values - median) > OUTLIER_Z * max(deviation, 1e-6)


def flags(doubts: Int8[np.ndarray, "N T"]) -> np.ndarray:
    """Return the flag of each pose, (N, T) str: `ok`, `unsure`, `contradicted`; empty where `doubts` is −1."""
    contradicted, unsure = (
        sum(1 << i for i, doubt in enumerate(DOUBTS) if doubt.flag == flag) for flag in (CONTRADICTED, UNSURE)
    )
    conditions = [doubts < 0, (doubts & contradicted) > 0, (doubts & unsure) > 0]
    return np.select(conditions, ["", CONTRADICTED, UNSURE], OK)


def with_flag(name: str, flag: str) -> str:
    """Return a name with the flag of a pose, for pictures; the name alone for `ok` and for poses without a flag."""
    return f"{name} {flag}" if flag in (UNSURE, CONTRADICTED) else name


def doubt_texts(doubts: int) -> tuple[str, ...]:
    """Return the texts of the doubts about one pose."""
    return tuple(doubt.text for i, doubt in enumerate(DOUBTS) if doubts > 0 and doubts >> i & 1)


def flag_counts(doubts: Int8[np.ndarray, "N T"]) -> dict[str, int]:
    """Return the number of poses with each flag; empty if no pose was judged."""
    found = flags(doubts)
    counts = {flag: int((found == flag).sum()) for flag in FLAGS}
    return counts if any(counts.values()) else {}


def flag_ranges(doubts: Int8[np.ndarray, "T"]) -> list[tuple[int, int, tuple[str, ...]]]:
    """Return the ranges of frames whose poses have the same flag: first position, position after the last, reasons."""
    found = flags(doubts[None])[0]
    edges = (np.flatnonzero(found[1:] != found[:-1]) + 1).tolist()
    pairs = zip([0, *edges], [*edges, len(found)], strict=True)
    return [(a, b, doubt_texts(int(np.bitwise_or.reduce(doubts[a:b])))) for a, b in pairs if a < b]


def flagged_ranges(solution: Solution) -> dict[int, tuple[str, ...]]:
    """Return track → a text for each range of frames whose poses are not `ok`, with the reasons."""
    found, texts = flags(solution.flags.doubts), {}
    for n, track in enumerate(solution.track_id.tolist()):
        ranges = []
        for a, b, reasons in flag_ranges(solution.flags.doubts[n]):
            if found[n, a] in (UNSURE, CONTRADICTED):
                numbers = solution.frame_index[[a, b - 1]].tolist()
                where = f"frame {numbers[0]}" if b - a == 1 else f"frames {numbers[0]} to {numbers[1]}"
                ranges.append(f"{where} {found[n, a]}: {'; '.join(reasons)}")
        if ranges:
            texts[track] = tuple(ranges)
    return texts


def expected_error(solution: Solution, bird: Bird) -> Float[np.ndarray, "N T"]:
    """Return the RMS error that the error bars expect of the keypoints in space, as a share of the length of the bird.

    The error is relative to the mean of the keypoints. NaN without error bars.
    """
    if solution.error_bars is None:
        return np.full(solution.valid.shape, np.nan)
    variance = np.trace(solution.error_bars.keypoints_centred_cov, axis1=-2, axis2=-1).mean(-1)
    with np.errstate(invalid="ignore"):
        return np.sqrt(variance) / (rest_length(bird) * solution.poses.scale)
