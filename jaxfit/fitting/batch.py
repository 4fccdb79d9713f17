"""All stages of a batch of problems; hypotheses and failures.

Between two stages, equal problems are one row (`Hypotheses`): problems of several configs are computed once until a
stage gives them different hyperparameters.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial.transform import Rotation

from jaxfit.config.fit import FitConfig, StageConfig
from jaxfit.fitting.diagnose import name_failures
from jaxfit.fitting.error_bars import ErrorBars, window_error_bars
from jaxfit.fitting.posterior import with_shared
from jaxfit.fitting.problem import Hyperparameters, Problem, Program
from jaxfit.fitting.solve import (
    FitModel,
    Report,
    advance,
    begin,
    needs_mask,
    report,
    stage_hyperparameters,
    stage_program,
)
from jaxfit.fitting.tiles import join_tiles, take_tile, tile_rows, tile_size
from jaxfit.foundation.progress import ReportProgress
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose
from jaxfit.objective.posed_window import Targets

_logger = logging.getLogger(__name__)

LIKELIHOOD_RATIO = 20.0
"""A hypothesis is reported if the best hypothesis is less than this many times as likely."""
MIN_ANGLE_DEG = 45.0
"""Hypotheses are one pose where their orientations differ by a smaller angle, and everywhere if the median does."""
SECONDS_PER_CALL = 1.0
"""Target duration of some steps of all tiles. After these steps, progress is reported."""


def bytes_per_frame(bird: Bird, config: FitConfig) -> int:
    """Return an estimate of the memory of one frame of one bird, in bytes.

    A frame needs memory for about ten arrays of the mesh's size and two arrays of the silhouette's size.
    """
    return 10 * 12 * bird.vertices.shape[0] + 2 * config.crop.size_px**2 + 100_000


def frames_per_batch(bird: Bird, config: FitConfig) -> int:
    """Return the number of frames that fit into `config.memory_gb`."""
    return max(int(config.memory_gb * 1e9 / bytes_per_frame(bird, config)), 1)


class Batch(NamedTuple):
    """B problems; a problem is one window under one config. Problems may share targets and initial poses."""

    targets: Targets
    """Leading axis E, NumPy. Only stages that compare masks receive the masks."""
    initial_pose: Pose
    """Leading axes S, H: S initial poses with H hypotheses each."""
    config: Int[np.ndarray, "B"]
    """Position of each problem's config in the sequence of configs."""
    targets_row: Int[np.ndarray, "B"]
    """Row of each problem's targets."""
    pose_row: Int[np.ndarray, "B"]
    """Row of each problem's initial pose. Problems that share an initial pose must share their targets, too. They are
    computed as one problem until a stage gives them different hyperparameters."""


class FittedWindow(NamedTuple):
    """The result of one window of T frames, as NumPy arrays. The result of a batch has a leading axis B everywhere."""

    pose: Pose
    loss: dict[str, Any]
    """Weighted value of each term in the objective, a number."""
    keypoints_cam: Float[np.ndarray, "*B T K 3"]
    """Camera frame of the crop, model units."""
    keypoints_px: Float[np.ndarray, "*B T K 2"]
    """Crop pixels."""
    failure: Any
    """Text: reason why the fit diverged, with the terms that were not finite and the step; empty without failure."""
    ambiguity_deg: Float[np.ndarray, "*B T"]
    """As `Solution.flags.ambiguity_deg`."""
    error_bars: ErrorBars | None = None
    """None if the config has none."""


class Hypotheses(NamedTuple):
    """R distinct problems with H hypotheses each, between two stages; R·H poses, as NumPy arrays."""

    pose: Pose
    solver: Any
    """The solver's state after the previous stage; None if the next stage does not continue its moments."""
    failure: np.ndarray
    """(R·H,) text as in `FittedWindow`."""
    ambiguity_deg: Float[np.ndarray, "RH T"]
    """As in `FittedWindow`; 0 before hypotheses are compared."""
    row: Int[np.ndarray, "B"]
    """Row of each problem of the batch."""
    count: int
    """Number of hypotheses H of each row."""

    def rows(self, at: np.ndarray, **changes: Any) -> Hypotheses:
        """Return some of the R·H poses, with other values for `row` and `count` in `changes`."""
        kept = self.pose, self.solver, self.failure, self.ambiguity_deg
        pose, solver, failure, ambiguity_deg = jax.tree.map(lambda x: x[at], kept)
        changes = {"row": self.row, "count": self.count} | changes
        return Hypotheses(pose, solver, failure, ambiguity_deg, **changes)


def fit_batch(
    model: FitModel, configs: Sequence[FitConfig], batch: Batch, report_progress: ReportProgress
) -> FittedWindow:
    """Run all stages on a batch of problems. The result of a problem does not depend on the other problems.

    Args:
        model: the bird and the camera.
        configs: configs with an equal `stages.compiled_part`.
        batch: the problems.
        report_progress: called with the number of new steps.

    Returns:
        The results of all problems, with a leading axis B, in the order of the batch.
    """
    initial, last = batch.initial_pose, len(configs[0].stages) - 1
    count, hypotheses, frames = initial.global_orient.shape[:3]
    pose = jax.tree.map(lambda x: np.asarray(x).reshape(count * hypotheses, *x.shape[2:]), initial)
    failure, ambiguity_deg = np.full(len(pose.transl), "", object), np.zeros((len(pose.transl), frames), np.float32)
    rows = Hypotheses(pose, None, failure, ambiguity_deg, batch.pose_row, hypotheses)
    for i, stage in enumerate(configs[0].stages):
        program = stage_program(configs[0], stage, model)
        hyperparameters = [stage_hyperparameters(c, c.stages[i], model.bird.keypoint_names) for c in configs]
        rows, first = _split_rows(rows, batch, hyperparameters)
        tiles = tile_rows(len(rows.failure), tile_size(frames))
        problems = _stage_problems(rows, tiles, hyperparameters, batch, first, needs_mask(stage))
        carries = i < last and configs[0].stages[i + 1].carry_moments
        rows = _run_stage(program, problems, tiles, rows, stage, carries, report_progress)
        if i < last and not (stage.keep_best and rows.count > 1):
            continue
        reports = [report(program, p, take_tile(rows.pose, tile)) for p, tile in zip(problems, tiles, strict=True)]
        final = join_tiles(reports, len(rows.failure))
        if i == last:
            step = np.where(np.isfinite(sum(final.loss.values())), 0, stage.steps)
            rows = _name_failures(program, problems, tiles, rows, step, stage)
        rows, best = _compare_hypotheses(rows, final, batch.targets.present[batch.targets_row[first]])
        rows, final = rows.rows(best, count=1), jax.tree.map(lambda x, best=best: x[best], final)
    bars = None
    if configs[0].error_bars:
        tiles = tile_rows(len(rows.failure), tile_size(frames))
        problems = _stage_problems(rows, tiles, hyperparameters, batch, first, needs_mask(stage))
        bars = _error_bars(with_shared(program, stage), problems, tiles, rows, configs[0].common_size)
    fitted = FittedWindow(
        rows.pose, final.loss, final.keypoints_cam, final.keypoints_px, rows.failure, rows.ambiguity_deg, bars
    )
    return jax.tree.map(lambda x: x[rows.row], fitted)


def _split_rows(
    rows: Hypotheses, batch: Batch, hyperparameters: Sequence[Hyperparameters]
) -> tuple[Hypotheses, Int[np.ndarray, "R"]]:
    """Split rows whose problems have different hyperparameters in the next stage.

    Two problems share a row of the next stage if they shared a row before and have equal hyperparameters.

    Returns:
        The rows of the next stage, and the first problem of each row.
    """
    content = [b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(values)) for values in hyperparameters]
    new_rows: dict[tuple[int, bytes], int] = {}
    pairs = zip(rows.row.tolist(), batch.config.tolist(), strict=True)
    row = np.array([new_rows.setdefault((old_row, content[config]), len(new_rows)) for old_row, config in pairs])
    first = np.unique(row, return_index=True)[1]
    source = (rows.row[first][:, None] * rows.count + np.arange(rows.count)).ravel()
    return rows.rows(source, row=row), first


def _stage_problems(
    rows: Hypotheses,
    tiles: Sequence[Int[np.ndarray, "G"]],
    hyperparameters: Sequence[Hyperparameters],
    batch: Batch,
    first: Int[np.ndarray, "R"],
    with_masks: bool,
) -> list[Problem]:
    """Return the problems of each tile: one for every hypothesis of every row, whose first problem is `first`.

    Without `with_masks` the masks are empty.
    """
    targets = batch.targets
    if not with_masks:
        targets = replace(targets, mask=targets.mask[..., :0, :0])
    config, targets_row = (np.repeat(values[first], rows.count) for values in (batch.config, batch.targets_row))
    problems = []
    for tile in tiles:
        seen = take_tile(targets, targets_row[tile])
        # without masks, the problems that fill up the last tile render no silhouettes
        real = (tile >= 0).reshape(-1, *(1,) * (seen.has_mask.ndim - 1))
        seen = replace(seen, has_mask=seen.has_mask & real)
        settings = jax.device_put(jax.tree.map(lambda *x: np.stack(x), *(hyperparameters[c] for c in config[tile])))
        problems.append(Problem(settings, take_tile(rows.pose, tile), seen))
    return problems


def _run_stage(
    program: Program,
    problems: Sequence[Problem],
    tiles: Sequence[Int[np.ndarray, "G"]],
    rows: Hypotheses,
    stage: StageConfig,
    carries: bool,
    report_progress: ReportProgress,
) -> Hypotheses:
    """Take all steps of a stage, and name the failures. `carries`: the next stage continues the moments.

    Some steps of every tile are taken at a time, which last about `SECONDS_PER_CALL`.
    """
    carried = rows.solver if stage.carry_moments else None
    states = [begin(program, p, take_tile(carried, tile)) for p, tile in zip(problems, tiles, strict=True)]
    done, chunk, rejected, count = 0, 1, [], len(rows.failure)
    while done < stage.steps:
        take = min(chunk, stage.steps - done)
        start = time.perf_counter()
        advanced = [advance((program, p, jnp.int32(take)), state) for p, state in zip(problems, states, strict=True)]
        states, losses, rejected = (list(parts) for parts in zip(*advanced, strict=True))
        mean_loss = np.mean(join_tiles(losses, count))  # waits for the result
        seconds = time.perf_counter() - start
        done += take
        report_progress(take, f"{stage.name}: loss {mean_loss:.5g} per window")
        # the first call may compile, so its duration does not show the speed of the steps
        chunk = 2 if done == take else max(1, min(4 * take, int(SECONDS_PER_CALL * take / seconds)))
    rejected = join_tiles(rejected, count)
    rows = rows._replace(
        pose=join_tiles([state.pose for state in states], count),
        solver=join_tiles([state.solver for state in states], count) if carries else None,
    )
    step = np.where(rejected > 0, stage.steps + 1 - rejected, 0)  # all steps after the first failure are rejected
    return _name_failures(program, problems, tiles, rows, step, stage)


def _name_failures(
    program: Program,
    problems: Sequence[Problem],
    tiles: Sequence[Int[np.ndarray, "G"]],
    rows: Hypotheses,
    step: Int[np.ndarray, "RH"],
    stage: StageConfig,
) -> Hypotheses:
    """Name the failures of the problems that failed at a step of a stage; `step` is 0 without failure."""
    failure = rows.failure.copy()
    for p, tile in zip(problems, tiles, strict=True):
        real = tile >= 0
        steps = np.where(real, step[tile], 0)
        if steps.any():
            pose = take_tile(rows.pose, tile)
            failure[tile[real]] = name_failures(failure[tile], steps, stage.name, program, p, pose)[real]
    return rows._replace(failure=failure)


def _error_bars(
    program: Program,
    problems: Sequence[Problem],
    tiles: Sequence[Int[np.ndarray, "G"]],
    rows: Hypotheses,
    common_size: bool,
) -> ErrorBars:
    """Return the error bars of all rows, and log why a row that did not diverge has none."""
    parts = []
    for p, tile in zip(problems, tiles, strict=True):
        bars, reasons = window_error_bars(program, p, take_tile(rows.pose, tile), common_size)
        parts.append(jax.tree.map(lambda *x: np.stack(x), *bars))
        for row, reason in zip(tile.tolist(), reasons, strict=True):
            if row >= 0 and reason and not rows.failure[row]:
                _logger.warning("a window has no error bars: %s", reason)
    return join_tiles(parts, len(rows.failure))


def _compare_hypotheses(
    rows: Hypotheses, final: Report, present: Bool[Array | np.ndarray, "R T"]
) -> tuple[Hypotheses, Int[np.ndarray, "R"]]:
    """Return the rows with the ambiguity of their best hypothesis, and the position of each best hypothesis.

    A hypothesis that is not finite is never the best. Poses of frames without the bird are arbitrary and do not count.
    """
    total = np.sum(list(final.loss.values()), axis=0).reshape(-1, rows.count)
    total = np.where(np.isfinite(total), total, np.inf)
    of_row = np.argmin(total, axis=1)
    best = np.arange(len(total)) * rows.count + of_row
    if rows.count == 1:
        return rows, best
    orient = np.asarray(rows.pose.global_orient, np.float64)
    pairs = orient.reshape(-1, 3), np.repeat(orient[best], rows.count, axis=0).reshape(-1, 3)
    rotation, of_best = (Rotation.from_rotvec(rotvecs) for rotvecs in pairs)
    angle_deg = np.rad2deg((rotation.inv() * of_best).magnitude()).reshape(orient.shape[:2])
    angle_deg = np.where(np.repeat(present, rows.count, axis=0), angle_deg, np.nan)
    is_other_pose = np.nanmedian(angle_deg, axis=1).reshape(total.shape) > MIN_ANGLE_DEG
    others = np.where(is_other_pose, total, np.inf)
    second = np.argmin(others, axis=1)
    with np.errstate(invalid="ignore"):  # no finite hypothesis
        is_near = others.min(axis=1) - total.min(axis=1) < np.log(LIKELIHOOD_RATIO)
    ambiguity_deg = rows.ambiguity_deg.copy()
    of_second = angle_deg[(best - of_row + second)[is_near]]
    ambiguity_deg[best[is_near]] = np.where(of_second > MIN_ANGLE_DEG, of_second, 0)
    return rows._replace(ambiguity_deg=ambiguity_deg), best
