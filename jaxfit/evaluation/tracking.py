"""Observations against the truth: CLEAR, IDF1 and HOTA.

M true and N detected tracks over T frames. ``iou`` is 0 where a bird is not present; a metric is NaN where nothing is
measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment

from jaxfit.data.observations import Observations
from jaxfit.evaluation.detection import (
    MATCH_IOU,
    KeypointRow,
    assign,
    average_precision,
    comparable_boxes,
    keypoint_accuracy,
    matches,
    overlap,
)
from jaxfit.evaluation.truth import Truth

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


@dataclass(frozen=True)
class ObservationsEvaluation:
    """Metrics of observations; NaN where nothing is measured. All metrics except AP count every bird of the file,
    whatever its score."""

    detection: dict[str, float]
    """``ap50`` and ``ap50-95``; ``precision``, ``recall`` and ``mean_iou`` of the matches."""
    keypoints: dict[str, KeypointRow]
    """Keypoint, or ``all`` → accuracy for the matched birds; empty where the files share no keypoint."""
    tracking: dict[str, float]
    """``hota``, ``deta``, ``assa``, ``mota``, ``idf1``, ``switches``, ``fragments``."""
    counts: dict[str, int]
    """``frames``: compared frames. Pairs of bird and frame: ``true`` and ``detected`` count; ``ignored`` and
    ``excused`` do not count; ``true_elsewhere`` and ``detected_elsewhere`` are in frames that the other file lacks."""
    compared: Literal["masks", "boxes", "boxes of labelled keypoints"]
    """The regions of the IoU."""


def evaluate_observations(observations: Observations, truth: Truth | Observations) -> ObservationsEvaluation:
    """Compare the detected birds of a video with annotations of the video, over the frames that both files hold.

    Birds match one-to-one by the IoU of their visible masks, from 0.5 on; without masks, of their boxes as
    ``comparable_boxes`` defines them. ``overlap`` also defines the ignored birds, ``detection`` and ``tracking`` define
    the metrics.

    Args:
        observations: detected birds; their track ids are arbitrary.
        truth: the annotations.

    Raises:
        InputError: no common frame, frames of different sizes, or photographs instead of video.
    """
    truth = Truth.of(truth)
    boxed, true_boxed = comparable_boxes(observations, truth)
    both = overlap(boxed, true_boxed)
    pairs = matches(both)
    ap50, ap = average_precision(boxed, true_boxed.observations, both)
    true, detected = int(both.true.sum()), int(both.detected.sum())
    birds = (both.iou, both.true, both.detected)
    return ObservationsEvaluation(
        {
            "ap50": ap50,
            "ap50-95": ap,
            "precision": len(pairs) / detected if detected else float("nan"),
            "recall": len(pairs) / true if true else float("nan"),
            "mean_iou": float(both.iou[tuple(pairs.T)].mean()) if len(pairs) else float("nan"),
        },
        keypoint_accuracy(observations, truth.observations, both, pairs),
        {**hota(*birds)._asdict(), **clear(*birds)._asdict(), "idf1": idf1(*birds)},
        {
            "frames": len(both.true_frame),
            "true": true,
            "detected": detected,
            "ignored": int(both.ignored.sum()),
            "excused": int(both.excused.sum()),
            "true_elsewhere": _elsewhere(truth.observations, both.true_frame),
            "detected_elsewhere": _elsewhere(observations, both.detected_frame),
        },
        both.kind if boxed is observations else "boxes of labelled keypoints",
    )


def _elsewhere(observations: Observations, frames: np.ndarray) -> int:
    """Return the number of birds in all other frames."""
    return int(observations.present.sum() - observations.present[:, frames].sum())
