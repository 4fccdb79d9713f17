"""What people read on the terminal: tables that align, and JSON for programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.table import Table

from jaxfit.data.track_quality import track_quality

if TYPE_CHECKING:
    from jaxfit.data.observations import Observations
    from jaxfit.data.solution import Solution
    from jaxfit.evaluation.aggregation import Evaluation

__all__ = [
    "breakdown_tables",
    "counted",
    "evaluation_tables",
    "right_aligned",
    "show",
    "show_facts",
    "track_table",
]

_IN_SPACE = {
    "mpjpe": "MPJPE",
    "mpjpe/length": "% length",
    "pa_mpjpe": "PA-MPJPE",
    "pa_mpjpe/length": "% length",
    "orientation_deg": "orient. °",
    "acceleration": "accel.",
    "size_error": "size %",
}
"""Figures in space that the table shows, and their headings."""
_INTERVAL = "from, to: 95 % bootstrap interval over birds (none for one bird)"
_PERCENT = ("mpjpe/length", "pa_mpjpe/length", "size_error")


def show(what: Any) -> None:
    """Print a table or a line of text."""
    Console(soft_wrap=not isinstance(what, Table), highlight=False).print(what)


def counted(count: int, noun: str) -> str:
    """`1 bird`, `2 birds`."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def right_aligned(*columns: str, **options: Any) -> Table:
    """A table whose columns are all numbers."""
    table = Table(**options)
    for column in columns:
        table.add_column(column, justify="right")
    return table


def evaluation_tables(result: Evaluation) -> list[Table]:
    """What `evaluate` found, a row for every track: in the picture, and in space where that was measured."""
    from jaxfit.evaluation.aggregation import COLUMNS

    def frames(row: dict[str, float]) -> str:
        return f"{row['frames']:.0f}"

    tables = [right_aligned("track", "frames", *COLUMNS)]
    for track, row in result.tracks.items():
        tables[0].add_row(str(track), frames(row), *_in_picture(row, COLUMNS))
    tables[0].add_section()
    tables[0].add_row("all", str(result.frames), *_in_picture(result.overall, COLUMNS))
    for name, bounds in _bounds(result):
        tables[0].add_row(name, "", *_in_picture(bounds, COLUMNS))
    tables[0].caption = (
        "PCK: share of keypoints within 5 or 10 % of the annotated mask's longer side; IoU: mesh against mask; "
        "me_p, me_v: RMS position and velocity error over the mesh mask's longer side; "
        f"all of annotated keypoints, hidden ones included; {_INTERVAL}"
    )
    if result.points_3d:
        space = right_aligned("track", *_IN_SPACE.values())
        for track, row in result.tracks.items():
            space.add_row(str(track), *_in_space(row))
        space.add_section()
        space.add_row("all", *_in_space(result.overall))
        for name, bounds in _bounds(result):
            space.add_row(name, *_in_space(bounds))
        space.caption = (
            f"in space, over {result.points_3d}: mean error in model units and per cent of body length, about the root "
            "and up to one size a track; PA: after aligning every frame; orientation in degrees; acceleration error in "
            "units per frame²; error of the apparent size"
        )
        tables.append(space)
    return tables


def breakdown_tables(result: Evaluation, by: Literal["behaviour", "keypoint"]) -> list[Table]:
    """What `evaluate` found, a row for every behaviour or keypoint."""
    from jaxfit.evaluation.aggregation import COLUMNS, COLUMNS_KEYPOINT

    if by == "keypoint":
        table = right_aligned("keypoint", "frames", *COLUMNS_KEYPOINT)
        for name, row in result.keypoints.items():
            table.add_row(name, f"{row['count']:.0f}", *_in_picture(row, COLUMNS_KEYPOINT))
        tables = [table]
    else:
        tables = [right_aligned("behaviour", "birds", "frames", *COLUMNS)]
        if result.points_3d:
            tables.append(right_aligned("behaviour", *_IN_SPACE.values(), padding=(0, 0, 0, 1)))
        for name, row in result.behaviours.items():
            counts = [f"{row[what]:.0f}" for what in ("birds", "frames")]
            for table, cells in zip(tables, ([*counts, *_in_picture(row, COLUMNS)], _in_space(row)), strict=False):
                table.add_row(name, *cells)
        tables[0].caption = "me_v counts a pair of frames for what the bird does in the earlier one"
    for table in tables:
        table.columns[0].justify = "left"
    return tables


def track_table(observations: Observations, solution: Solution | None = None) -> Table:
    """What is known of every track: how much was seen of it, how well, and how its fit ended."""
    table = right_aligned("bird", "frames", "coverage", "confidence", "jitter")
    table.caption = (
        "coverage: share of the frames from a bird's first to its last in which it was seen; confidence: mean over all "
        "keypoints; jitter: median second difference of keypoints over the longer side of the box"
    )
    status = None
    if solution is not None:
        table.add_column("status")
        status = dict(zip(solution.track_id.tolist(), solution.status.tolist(), strict=True))
    for row in track_quality(observations):
        jitter = "–" if row.jitter is None else f"{row.jitter:.4f}"
        cells = [str(row.track_id), str(row.frames), f"{row.coverage:.2f}", f"{row.mean_confidence:.2f}", jitter]
        table.add_row(*cells, *([] if status is None else [str(status[row.track_id])]))
    return table


def _bounds(result: Evaluation) -> list[tuple[str, dict[str, float]]]:
    """Both ends of the intervals; nothing where there are none."""
    if len(result.sums.birds) < 2:
        return []
    lows, highs = ({name: interval[end] for name, interval in result.intervals.items()} for end in (0, 1))
    return [("from", lows), ("to", highs)]


def _in_picture(row: dict[str, float], columns: Sequence[str]) -> list[str]:
    return [_figure(row[name]) for name in columns]


def _in_space(row: dict[str, float]) -> list[str]:
    shown = []
    for name in _IN_SPACE:
        value = row[name] * (100 if name in _PERCENT else 1)
        places = 1 if name in (*_PERCENT, "orientation_deg") else 3
        shown.append("–" if math.isnan(value) else f"{value:.{places}f}")
    return shown


def show_facts(facts: dict[str, Any]) -> None:
    """Print names and values in two columns."""
    table = Table(show_header=False)
    table.add_column()
    table.add_column(overflow="fold")
    for key, value in facts.items():
        table.add_row(key.replace("_", " "), _fact(value))
    show(table)


def _figure(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.4f}"


def _fact(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join("/".join(map(str, v)) if isinstance(v, list) else _fact(v) for v in value)
    return "–" if value is None else str(value)
