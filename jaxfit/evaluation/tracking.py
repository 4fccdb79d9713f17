"""How well tracks keep to their birds: CLEAR, identity and HOTA figures. NumPy, exactly defined.

M true and N found tracks over T frames. ``iou`` is 0 where one of the two is not there; a figure that has nothing to
measure is NaN.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment

from jaxfit.evaluation.overlap import MATCHED, assign

__all__ = ["Clear", "Hota", "clear", "hota", "idf1"]

_ALPHAS = np.arange(1, 20) / 20
_CONTINUED = 1000.0
"""Outweighs every similarity of one frame."""


class Clear(NamedTuple):
    """Figures of CLEAR MOT."""

    mota: float
    """1 − (misses + false alarms + switches) / true birds: at most 1, and below 0 with more errors than birds."""
    switches: int
    """Times that a bird is matched with another track than the last one it was matched with."""
    fragments: int
    """Times that a bird is lost and found again; frames in which it is not there, or ignored, are no loss."""


def clear(
    iou: Float[np.ndarray, "T M N"],
    true: Bool[np.ndarray, "T M"],
    found: Bool[np.ndarray, "T N"],
    at_least: float = MATCHED,
) -> Clear:
    """Count misses, false alarms and switches, frame after frame.

    Pairs match from an IoU of ``at_least``; those of the frame before are kept where they still match, the others
    are assigned with the greatest sum of IoUs.

    Args:
        iou: of every true and found bird.
        true: where the true birds are.
        found: where the found ones are.
        at_least: IoU.

    Source: Bernardin and Stiefelhagen 2008, *Evaluating Multiple Object Tracking Performance: The CLEAR MOT
    Metrics*; fragments: Li et al. 2009, *Learning to Associate*; what goes on from the frame before, as in the code
    of the MOTChallenge (TrackEval): a frame without any true or found bird breaks nothing.
    """
    matched = np.zeros(true.shape, bool)
    before, last = np.full(true.shape[1], -1), np.full(true.shape[1], -1)
    switches = 0
    for t in np.flatnonzero(true.any(1) & found.any(1)):
        goes_on = (before[:, None] == np.arange(found.shape[1])) & (iou[t] >= at_least)
        rows, columns = assign(iou[t] + _CONTINUED * goes_on, at_least)
        switches += int(((last[rows] >= 0) & (last[rows] != columns)).sum())
        before[:] = -1
        before[rows] = last[rows] = columns
        matched[t, rows] = True
    errors = true.sum() + found.sum() - 2 * matched.sum() + switches
    mota = 1 - errors / true.sum() if true.any() else np.nan
    return Clear(float(mota), switches, sum(_losses(matched[true[:, m], m]) for m in range(true.shape[1])))


def _losses(matched: Bool[np.ndarray, "T"]) -> int:
    times = np.flatnonzero(matched)
    return int((np.diff(times) > 1).sum())


def idf1(
    iou: Float[np.ndarray, "T M N"],
    true: Bool[np.ndarray, "T M"],
    found: Bool[np.ndarray, "T N"],
    at_least: float = MATCHED,
) -> float:
    """How much of all birds the best naming of whole tracks gets right.

    IDF1 = 2 IDTP / (true + found), where IDTP counts the matching frames of the one-to-one pairs of tracks that
    have most of them.

    Args: as for ``clear``.

    Source: Ristani et al. 2016, *Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking*.
    """
    together = (iou >= at_least).sum(0)
    right = together[linear_sum_assignment(together, maximize=True)].sum()
    birds = true.sum() + found.sum()
    return float(2 * right / birds) if birds else float("nan")


class Hota(NamedTuple):
    """Means over the IoU thresholds 0.05, 0.10, …, 0.95."""

    hota: float
    """√(DetA · AssA) of each threshold."""
    deta: float
    """Detection: matches / (true + found − matches)."""
    assa: float
    """Association: over all matches, the mean share of both tracks' frames in which they match each other."""


def hota(iou: Float[np.ndarray, "T M N"], true: Bool[np.ndarray, "T M"], found: Bool[np.ndarray, "T N"]) -> Hota:
    """Detection and association in one figure.

    Frames are assigned by IoU times how well the two tracks agree over the whole video, which does not depend on
    the threshold.

    Args: as for ``clear``.

    Source: Luiten et al. 2021, *HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking*; the
    assignment as in its code, TrackEval.
    """
    birds = true.sum() + found.sum()
    if not birds:
        return Hota(*[float("nan")] * 3)
    either = iou.sum(1, keepdims=True) + iou.sum(2, keepdims=True) - iou
    together = np.divide(iou, either, out=np.zeros_like(iou), where=either > 0).sum(0)
    frames = true.sum(0)[:, None] + found.sum(0)
    agreement = together / np.maximum(frames - together, 1)
    paired = np.zeros_like(iou)
    for t in range(len(iou)):
        rows, columns = linear_sum_assignment(agreement * iou[t], maximize=True)
        paired[t, rows, columns] = iou[t, rows, columns]
    deta, assa = np.zeros((2, len(_ALPHAS)))
    for a, alpha in enumerate(_ALPHAS):
        matches = (paired >= alpha - np.finfo(float).eps).sum(0)
        deta[a] = matches.sum() / (birds - matches.sum())
        share = matches / np.maximum(frames - matches, 1)
        assa[a] = (matches * share).sum() / max(matches.sum(), 1)
    return Hota(float(np.sqrt(deta * assa).mean()), float(deta.mean()), float(assa.mean()))
