"""The report of an ablation: tables, a plot, and one HTML page without external files."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from string import Template

from jaxfit import __version__
from jaxfit.ablation.claims import Verdict
from jaxfit.ablation.measure import Result
from jaxfit.ablation.plot import plot, swept
from jaxfit.ablation.table import CAPTION, claims_table, heading, results_csv, results_table
from jaxfit.storage.files import write_whole

__all__ = ["FILES", "write_report"]

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
    template = (resources.files("jaxfit.ablation") / "report.html").read_text(encoding="utf-8")
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
