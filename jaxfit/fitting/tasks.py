"""Tasks of a fit: some windows under some configs, and their distribution over processes.

The result of a window does not depend on the other windows of its task, so tasks of any size give the same result.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfit.config.fit import FitConfig, InitialiseConfig
from jaxfit.fitting.batch import Batch, FittedWindow, fit_batch, frames_per_batch
from jaxfit.fitting.bodies import Body, estimate_bodies, stages_of_pass, windows_of_bodies
from jaxfit.fitting.initial_poses import search_initial_poses
from jaxfit.fitting.solve import FitModel, needs_mask
from jaxfit.fitting.stored_windows import StoredWindows, windows_per_part
from jaxfit.fitting.tiles import tile_size
from jaxfit.fitting.windows import Windows, load_targets, windows_key
from jaxfit.foundation.progress import ProgressTask, ReportProgress
from jaxfit.foundation.workers import Cluster, FailedTask
from jaxfit.model.kinematics import Pose, rest_pose

_logger = logging.getLogger(__name__)


class Start(NamedTuple):
    """The start of the stages with a given body, for one window."""

    pose: Pose
    """The optimum of the stages before, with the bone lengths and the shape of the body."""
    ambiguity_deg: Float[np.ndarray, "T"]
    body_covariance: Float[np.ndarray, "P P"]
    keypoint_scale: Float[np.ndarray, ""]

    @property
    def content(self) -> bytes:
        """The content that determines the result, beside the window and the config."""
        return b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves((self.pose, *self[2:])))


class FitTask(NamedTuple):
    """Some problems of a fit, with their windows. A problem is one window under one config (a run)."""

    configs: list[FitConfig]
    """The config of each run."""
    windows: list[Windows]
    """The windows of each run; runs with an equal `windows_key` have the same windows."""
    problems: list[tuple[int, int]]
    """Run and row of the window in the windows of the run."""
    starts: Mapping[tuple[int, int], Start] | None = None
    """The start of each problem with a given body; None before the bodies are known."""
    tells_body: bool = True
    """Whether the bodies are estimated from these problems."""

    @property
    def stages(self) -> range:
        """Positions of the stages that run."""
        return stages_of_pass(self.configs[0], self.starts is not None, self.tells_body)

    def part(self, problems: Sequence[tuple[int, int]]) -> FitTask:
        """Return some problems, with only the windows that they need.

        Runs with an equal `windows_key` keep the same rows of windows, because `_prepare_rows` shares these rows.
        """
        keys = [windows_key(config) for config in self.configs]
        needed: dict[Hashable, set[int]] = {key: set() for key in keys}
        for r, w in problems:
            needed[keys[r]].add(w)
        rows = [sorted(needed[key]) for key in keys]
        windows = [all_windows[np.array(some, int)] for all_windows, some in zip(self.windows, rows, strict=True)]
        own = [(r, rows[r].index(w)) for r, w in problems]
        starts = None
        if self.starts is not None:
            starts = {new: self.starts[old] for new, old in zip(own, problems, strict=True)}
        return FitTask(self.configs, windows, own, starts, self.tells_body)


def _no_report(_steps: float, _note: str) -> None:
    """Report nothing, as in a worker process."""


def fit_task(model: FitModel, task: FitTask, report_progress: ReportProgress = _no_report) -> list[FittedWindow]:
    """Fit the problems of a task.

    Args:
        model: the model and initial poses of the fit.
        task: the problems.
        report_progress: called with the number of new steps.

    Returns:
        The result of every problem.
    """
    fitted = fit_batch(model, task.configs, gather_batch(model, task), report_progress)
    loss = {name: values.tolist() for name, values in fitted.loss.items()}
    windows = []
    for i in range(len(task.problems)):
        # copies, so that a window does not keep the arrays of its batch
        window = jax.tree.map(lambda x, i=i: np.array(x[i]), fitted._replace(loss={}, failure=None))
        failure = fitted.failure[i]
        if not failure and not (window.pose.scale > 0).all():  # a solver may step across 0
            failure = "the size of the bird is not above 0"
        losses = {name: values[i] for name, values in loss.items()}
        windows.append(window._replace(loss=losses, failure=failure))
    return windows


def failed_windows(model: FitModel, config: FitConfig, count: int, failure: str) -> list[FittedWindow]:
    """Return the results of windows that could not be computed."""

    def nothing(*shape: int) -> np.ndarray:
        return np.full(shape, np.nan, np.float32)

    T, K = config.window, model.bird.num_keypoints
    pose = jax.tree.map(lambda x: nothing(*np.shape(x)), rest_pose(model.bird, T, config.common_size))
    loss = dict.fromkeys(sorted(config.stages[-1].terms), float("nan"))
    return [FittedWindow(pose, loss, nothing(T, K, 3), nothing(T, K, 2), failure, nothing(T))] * count


def initial_poses_of(windows: Windows, config: FitConfig, model: FitModel) -> Pose:
    """Return the initial poses of some windows from the file of the fit, or by a search; leading axes W, H.

    Windows with `all_orientations` have the best of all orientations, and last the best seen from above.
    """
    if model.initial_poses is not None:
        return model.initial_poses.window_poses(model.bird, windows, config.common_size)

    def search(some: Windows, how: InitialiseConfig) -> Pose:
        detections = some.keypoints_px, some.confidence
        return search_initial_poses(model.bird, model.rig, *detections, how, model.camera, config.common_size)

    how = config.initialise
    if how.method != "auto":
        return search(windows, how)
    poses = search(windows, replace(how, method="viewing_axis"))
    if windows.all_orientations is None or not windows.all_orientations.any():
        return poses
    rows = np.flatnonzero(windows.all_orientations)
    found = search(windows[rows], replace(how, method="so3", hypotheses=max(how.hypotheses - 1, 1)))

    def chosen(above: Array, around: Array) -> np.ndarray:
        result = np.array(above)
        result[rows] = np.concatenate([around, result[rows, :1]], axis=1)[:, : how.hypotheses]
        return result

    return jax.tree.map(chosen, poses, found)


def gather_batch(model: FitModel, task: FitTask) -> Batch:
    """Return the batch of the problems of a task."""
    mask_px = task.configs[0].crop.size_px if any(map(needs_mask, task.configs[0].stages)) else 0

    def pose_key(r: int) -> Hashable:
        """Return what determines the windows of a run and their initial poses."""
        config, around = task.configs[r], task.windows[r].all_orientations
        return *windows_key(config), config.initialise, config.common_size, None if around is None else around.tobytes()

    targets, targets_row = _prepare_rows(
        task, lambda r: windows_key(task.configs[r]), lambda windows, _: load_targets(windows, mask_px)
    )
    runs = np.array([r for r, _ in task.problems])
    if task.starts is not None:
        starts = [task.starts[problem] for problem in task.problems]
        pose, ambiguity_deg, *of_bodies = jax.tree.map(lambda *x: np.stack(x), *starts)
        pose = jax.tree.map(lambda x: x[:, None], pose)  # one hypothesis
        return Batch(targets, pose, runs, targets_row, np.arange(len(starts)), ambiguity_deg, *of_bodies)
    poses, pose_row = _prepare_rows(task, pose_key, lambda windows, config: initial_poses_of(windows, config, model))
    return Batch(targets, poses, runs, targets_row, pose_row, tells_body=task.tells_body)


def _prepare_rows(
    task: FitTask, key_of: Callable[[int], Hashable], prepare: Callable[[Windows, FitConfig], Any]
) -> tuple[Any, Int[np.ndarray, "B"]]:
    """Prepare the windows of the B problems of a task. Runs with an equal key share the rows of their windows.

    Args:
        task: the problems.
        key_of: returns what determines the result of `prepare` for a run.
        prepare: takes some windows and a config, and returns a pytree with one row for each window.

    Returns:
        The concatenated pytrees of all keys, and the row of each problem in them.
    """
    pairs = [(key_of(r), w) for r, w in task.problems]
    run_of = {key: r for (key, _), (r, _) in zip(pairs, task.problems, strict=True)}
    prepared: list[Any] = []
    row: dict[tuple[Hashable, int], int] = {}
    for key, r in run_of.items():
        windows = list(dict.fromkeys(w for other, w in pairs if other == key))
        row |= {(key, w): len(row) + i for i, w in enumerate(windows)}
        prepared.append(prepare(task.windows[r][np.array(windows)], task.configs[r]))
    return jax.tree.map(lambda *x: np.concatenate(x), *prepared), np.array([row[pair] for pair in pairs])


def _in_batches(
    task: FitTask, model: FitModel, birds: int, is_stored: bool, has_workers: bool
) -> list[list[tuple[int, int]]]:
    """Divide the problems of a fit into batches."""
    config, views = task.configs[0], task.windows[0].has_mask.shape[2:]
    frames = frames_per_batch(model.bird, config) // (views[0] if views else 1)
    size = max(min(frames // config.window, len(task.problems)), 1)

    def time(problem: tuple[int, int]) -> tuple[int, tuple[int, int]]:
        r, w = problem
        return int(task.windows[r].frame[w].max()), (w, r)

    # by time, because masks of a frame lie together in files; problems of one window share their initial poses
    ordered = sorted(task.problems, key=time)
    if has_workers:  # a small task costs little if its worker ends
        size = min(size, tile_size(config.window) * len(task.configs))
    if is_stored:  # an interruption costs one batch
        size = min(size, windows_per_part(birds, config.window))
    return [ordered[first : first + size] for first in range(0, len(ordered), size)]


class Fitted(NamedTuple):
    """The results of a fit."""

    windows: dict[tuple[int, int], FittedWindow]
    """The result of every problem."""
    bodies: list[dict[int, Body]]
    """For each run: track → its body; empty if no stage of the config shares a body."""


def fit_windows(
    task: FitTask,
    model: FitModel,
    birds: int,
    subject: str,
    progress: ProgressTask,
    stored: StoredWindows | None = None,
    cluster: Cluster | None = None,
    known: Mapping[int, Body] | None = None,
    species: Int[np.ndarray, "N"] | None = None,
) -> Fitted:
    """Fit the problems of a fit in batches, with progress, and store the windows of every batch when they are fitted.

    If a stage shares the body, the windows are fitted up to this stage, the bodies are estimated, and the windows are
    fitted with the later stages. Only `windows_of_bodies` run the stage itself.

    Args:
        task: all problems.
        model: the model of the fit.
        birds: number of tracks.
        subject: what is fitted, for people.
        progress: shows progress.
        stored: the store of fitted windows, which are not fitted again, or None. Only for one config.
        cluster: worker processes; None: this process.
        known: position of a track → its body, which is used and not estimated.
        species: number of the species of each track; None for one species.

    Returns:
        The results. A window whose task failed on the workers is not stored.
    """

    def run(task: FitTask, subject: str) -> dict[tuple[int, int], FittedWindow]:
        return _fit_pass(task, model, birds, subject, progress, stored, cluster)

    telling = [windows_of_bodies(of_run.track, c) for of_run, c in zip(task.windows, task.configs, strict=True)]
    first = task._replace(problems=[(r, w) for r, w in task.problems if telling[r][w]])
    others = task._replace(problems=[(r, w) for r, w in task.problems if not telling[r][w]], tells_body=False)
    windows = run(first, subject)
    if others.problems:
        windows |= run(others, f"other windows of {subject}")
    if task.configs[0].body_stage is None:
        return Fitted(windows, [{} for _ in task.configs])
    bodies, starts = [], {}
    for r, (config, of_run) in enumerate(zip(task.configs, task.windows, strict=True)):
        rows = [w for run, w in task.problems if run == r]
        evidence = [None if windows[r, w].failure else windows[r, w].body for w in rows]
        bodies.append(estimate_bodies(of_run.track[rows], evidence, model, config, species) | dict(known or {}))
        for w in rows:
            fitted, body = windows.pop((r, w)), bodies[r][int(of_run.track[w])]
            if fitted.failure:  # no later stage: the loss has the terms of the last stage
                loss = dict.fromkeys(sorted(config.stages[-1].terms), float("nan"))
                windows[r, w] = fitted._replace(loss=loss, body=None)
                continue
            betas = body.betas[: len(fitted.pose.betas)]  # none for a fit without shape coefficients
            pose = replace(fitted.pose, bone_length=body.bone_length, betas=np.concatenate([betas, body.offsets]))
            starts[r, w] = Start(pose, fitted.ambiguity_deg, body.covariance, np.array(body.keypoint_scale, np.float32))
    if starts:
        second = task._replace(problems=[problem for problem in task.problems if problem in starts], starts=starts)
        windows |= run(second, f"{subject} with their bodies")
    return Fitted(windows, bodies)


def _fit_pass(
    task: FitTask,
    model: FitModel,
    birds: int,
    subject: str,
    progress: ProgressTask,
    stored: StoredWindows | None,
    cluster: Cluster | None,
) -> dict[tuple[int, int], FittedWindow]:
    """Fit the problems of one pass: before the bodies are known, or with given bodies."""
    config, results, contents = task.configs[0], {}, {}
    if stored is not None:
        own = {w: b"" if task.starts is None else task.starts[r, w].content for r, w in task.problems}
        contents = {w: bytes(task.stages) + content for w, content in own.items()}
        results = {(0, w): window for w, window in stored.find(task.windows[0], contents).items()}
        task = task._replace(problems=[problem for problem in task.problems if problem not in results])
    batches = _in_batches(task, model, birds, stored is not None, cluster is not None)
    _logger.info("%s, %d windows of %d frames, %d batches", subject, len(task.problems), config.window, len(batches))
    steps = sum(config.stages[i].steps for i in task.stages)
    with progress(f"Fitting {subject}", steps * len(batches)) as report_progress:
        parts = (task.part(batch) for batch in batches)
        fitted = _fit_here(parts, model, report_progress)
        if cluster is not None:
            report_progress(0, "starting workers")
            fitted = cluster.run(fit_task, model, parts)
        for i, windows in fitted:  # in the order of arrival
            if cluster is not None:
                report_progress(steps, "on workers")
            if isinstance(windows, FailedTask):
                windows = failed_windows(model, config, len(batches[i]), f"not computed: {windows.reason}")
            elif stored is not None:
                new = {w: window for (_, w), window in zip(batches[i], windows, strict=True)}
                stored.add(task.windows[0], new, contents)
                report_progress(0, "")
            results |= dict(zip(batches[i], windows, strict=True))
    return results


def _fit_here(
    parts: Iterable[FitTask], model: FitModel, report_progress: ReportProgress
) -> Iterator[tuple[int, list[FittedWindow]]]:
    """Fit tasks in this process. Yield number and results of every task."""
    for i, part in enumerate(parts):
        report_progress(0, "initial poses")
        yield i, fit_task(model, part, report_progress)
