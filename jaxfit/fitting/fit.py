"""The whole fit: from observations and a bird to posed birds.

Data goes forward once: observations → windows → targets and initial poses → stages → solution.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxfit.config.fit import FitConfig
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution
from jaxfit.errors import InputError
from jaxfit.fitting.batch import Batch, fit_batch, frames_per_batch
from jaxfit.fitting.collect import FittedWindow, collect_windows, window_of_batch
from jaxfit.fitting.diagnose import check_terms
from jaxfit.fitting.initial_pose_file import InitialPoses
from jaxfit.fitting.initial_pose_search import search_initial_poses
from jaxfit.fitting.stages import FitModel, compiled_part, fit_model
from jaxfit.fitting.windows import Windows, cut_windows, load_targets, windows_key
from jaxfit.model.bird import Bird
from jaxfit.model.pose import Pose
from jaxfit.progress import ProgressTask, silent

__all__ = ["check_observations", "fit", "fit_runs", "windows_of"]

_logger = logging.getLogger(__name__)

T = TypeVar("T")


def fit(
    observations: Observations,
    bird: Bird,
    config: FitConfig,
    initial_poses: InitialPoses | None = None,
    progress: ProgressTask = silent,
    source: object = "observations",
) -> Solution:
    """Pose every bird of a video (or of a set of photographs).

    Args:
        observations: keypoints and masks; the keypoints must be those of the bird, in any order.
        bird: the model.
        config: the config of the fit.
        initial_poses: initial poses from a file; None: a search, as `config.initialise` says.
        progress: shows progress.
        source: name of the observations in error messages.

    Returns:
        The poses, and a status of every track: `ok`, `partly diverged`, `diverged` or `no usable frame`.

    Raises:
        InputError: no bird, keypoints that are not those of the model, no track with a usable frame, crops that cannot
            be made, a term that cannot be used.
    """
    return fit_runs(observations, bird, [config], initial_poses, progress, source)[0]


def fit_runs(
    observations: Observations,
    bird: Bird,
    configs: Sequence[FitConfig],
    initial_poses: InitialPoses | None = None,
    progress: ProgressTask = silent,
    source: object = "observations",
) -> list[Solution]:
    """Fit the same birds under several configs at once, as one compiled program.

    Args:
        configs: configs with an equal `stages.compiled_part`.
        observations, bird, initial_poses, progress, source: as for `fit`.

    Returns:
        The solution of every config.

    Raises:
        InputError: as `fit`.
        ValueError: configs that need different programs.
    """
    observations = check_observations(observations, bird, source)
    if any(compiled_part(config) != compiled_part(configs[0]) for config in configs):
        raise ValueError("configs must share one compiled program: they may differ in weights, settings, step sizes, …")
    model = fit_model(_fitted_bird(bird, configs[0], initial_poses), configs[0])
    check_terms(configs[0], model)
    runs = _runs(observations, configs, model, initial_poses, source)
    # every problem is one window of one run
    problems = [(r, w) for r, run in enumerate(runs) for w in range(len(run.windows))]
    size = min(max(frames_per_batch(bird, configs[0]) // configs[0].window, 1), len(problems))
    batches = [problems[first : first + size] for first in range(0, len(problems), size)]
    birds = len(np.unique(runs[0].windows.track))
    what = f"{birds} {'bird' if birds == 1 else 'birds'}" + (f" × {len(configs)} runs" if len(configs) > 1 else "")
    _logger.info("%s, %d windows of %d frames, %d batches", what, len(problems), configs[0].window, len(batches))
    steps = sum(stage.steps for stage in configs[0].stages)
    results: list[list[FittedWindow]] = [[] for _ in runs]
    with progress(f"Fitting {what}", steps * len(batches)) as report_progress:
        for batch in batches:
            report_progress(0, "initial poses")
            fitted = fit_batch(model, configs, _gather(runs, batch, size), report_progress)
            for i, (r, _) in enumerate(batch):
                results[r].append(window_of_batch(fitted, i))
    return [
        collect_windows(observations, run.windows, result, bird, model.camera)
        for run, result in zip(runs, results, strict=True)
    ]


def check_observations(observations: Observations, bird: Bird, source: object) -> Observations:
    """Return the observations with their keypoints in the order of the model.

    Raises:
        InputError: no bird, or keypoints that are not those of the model.
    """
    if not observations.num_tracks:
        raise InputError(source, "holds no bird", "look for birds in other footage, or with another network")
    return check_keypoints(observations, bird.keypoint_names, source)


def windows_of(observations: Observations, config: FitConfig, source: object) -> Windows:
    """Return the windows of a fit.

    Raises:
        InputError: no track with a usable frame, or crops that cannot be made.
    """
    windows = cut_windows(observations, config)
    if len(windows) == 0:
        raise InputError(
            source,
            f"no track has a frame with {config.min_keypoints} confident keypoints",
            "detect more keypoints, or lower min_keypoints in the config",
        )
    return windows


class _Run(NamedTuple):
    """One config, with all windows of the video. Runs with equal keys share windows, targets and initial poses."""

    windows: Windows
    windows_key: Hashable
    initial_pose: Callable[[Windows], Pose]
    """Some of the windows → their initial poses, with leading axes W, H (hypotheses)."""
    pose_key: Hashable
    mask_px: int


def _runs(
    observations: Observations,
    configs: Sequence[FitConfig],
    model: FitModel,
    initial_poses: InitialPoses | None,
    source: object,
) -> list[_Run]:
    windows: dict[Hashable, Windows] = {}
    runs = []
    for config in configs:
        key = windows_key(config)
        if key not in windows:
            windows[key] = windows_of(observations, config, source)
            if initial_poses is not None:
                initial_poses.check_crops(windows[key])

        def initial_pose(some: Windows, config: FitConfig = config) -> Pose:
            if initial_poses is not None:
                return initial_poses.window_poses(model.bird, some, config.common_size)
            return search_initial_poses(
                model.bird,
                model.rig,
                jnp.asarray(some.keypoints_px),
                jnp.asarray(some.confidence),
                config.initialise,
                model.camera,
                config.common_size,
            )

        pose_key = (*key, config.initialise, config.common_size)
        runs.append(_Run(windows[key], key, initial_pose, pose_key, config.crop.size_px))
    return runs


def _gather(runs: Sequence[_Run], problems: Sequence[tuple[int, int]], size: int) -> Batch:
    """Return a batch of some problems (run, window). What runs share is loaded and computed once.

    Every batch has `size` problems, so that one compiled program serves all. A short batch is filled with copies, whose
    initial poses have rows of their own so that they are computed and not merged.
    """
    loaded: list[Any] = []
    poses: list[Pose] = []
    targets_row: dict[Hashable, int] = {}
    pose_row: dict[Hashable, int] = {}
    config, to_targets, to_pose = [], [], []
    for r in dict.fromkeys(r for r, _ in problems):
        run, rows = runs[r], [w for other, w in problems if other == r]
        if new := _new_rows(targets_row, run.windows_key, rows):
            loaded.append(load_targets(run.windows[np.array(new)], run.mask_px))
        if new := _new_rows(pose_row, run.pose_key, rows):
            poses.append(run.initial_pose(run.windows[np.array(new)]))
        config += [r] * len(rows)
        to_targets += [targets_row[run.windows_key, w] for w in rows]
        to_pose += [pose_row[run.pose_key, w] for w in rows]
    copied = np.arange(size - len(config)) % len(config)
    initial_pose = jax.tree.map(lambda *x: jnp.concatenate(x), *poses)
    source_rows = np.concatenate([np.arange(len(pose_row)), np.array(to_pose)[copied]]).astype(int)
    all_rows = np.concatenate([np.arange(len(config)), copied]).astype(int)
    return Batch(
        targets=jax.tree.map(lambda *x: np.concatenate(x), *loaded),
        initial_pose=jax.tree.map(lambda x: x[source_rows], initial_pose),
        config=np.array(config)[all_rows],
        targets_row=np.array(to_targets)[all_rows],
        pose_row=np.concatenate([to_pose, len(pose_row) + np.arange(len(copied))]).astype(int),
    )


def _new_rows(rows: dict[Hashable, int], key: Hashable, windows: Sequence[int]) -> list[int]:
    """Give the next rows to those windows that have none; return these windows."""
    new = [w for w in windows if (key, w) not in rows]
    rows |= {(key, w): len(rows) + i for i, w in enumerate(new)}
    return new


def _fitted_bird(bird: Bird, config: FitConfig, initial_poses: InitialPoses | None) -> Bird:
    """The bird without its shape directions where no stage and no initial pose uses them: they would only cost time."""
    if any("betas" in stage.optimised for stage in config.stages):
        return bird
    if initial_poses is not None and initial_poses.has_shape:
        return bird
    return eqx.tree_at(
        lambda b: (b.shape_basis, b.shape_variance), bird, (bird.shape_basis[:0], bird.shape_variance[:0])
    )
