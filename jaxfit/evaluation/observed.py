"""How well observations of a video agree with its annotations: birds found, keypoints, tracks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from jaxfit.data.observations import Observations
from jaxfit.evaluation.detection import KeypointRow, average_precision, found_keypoints, matches
from jaxfit.evaluation.overlap import overlap
from jaxfit.evaluation.tracking import clear, hota, idf1

__all__ = ["ObservationsEvaluation", "evaluate_observations"]


@dataclass(frozen=True)
class ObservationsEvaluation:
    """Figures of observations; NaN where there is nothing to measure. All but AP take every bird of the file, whatever
    its score."""

    detection: dict[str, float]
    """``ap50``, ``ap50-95``; ``precision``, ``recall`` and ``mean_iou`` of the matches."""
    keypoints: dict[str, KeypointRow]
    """Of the matched birds, by name, and ``all``; empty where the files share no keypoint."""
    tracking: dict[str, float]
    """``hota``, ``deta``, ``assa``, ``mota``, ``idf1``, ``switches``, ``fragments``."""
    counts: dict[str, int]
    """``frames`` compared; birds × frames: ``true`` and ``found`` ones that count, ``ignored`` and ``excused`` ones
    that do not, and those that stand in frames the other file lacks: ``true_elsewhere``, ``found_elsewhere``."""
    compared: Literal["masks", "boxes"]
    """What the IoU is of."""


def evaluate_observations(
    observations: Observations, truth: Observations, source: object = "truth"
) -> ObservationsEvaluation:
    """Compare what was found in a video with annotations of it, over the frames that both hold.

    Birds match by the IoU of visible masks (see ``overlap``, also for birds that are ignored), one-to-one, from 0.5
    on. The figures are defined in ``detection`` and ``tracking``.

    Args:
        observations: what was found; its tracks may have any numbers.
        truth: the annotations.
        source: what they were read from, for messages.

    Raises:
        InputError: no frame in common, frames of another size, or photographs instead of video.
    """
    both = overlap(observations, truth, source)
    pairs = matches(both)
    ap50, ap = average_precision(observations, truth, both)
    true, found = int(both.true.sum()), int(both.found.sum())
    named = (both.iou, both.true, both.found)
    return ObservationsEvaluation(
        {
            "ap50": ap50,
            "ap50-95": ap,
            "precision": len(pairs) / found if found else float("nan"),
            "recall": len(pairs) / true if true else float("nan"),
            "mean_iou": float(both.iou[tuple(pairs.T)].mean()) if len(pairs) else float("nan"),
        },
        found_keypoints(observations, truth, both, pairs),
        {**hota(*named)._asdict(), **clear(*named)._asdict(), "idf1": idf1(*named)},
        {
            "frames": len(both.true_frame),
            "true": true,
            "found": found,
            "ignored": int(both.ignored.sum()),
            "excused": int(both.excused.sum()),
            "true_elsewhere": _elsewhere(truth, both.true_frame),
            "found_elsewhere": _elsewhere(observations, both.found_frame),
        },
        both.kind,
    )


def _elsewhere(observations: Observations, frames: np.ndarray) -> int:
    return int(observations.present.sum() - observations.present[:, frames].sum())
