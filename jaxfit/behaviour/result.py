"""From a result to features, bouts and time budgets, and their files: `describe_result`, `write_described`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfit.behaviour.birds import flock_of, times_known
from jaxfit.behaviour.bouts import Budget, Ethogram, find_bouts, time_budget
from jaxfit.behaviour.describe import Description, describe
from jaxfit.behaviour.page import BehaviourPage
from jaxfit.behaviour.registry import Feature
from jaxfit.behaviour.rules import BehaviourConfig, load_behaviour_config
from jaxfit.behaviour.tables import boris_project, bout_columns, budget_columns, features_file
from jaxfit.cameras.camera import Camera
from jaxfit.cameras.files import read_cameras
from jaxfit.data.flags import CONTRADICTED, flags
from jaxfit.data.result_folder import CAMERAS, read_summary
from jaxfit.data.solution import Solution
from jaxfit.data.world import as_filmed
from jaxfit.export.result import Exported, frame_times, open_result, stored_times
from jaxfit.export.tables import csv_table
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import require_package
from jaxfit.foundation.files import check_new_file, check_writable, write_errors, write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.model.bird import Bird

UNEVEN = 0.2
"""Share by which the time between frames varies, from which the frame rate is called variable."""


class Described(NamedTuple):
    """What birds do."""

    description: Description
    ethogram: Ethogram | None
    """None where the times of the frames are unknown, or for one frame."""
    budget: tuple[Budget, ...]
    config: BehaviourConfig
    notes: tuple[str, ...]
    """Sentences about what is estimated, unknown or undecidable, for people."""

    @property
    def shown(self) -> BehaviourPage | None:
        """What a report shows; None without an ethogram."""
        if self.ethogram is None:
            return None
        return BehaviourPage(self.description, self.ethogram, self.budget, self.config, self.notes)

    def select(self, rows: Int[np.ndarray, "M"], columns: Int[np.ndarray, "L"]) -> Described:
        """Return what M of the birds do in L of the frames.

        The values are those of the whole result. Bouts are cut to the frames, and the budget is that of the part.

        Args:
            rows: positions of the birds.
            columns: positions of the frames, without a gap.
        """
        description = self.description.select(rows, columns)
        if self.ethogram is None:
            return self._replace(description=description)
        ethogram = self.ethogram.select(rows, columns, description)
        budget = tuple(time_budget(ethogram, description.flock.solution.track_id))
        return self._replace(description=description, ethogram=ethogram, budget=budget)


class Written(NamedTuple):
    """Files of `write_described`."""

    files: list[Path]
    removed: list[Path]
    """Files of an earlier run that this run does not write."""


def describe_solution(
    solution: Solution,
    bird: Bird,
    times_s: Float[np.ndarray, "T"] | None = None,
    *,
    config: BehaviourConfig | None = None,
    features: Sequence[Feature] = (),
    cameras: int = 0,
    camera: Camera | None = None,
    photographs: bool = False,
    source: object = "the result",
    progress: ProgressTask = silent,
) -> Described:
    """Describe what the birds of a solution do.

    Args:
        solution: the poses; those in a world, in the frame of `camera` (`data.world.as_filmed`).
        bird: the model.
        times_s: time of each frame; None takes those of the solution.
        config: the rules of behaviours; None: those of the shipped config `behaviour`.
        features: further features.
        cameras, camera, photographs, source: as for `jaxfit.behaviour.birds.flock_of`.
        progress: reports frames.

    Raises:
        InputError: a feature fails.
    """
    config = load_behaviour_config() if config is None else config
    times_s = frame_times(solution, None, solution.fps) if times_s is None else times_s
    if photographs:
        times_s = np.full(len(times_s), np.nan)
    with progress("Placing the birds", None):
        flock = flock_of(solution, bird, times_s, cameras, camera, photographs, source)
    description = describe(flock, [*features, *config.features], progress)
    ethogram = find_bouts(description, config) if times_known(times_s) else None
    budget = () if ethogram is None else tuple(time_budget(ethogram, solution.track_id))
    notes = (*flock.notes, *_notes_of_times(solution, times_s, photographs, description))
    return Described(description, ethogram, budget, config, notes)


def describe_result(
    folder: Path,
    exported: Exported,
    config: BehaviourConfig | None = None,
    features: Sequence[Feature] = (),
    progress: ProgressTask = silent,
) -> Described:
    """Describe what the birds of a result folder do.

    Args:
        folder: folder of `jaxfit fit`, `jaxfit ledge` or `jaxfit reconstruct`.
        exported: all tracks and frames of the result (`jaxfit.export.result.open_result`).
        config, features, progress: as for `describe_solution`.

    Raises:
        InputError: the cameras of the result cannot be read, or a feature fails.
    """
    solution, camera = as_filmed(folder, exported.solution, exported.bird)
    path = folder / CAMERAS
    described = describe_solution(
        solution,
        exported.bird,
        exported.times_s,
        config=config,
        features=features,
        cameras=len(read_cameras(path)) if solution.world is not None and path.is_file() else 0,
        camera=camera,
        photographs=bool(read_summary(folder).get("photographs")),
        source=folder,
        progress=progress,
    )
    return described._replace(notes=(*_notes_of_quality(folder, solution), *described.notes))


def shown_behaviour(solution: Solution, bird: Bird, progress: ProgressTask = silent) -> BehaviourPage | None:
    """Return what the birds of a solution do, for its report; None without poses or times."""
    return describe_solution(solution, bird, progress=progress).shown if solution.valid.any() else None


def behaviour_of_result(folder: Path, progress: ProgressTask = silent) -> BehaviourPage | None:
    """Return what the birds of a result folder do, for its report; None without poses, times or moving birds.

    Raises:
        InputError: the folder holds no result, or its files do not belong together.
    """
    exported = open_result(folder)
    if read_summary(folder).get("photographs") or not exported.solution.valid.any():
        return None
    return describe_result(folder, exported, progress=progress).shown


def _notes_of_quality(folder: Path, solution: Solution) -> tuple[str, ...]:
    """Return sentences about why the features may be wrong: low trust, poses that the detections contradict."""
    notes, flag = [], flags(solution.flags.doubts)[solution.valid]
    if read_summary(folder).get("trust") == "low":
        notes.append("trust in the tracking is low, so what follows may be wrong: see the report of the result")
    share = float((flag == CONTRADICTED).mean()) if flag.size else 0.0
    if share:
        notes.append(
            f"{100 * share:.1f} % of the poses are contradicted by the detections: leave out their rows (`flag`)"
        )
    return tuple(notes)


def _notes_of_times(solution: Solution, times_s: np.ndarray, photographs: bool, description: Description) -> list[str]:
    """Return sentences about what the times of the frames allow."""
    if photographs:
        return ["the frames are photographs, so nothing is known about movements, neighbours and behaviours"]
    if not np.isfinite(times_s).all():
        return ["the times of the frames are unknown, so there are no movements and behaviours; give --fps"]
    if len(times_s) < 2:
        return ["one frame shows no movements and behaviours"]
    steps, notes = np.diff(times_s), []
    usual = float(np.median(steps))
    stored = solution.timestamp_s
    if stored is not None and np.isfinite(stored).any() and stored_times(solution) is None:
        notes.append("the stored times of the frames have gaps or do not increase, so the frame rate gives the times")
    if times_s[0] < 0:
        notes.append(f"the times begin at {times_s[0]:.3g} s; BORIS counts from the start of the film, at 0 s")
    if (np.abs(steps - usual) > UNEVEN * usual).any():
        notes.append(f"the time between frames varies from {steps.min():.3g} to {steps.max():.3g} s")
    if "beat_frequency" not in description.missing:
        notes.append(
            f"more than {0.5 / usual:.4g} wingbeats a second (half the frame rate) cannot be told from fewer: "
            "beat_alias is the other possible frequency"
        )
    return notes


def write_described(
    exported: Exported, described: Described, out: Path, overwrite: bool = False, progress: ProgressTask = silent
) -> Written:
    """Write features, bouts, time budgets, an ethogram and a project for BORIS; each file completely or not at all.

    Args:
        exported: the tracks and frames that are described.
        described: what these birds do in these frames.
        out: file of the features, .csv, .parquet or .nc. The other files stand beside it.
        overwrite: replace existing files, and remove those of an earlier run that this run does not write.
        progress: reports files.

    Returns:
        The files: without an ethogram, that of the features only.

    Raises:
        InputError: a file exists or cannot be written, or a package for its format is missing.
    """
    check_outputs(out, overwrite)
    paths, description, ethogram, shown = output_paths(out), described.description, described.ethogram, described.shown
    files: dict[Path, Callable[[], bytes]] = {out: lambda: features_file(out, exported, description, ethogram)}
    if ethogram is not None and shown is not None:
        bouts = bout_columns(exported, description, ethogram, described.config)
        files[paths["bouts"]] = lambda: csv_table(bouts, {})
        files[paths["budget"]] = lambda: csv_table(budget_columns(described.budget), {})
        files[paths["ethogram"]] = lambda: shown.svg(f"Birds of {exported.source.name}").encode()
        files[paths["boris"]] = lambda: boris_project(exported, ethogram, described.config)
    with progress("Writing tables", len(files)) as report_progress:
        for path, content in files.items():
            write_whole(path, content())
            report_progress(1, path.name)
    removed = [path for path in paths.values() if overwrite and path not in files and path.is_file()]
    for path in removed:
        with write_errors(path):
            path.unlink()
    return Written(list(files), removed)


def output_paths(out: Path) -> dict[str, Path]:
    """Return the paths of the files beside the features: `birds_bouts.csv` and others of `birds.csv`."""
    return {
        "bouts": out.with_name(f"{out.stem}_bouts.csv"),
        "budget": out.with_name(f"{out.stem}_budget.csv"),
        "ethogram": out.with_name(f"{out.stem}_ethogram.svg"),
        "boris": out.with_name(f"{out.stem}.boris"),
    }


def check_outputs(out: Path, overwrite: bool) -> None:
    """Raise InputError if an output exists, cannot be written or has no known format; before the long work."""
    if out.suffix.lower() not in (".csv", ".parquet", ".nc"):
        raise InputError(out, "must end with .csv, .parquet or .nc", "choose another --out")
    for path in (out, *output_paths(out).values()):
        check_new_file(path, overwrite)
    check_writable(out)
    for package in {".parquet": ("pyarrow",), ".nc": ("xarray", "h5netcdf")}.get(out.suffix.lower(), ()):
        require_package(package, f"{out.suffix.lower()} files")
