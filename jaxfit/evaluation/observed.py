"""Evaluation of observations against annotations of the same video: detection, keypoints and tracking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from jaxfit.data.observations import Observations
from jaxfit.evaluation.detection import KeypointRow, average_precision, keypoint_accuracy, matches
from jaxfit.evaluation.overlap import overlap
from jaxfit.evaluation.tracking import clear, hota, idf1
from jaxfit.evaluation.truth import Truth

__all__ = ["ObservationsEvaluation", "evaluate_observations"]


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
    compared: Literal["masks", "boxes"]
    """The regions of the IoU."""


def evaluate_observations(observations: Observations, truth: Truth | Observations) -> ObservationsEvaluation:
    """Compare the detected birds of a video with annotations of the video, over the frames that both files hold.

    Birds match one-to-one by the IoU of their visible masks, from 0.5 on. ``overlap`` also defines the ignored birds,
    ``detection`` and ``tracking`` define the metrics.

    Args:
        observations: detected birds; their track ids are arbitrary.
        truth: the annotations.

    Raises:
        InputError: no common frame, frames of different sizes, or photographs instead of video.
    """
    truth = Truth.of(truth)
    both = overlap(observations, truth)
    pairs = matches(both)
    ap50, ap = average_precision(observations, truth.observations, both)
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
        both.kind,
    )


def _elsewhere(observations: Observations, frames: np.ndarray) -> int:
    """Return the number of birds in all other frames."""
    return int(observations.present.sum() - observations.present[:, frames].sum())
