"""The runs of an ablation, measured against the truth; every figure is kept beside its run."""

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
from jaxfit.evaluation.truth import read_behaviours, read_truth
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.files import write_whole
from jaxfit.storage.json_values import json_text

__all__ = ["Result", "check_shared", "measure_grid"]

_EVALUATION = "evaluation.json"


@dataclass(frozen=True)
class Result:
    """A run and what came of it."""

    run: Run
    evaluation: Evaluation
    seconds: float
    """Its share of the time that its batch took."""
    runs_at_once: int
    """How many runs that batch held."""


def check_shared(observations: Observations, truth: Observations, source: object) -> None:
    """See, before the work, that there will be something to measure.

    Raises:
        InputError: no track or no frame in common.
    """
    for name, own, true in (
        ("track", observations.track_id, truth.track_id),
        ("frame", observations.frame_index, truth.frame_index),
    ):
        if not set(own.tolist()) & set(true.tolist()):
            ids = [", ".join(map(str, each[:10])) + (", …" if len(each) > 10 else "") for each in (true, own)]
            problem = f"shares no {name} with the observations: it has {name}s {ids[0]}, they have {ids[1]}"
            remedy = "give the annotations of the same video"
            if name == "track":
                remedy += ", or pass --match overlap where a tracker named the birds"
            raise InputError(source, problem, remedy)


def measure_grid(
    runs: Sequence[Run],
    folder: Path,
    truth: Path,
    matching: Literal["auto", "ids", "overlap"] = "auto",
    progress: ProgressTask = silent,
) -> list[Result]:
    """Measure every run that was not measured before.

    Args:
        runs: the grid, all of it fitted.
        folder: the ablation's.
        truth: annotations, or the folder of a simulated scene.
        matching: by which tracks are matched, as `match_tracks`.
        progress: told of every run.
    """
    annotations, poses, truth_bird = read_truth(truth)
    behaviours = read_behaviours(truth)
    results = []
    with progress("Measuring", len(runs)) as report_progress:
        for run in runs:
            own = run_folder(folder, run)
            path = own / _EVALUATION
            if not path.is_file():
                solution, bird = load_solution(own)
                solution, _ = match_tracks(solution, annotations, matching, truth)
                found = evaluate(
                    solution,
                    bird,
                    annotations,
                    source=truth,
                    truth_solution=poses,
                    truth_bird=truth_bird,
                    behaviours=behaviours,
                )
                write_whole(path, json_text(found.to_dict(), indent=1).encode())
            try:
                found = Evaluation.from_dict(json.loads(path.read_text(encoding="utf-8")))
                summary = json.loads((own / "summary.json").read_text(encoding="utf-8"))
                results.append(Result(run, found, summary["seconds"]["fit"], summary["runs_at_once"]))
            except (OSError, ValueError, KeyError, TypeError) as error:
                problem = f"cannot be read: {type(error).__name__}: {error}"
                raise InputError(own, problem, "remove this folder, and its run is done again") from None
            report_progress(1, run.name)
    return results
