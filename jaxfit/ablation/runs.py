"""The runs of an ablation: fitted in batches, and stored batch by batch so that no run is fitted twice."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from jaxfit.ablation.grid import Run
from jaxfit.config.build import build_config
from jaxfit.config.fit import FitConfig
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.formats.scene_folder import TRUE_POSES, TRUTH
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution, write_solution
from jaxfit.errors import InputError
from jaxfit.fitting.batch import frames_per_batch
from jaxfit.fitting.fit import fit_runs, windows_of
from jaxfit.fitting.stages import compiled_part
from jaxfit.fitting.summary import summarise
from jaxfit.model.bird import Bird
from jaxfit.model.describe import model_hash
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.files import new_folder, write_whole
from jaxfit.storage.temporary import remove_leftovers

__all__ = ["FRAMES_AT_ONCE", "FittedBatch", "claim_folder", "fit_batches", "fit_grid", "plan_batches", "run_folder"]

FRAMES_AT_ONCE = 3000
"""Birds × frames of a batch. A larger batch is not faster, and an interruption loses more work."""
FORMAT_VERSION = 1
_GRID, _RUNS, _READY = "ablation.json", "runs", ".ready-"


def run_folder(folder: Path, run: Run) -> Path:
    """Return the result folder of a run."""
    return folder / _RUNS / run.name


def claim_folder(folder: Path, runs: Sequence[Run], inputs: dict[str, Path], bird: Bird) -> None:
    """Record this ablation in a new folder, or check that an existing folder belongs to this ablation.

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
        "runs": {run.name: config_to_yaml(run.config) for run in runs},
        "model": model_hash(bird),
        **{name: _digest(path) for name, path in inputs.items()},
    }
    path = folder / _GRID
    if not path.is_file():
        remove_leftovers(folder)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(folder, f"holds files, but no {_GRID}", "choose another --out")
        write_whole(path, json.dumps(own, indent=1).encode())
        return
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        differs = [name for name in own if name != "runs" and held[name] != own[name]]
        # compare configs, not text: a later version may write keys that an earlier version did not have
        held_configs = {name: build_config(FitConfig, yaml.safe_load(text)) for name, text in held["runs"].items()}
    except (OSError, ValueError, KeyError, AttributeError, yaml.YAMLError, InputError) as error:
        raise InputError(path, f"cannot be read: {error}", "choose another --out") from None
    if held_configs != {run.name: run.config for run in runs}:
        differs.insert(0, "grid")
    if differs:
        raise InputError(
            folder, f"holds an ablation of another {', '.join(differs)}", "choose another --out, or remove that folder"
        )


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of the truth in the folder of a simulated scene."""
    digest = hashlib.sha256()
    for file in [path / TRUTH, *sorted((path / TRUE_POSES).glob("*.npz"))] if path.is_dir() else [path]:
        with file.open("rb") as opened:
            digest.update(hashlib.file_digest(opened, "sha256").digest())
    return digest.hexdigest()


def plan_batches(observations: Observations, bird: Bird, runs: Sequence[Run], source: object) -> list[list[int]]:
    """Return the positions of the runs of every batch.

    The runs of a batch share one compiled program and keep the order of the grid. The memory and ``FRAMES_AT_ONCE``
    limit the size of a batch.
    """
    groups: dict[Any, list[int]] = {}
    for r, run in enumerate(runs):
        groups.setdefault(config_to_yaml(compiled_part(run.config)), []).append(r)
    batches = []
    for group in groups.values():
        config = runs[group[0]].config
        frames = len(windows_of(observations, config, source)) * config.window
        at_once = max(min(frames_per_batch(bird, config), FRAMES_AT_ONCE) // frames, 1)
        parts = np.array_split(group, -(-len(group) // at_once))
        batches += [part.tolist() for part in parts]
    return batches


class FittedBatch(NamedTuple):
    """Runs that were fitted together."""

    runs: list[int]
    """Positions of the runs in the grid."""
    solutions: list[Solution]
    """The result of each run."""
    seconds_per_run: float
    """Time of the fit, divided by the number of runs."""


def fit_batches(
    observations: Observations,
    bird: Bird,
    runs: Sequence[Run],
    progress: ProgressTask = silent,
    stored: Collection[int] = (),
    source: object = "observations",
) -> Iterator[FittedBatch]:
    """Fit the runs of a grid, batch by batch.

    A batch is fitted as a whole even where some of its runs are stored, so the results of an interrupted ablation do
    not depend on the interruption. Only batches whose runs are all stored are skipped.

    Args:
        observations: keypoints and masks.
        bird: the model.
        runs: the grid.
        progress: shows the progress of every part.
        stored: positions of the runs that are stored already.
        source: name of the observations in error messages.
    """
    for batch in plan_batches(observations, bird, runs, source):
        if not all(r in stored for r in batch):
            began = time.perf_counter()
            configs = [runs[r].config for r in batch]
            solutions = fit_runs(observations, bird, configs, None, progress, source)
            yield FittedBatch(batch, solutions, (time.perf_counter() - began) / len(batch))


def fit_grid(
    observations: Observations,
    bird: Bird,
    runs: Sequence[Run],
    folder: Path,
    progress: ProgressTask = silent,
    source: object = "observations",
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
    for b, batch in enumerate(fit_batches(observations, bird, runs, progress, stored, source)):
        ready = folder / f"{_READY}{b}"
        with new_folder(ready) as part:
            for r, solution in zip(batch.runs, batch.solutions, strict=True):
                if r not in stored:
                    (part / runs[r].name).mkdir()
                    summary = summarise(solution, bird, {"fit": batch.seconds_per_run})
                    summary |= {"runs_at_once": len(batch.runs)}
                    write_solution(solution, bird, config_to_yaml(runs[r].config), summary, part / runs[r].name)
        _move_in(ready, folder)
    return len(runs) - len(stored)


def _move_in(ready: Path, folder: Path) -> None:
    (folder / _RUNS).mkdir(exist_ok=True)
    for run in ready.iterdir():
        run.rename(folder / _RUNS / run.name)
    ready.rmdir()
