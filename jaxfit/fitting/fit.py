"""The whole fit, from observations and a bird model to poses.

The data passes each step once: observations → windows → targets and initial poses → stages → solution.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from jaxfit.config.fit import FitConfig
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution
from jaxfit.errors import InputError
from jaxfit.fitting.batch import Batch, fit_batch, frames_per_batch
from jaxfit.fitting.collect import FittedWindow, collect_windows, window_of_batch
from jaxfit.fitting.diagnose import check_terms
from jaxfit.fitting.distant import distant_birds, report_distant_birds
from jaxfit.fitting.initial_pose_file import InitialPoses
from jaxfit.fitting.initial_pose_search import search_initial_poses
from jaxfit.fitting.memory import check_fit_memory
from jaxfit.fitting.seams import blend_seams
from jaxfit.fitting.stages import FitModel, compiled_part, fit_model, needs_mask, without_mask_stages
from jaxfit.fitting.stored_windows import StoredWindows, windows_per_part
from jaxfit.fitting.windows import Windows, cut_windows, load_targets, windows_key
from jaxfit.model.bird import Bird
from jaxfit.model.pose import Pose
from jaxfit.progress import ProgressTask, silent

__all__ = ["check_observations", "fit", "fit_runs", "initial_poses_of", "windows_of"]

_logger = logging.getLogger(__name__)


def fit(
    observations: Observations,
    bird: Bird,
    config: FitConfig,
    initial_poses: InitialPoses | None = None,
    progress: ProgressTask = silent,
    source: object = "observations",
    stored: StoredWindows | None = None,
) -> Solution:
    """Fit the poses of all birds of a video (or of a set of photographs).

    Args:
        observations: keypoints and masks. The keypoints must have the names of the model's keypoints, in any order.
        bird: the model.
        config: the config of the fit.
        initial_poses: initial poses from a file. None: a search with the settings `config.initialise`.
        progress: shows progress.
        source: name of the observations in error messages.
        stored: receives every fitted window, and holds the windows of an interrupted fit, which are not fitted again.

    Returns:
        The poses, and the status of every track: `ok`, `partly diverged`, `diverged` or `no usable frame`.

    Raises:
        InputError: no bird, other keypoints than the model's, no track with a usable frame, unusable crop settings, an
            unusable term, initial poses that do not match the windows, or a fit that needs too much memory.
    """
    return fit_runs(observations, bird, [config], initial_poses, progress, source, stored=stored)[0]


def fit_runs(
    observations: Observations,
    bird: Bird,
    configs: Sequence[FitConfig],
    initial_poses: InitialPoses | None = None,
    progress: ProgressTask = silent,
    source: object = "observations",
    select: Int[np.ndarray, "rows"] | None = None,
    stored: StoredWindows | None = None,
) -> list[Solution]:
    """Fit the same birds under several configs at once, with one compiled program.

    Args:
        configs: configs with an equal `stages.compiled_part`.
        select: rows of the windows (`windows_of`) that are fitted; None fits all. Other windows have no valid pose.
        observations, bird, initial_poses, progress, source, stored: as for `fit`; `stored` is for one config.

    Returns:
        The solution of every config.

    Raises:
        InputError: as for `fit`.
        ValueError: the configs need different programs.
    """
    observations = check_observations(observations, bird, source)
    skipped = report_distant_birds(observations, source)
    if not observations.masks:
        configs = _without_mask_stages(configs, source)
    if any(compiled_part(config) != compiled_part(configs[0]) for config in configs):
        allowed = "weights, settings, step sizes and the preparation of the data"
        raise ValueError(f"configs: expected configs that share one compiled program and differ only in {allowed}")
    check_fit_memory(observations, bird, configs, source)
    model = fit_model(_fitted_bird(bird, configs[0], initial_poses), configs[0])
    check_terms(configs[0], model)
    runs = _cut_runs(observations, configs, initial_poses, source)
    if select is not None:
        runs = [run._replace(windows=run.windows[select]) for run in runs]
    prepare_poses = partial(_initial_poses, model, initial_poses)
    # each problem is one window of one run
    problems = [(r, w) for r, run in enumerate(runs) for w in range(len(run.windows))]
    results = {} if stored is None else {(0, w): result for w, result in stored.find(runs[0].windows).items()}
    missing = [problem for problem in problems if problem not in results]
    size = max(min(frames_per_batch(bird, configs[0]) // configs[0].window, len(problems)), 1)
    if stored is not None:
        # from the first frame on, because an interruption costs one batch
        missing.sort(key=lambda problem: runs[0].windows.frame[problem[1], 0])
        size = min(size, windows_per_part(observations.num_tracks, configs[0].window))
    batches = [missing[first : first + size] for first in range(0, len(missing), size)]
    birds = len(np.unique(runs[0].windows.track))
    subject = f"{birds} {'bird' if birds == 1 else 'birds'}" + (f" × {len(configs)} runs" if len(configs) > 1 else "")
    _logger.info("%s, %d windows of %d frames, %d batches", subject, len(problems), configs[0].window, len(batches))
    steps = sum(stage.steps for stage in configs[0].stages)
    with progress(f"Fitting {subject}", steps * len(batches)) as report_progress:
        for batch in batches:
            report_progress(0, "initial poses")
            fitted = fit_batch(model, configs, _gather(runs, batch, prepare_poses), report_progress)
            results |= {problem: window_of_batch(fitted, i) for i, problem in enumerate(batch)}
            if stored is not None:
                stored.add(runs[0].windows, {w: results[0, w] for _, w in batch})
    return [
        collect_windows(observations, run.windows, _final_results(r, run, results, model), bird, model.camera, skipped)
        for r, run in enumerate(runs)
    ]


def _final_results(
    r: int, run: _Run, results: Mapping[tuple[int, int], FittedWindow], model: FitModel
) -> list[FittedWindow]:
    """Return the result of every window of run `r`, blended where windows share frames."""
    own = [results[r, w] for w in range(len(run.windows))]
    return blend_seams(run.windows, own, model) if run.config.overlap else own


def _without_mask_stages(configs: Sequence[FitConfig], source: object) -> list[FitConfig]:
    """Return the configs without the stages that compare masks, and report these stages once."""
    left = [without_mask_stages(config) for config in configs]
    skipped = [stage.name for stage in configs[0].stages if needs_mask(stage)]
    if skipped:
        how = "are skipped" if len(left[0].stages) < len(configs[0].stages) else "run without their mask terms"
        _logger.warning("%s: no masks, so the stages that compare masks %s: %s", source, how, ", ".join(skipped))
    return left


def check_observations(observations: Observations, bird: Bird, source: object) -> Observations:
    """Return the observations with their keypoints in the order of the model.

    Raises:
        InputError: no bird, or other keypoints than the model's.
    """
    if not observations.num_tracks:
        raise InputError(source, "holds no bird", "use other footage, or another network")
    return check_keypoints(observations, bird.keypoint_names, source)


def windows_of(observations: Observations, config: FitConfig, source: object) -> Windows:
    """Return the windows of a fit.

    Raises:
        InputError: no track with a usable frame, or unusable crop settings.
    """
    windows = cut_windows(observations, config)
    if len(windows) == 0 and distant_birds(observations).any():
        problem = "no track has a usable frame: boxes or keypoints lie far outside their images"
        raise InputError(source, problem, "give positions in image pixels")
    if len(windows) == 0:
        raise InputError(
            source,
            f"no track has a frame with {config.min_keypoints} confident keypoints",
            "detect more keypoints, or lower min_keypoints in the config",
        )
    return windows


class _Run(NamedTuple):
    """One config, with all windows of the video."""

    config: FitConfig
    windows: Windows


def _cut_runs(
    observations: Observations, configs: Sequence[FitConfig], initial_poses: InitialPoses | None, source: object
) -> list[_Run]:
    """Return the run of each config. Runs with an equal `windows_key` share their windows."""
    windows: dict[Hashable, Windows] = {}
    for config in configs:
        key = windows_key(config)
        if key not in windows:
            windows[key] = windows_of(observations, config, source)
            if initial_poses is not None:
                if config.overlap and initial_poses.crop is not None:
                    problem = "holds one crop for every frame, but windows that share a frame have two"
                    raise InputError(
                        initial_poses.source, problem, "set `overlap: 0` in the config, or leave out --init"
                    )
                initial_poses.check_crops(windows[key])
    return [_Run(config, windows[windows_key(config)]) for config in configs]


def _initial_poses(model: FitModel, initial_poses: InitialPoses | None, run: _Run, windows: Windows) -> Pose:
    """Return the initial poses of some windows of a run, with leading axes W, H (hypotheses)."""
    if initial_poses is not None:
        return initial_poses.window_poses(model.bird, windows, run.config.common_size)
    return initial_poses_of(windows, run.config, model)


def initial_poses_of(windows: Windows, config: FitConfig, model: FitModel) -> Pose:
    """Search the initial poses of some windows as `config.initialise` says; leading axes W, H (hypotheses)."""
    return search_initial_poses(
        model.bird,
        model.rig,
        jnp.asarray(windows.keypoints_px),
        jnp.asarray(windows.confidence),
        config.initialise,
        model.camera,
        config.common_size,
    )


def _pose_key(config: FitConfig) -> Hashable:
    """Return the part of the config that determines the windows and their initial poses."""
    return *windows_key(config), config.initialise, config.common_size


def _gather(
    runs: Sequence[_Run], problems: Sequence[tuple[int, int]], prepare_poses: Callable[[_Run, Windows], Pose]
) -> Batch:
    """Return a batch of some problems (run, window)."""
    config = runs[0].config
    mask_px = config.crop.size_px if any(needs_mask(stage) for stage in config.stages) else 0
    targets, targets_row = _prepare_rows(runs, problems, windows_key, lambda _, windows: load_targets(windows, mask_px))
    poses, pose_row = _prepare_rows(runs, problems, _pose_key, prepare_poses)
    return Batch(
        targets=jax.tree.map(lambda *x: np.concatenate(x), *targets),
        initial_pose=jax.tree.map(lambda *x: jnp.concatenate(x), *poses),
        config=np.array([r for r, _ in problems]),
        targets_row=targets_row,
        pose_row=pose_row,
    )


def _prepare_rows(
    runs: Sequence[_Run],
    problems: Sequence[tuple[int, int]],
    key_of: Callable[[FitConfig], Hashable],
    prepare: Callable[[_Run, Windows], Any],
) -> tuple[list[Any], Int[np.ndarray, "B"]]:
    """Prepare the windows of some problems (run, window). Runs with an equal key share the rows of their windows.

    Args:
        runs: all runs.
        problems: B pairs of run and window.
        key_of: returns the part of a config that determines the result of `prepare`.
        prepare: takes a run and some of its windows, and returns a pytree with one row for each window.

    Returns:
        The pytree of every key, and the row of each problem in their concatenation.
    """
    pairs = [(key_of(runs[r].config), w) for r, w in problems]
    run_of = {key: runs[r] for (key, _), (r, _) in zip(pairs, problems, strict=True)}
    prepared: list[Any] = []
    row: dict[tuple[Hashable, int], int] = {}
    for key, run in run_of.items():
        windows = list(dict.fromkeys(w for other, w in pairs if other == key))
        row |= {(key, w): len(row) + i for i, w in enumerate(windows)}
        prepared.append(prepare(run, run.windows[np.array(windows)]))
    return prepared, np.array([row[pair] for pair in pairs])


def _fitted_bird(bird: Bird, config: FitConfig, initial_poses: InitialPoses | None) -> Bird:
    """Return the bird, without its shape directions if no stage and no initial pose uses the directions.

    Unused shape directions only cost time.
    """
    if any("betas" in stage.optimised for stage in config.stages):
        return bird
    if initial_poses is not None and initial_poses.has_shape:
        return bird
    return eqx.tree_at(
        lambda b: (b.shape_basis, b.shape_variance), bird, (bird.shape_basis[:0], bird.shape_variance[:0])
    )
