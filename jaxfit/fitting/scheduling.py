"""The problems of a fit in batches, computed in this process or on workers; fitted windows are stored."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from jaxfit.config.fit import FitConfig
from jaxfit.fitting.batch import frames_per_batch
from jaxfit.fitting.collect import FittedWindow
from jaxfit.fitting.stored_windows import StoredWindows, windows_per_part
from jaxfit.fitting.tasks import FitShared, FitTask, Run, cut_task, failed_windows, fit_task
from jaxfit.fitting.tiles import tile_size
from jaxfit.progress import ReportProgress
from jaxfit.workers.cluster import Cluster, FailedTask

__all__ = ["fit_batches", "in_batches", "steps_per_batch"]


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
