"""The runs of an ablation: planned into batches, each stored as soon as it is done, none done twice."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from jaxfit.ablation.grid import Run
from jaxfit.config.build import build_config
from jaxfit.config.fit import FitConfig
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.formats.scene_folder import TRUE_POSES, TRUTH
from jaxfit.data.solution import write_solution
from jaxfit.errors import InputError
from jaxfit.fitting.batch import frames_per_batch
from jaxfit.fitting.fit import fit_runs
from jaxfit.fitting.prepare import Preparation
from jaxfit.fitting.stages import program
from jaxfit.fitting.summary import summarise
from jaxfit.model.bird import Bird
from jaxfit.model.describe import model_hash
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.files import new_folder, write_whole

__all__ = ["FRAMES_AT_ONCE", "claim_folder", "fit_grid", "plan_batches", "run_folder"]

FRAMES_AT_ONCE = 3000
"""Birds × frames from which on a larger batch is no faster, but loses more where it is interrupted."""
FORMAT_VERSION = 1
_GRID, _RUNS, _READY = "ablation.json", "runs", ".ready-"


def run_folder(folder: Path, run: Run) -> Path:
    """Where the result of a run lies: a folder of results."""
    return folder / _RUNS / run.name


def claim_folder(folder: Path, runs: Sequence[Run], inputs: dict[str, Path], bird: Bird) -> None:
    """Make a folder that of this ablation, or see that it is.

    Args:
        folder: where.
        runs: the grid, crossed.
        inputs: what the files are called → the files that the results depend on.
        bird: the model.

    Raises:
        InputError: the folder holds something else, or another ablation: what differs is named.
    """
    own = {
        "format_version": FORMAT_VERSION,
        "runs": {run.name: config_to_yaml(run.config) for run in runs},
        "model": model_hash(bird),
        **{name: _digest(path) for name, path in inputs.items()},
    }
    path = folder / _GRID
    if not path.is_file():
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(folder, f"holds something, but no {_GRID}", "choose another --out")
        write_whole(path, json.dumps(own, indent=1).encode())
        return
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        differs = [name for name in own if name != "runs" and held[name] != own[name]]
        # by meaning: a later version's config may hold keys that an earlier one did not write
        as_before = {name: build_config(FitConfig, yaml.safe_load(text)) for name, text in held["runs"].items()}
    except (OSError, ValueError, KeyError, AttributeError, yaml.YAMLError, InputError) as error:
        raise InputError(path, f"cannot be read: {error}", "choose another --out") from None
    if as_before != {run.name: run.config for run in runs}:
        differs.insert(0, "grid")
    if differs:
        raise InputError(
            folder, f"holds an ablation of another {', '.join(differs)}", "choose another --out, or remove that folder"
        )


def _digest(path: Path) -> str:
    """SHA-256 of a file, or of the truth in the folder of a simulated scene."""
    digest = hashlib.sha256()
    for file in [path / TRUTH, *sorted((path / TRUE_POSES).glob("*.npz"))] if path.is_dir() else [path]:
        with file.open("rb") as opened:
            digest.update(hashlib.file_digest(opened, "sha256").digest())
    return digest.hexdigest()


def plan_batches(prepared: Preparation, bird: Bird, runs: Sequence[Run]) -> list[list[int]]:
    """Positions of the runs that are fitted together, batch by batch: those of one program, in the grid's order, as
    many as the memory holds and no more than keep the cores busy."""
    groups: dict[Any, list[int]] = {}
    for r, run in enumerate(runs):
        groups.setdefault(config_to_yaml(program(run.config)), []).append(r)
    batches = []
    for group in groups.values():
        config = runs[group[0]].config
        frames = len(prepared.windows(config)) * config.window
        at_once = max(min(frames_per_batch(bird, config), FRAMES_AT_ONCE) // frames, 1)
        parts = np.array_split(group, -(-len(group) // at_once))
        batches += [part.tolist() for part in parts]
    return batches


def fit_grid(
    prepared: Preparation, bird: Bird, runs: Sequence[Run], folder: Path, progress: ProgressTask = silent
) -> int:
    """Fit every run that the folder does not hold yet, and store it there.

    A batch is always fitted as planned, so that an interrupted ablation ends with the same numbers. It is written
    to one side and then moved in, so that a run is there as a whole or not at all, and no finished one is lost.

    Returns:
        How many runs were fitted now.
    """
    for ready in sorted(folder.glob(f"{_READY}*")):  # an interruption may have come between two moves
        _move_in(ready, folder)
    for part in folder.glob(f".{_READY}*.part"):  # or while they were written
        shutil.rmtree(part)
    fitted = 0
    for b, batch in enumerate(plan_batches(prepared, bird, runs)):
        missing = [r for r in batch if not run_folder(folder, runs[r]).is_dir()]
        if not missing:
            continue
        began = time.perf_counter()
        solutions = fit_runs(prepared, bird, [runs[r].config for r in batch], progress)
        seconds = {"fit": (time.perf_counter() - began) / len(batch)}
        ready = folder / f"{_READY}{b}"
        with new_folder(ready) as part:
            for r, solution in zip(batch, solutions, strict=True):
                if r in missing:
                    (part / runs[r].name).mkdir()
                    summary = summarise(solution, bird, seconds) | {"runs_at_once": len(batch)}
                    write_solution(solution, bird, config_to_yaml(runs[r].config), summary, part / runs[r].name)
        _move_in(ready, folder)
        fitted += len(missing)
    return fitted


def _move_in(ready: Path, folder: Path) -> None:
    (folder / _RUNS).mkdir(exist_ok=True)
    for run in ready.iterdir():
        run.rename(folder / _RUNS / run.name)
    ready.rmdir()
