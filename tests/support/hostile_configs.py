"""Readers of configs and of an ablation's folder, for hostile files; one server can call all of them."""

from __future__ import annotations

from pathlib import Path

from jaxfit.config.fit import load_config
from jaxfit.config.reconstruct import load_reconstruct_config
from jaxfit.evaluation.ablation import ablate
from jaxfit.evaluation.ablation.grid import load_grid
from jaxfit.evaluation.ablation.measure import Result, judge, read_metrics
from jaxfit.evaluation.ablation.report import swept
from jaxfit.evaluation.ablation.table import claims_table, results_csv, results_table

ablate.model_hash = lambda _: "a hash"  # a model would start JAX's threads before the fork, or take seconds after it


def call(reader: str, path: str) -> None:
    """Call the reader of a name; what the reader returns is used as `ablate` uses it."""
    {
        "fit": load_config,
        "reconstruct": load_reconstruct_config,
        "grid": load_grid,
        "record": _record,
        "metrics": _metrics,
    }[reader](path)


def _record(path: str) -> None:
    folder = Path(path).parent  # it also holds the grid
    ablate.claim_folder(folder, load_grid(folder / "grid.yaml").runs, {"truth": folder / "grid.yaml"}, None)


def _metrics(path: str) -> None:
    folder = Path(path).parent
    grid = load_grid(folder / "grid.yaml")
    results = [Result(run, *read_metrics(folder)) for run in grid.runs]
    for form in ("simple", "github", "latex_booktabs", "html"):
        results_table(results, form)
        claims_table(judge(grid.claims, results), form)
    results_csv(results)
    swept(results)
