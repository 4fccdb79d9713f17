"""Metrics of the runs of an ablation; the metrics of a run are stored in the folder of the run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jaxfit.ablation.grid import Run
from jaxfit.ablation.runs import run_folder
from jaxfit.data.observations import Observations
from jaxfit.data.solution import load_solution
from jaxfit.errors import InputError
from jaxfit.evaluation.aggregation import Evaluation
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.matching import match_tracks
from jaxfit.evaluation.truth import Truth
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.files import write_whole
from jaxfit.storage.json_values import json_text

__all__ = ["Result", "check_shared", "measure_grid"]

_EVALUATION = "evaluation.json"


@dataclass(frozen=True)
class Result:
    """The metrics of a run."""

    run: Run
    evaluation: Evaluation
    seconds: float
    """Time of the fit of the batch, divided by the number of runs in the batch."""
    runs_at_once: int
    """Number of runs in the batch."""


def check_shared(observations: Observations, truth: Truth) -> None:
    """Check before the fit that the truth has tracks and frames of the observations.

    Raises:
        InputError: no common track or no common frame.
    """
    for name, own, true in (
        ("track", observations.track_id, truth.observations.track_id),
        ("frame", observations.frame_index, truth.observations.frame_index),
    ):
        if not set(own.tolist()) & set(true.tolist()):
            ids = [", ".join(map(str, each[:10])) + (", …" if len(each) > 10 else "") for each in (true, own)]
            problem = f"shares no {name} with the observations: it has {name}s {ids[0]}, they have {ids[1]}"
            remedy = "give the annotations of the same video"
            if name == "track":
                remedy += ", or pass --match overlap where a tracker named the birds"
            raise InputError(truth.source, problem, remedy)


def measure_grid(
    runs: Sequence[Run],
    folder: Path,
    truth: Truth,
    matching: Literal["auto", "ids", "overlap"] = "auto",
    progress: ProgressTask = silent,
) -> list[Result]:
    """Return the metrics of every run, and compute and store metrics that the folder lacks.

    Args:
        runs: the grid; the folder holds all runs.
        folder: the folder of the ablation.
        truth: the annotations, optionally with poses and behaviours.
        matching: how tracks and birds are matched, see `match_tracks`.
        progress: shows the progress over runs.

    Raises:
        InputError: the result or the metrics of a run cannot be read.
    """
    results = []
    with progress("Measuring", len(runs)) as report_progress:
        for run in runs:
            own = run_folder(folder, run)
            path = own / _EVALUATION
            if not path.is_file():
                solution, bird = load_solution(own)
                solution, _ = match_tracks(solution, truth, matching)
                write_whole(path, json_text(evaluate(solution, bird, truth).to_dict(), indent=1).encode())
            try:
                evaluation = Evaluation.from_dict(json.loads(path.read_text(encoding="utf-8")))
                summary = json.loads((own / "summary.json").read_text(encoding="utf-8"))
                results.append(Result(run, evaluation, summary["seconds"]["fit"], summary["runs_at_once"]))
            except (OSError, ValueError, KeyError, TypeError) as error:
                problem = f"cannot be read: {type(error).__name__}: {error}"
                raise InputError(own, problem, "remove this folder; then the same command fits the run again") from None
            report_progress(1, run.name)
    return results
