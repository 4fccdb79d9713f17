"""An ablation as a whole: what `jaxfit ablate` does."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

from jaxfit.ablation.claims import Verdict, judge
from jaxfit.ablation.grid import load_grid
from jaxfit.ablation.measure import Result, check_shared, measure_grid
from jaxfit.ablation.runs import claim_folder, fit_grid
from jaxfit.data.formats.coco import read_coco
from jaxfit.evaluation.truth import read_truth
from jaxfit.extras import require_extra
from jaxfit.fitting.prepare import Preparation
from jaxfit.model.bird import Bird
from jaxfit.model.files import load_murre
from jaxfit.progress import ProgressTask, silent

__all__ = ["Ablation", "ablate"]


class Ablation(NamedTuple):
    """What came of a grid."""

    results: list[Result]
    """Of every run, in the grid's order."""
    verdicts: list[Verdict]
    """Of every claim that has runs to compare."""
    fitted: int
    """Runs that were fitted now; the folder held the others."""


def ablate(
    observations: str | Path,
    truth: str | Path,
    folder: str | Path,
    grid: str | Path = "ablation",
    bird: Bird | None = None,
    matching: Literal["auto", "ids", "overlap"] = "auto",
    progress: ProgressTask = silent,
) -> Ablation:
    """Fit the same birds under every config of a grid, measure them, and write tables, a plot and a report.

    Every run is stored as soon as its batch is done, and is not done again: the same call goes on where an
    interruption left off. A term that is defined in a notebook is known to the folder by its name alone; sweep such a
    one by `sweep`, which stores nothing.

    Args:
        observations: COCO file that all runs are fitted to.
        truth: COCO file of annotations, or the folder of a simulated scene.
        folder: where runs and report go.
        grid: `ablation` (the paper's) or a YAML file, see `load_grid`.
        bird: the model; None takes the murre.
        matching: by which tracks are matched, as `match_tracks`.
        progress: told of every part.

    Raises:
        InputError: Matplotlib or tabulate is missing (extra `report`); a file that cannot be read, a grid or config
            that makes no sense, a truth of other birds, a folder that holds something else.
    """
    require_extra("report", "ablate")
    from jaxfit.ablation.report import write_report

    observations, truth, folder = Path(observations), Path(truth), Path(folder)
    crossed, bird = load_grid(grid), bird or load_murre()
    observed = read_coco(observations)
    if matching != "overlap":
        check_shared(observed, read_truth(truth)[0], truth)
    prepared = Preparation(observed, bird, None, observations)
    inputs = {"observations": observations, "truth": truth}
    claim_folder(folder, crossed.runs, inputs, bird)
    fitted = fit_grid(prepared, bird, crossed.runs, folder, progress)
    results = measure_grid(crossed.runs, folder, truth, matching, progress)
    verdicts = judge(crossed.claims, results)
    write_report(results, verdicts, folder, inputs, bird.name)
    return Ablation(results, verdicts, fitted)
