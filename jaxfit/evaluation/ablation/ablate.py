"""`ablate` and `sweep`: an ablation as a whole, its record, and a sweep in memory."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxfit.config.build import describes, plain_config
from jaxfit.config.fit import FitConfig
from jaxfit.data.formats import TRUE_POSES, TRUTH
from jaxfit.data.formats.coco import read_coco
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.evaluation.ablation.grid import ClaimConfig, Run, cross, load_grid, require_runs, short
from jaxfit.evaluation.ablation.measure import Result, Verdict, check_shared, judge, measure_grid
from jaxfit.evaluation.ablation.runs import fit_batches, fit_grid
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.truth import Truth, read_truth
from jaxfit.fitting.fit import check_observations
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.files import remove_leftovers, write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.foundation.reading import check_folder, read_json_file
from jaxfit.foundation.workers import Cluster
from jaxfit.model.bird import Bird, model_hash
from jaxfit.model.files import load_murre

FORMAT_VERSION = 2
_RECORD = "ablation.json"
_SHOWN_RUNS = 7
"""Most runs that `print` shows."""


def claim_folder(folder: Path, runs: Sequence[Run], inputs: dict[str, Path], bird: Bird) -> None:
    """Record this ablation in a new folder, or check that an existing folder belongs to this ablation.

    The configs in the record are compared as plain values. No term in the record is imported.

    Args:
        folder: the folder of the ablation.
        runs: the grid.
        inputs: name in messages → file that the results depend on.
        bird: the model.

    Raises:
        InputError: the folder holds something else, or another ablation; the message names the difference.
    """
    own = {
        "format_version": FORMAT_VERSION,
        "runs": {run.name: plain_config(run.config) for run in runs},
        "model": model_hash(bird),
        **{name: _digest(path) for name, path in inputs.items()},
    }
    path, files = folder / _RECORD, []
    if os.path.lexists(folder):
        remove_leftovers(folder)
        files = [file.name for file in check_folder(folder, "a folder of an ablation").iterdir()]
    if not files:
        write_whole(path, json.dumps(own, indent=1).encode())
        return
    if _RECORD not in files:
        raise InputError(folder, f"holds files, but no {_RECORD}", "choose another --out")
    held = read_json_file(path)
    if not isinstance(held, dict) or not isinstance(held.get("runs"), dict):
        raise InputError(path, "does not describe an ablation", "choose another --out")
    differs = [name for name in own if name != "runs" and held.get(name) != own[name]]
    same = held["runs"].keys() == own["runs"].keys()
    if not same or not all(describes(held["runs"][run.name], run.config) for run in runs):
        differs.insert(0, "grid")
    if differs:
        remedy = "choose another --out, or remove that folder"
        raise InputError(folder, f"holds an ablation of another {', '.join(differs)}", remedy)


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of the truth in the folder of a simulated scene."""
    digest = hashlib.sha256()
    for file in [path / TRUTH, *sorted((path / TRUE_POSES).glob("*.npz"))] if path.is_dir() else [path]:
        with file.open("rb") as opened:
            digest.update(hashlib.file_digest(opened, "sha256").digest())
    return digest.hexdigest()


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
        cluster: worker processes that fit the windows. None: this process.

    Raises:
        InputError: Matplotlib or tabulate is missing (extra `report`), a file cannot be read, the grid or a config is
            invalid, the truth and the observations share no bird, or the folder holds something else.
    """
    require_extra("report", "ablate")
    from jaxfit.evaluation.ablation.report import write_report

    observations, truth, folder = Path(observations), Path(truth), Path(folder)
    (runs, claims), bird = load_grid(grid), bird or load_murre()
    observed = read_coco(observations, untracked="photographs")  # as `jaxfit fit`
    true = read_truth(truth, untracked="photographs" if observed.own_images else "video")
    if matching != "overlap":
        check_shared(observed, true)
    check_observations(observed, bird, observations)
    inputs = {"observations": observations, "truth": truth}
    claim_folder(folder, runs, inputs, bird)
    fitted = fit_grid(observed, bird, runs, folder, progress, observations, cluster)
    results = measure_grid(runs, folder, true, matching, progress)
    verdicts = judge(claims, results)
    write_report(results, verdicts, folder, inputs, bird.name)
    return Ablation(results, verdicts, fitted)


class Sweep(NamedTuple):
    """The outcome of a sweep, run by run. `print` shows the best runs."""

    solutions: list[Solution]
    results: list[Result]
    """The runs and their metrics."""

    def __repr__(self) -> str:
        """Return the varied keys and the metrics of the best runs, in ten lines at most."""
        best = sorted(self.results, key=lambda result: np.nan_to_num(result.evaluation.overall["me_p"], nan=np.inf))
        lines = [f"Sweep of {len(best)} runs, the lowest me_p first"]
        for result in best[:_SHOWN_RUNS]:
            levels = ", ".join(f"{path} {short(level)}" for path, level in result.run.levels.items())
            metrics = (f"{name} {result.evaluation.overall[name]:.4f}" for name in ("me_p", "me_v"))
            lines.append("  " + "  ".join([levels, *metrics]))
        more = [f"  … and {len(best) - _SHOWN_RUNS} more runs"] if len(best) > _SHOWN_RUNS else []
        return "\n".join([*lines, *more, "table() has all metrics, plot() draws them, compare() tests a claim"])

    def table(self, form: str = "simple") -> str:
        """Return the metrics of all runs, the best first (extra `report`).

        Args:
            form: a format of tabulate: `simple`, `github`, `latex_booktabs`, `html`, …
        """
        require_extra("report", "sweep")
        from jaxfit.evaluation.ablation.table import results_table

        return results_table(self.results, form)

    def plot(self) -> bytes:
        """Return a PNG of me_p and me_v over the varied key with the most numbers (extra `report`)."""
        require_extra("report", "sweep")
        from jaxfit.evaluation.ablation.report import plot

        return plot(self.results)

    def compare(self, claim: str, better: Mapping[str, Any], worse: Mapping[str, Any], form: str = "simple") -> str:
        """Return the verdict on a claim as a table: whether some values give lower errors than others.

        Args:
            claim: the claim in words.
            better: path of a config key → the value that is claimed to be better.
            worse: the other value of the same keys.
            form: as for `table`.
        """
        require_extra("report", "sweep")
        from jaxfit.evaluation.ablation.table import claims_table

        return claims_table(judge([ClaimConfig(claim, dict(better), dict(worse))], self.results), form)


def sweep(
    observations: Observations,
    bird: Bird,
    config: FitConfig,
    values: Mapping[str, Sequence[Any]],
    truth: Truth | Observations,
    *,
    progress: ProgressTask = silent,
) -> Sweep:
    """Fit the same birds under every combination of some values, and measure every result; nothing is stored.

    Runs that differ only in weights, hyperparameters, step sizes or the filter are fitted together, as one compiled
    program.

    Args:
        observations: keypoints and masks.
        bird: the model.
        config: the config that every run starts from.
        values: path of a config key (`terms.velocity`, `filter_window`) → values; the last key changes fastest.
        truth: the annotations of the same track ids, optionally with exact poses and behaviours.
        progress: shows the progress of every part.

    Raises:
        InputError: as `fit` and `evaluate`; or a key is unknown, a value is invalid, or there are too many runs.
    """
    require_runs("values", [list(values.values())])
    points = [dict(zip(values, point, strict=True)) for point in itertools.product(*values.values())]
    runs = cross(config, points, "sweep")
    observations = check_observations(observations, bird, "observations")
    solutions: dict[int, Solution] = {}
    results: dict[int, Result] = {}
    for batch, fitted, seconds in fit_batches(observations, bird, runs, progress):
        for r, solution in zip(batch, fitted, strict=True):
            evaluation = evaluate(solution, bird, truth, progress)
            solutions[r], results[r] = solution, Result(runs[r], evaluation, seconds, len(batch))
    return Sweep([solutions[r] for r in range(len(runs))], [results[r] for r in range(len(runs))])
