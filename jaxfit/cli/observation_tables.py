"""Tables and lines that `evaluate` prints for observations and for matched tracks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.table import Table

from jaxfit.cli.tables import counted, right_aligned

if TYPE_CHECKING:
    from jaxfit.evaluation.matching import Matching
    from jaxfit.evaluation.observed import ObservationsEvaluation

__all__ = ["matching_line", "observation_tables", "uncounted_lines"]

_DETECTION = {
    "ap50": "AP50",
    "ap50-95": "AP50-95",
    "precision": "precision",
    "recall": "recall",
    "mean_iou": "mean IoU",
}
_TRACKING = {
    "hota": "HOTA",
    "deta": "DetA",
    "assa": "AssA",
    "mota": "MOTA",
    "idf1": "IDF1",
    "switches": "id switches",
    "fragments": "fragments",
}


def observation_tables(result: ObservationsEvaluation) -> list[Table]:
    """Return tables of detection, keypoint and tracking metrics; no keypoint table if the files share no keypoint."""
    birds = right_aligned("frames", "birds", "detected", *_DETECTION.values())
    counts = (str(result.counts[name]) for name in ("frames", "true", "detected"))
    birds.add_row(*counts, *(_fraction(result.detection[name]) for name in _DETECTION))
    birds.caption = (
        f"{result.compared} match if their IoU is at least 0.5; AP ranks detections by score; the other metrics use "
        "all detections in the file; mean IoU: over the matches"
    )
    tables = [birds]
    if result.keypoints:
        points = right_aligned("keypoint", *["visible", "PCK@0.05", "PCK@0.10", "all", "PCK@0.05", "PCK@0.10"])
        points.columns[0].justify = "left"
        for name, row in result.keypoints.items():
            if name == "all":
                points.add_section()
            cells = (str(cell) if isinstance(cell, int) else _fraction(cell) for cell in row)
            points.add_row(name, *cells)
        points.caption = (
            "PCK: fraction of the matched birds' keypoints within 5 or 10 % of the longer side of the annotated box, "
            "for visible and for all keypoints; a missing keypoint counts as wrong"
        )
        tables.append(points)
    tracks = right_aligned(*_TRACKING.values())
    metrics = (result.tracking[name] for name in _TRACKING)
    tracks.add_row(*(str(metric) if isinstance(metric, int) else _fraction(metric) for metric in metrics))
    tracks.caption = "HOTA, DetA, AssA: means over IoU thresholds from 0.05 to 0.95; the other metrics: threshold 0.5"
    return [*tables, tracks]


def uncounted_lines(result: ObservationsEvaluation) -> list[str]:
    """Return lines that say which birds the metrics ignore, and why."""
    counts, lines = result.counts, []
    if counts["ignored"]:
        excused = f" and {counted(counts['excused'], 'detection')} of these birds" if counts["excused"] else ""
        lines.append(f"not counted: {counted(counts['ignored'], 'hardly visible bird')}{excused}")
    for name, missing in (("true_elsewhere", "the observations lack"), ("detected_elsewhere", "the truth lacks")):
        if counts[name]:
            lines.append(f"not counted: {counted(counts[name], 'bird')} in frames that {missing}")
    return lines


def matching_line(matching: Matching) -> str:
    """Return a line that says which annotated bird each track follows, for tracks that were matched by overlap."""
    pairs = ", ".join(f"{track} → {bird}" for track, bird in matching.follows.items()) or "none"
    strays = f"; tracks that follow no bird: {_listed(matching.unmatched)}" if matching.unmatched else ""
    lost = f"; birds that no track follows: {_listed(matching.missed)}" if matching.missed else ""
    return f"tracks matched by overlap and renamed to the ids of the truth: {pairs}{strays}{lost}"


def _listed(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers))


def _fraction(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.4f}"
