"""A whole ablation: fit, measure and report every config of a grid."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Literal, NamedTuple

from jaxfit.ablation.claims import Verdict, judge
from jaxfit.ablation.grid import load_grid
from jaxfit.ablation.measure import Result, check_shared, measure_grid
from jaxfit.ablation.record import claim_folder
from jaxfit.ablation.runs import fit_grid
from jaxfit.data.formats.coco import read_coco
from jaxfit.evaluation.truth import read_truth
from jaxfit.extras import require_extra
from jaxfit.fitting.fit import check_observations
from jaxfit.model.bird import Bird
from jaxfit.model.files import load_murre
from jaxfit.progress import ProgressTask, silent
from jaxfit.workers.cluster import Cluster

__all__ = ["Ablation", "ablate"]


class Ablation(NamedTuple):
    """The outcome of an ablation."""

    results: list[Result]
    """One for every run, in the order of the grid."""
    verdicts: list[Verdict]
    """One for every claim and metric, where the grid has runs to compare."""
    fitted: int
    """Number of runs that this call fitted; the folder held the other runs."""


def ablate(
    observations: str | Path,
    truth: str | Path,
    folder: str | Path,
    grid: str | Path = "ablation",
    bird: Bird | None = None,
    matching: Literal["auto", "ids", "overlap"] = "auto",
    progress: ProgressTask = silent,
    allow_import: Collection[str] = (),
    cluster: Cluster | None = None,
) -> Ablation:
    """Fit the same birds under every config of a grid, measure the results, and write tables, a plot and a report.

    Runs are stored batch by batch, and stored runs are not fitted again: after an interruption, the same call
    continues. The folder records a term that is defined in a notebook by name only; use `sweep` for such a term, which
    stores nothing.

    Args:
        observations: COCO file that all runs are fitted to.
        truth: COCO file of annotations, or the folder of a simulated scene.
        folder: for the runs and the report.
        grid: `ablation` (the grid of the paper) or a YAML file, see `load_grid`.
        bird: the model; None takes the murre.
        matching: how tracks and birds are matched, see `match_tracks`.
        progress: shows the progress of every part.
        allow_import: terms `package.module:function` that the record of the folder may name, beside the terms of the
            grid. The record is only compared with the grid; its terms are never imported.
        cluster: worker processes that fit the windows. None: this process.

    Raises:
        InputError: Matplotlib or tabulate is missing (extra `report`), a file cannot be read, the grid or a config is
            invalid, the truth and the observations share no bird, or the folder holds something else.
    """
    require_extra("report", "ablate")
    from jaxfit.ablation.report import write_report

    observations, truth, folder = Path(observations), Path(truth), Path(folder)
    crossed, bird = load_grid(grid), bird or load_murre()
    observed = read_coco(observations, untracked="photographs")  # as `jaxfit fit`
    true = read_truth(truth, untracked="photographs" if observed.own_images else "video")
    if matching != "overlap":
        check_shared(observed, true)
    check_observations(observed, bird, observations)
    inputs = {"observations": observations, "truth": truth}
    claim_folder(folder, crossed.runs, inputs, bird, allow_import)
    fitted = fit_grid(observed, bird, crossed.runs, folder, progress, observations, cluster)
    results = measure_grid(crossed.runs, folder, true, matching, progress)
    verdicts = judge(crossed.claims, results)
    write_report(results, verdicts, folder, inputs, bird.name)
    return Ablation(results, verdicts, fitted)
