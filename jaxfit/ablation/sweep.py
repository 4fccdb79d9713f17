"""A sweep in memory: the same birds under a few configs, for a notebook."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from jaxfit.ablation.grid import cross
from jaxfit.ablation.measure import Result
from jaxfit.ablation.runs import plan_batches
from jaxfit.config.fit import FitConfig
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.fitting.fit import fit_runs
from jaxfit.fitting.prepare import Preparation
from jaxfit.model.bird import Bird
from jaxfit.progress import ProgressTask, silent

__all__ = ["Sweep", "sweep"]


class Sweep(NamedTuple):
    """What came of a sweep, run by run."""

    solutions: list[Solution]
    results: list[Result]
    """The runs and their figures, as `jaxfit.ablation` tabulates and plots them."""


def sweep(
    observations: Observations,
    bird: Bird,
    config: FitConfig,
    values: Mapping[str, Sequence[Any]],
    truth: Observations,
    *,
    truth_solution: Solution | None = None,
    progress: ProgressTask = silent,
) -> Sweep:
    """Fit the same birds under every combination of some values, and measure each; nothing is stored.

    Runs that differ only in weights, settings, step sizes or the filter are fitted at once, as one compiled program.

    Args:
        observations: keypoints and masks.
        bird: the model.
        config: what every run starts from.
        values: path of a config key (`terms.velocity`, `filter_window`) → its values; the last key changes fastest.
        truth: the annotations, of the same track ids.
        truth_solution: the true poses, for errors in space, as `evaluate` takes them.
        progress: told of every part.

    Raises:
        InputError: as `fit` and `evaluate`; an unknown key, or a value that makes no sense.
    """
    points = [dict(zip(values, point, strict=True)) for point in itertools.product(*values.values())]
    runs = cross(config, points, "sweep")
    prepared = Preparation(observations, bird, None, "observations")
    found: dict[int, tuple[Solution, Result]] = {}
    for batch in plan_batches(prepared, bird, runs):
        began = time.perf_counter()
        solutions = fit_runs(prepared, bird, [runs[r].config for r in batch], progress)
        seconds = (time.perf_counter() - began) / len(batch)
        for r, solution in zip(batch, solutions, strict=True):
            evaluation = evaluate(solution, bird, truth, progress, truth_solution=truth_solution)
            found[r] = solution, Result(runs[r], evaluation, seconds, len(batch))
    return Sweep(*(list(each) for each in zip(*(found[r] for r in range(len(runs))), strict=True)))
