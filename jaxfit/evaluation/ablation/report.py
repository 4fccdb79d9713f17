"""Files of the report of an ablation, and its plot of me_p and me_v."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from jaxfit.evaluation.ablation.measure import CLAIMED, Result, Verdict
from jaxfit.evaluation.ablation.table import CAPTION, claims_table, format_cell, heading, results_csv, results_table
from jaxfit.foundation.errors import one_line, shortened
from jaxfit.foundation.extras import __version__
from jaxfit.foundation.files import write_whole

_LABELS = {"me_p": "me_p (fraction of the bird's longer side)", "me_v": "me_v (the same fraction, per frame)"}
_LABEL_CHARACTERS, _LABELS_SHOWN = 100, 60
_STYLES = ("-", "--", "-.", ":")
_MARKERS = "osD^v<>Pp*"


def plot(results: Sequence[Result]) -> bytes:
    """Return a PNG with one panel for me_p and one for me_v.

    The horizontal axis is the varied key with the most numbers (λ_vel for the grid of the paper). A line joins runs
    with the same values of all other keys; a horizontal line shows a run without such partners. Bars are 95 %
    intervals over birds.
    """
    path = swept(results)
    lines: dict[tuple[str, ...], list[Result]] = {}
    for result in results:
        rest = (f"{heading(p)} {format_cell(p, level)}" for p, level in result.run.levels.items() if p != path)
        lines.setdefault(tuple(rest), []).append(result)
    common = set.intersection(*(set(key) for key in lines)) if len(lines) > 1 else set()
    figure = Figure(figsize=(12, 5.2), layout="constrained")
    panels = figure.subplots(1, len(CLAIMED))
    x_of = [_number(result, path) for result in results]
    positive = [x for x in x_of if x > 0]
    logarithmic = bool(path and positive) and max(positive) >= 20 * min(positive)
    shift = 1.1 if logarithmic else 1.03
    for panel, metric in zip(panels, CLAIMED, strict=True):
        for i, (key, members) in enumerate(lines.items()):
            text = ", ".join(part for part in key if part not in common) or "all"
            # Matplotlib reads text between dollar signs as mathematics
            label = shortened(one_line(text), _LABEL_CHARACTERS).replace("$", r"\$")
            style = {"color": f"C{i % 10}", "linestyle": _STYLES[i // 10 % 4], "label": label}
            value = np.array([r.evaluation.overall[metric] for r in members])
            bounds = np.array([r.evaluation.intervals[metric] for r in members]).T
            if len(members) == 1:
                panel.axhline(value[0], linewidth=1, alpha=0.8, **style)
                continue
            # shifted, so that the error bars of different lines do not overlap
            x = np.array([_number(r, path) for r in members]) * shift ** (i - (len(lines) - 1) / 2)
            order = np.argsort(x)
            error = np.abs(bounds - value)[:, order]
            marker = _MARKERS[i % len(_MARKERS)]
            panel.errorbar(x[order], value[order], error, marker=marker, markersize=4, elinewidth=0.6, **style)
        panel.set(xlabel=heading(path) if path else "run", ylabel=_LABELS[metric], title=metric)
        if logarithmic:
            # a logarithmic scale has no place for 0, the weight of a term that is switched off; symlog has
            panel.set_xscale("symlog", linthresh=min(positive), linscale=0.5)
        panel.set_yscale("log")
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
        panel.yaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_minor_formatter(NullFormatter())
        panel.grid(True, which="both", alpha=0.2)
    if len(lines) > 1:
        handles, labels = (each[:_LABELS_SHOWN] for each in panels[0].get_legend_handles_labels())
        figure.legend(handles, labels, loc="outside right center", fontsize=7, frameon=False)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110, metadata={"Software": None})
    return out.getvalue()


def swept(results: Sequence[Result]) -> str:
    """Return the path of the varied key with the most numbers; an empty text where no key has two numbers."""

    def numbers(path: str) -> int:
        if not all(_is_number(result.run.value(path)) for result in results):
            return 0
        return len({level for result in results if _is_number(level := result.run.levels[path])})

    best = max(results[0].run.levels, key=numbers, default="")
    return best if best and numbers(best) > 1 else ""


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _number(result: Result, path: str) -> float:
    """Return the value of the key in this run; without a key, the position of the run."""
    return float(result.run.value(path)) if path else float(result.run.name.partition("_")[0])


FILES = {
    "report.html": "everything on one page",
    "table.txt": "the table of runs and the table of claims",
    "table.md": "both tables for Markdown",
    "table.tex": "the table of runs for LaTeX (package booktabs)",
    "table.csv": "all metrics with their intervals",
    "plot.png": "plot of me_p and me_v",
}
"""Name of each file → its content."""


def write_report(
    results: Sequence[Result], verdicts: Sequence[Verdict], folder: Path, inputs: dict[str, Path], model: str
) -> None:
    """Write FILES into the folder of the ablation.

    Args:
        results: all runs.
        verdicts: the result of `judge`; may be empty.
        folder: the folder of the ablation.
        inputs: name in the report → input file.
        model: name of the model.
    """
    png = plot(results)

    def both_tables(form: str) -> str:
        parts = [results_table(results, form), CAPTION]
        return "\n\n".join([*parts, claims_table(verdicts, form)] if verdicts else parts) + "\n"

    texts = {
        "table.txt": both_tables("simple"),
        "table.md": both_tables("github"),
        "table.tex": results_table(results, "latex_booktabs") + "\n",
        "table.csv": results_csv(results),
        "report.html": _page(results, verdicts, png, inputs, model),
    }
    for name, text in texts.items():
        write_whole(folder / name, text.encode())
    write_whole(folder / "plot.png", png)


def _page(
    results: Sequence[Result], verdicts: Sequence[Verdict], png: bytes, inputs: dict[str, Path], model: str
) -> str:
    template = (resources.files("jaxfit.evaluation.ablation") / "report.html").read_text(encoding="utf-8")
    birds = max(len(result.evaluation.sums.birds) for result in results)
    minutes = sum(result.seconds for result in results) / 60
    files = ", ".join(f"{name} {path}" for name, path in inputs.items())
    steps = " + ".join(f"{stage.steps}" for stage in results[0].run.config.stages)
    at_once = max(result.runs_at_once for result in results)
    values = {
        "title": f"{len(results)} runs, {birds} birds",
        "what": f"Each run fits the same birds with another config. Files: {files}. Model: {model}.",
        "swept": heading(swept(results)) or "runs",
        "caption": CAPTION,
        "made": f"jaxfit {__version__}; {steps} steps per run; up to {at_once} runs in one batch; {minutes:.1f} "
        f"minutes for all fits, {minutes / len(results):.2f} minutes per run. The folder runs/ holds the results "
        "and the config.yaml of every run.",
    }
    return Template(template).substitute(
        {name: html.escape(text) for name, text in values.items()},
        claims=claims_table(verdicts, "html") if verdicts else "<p>The grid makes no claims.</p>",
        table=results_table(results, "html"),
        plot=base64.b64encode(png).decode(),
    )
