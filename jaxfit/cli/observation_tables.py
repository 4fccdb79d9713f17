"""What `evaluate` prints of observations, and of whose track is whose."""

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
    """Birds, keypoints and tracks; no keypoints where the files share none."""
    birds = right_aligned("frames", "birds", "found", *_DETECTION.values())
    counts = (str(result.counts[name]) for name in ("frames", "true", "detected"))
    birds.add_row(*counts, *(_share(result.detection[name]) for name in _DETECTION))
    birds.caption = (
        f"{result.compared} match from an IoU of 0.5 on; AP by score, the others of every bird in the file; mean IoU: "
        "of the matches"
    )
    tables = [birds]
    if result.keypoints:
        points = right_aligned("keypoint", *["visible", "PCK@0.05", "PCK@0.10", "all", "PCK@0.05", "PCK@0.10"])
        points.columns[0].justify = "left"
        for name, row in result.keypoints.items():
            if name == "all":
                points.add_section()
            cells = (str(cell) if isinstance(cell, int) else _share(cell) for cell in row)
            points.add_row(name, *cells)
        points.caption = (
            "of the matched birds' keypoints, those that nothing hides and all: share within 5 or 10 % of the longer "
            "side of the annotated box; one that is not found is wrong"
        )
        tables.append(points)
    tracks = right_aligned(*_TRACKING.values())
    figures = (result.tracking[name] for name in _TRACKING)
    tracks.add_row(*(str(figure) if isinstance(figure, int) else _share(figure) for figure in figures))
    tracks.caption = "HOTA, DetA, AssA: means over IoUs of 0.05 to 0.95; the others at 0.5"
    return [*tables, tracks]


def uncounted_lines(result: ObservationsEvaluation) -> list[str]:
    """What no figure counts, and why."""
    counts, lines = result.counts, []
    if counts["ignored"]:
        excused = f"; {counted(counts['excused'], 'found one')} on them" if counts["excused"] else ""
        lines.append(f"no figure counts {counted(counts['ignored'], 'bird')} hardly to be seen{excused}")
    for name, whose in (("true_elsewhere", "the observations lack"), ("detected_elsewhere", "the truth lacks")):
        if counts[name]:
            lines.append(f"no figure counts {counted(counts[name], 'bird')} in frames that {whose}")
    return lines


def matching_line(matching: Matching) -> str:
    """Whose track is whose, by overlap."""
    pairs = ", ".join(f"{track} → {bird}" for track, bird in matching.follows.items()) or "none"
    strays = f"; tracks that follow nobody: {_listed(matching.unmatched)}" if matching.unmatched else ""
    lost = f"; birds that no track follows: {_listed(matching.missed)}" if matching.missed else ""
    return f"tracks matched by overlap, named as the truth's birds: {pairs}{strays}{lost}"


def _listed(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers))


def _share(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.4f}"
