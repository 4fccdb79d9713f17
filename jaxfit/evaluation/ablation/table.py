"""Tables of an ablation as text, CSV, Markdown, LaTeX and HTML: one row per run, the best run first."""

from __future__ import annotations

import csv
import html
import io
import math
from collections.abc import Callable, Sequence
from typing import Any

from tabulate import tabulate

from jaxfit.evaluation.ablation.grid import Run, short
from jaxfit.evaluation.ablation.measure import Result, Verdict
from jaxfit.foundation.errors import one_line

HEADINGS = {
    "terms.velocity": "λ_vel",
    "terms.acceleration": "acceleration",
    "filter_window": "median filter",
    "common_size": "common size",
}
"""Path of a key → its name in the paper; other keys are shown by their path."""
SHOWN: tuple[tuple[str, str, Callable[[float], str]], ...] = (
    ("me_p", "me_p", lambda v: f"{v:.4f}"),
    ("me_v", "me_v", lambda v: f"{v:.4f}"),
    ("mpjpe/length", "MPJPE %", lambda v: f"{100 * v:.2f}"),
    ("iou", "IoU", lambda v: f"{v:.3f}"),
    ("pck@0.05", "PCK@0.05", lambda v: f"{v:.3f}"),
)
"""Metric, heading and number format of each column; the first two columns also show intervals."""
CAPTION = (
    "Runs are sorted by me_p. me_p and me_v: RMS error of the position and of the frame-to-frame velocity of the "
    "projected keypoints, divided by the longer side of the box of the predicted mask; brackets: 95 % bootstrap "
    "intervals over birds. MPJPE: mean 3D error of the joints, per cent of the body length. Poses: number of measured "
    "pairs of bird and frame."
)


def heading(path: str) -> str:
    """Return the heading of a varied key."""
    return HEADINGS.get(path, path)


def format_cell(path: str, level: Any) -> str:
    """Return the text of a value: `yes` or `no` for a bool, a dash for a weight of 0 or a filter of one frame."""
    if isinstance(level, bool):
        return "yes" if level else "no"
    if isinstance(level, str) and level.startswith("="):
        return f"= {heading(level[1:])}"
    if (level == 0 and path.startswith("terms.")) or (path == "filter_window" and level == 1):
        return "–"
    return short(level)


def ranked(results: Sequence[Result]) -> list[Result]:
    """Return the results sorted by me_p, the best first; results without me_p are last."""
    return sorted(results, key=lambda result: (math.isnan(_metric(result, "me_p")), _metric(result, "me_p")))


def results_table(results: Sequence[Result], form: str) -> str:
    """Return the table of runs in a format of tabulate: `simple`, `github`, `latex_booktabs`, `html`, …"""
    shown = [column for column in SHOWN if any(column[0] in result.evaluation.overall for result in results)]
    paths = list(results[0].run.levels)
    head = ["run", *map(heading, paths), *(title for _, title, _ in shown), "poses"]
    rows = [
        [
            result.run.name.partition("_")[0],
            *(format_cell(path, level) for path, level in result.run.levels.items()),
            *(_cell(result, *column, bounds=i < 2) for i, column in enumerate(shown)),
            str(result.evaluation.frames),
        ]
        for result in ranked(results)
    ]
    return _table(head, rows, form)


def claims_table(verdicts: Sequence[Verdict], form: str) -> str:
    """Return the table of verdicts in a format of tabulate."""
    head = ["claim", "metric", "pairs", "agree", "better / worse", "95 % interval", "verdict"]
    rows = [
        [
            verdict.claim.claim,
            verdict.metric,
            str(verdict.pairs),
            str(verdict.agree),
            f"{verdict.ratio.value:.3f}",
            f"{verdict.ratio.low:.3f}–{verdict.ratio.high:.3f}",
            verdict.holds,
        ]
        for verdict in verdicts
    ]
    return _table(head, rows, form)


def results_csv(results: Sequence[Result]) -> str:
    """Return all metrics of all runs with their intervals as CSV; varied keys are named by their paths."""
    paths = list(results[0].run.levels)
    metrics = list(dict.fromkeys(name for result in results for name in result.evaluation.overall))
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(["run", *paths, *(f"{m}{end}" for m in metrics for end in ("", "_low", "_high")), "poses", "missing"])
    for result in ranked(results):
        values = []
        for metric in metrics:
            bounds = result.evaluation.intervals.get(metric, (math.nan, math.nan))
            values += [_metric(result, metric), *bounds]
        out.writerow(
            [
                result.run.name,
                *(_csv_value(result.run, path) for path in paths),
                *("" if math.isnan(value) else f"{value:.6g}" for value in values),
                result.evaluation.frames,
                result.evaluation.missing,
            ]
        )
    return text.getvalue()


def _table(head: list[str], rows: list[list[str]], form: str) -> str:
    alignment = _alignment(rows)
    # a cell is one line: a line break would end the row of a Markdown table
    clean = [[one_line(" ".join(cell.split())) for cell in row] for row in (head, *rows)]
    if form == "github":  # tabulate escapes the cells of HTML and LaTeX only
        clean = [[html.escape(cell, quote=False).replace("|", "\\|") for cell in row] for row in clean]
    text = tabulate(clean[1:], clean[0], tablefmt=form, disable_numparse=True, colalign=alignment)
    return text.replace("λ\\_vel", r"$\lambda_{\mathrm{vel}}$") if form.startswith("latex") else text


def _alignment(rows: list[list[str]]) -> list[str]:
    return ["right" if all(row[i][:1] in "0123456789–" for row in rows) else "left" for i in range(len(rows[0]))]


def _cell(result: Result, metric: str, _title: str, write: Callable[[float], str], bounds: bool) -> str:
    value = _metric(result, metric)
    if math.isnan(value):
        return "–"
    interval = result.evaluation.intervals.get(metric)
    if not bounds or interval is None or math.isnan(interval.low):
        return write(value)
    return f"{write(value)} ({write(interval.low)}–{write(interval.high)})"


def _metric(result: Result, metric: str) -> float:
    return result.evaluation.overall.get(metric, math.nan)


def _csv_value(run: Run, path: str) -> Any:
    value = run.value(path)
    return str(value).lower() if isinstance(value, bool) else value
