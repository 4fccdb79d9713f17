"""Tracking metrics: CLEAR MOT, IDF1 and HOTA, in NumPy.

M true and N detected tracks over T frames. ``iou`` is 0 where a bird is not present; a metric is NaN where nothing is
measured.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment

from jaxfit.evaluation.overlap import MATCH_IOU, assign

__all__ = ["Clear", "Hota", "clear", "hota", "idf1"]

_ALPHAS = np.arange(1, 20) / 20
_CONTINUED = 1000.0
"""Added to the similarity of a pair that matched in the frame before; greater than any sum of IoUs in one frame."""


class Clear(NamedTuple):
    """Metrics of CLEAR MOT."""

    mota: float
    """1 − (misses + false alarms + switches) / true birds: at most 1, and below 0 with more errors than birds."""
    switches: int
    """How often a bird is matched with another track than in its last match."""
    fragments: int
    """How often the matches of a bird are interrupted; frames in which the bird is absent or ignored do not count."""


def clear(
    iou: Float[np.ndarray, "T M N"],
    true: Bool[np.ndarray, "T M"],
    detected: Bool[np.ndarray, "T N"],
    at_least: float = MATCH_IOU,
) -> Clear:
    """Count misses, false alarms, switches and fragments.

    Pairs match from an IoU of ``at_least`` on. Pairs of the frame before are kept where they still match; the other
    birds are assigned with the greatest sum of IoUs.

    Args:
        iou: IoU of every true and detected bird.
        true: where the true birds are present.
        detected: where the detected birds are present.
        at_least: least IoU of a match.

    Source: Bernardin and Stiefelhagen 2008, *Evaluating Multiple Object Tracking Performance: The CLEAR MOT
    Metrics*; fragments: Li et al. 2009, *Learning to Associate*. Pairs are kept as in the code
    of the MOTChallenge (TrackEval): a frame without any true or any detected bird interrupts no pair.
    """
    matched = np.zeros(true.shape, bool)
    before, last = np.full(true.shape[1], -1), np.full(true.shape[1], -1)
    switches = 0
    for t in np.flatnonzero(true.any(1) & detected.any(1)):
        continued = (before[:, None] == np.arange(detected.shape[1])) & (iou[t] >= at_least)
        rows, columns = assign(iou[t] + _CONTINUED * continued, at_least)
        switches += int(((last[rows] >= 0) & (last[rows] != columns)).sum())
        before[:] = -1
        before[rows] = last[rows] = columns
        matched[t, rows] = True
    errors = true.sum() + detected.sum() - 2 * matched.sum() + switches
    mota = 1 - errors / true.sum() if true.any() else np.nan
    return Clear(float(mota), switches, sum(_interruptions(matched[true[:, m], m]) for m in range(true.shape[1])))


def _interruptions(matched: Bool[np.ndarray, "T"]) -> int:
    times = np.flatnonzero(matched)
    return int((np.diff(times) > 1).sum())


def idf1(
    iou: Float[np.ndarray, "T M N"],
    true: Bool[np.ndarray, "T M"],
    detected: Bool[np.ndarray, "T N"],
    at_least: float = MATCH_IOU,
) -> float:
    """Return IDF1, the F1 score of the identities of whole tracks.

    IDF1 = 2 IDTP / (true + detected). IDTP is the number of matching frames of the one-to-one pairs of tracks with the
    greatest total number of matching frames.

    Args: as for ``clear``.

    Source: Ristani et al. 2016, *Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking*.
    """
    together = (iou >= at_least).sum(0)
    right = together[linear_sum_assignment(together, maximize=True)].sum()
    birds = true.sum() + detected.sum()
    return float(2 * right / birds) if birds else float("nan")


class Hota(NamedTuple):
    """Means over the IoU thresholds 0.05, 0.10, …, 0.95."""

    hota: float
    """√(DetA · AssA) of each threshold."""
    deta: float
    """Detection: matches / (true + detected − matches)."""
    assa: float
    """Association: mean over all matches of (frames in which the two tracks match) / (frames of either track)."""


def hota(iou: Float[np.ndarray, "T M N"], true: Bool[np.ndarray, "T M"], detected: Bool[np.ndarray, "T N"]) -> Hota:
    """Return HOTA, which combines detection and association, and both parts.

    Birds are assigned in each frame by the IoU times the agreement of the two tracks over the whole video. The
    assignment does not depend on the threshold.

    Args: as for ``clear``.

    Source: Luiten et al. 2021, *HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking*;
    assignment as in TrackEval, the code of the authors.
    """
    birds = true.sum() + detected.sum()
    if not birds:
        return Hota(*[float("nan")] * 3)
    union = iou.sum(1, keepdims=True) + iou.sum(2, keepdims=True) - iou
    together = np.divide(iou, union, out=np.zeros_like(iou), where=union > 0).sum(0)
    frames = true.sum(0)[:, None] + detected.sum(0)
    agreement = together / np.maximum(frames - together, 1)
    paired = np.zeros_like(iou)
    for t in range(len(iou)):
        rows, columns = linear_sum_assignment(agreement * iou[t], maximize=True)
        paired[t, rows, columns] = iou[t, rows, columns]
    deta, assa = np.zeros((2, len(_ALPHAS)))
    for a, alpha in enumerate(_ALPHAS):
        matches = (paired >= alpha - np.finfo(float).eps).sum(0)
        deta[a] = matches.sum() / (birds - matches.sum())
        fraction = matches / np.maximum(frames - matches, 1)
        assa[a] = (matches * fraction).sum() / max(matches.sum(), 1)
    return Hota(float(np.sqrt(deta * assa).mean()), float(deta.mean()), float(assa.mean()))
