"""The runs of an ablation: fitted in batches, and stored batch by batch so that no run is fitted twice."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution, write_solution
from jaxfit.evaluation.ablation.grid import Run
from jaxfit.fitting.batch import frames_per_batch
from jaxfit.fitting.collect import summarise
from jaxfit.fitting.fit import LEARN_REMEDY, fit_runs, windows_of
from jaxfit.fitting.solve import compiled_part
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import new_folder
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.foundation.workers import Cluster
from jaxfit.model.bird import Bird

FRAMES_AT_ONCE = 3000
"""Birds × frames of a batch. A larger batch is not faster, and an interruption loses more work."""
_RUNS, _READY = "runs", ".ready-"


def run_folder(folder: Path, run: Run) -> Path:
    """Return the result folder of a run."""
    return folder / _RUNS / run.name


def fit_batches(
    observations: Observations,
    bird: Bird,
    runs: Sequence[Run],
    progress: ProgressTask = silent,
    stored: Collection[int] = (),
    source: object = "observations",
    cluster: Cluster | None = None,
) -> Iterator[tuple[list[int], list[Solution], float]]:
    """Fit the runs of a grid, batch by batch.

    The runs of a batch share one compiled program and keep the order of the grid. The memory and ``FRAMES_AT_ONCE``
    limit the size of a batch. A batch is fitted as a whole even where some of its runs are stored, so the results of
    an interrupted ablation do not depend on the interruption. Only batches whose runs are all stored are skipped.

    Args:
        observations: keypoints and masks.
        bird: the model.
        runs: the grid.
        progress: shows the progress of every part.
        stored: positions of the runs that are stored already.
        source: name of the observations in error messages.
        cluster: worker processes that fit the windows. None: this process.

    Yields:
        For each batch: the positions of its runs in the grid, the result of each run, and the time of the fit in
        seconds, divided by the number of runs.

    Raises:
        InputError: as `fit_runs`; a config learns its weights.
    """
    if any(run.config.learns_first for run in runs):
        raise InputError("config", "`learn_weights` would change the weights that an ablation sets", LEARN_REMEDY)
    groups: dict[Any, list[int]] = {}
    for r, run in enumerate(runs):
        groups.setdefault(config_to_yaml(compiled_part(run.config)), []).append(r)
    for group in groups.values():
        config = runs[group[0]].config
        frames = len(windows_of(observations, config, source)) * config.window
        at_once = max(min(frames_per_batch(bird, config), FRAMES_AT_ONCE) // frames, 1)
        for batch in (part.tolist() for part in np.array_split(group, -(-len(group) // at_once))):
            if not all(r in stored for r in batch):
                began = time.perf_counter()
                configs = [runs[r].config for r in batch]
                solutions = fit_runs(observations, bird, configs, None, progress, source, cluster=cluster)
                yield batch, solutions, (time.perf_counter() - began) / len(batch)


def fit_grid(
    observations: Observations,
    bird: Bird,
    runs: Sequence[Run],
    folder: Path,
    progress: ProgressTask = silent,
    source: object = "observations",
    cluster: Cluster | None = None,
) -> int:
    """Fit and store every run that the folder lacks.

    The results of a batch are written into a temporary folder and then moved, so that the folder of a run is complete
    whenever it exists, and a stored run is never lost.

    Returns:
        The number of runs that this call fitted and stored.
    """
    for ready in sorted(folder.glob(f"{_READY}*")):  # an interruption between two moves leaves this folder
        _move_in(ready, folder)
    stored = {r for r, run in enumerate(runs) if run_folder(folder, run).is_dir()}
    for b, fitted in enumerate(fit_batches(observations, bird, runs, progress, stored, source, cluster)):
        ready, (batch, solutions, seconds) = folder / f"{_READY}{b}", fitted
        with new_folder(ready) as part:
            for r, solution in zip(batch, solutions, strict=True):
                if r not in stored:
                    (part / runs[r].name).mkdir()
                    summary = summarise(solution, bird, {"fit": seconds}) | {"runs_at_once": len(batch)}
                    write_solution(solution, bird, config_to_yaml(runs[r].config), summary, part / runs[r].name)
        _move_in(ready, folder)
    return len(runs) - len(stored)


def _move_in(ready: Path, folder: Path) -> None:
    (folder / _RUNS).mkdir(exist_ok=True)
    for run in ready.iterdir():
        run.rename(folder / _RUNS / run.name)
    ready.rmdir()
