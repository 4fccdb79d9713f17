"""Everything an ablation writes for people: tables, a plot, and a page that stands alone."""

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
    "table.txt": "the table, and what was claimed",
    "table.md": "both for Markdown",
    "table.tex": "the table for LaTeX (package booktabs)",
    "table.csv": "all figures with their intervals",
    "plot.png": "me_p and me_v",
}
"""What is written, and what it holds."""


def write_report(
    results: Sequence[Result], verdicts: Sequence[Verdict], folder: Path, inputs: dict[str, Path], model: str
) -> None:
    """Write FILES into the ablation's folder.

    Args:
        results: all runs.
        verdicts: what `judge` found; may be empty.
        folder: the ablation's.
        inputs: what the files are called → the files that were fitted and compared with.
        model: the bird's name.
    """
    picture = plot(results)

    def both(form: str) -> str:
        parts = [results_table(results, form), CAPTION]
        return "\n\n".join([*parts, claims_table(verdicts, form)] if verdicts else parts) + "\n"

    texts = {
        "table.txt": both("simple"),
        "table.md": both("github"),
        "table.tex": results_table(results, "latex_booktabs") + "\n",
        "table.csv": results_csv(results),
        "report.html": _page(results, verdicts, picture, inputs, model),
    }
    for name, text in texts.items():
        write_whole(folder / name, text.encode())
    write_whole(folder / "plot.png", picture)


def _page(
    results: Sequence[Result], verdicts: Sequence[Verdict], picture: bytes, inputs: dict[str, Path], model: str
) -> str:
    template = (resources.files("jaxfit.ablation") / "report.html").read_text(encoding="utf-8")
    birds = max(len(result.evaluation.sums.birds) for result in results)
    minutes = sum(result.seconds for result in results) / 60
    files = ", ".join(f"{name} {path}" for name, path in inputs.items())
    steps = " + ".join(f"{stage.steps}" for stage in results[0].run.config.stages)
    at_once = max(result.runs_at_once for result in results)
    values = {
        "title": f"{len(results)} runs, {birds} birds",
        "what": f"Each run fits the same birds under another config: {files}; model {model}.",
        "swept": heading(swept(results)) or "runs",
        "caption": CAPTION,
        "made": f"jaxfit {__version__}; {steps} steps a run; up to {at_once} runs at once, {minutes:.1f} minutes of "
        f"fitting in all, {minutes / len(results):.2f} a run. Every run is a folder of results in runs/, with its "
        "config.yaml.",
    }
    return Template(template).substitute(
        {name: html.escape(text) for name, text in values.items()},
        claims=claims_table(verdicts, "html") if verdicts else "<p>The grid claims nothing.</p>",
        table=results_table(results, "html"),
        plot=base64.b64encode(picture).decode(),
    )
