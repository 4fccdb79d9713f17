"""Metrics of the runs, and verdicts on claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jaxfit.data.observations import Observations
from jaxfit.data.result_folder import SUMMARY
from jaxfit.data.solution import load_solution
from jaxfit.evaluation.ablation.grid import ClaimConfig, Run
from jaxfit.evaluation.ablation.runs import run_folder
from jaxfit.evaluation.bootstrap import Ratio, paired_ratio
from jaxfit.evaluation.evaluate import Evaluation, evaluate
from jaxfit.evaluation.truth import Truth, match_tracks
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.foundation.reading import json_text, read_json_file, reading

CLAIMED = ("me_p", "me_v")
"""The metrics of claims and plots; lower is better."""
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
            results.append(Result(run, *read_metrics(own)))
            report_progress(1, run.name)
    return results


def read_metrics(folder: Path) -> tuple[Evaluation, float, int]:
    """Return the stored metrics of a run, the seconds of its fit, and the number of runs in its batch.

    Raises:
        InputError: a file cannot be read, or does not hold metrics.
    """
    remedy = "remove this folder; then the same command fits the run again"
    content, summary = read_json_file(folder / _EVALUATION), read_json_file(folder / SUMMARY)
    with reading(folder / _EVALUATION, "the metrics of a run", remedy):
        return Evaluation.from_dict(content), float(summary["seconds"]["fit"]), int(summary["runs_at_once"])


@dataclass(frozen=True)
class Verdict:
    """The verdict on one claim in one metric."""

    claim: ClaimConfig
    metric: str
    pairs: int
    """Number of pairs of runs that differ only in the keys of the claim."""
    agree: int
    """Number of pairs in which the better run of the claim has the lower error."""
    ratio: Ratio
    """Error of the better over the worse run, as the geometric mean over pairs; below 1 where the claim is right."""

    @property
    def holds(self) -> str:
        """The verdict: `holds`, `does not hold`, or `not decided` where the interval over birds contains 1.

        A claim of harmlessness holds unless the interval lies above 1.
        """
        if self.ratio.high < 1:
            return "holds"
        if self.ratio.low > 1:
            return "does not hold"
        if self.claim.harmless and self.ratio.low <= 1 <= self.ratio.high:
            return "holds: no harm shown"
        return "not decided"


def judge(claims: Sequence[ClaimConfig], results: Sequence[Result]) -> list[Verdict]:
    """Return the verdict on each claim in each metric; claims without a pair of runs are skipped."""
    verdicts = []
    sums = {result.run.name: result.evaluation.sums for result in results}
    runs = [result.run for result in results]
    for claim in claims:
        pairs = [(sums[better.name], sums[worse.name]) for better, worse in pairs_of(claim, runs)]
        for metric in CLAIMED if pairs else ():
            agree = sum(better.value(metric) < worse.value(metric) for better, worse in pairs)
            verdicts.append(Verdict(claim, metric, len(pairs), agree, paired_ratio(pairs, metric)))
    return verdicts


def pairs_of(claim: ClaimConfig, runs: Sequence[Run]) -> list[tuple[Run, Run]]:
    """Return the pairs (better, worse) of a claim: runs with equal values of all keys that the claim does not name."""
    named = {*claim.better, *claim.worse}

    def chosen(levels: Mapping[str, Any]) -> list[tuple[Run, dict[str, Any]]]:
        """Return the runs with some levels, and their levels of all other keys."""
        return [
            (run, {path: level for path, level in run.levels.items() if path not in named})
            for run in runs
            if all(run.levels[path] == level for path, level in levels.items())
        ]

    worse_runs = chosen(claim.worse)
    return [(better, worse) for better, rest in chosen(claim.better) for worse, own in worse_runs if own == rest]
