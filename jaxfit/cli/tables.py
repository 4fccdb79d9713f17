"""Text output of commands: tables, lines and JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.table import Table

from jaxfit.data.tracks import track_quality
from jaxfit.foundation.errors import counted, one_line

if TYPE_CHECKING:
    from jaxfit.data.observations import Observations
    from jaxfit.data.solution import Solution
    from jaxfit.evaluation.calibration import Calibration, CalibrationRow
    from jaxfit.evaluation.evaluate import Evaluation

_COLUMNS_3D = {
    "mpjpe": "MPJPE",
    "mpjpe/length": "% length",
    "pa_mpjpe": "PA-MPJPE",
    "pa_mpjpe/length": "% length",
    "orientation_deg": "orient. °",
    "acceleration": "accel.",
    "size_error": "size %",
}
"""Metrics in 3D → their column headings."""
_INTERVAL = "from, to: 95 % bootstrap interval over birds (none for a single bird)"
_PERCENT = ("mpjpe/length", "pa_mpjpe/length", "size_error")
"""Metrics that the table shows in per cent."""


def show(output: Table | str) -> None:
    """Print a table or lines of text. Names from files are printed as they are: they contain no markup."""
    if isinstance(output, str):
        output = "\n".join(one_line(line) for line in output.split("\n"))
    is_text = isinstance(output, str)
    Console(soft_wrap=is_text, highlight=False, markup=False, emoji=False).print(output)


class EscapedTable(Table):
    """A table whose cells are single lines: control characters of the data become escapes."""

    def add_row(self, *cells: Any, **options: Any) -> None:
        super().add_row(*(one_line(cell) if isinstance(cell, str) else cell for cell in cells), **options)


def right_aligned(*columns: str, **options: Any) -> Table:
    """Return an empty table with right-aligned columns; in a narrow output, long cells take several lines."""
    table = EscapedTable(**options)
    for column in columns:
        table.add_column(column, justify="right", overflow="fold")
    return table


def calibration_tables(result: Calibration) -> list[Table]:
    """Return a table for each group of errors: coverage, sharpness and likelihood of each keypoint or joint."""
    tables = []
    for name, group in result.groups.items():
        coverage = [f"{100 * float(level):.0f} %" for level in group.overall.coverage]
        columns = ("errors", *coverage, "sd", "error", "NLL", "constant")
        table = right_aligned("", *columns, title=f"{name} ({group.unit})", padding=(0, 0, 0, 1))
        table.columns[0].justify = "left"
        for part, row in group.parts.items():
            table.add_row(part, *_calibration_cells(row))
        table.add_section()
        table.add_row("all", *_calibration_cells(group.overall))
        tables.append(table)
    return tables


def _calibration_cells(row: CalibrationRow) -> list[str]:
    inside = [f"{100 * fraction:.1f} %" for fraction in row.coverage.values()]
    return [str(row.count), *inside, f"{row.sd:.3g}", f"{row.error:.3g}", f"{row.nll:.2f}", f"{row.nll_constant:.2f}"]


def evaluation_tables(result: Evaluation, follows: Mapping[int, int] | None = None) -> list[Table]:
    """Return the table of metrics in 2D, and the table of metrics in 3D if there are any; one row per track.

    Args:
        result: the metrics, by the ids of the truth.
        follows: track of the result → bird of the truth, where they have different ids; rows then name both.
    """
    from jaxfit.evaluation.evaluate import COLUMNS

    def frames(row: dict[str, float]) -> str:
        return f"{row['frames']:.0f}"

    labels = {bird: f"{track} → {bird}" for track, bird in sorted((follows or {}).items()) if bird in result.tracks}
    rows = {labels.get(bird, str(bird)): result.tracks[bird] for bird in {**labels, **result.tracks}}
    tables = [right_aligned("track", "frames", *COLUMNS)]
    for track, row in rows.items():
        tables[0].add_row(track, frames(row), *_cells_2d(row, COLUMNS))
    tables[0].add_section()
    tables[0].add_row("all", str(result.frames), *_cells_2d(result.overall, COLUMNS))
    for name, bounds in _bounds(result):
        tables[0].add_row(name, "", *_cells_2d(bounds, COLUMNS))
    tables[0].caption = (
        "PCK: fraction of keypoints within 5 or 10 % of the longer side of the annotated mask; IoU: of mesh and mask; "
        "me_p, me_v: RMS position and velocity error divided by the longer side of the mesh's mask; "
        f"keypoint metrics use all annotated keypoints, also hidden keypoints; {_INTERVAL}"
    )
    if result.points_3d:
        table_3d = right_aligned("track", *_COLUMNS_3D.values(), padding=(0, 0, 0, 1))
        for track, row in rows.items():
            table_3d.add_row(track, *_cells_3d(row))
        table_3d.add_section()
        table_3d.add_row("all", *_cells_3d(result.overall))
        for name, bounds in _bounds(result):
            table_3d.add_row(name, *_cells_3d(bounds))
        table_3d.caption = (
            f"3D metrics over {result.points_3d}: mean error in model units and in per cent of body length, relative "
            "to the root and after scaling each track by one factor; PA: after alignment of every frame; orientation "
            "error in degrees; acceleration error in units per frame²; size: error of the apparent size"
        )
        bones, mean_bird = (100 * result.overall[name] for name in ("bone_error", "bone_error_mean_bird"))
        if not math.isnan(bones):
            table_3d.caption += f"; error of the bone lengths {bones:.1f} % ({mean_bird:.1f} % for the mean bird)"
        tables.append(table_3d)
    return tables


def flag_quality_line(result: Evaluation) -> str:
    """Return a line that says how well the flags find wrong poses; empty without true poses or flags."""
    if not result.flags:
        return ""
    wrong, flagged, found = (round(result.flags[name]) for name in ("wrong", "flagged", "found"))
    subject = f"{found} of {counted(wrong, 'pose')} with a joint wrong by more than 10 % of the length"
    return f"flagged: {subject}, and {counted(flagged - found, 'other pose')}"


def wrong_poses_line(result: Evaluation, follows: Mapping[int, int] | None = None) -> str:
    """Return a line with the worst frame of the five worst tracks, by the ids of the result; empty if no pose is wrong.

    `follows` is as for `evaluation_tables`.
    """
    own = {bird: track for track, bird in (follows or {}).items()}
    poses = [
        f"track {own.get(bird, bird)} frame {row['frame']:.0f} ({100 * row['error']:.1f} % of the length; "
        f"{counted(round(row['count']), 'wrong pose')})"
        for bird, row in result.wrong.items()
    ]
    return f"worst frames: {', '.join(poses[:5])}" if poses else ""


def breakdown_tables(result: Evaluation, by: Literal["behaviour", "keypoint"]) -> list[Table]:
    """Return tables of metrics with one row per behaviour or per keypoint."""
    from jaxfit.evaluation.evaluate import COLUMNS, COLUMNS_KEYPOINT

    if by == "keypoint":
        table = right_aligned("keypoint", "frames", *COLUMNS_KEYPOINT)
        for name, row in result.keypoints.items():
            table.add_row(name, f"{row['count']:.0f}", *_cells_2d(row, COLUMNS_KEYPOINT))
        tables = [table]
    else:
        tables = [right_aligned("behaviour", "birds", "frames", *COLUMNS)]
        if result.points_3d:
            tables.append(right_aligned("behaviour", *_COLUMNS_3D.values(), padding=(0, 0, 0, 1)))
        for name, row in result.behaviours.items():
            counts = [f"{row[name]:.0f}" for name in ("birds", "frames")]
            for table, cells in zip(tables, ([*counts, *_cells_2d(row, COLUMNS)], _cells_3d(row)), strict=False):
                table.add_row(name, *cells)
        tables[0].caption = "me_v assigns a pair of frames to the behaviour in the earlier frame"
    for table in tables:
        table.columns[0].justify = "left"
    return tables


FIT_COLUMNS = ("ok", "unsure", "contradicted", "status")
"""Columns of the cells of `fit_cells`."""


def fit_cells(solution: Solution) -> dict[int, list[str]]:
    """Return track → number of poses with each flag, and status of the fit."""
    from jaxfit.data.flags import FLAGS, flags

    found = flags(solution.flags.doubts)
    return {
        track: [*(f"{(found[n] == flag).sum()}" for flag in FLAGS), str(solution.status[n])]
        for n, track in enumerate(solution.track_id.tolist())
    }


def flag_line(solution: Solution) -> str:
    """Return a line with the share of poses of each flag."""
    from jaxfit.data.flags import flag_counts

    counts = flag_counts(solution.flags.doubts)
    total = sum(counts.values())
    return (
        "poses: " + ", ".join(f"{100 * count / total:.1f} % {flag}" for flag, count in counts.items()) if total else ""
    )


def track_table(observations: Observations, solution: Solution | None = None) -> Table:
    """Return a table with the quality of every track, and with the status of its fit if there is a solution."""
    padding = (0, 1) if solution is None else (0, 0, 0, 1)  # 80 characters hold all columns
    table = right_aligned("track", "frames", "coverage", "confidence", "jitter", padding=padding)
    table.caption = (
        "coverage: fraction of the frames between the first and the last detection that have a detection; confidence: "
        "mean over all keypoints; jitter: median second difference of keypoints divided by the longer side of the box"
    )
    fitted: dict[int, list[str]] = {}
    if solution is not None:
        fitted = fit_cells(solution)
        for name in FIT_COLUMNS:
            table.add_column(name, justify="left" if name == "status" else "right", overflow="fold")
    for row in track_quality(observations):
        jitter = "–" if row.jitter is None else f"{row.jitter:.4f}"
        cells = [str(row.track_id), str(row.frames), f"{row.coverage:.2f}", f"{row.mean_confidence:.2f}", jitter]
        table.add_row(*cells, *fitted.get(row.track_id, ()))
    return table


def _bounds(result: Evaluation) -> list[tuple[str, dict[str, float]]]:
    """Return the lower and the upper ends of the bootstrap intervals; nothing for a single bird."""
    if len(result.sums.birds) < 2:
        return []
    lows, highs = ({name: interval[end] for name, interval in result.intervals.items()} for end in (0, 1))
    return [("from", lows), ("to", highs)]


def _cells_2d(row: dict[str, float], columns: Sequence[str]) -> list[str]:
    return [_metric(row[name]) for name in columns]


def _cells_3d(row: dict[str, float]) -> list[str]:
    cells = []
    for name in _COLUMNS_3D:
        value = row[name] * (100 if name in _PERCENT else 1)
        decimals = 1 if name in (*_PERCENT, "orientation_deg") else 3
        cells.append("–" if math.isnan(value) else f"{value:.{decimals}f}")
    return cells


def show_facts(facts: dict[str, Any]) -> None:
    """Print names and values in two columns."""
    table = EscapedTable(show_header=False)
    table.add_column()
    table.add_column(overflow="fold")
    for key, value in facts.items():
        table.add_row(key.replace("_", " "), _fact(value))
    show(table)


def _metric(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.4f}"


def _fact(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join("/".join(map(str, v)) if isinstance(v, list) else _fact(v) for v in value)
    return "–" if value is None else str(value)
