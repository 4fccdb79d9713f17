"""A sweep in memory: fit the same birds under several configs, for a notebook."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from jaxfit.ablation.grid import cross
from jaxfit.ablation.measure import Result
from jaxfit.ablation.runs import fit_batches
from jaxfit.config.fit import FitConfig
from jaxfit.config.grid import require_runs
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.truth import Truth
from jaxfit.fitting.fit import check_observations
from jaxfit.model.bird import Bird
from jaxfit.progress import ProgressTask, silent

__all__ = ["Sweep", "sweep"]


class Sweep(NamedTuple):
    """The outcome of a sweep, run by run."""

    solutions: list[Solution]
    results: list[Result]
    """The runs and their metrics, for the tables and plots of `jaxfit.ablation`."""


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
    for batch in fit_batches(observations, bird, runs, progress):
        for r, solution in zip(batch.runs, batch.solutions, strict=True):
            evaluation = evaluate(solution, bird, truth, progress)
            solutions[r], results[r] = solution, Result(runs[r], evaluation, batch.seconds_per_run, len(batch.runs))
    return Sweep([solutions[r] for r in range(len(runs))], [results[r] for r in range(len(runs))])
