"""Tasks of a fit: some windows under some configs, and their distribution over processes.

The result of a window does not depend on the other windows of its task, so tasks of any size give the same result.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from jaxfit.config.fit import FitConfig
from jaxfit.fitting.batch import Batch, fit_batch, frames_per_batch, tile_size
from jaxfit.fitting.collect import FittedWindow, window_of_batch
from jaxfit.fitting.initial_poses import InitialPoses, search_initial_poses
from jaxfit.fitting.solve import FitModel, needs_mask
from jaxfit.fitting.stored_windows import StoredWindows, windows_per_part
from jaxfit.fitting.windows import Windows, load_targets, windows_key
from jaxfit.foundation.progress import ReportProgress
from jaxfit.foundation.workers import Cluster, FailedTask
from jaxfit.model.kinematics import Pose, rest_pose
from jaxfit.objective.posed_window import Targets


class Run(NamedTuple):
    """One config, with windows of the video."""

    config: FitConfig
    windows: Windows


class FitShared(NamedTuple):
    """The data that all tasks of a fit share."""

    model: FitModel
    initial_poses: InitialPoses | None
    """Initial poses of all tracks and frames, from a file. None: a search."""


class FitTask(NamedTuple):
    """Some problems of a fit, with their own data."""

    runs: list[Run]
    """The runs, with the windows of the problems only; runs with an equal `windows_key` have the same windows."""
    problems: list[tuple[int, int]]
    """Run and row of the window in the windows of the run."""


def _no_report(_steps: float, _note: str) -> None:
    """Report nothing, as in a worker process."""


def cut_task(runs: Sequence[Run], problems: Sequence[tuple[int, int]]) -> FitTask:
    """Return a task with the windows that some problems (run, window) need.

    Runs with an equal `windows_key` have the same rows of windows, because `_prepare_rows` shares these rows.
    """
    keys = [windows_key(run.config) for run in runs]
    wanted: dict[Hashable, set[int]] = {key: set() for key in keys}
    for r, w in problems:
        wanted[keys[r]].add(w)
    rows = [sorted(wanted[key]) for key in keys]
    cut = [run._replace(windows=run.windows[np.array(own, int)]) for run, own in zip(runs, rows, strict=True)]
    return FitTask(cut, [(r, rows[r].index(w)) for r, w in problems])


def fit_task(shared: FitShared, task: FitTask, report_progress: ReportProgress = _no_report) -> list[FittedWindow]:
    """Fit the problems of a task.

    Args:
        shared: the model and initial poses of the fit.
        task: the problems.
        report_progress: called with the number of new steps.

    Returns:
        The result of every problem.
    """
    batch = gather_batch(shared, task)
    fitted = fit_batch(shared.model, [run.config for run in task.runs], batch, report_progress)
    return [window_of_batch(fitted, i) for i in range(len(task.problems))]


def failed_windows(model: FitModel, config: FitConfig, count: int, failure: str) -> list[FittedWindow]:
    """Return the results of windows that could not be computed."""

    def nothing(*shape: int) -> np.ndarray:
        return np.full(shape, np.nan, np.float32)

    T, K = config.window, model.bird.num_keypoints
    pose = jax.tree.map(lambda x: nothing(*np.shape(x)), rest_pose(model.bird, T, config.common_size))
    loss = dict.fromkeys(sorted(config.stages[-1].terms), float("nan"))
    return [FittedWindow(pose, loss, nothing(T, K, 3), nothing(T, K, 2), failure, nothing(T))] * count


def initial_poses_of(windows: Windows, config: FitConfig, model: FitModel) -> Pose:
    """Search the initial poses of some windows as `config.initialise` says; leading axes W, H (hypotheses)."""
    return search_initial_poses(
        model.bird,
        model.rig,
        windows.keypoints_px,
        windows.confidence,
        config.initialise,
        model.camera,
        config.common_size,
    )


def _initial_poses(shared: FitShared, run: Run, windows: Windows) -> Pose:
    """Return the initial poses of some windows of a run, with leading axes W, H (hypotheses)."""
    if shared.initial_poses is not None:
        return shared.initial_poses.window_poses(shared.model.bird, windows, run.config.common_size)
    return initial_poses_of(windows, run.config, shared.model)


def _pose_key(config: FitConfig) -> Hashable:
    """Return the part of the config that determines the windows and their initial poses."""
    return *windows_key(config), config.initialise, config.common_size


def gather_batch(shared: FitShared, task: FitTask) -> Batch:
    """Return the batch of the problems of a task."""
    config = task.runs[0].config
    mask_px = config.crop.size_px if any(needs_mask(stage) for stage in config.stages) else 0

    def targets_of(run: Run, windows: Windows) -> Targets:
        return load_targets(windows, mask_px)

    targets, targets_row = _prepare_rows(task, windows_key, targets_of)
    poses, pose_row = _prepare_rows(task, _pose_key, partial(_initial_poses, shared))
    return Batch(
        targets=jax.tree.map(lambda *x: np.concatenate(x), *targets),
        initial_pose=jax.tree.map(lambda *x: np.concatenate(x), *poses),
        config=np.array([r for r, _ in task.problems]),
        targets_row=targets_row,
        pose_row=pose_row,
    )


def _prepare_rows(
    task: FitTask, key_of: Callable[[FitConfig], Hashable], prepare: Callable[[Run, Windows], Any]
) -> tuple[list[Any], Int[np.ndarray, "B"]]:
    """Prepare the windows of the B problems of a task. Runs with an equal key share the rows of their windows.

    Args:
        task: the problems.
        key_of: returns the part of a config that determines the result of `prepare`.
        prepare: takes a run and some of its windows, and returns a pytree with one row for each window.

    Returns:
        The pytree of every key, and the row of each problem in their concatenation.
    """
    pairs = [(key_of(task.runs[r].config), w) for r, w in task.problems]
    run_of = {key: task.runs[r] for (key, _), (r, _) in zip(pairs, task.problems, strict=True)}
    prepared: list[Any] = []
    row: dict[tuple[Hashable, int], int] = {}
    for key, run in run_of.items():
        windows = list(dict.fromkeys(w for other, w in pairs if other == key))
        row |= {(key, w): len(row) + i for i, w in enumerate(windows)}
        prepared.append(prepare(run, run.windows[np.array(windows)]))
    return prepared, np.array([row[pair] for pair in pairs])


def in_batches(
    problems: Sequence[tuple[int, int]],
    runs: Sequence[Run],
    shared: FitShared,
    birds: int,
    stored: StoredWindows | None,
    cluster: Cluster | None,
) -> list[list[tuple[int, int]]]:
    """Divide the problems (run, window) of a fit into batches.

    Args:
        problems: the problems.
        runs: the windows of every config.
        shared: the model of the fit.
        birds: number of tracks.
        stored: the store of fitted windows, or None.
        cluster: the workers, or None.
    """
    config = runs[0].config
    size = max(min(frames_per_batch(shared.model.bird, config) // config.window, len(problems)), 1)
    # by time, because masks of a frame lie together in files; problems of one window share their initial poses
    ordered = sorted(
        problems, key=lambda problem: (int(runs[problem[0]].windows.frame[problem[1]].max()), problem[::-1])
    )
    if cluster is not None:
        # a small task costs little if its worker ends
        size = min(size, tile_size(config.window) * len(runs))
    if stored is not None:
        # an interruption costs one batch
        size = min(size, windows_per_part(birds, config.window))
    return [ordered[first : first + size] for first in range(0, len(ordered), size)]


def steps_per_batch(config: FitConfig) -> int:
    """Return the number of steps that a fit reports for every batch."""
    return sum(stage.steps for stage in config.stages)


def fit_batches(
    batches: Sequence[list[tuple[int, int]]],
    runs: Sequence[Run],
    shared: FitShared,
    stored: StoredWindows | None,
    cluster: Cluster | None,
    report_progress: ReportProgress,
) -> dict[tuple[int, int], FittedWindow]:
    """Fit batches of problems, and store the windows of every batch when they are fitted.

    Args:
        batches: the result of `in_batches`.
        runs, shared, stored, cluster: as for `in_batches`.
        report_progress: called with the number of new steps, `steps_per_batch` for every batch.

    Returns:
        The result of every problem. A window whose task failed on the workers is not stored.
    """
    config, results = runs[0].config, {}
    tasks = (cut_task(runs, batch) for batch in batches)
    for i, windows in _fit_tasks(cluster, shared, tasks, steps_per_batch(config), report_progress):
        if isinstance(windows, FailedTask):
            windows = failed_windows(shared.model, config, len(batches[i]), f"not computed: {windows.reason}")
        elif stored is not None:
            stored.add(runs[0].windows, {w: window for (_, w), window in zip(batches[i], windows, strict=True)})
            report_progress(0, "")
        results |= dict(zip(batches[i], windows, strict=True))
    return results


def _fit_tasks(
    cluster: Cluster | None, shared: FitShared, tasks: Iterable[FitTask], steps: int, report_progress: ReportProgress
) -> Iterator[tuple[int, list[FittedWindow] | FailedTask]]:
    """Fit tasks in this process or on workers. Yield number and results of every task, in the order of arrival."""
    if cluster is None:
        for i, task in enumerate(tasks):
            report_progress(0, "initial poses")
            yield i, fit_task(shared, task, report_progress)
        return
    report_progress(0, "starting workers")
    for i, windows in cluster.run(fit_task, shared, tasks):
        report_progress(steps, "on workers")
        yield i, windows
