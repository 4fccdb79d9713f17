"""All stages of a batch of problems, in tiles of a fixed shape; hypotheses and failures.

Tiles: a batch is computed in parts of a fixed shape, so that the result of a problem does not depend on the batch. The
compiler fuses and orders the operations of a program by the shapes of its arrays. Programs for different numbers of
problems therefore round differently. The steps of Adam do not become smaller, so a difference of one rounding grows to
tenths of a pixel within some hundred steps. The shape of a tile depends only on the length of the windows, so all
problems run through one compiled program.
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
    StageState,
    advance,
    begin,
    needs_mask,
    report,
    stage_hyperparameters,
    stage_program,
)
from jaxfit.foundation.progress import ReportProgress
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose
from jaxfit.objective.posed_window import Targets

FRAMES_PER_TILE = 16
"""Frames in a tile of short windows. Larger tiles are not faster, and a single short window fills its tile up."""
MIN_PROBLEMS_PER_TILE = 2
"""A tile of a single long window is slow: the compiler then computes the joint transforms several times."""


def tile_size(frames: int) -> int:
    """Return the number of problems in a tile, for windows of `frames` frames."""
    return max(FRAMES_PER_TILE // frames, MIN_PROBLEMS_PER_TILE)


def tile_rows(count: int, size: int) -> list[Int[np.ndarray, "G"]]:
    """Return the rows of each tile of `size` of `count` rows.

    Rows that the last tile lacks are −1: the tile is filled with problems whose results are discarded.
    """
    rows = np.full(-(-count // size) * size, -1)
    rows[:count] = np.arange(count)
    return list(rows.reshape(-1, size))


def join_tiles(tiles: Sequence[Any], count: int) -> Any:
    """Return the first `count` rows of some tiles (pytrees of arrays with a leading axis) as NumPy arrays."""
    return jax.tree.map(lambda *x: np.concatenate([np.asarray(each) for each in x])[:count], *tiles)


def take_tile(tree: Any, rows: Int[np.ndarray, "G"]) -> Any:
    """Return some rows of a pytree of arrays as JAX arrays; −1 is the last row."""
    return jax.device_put(jax.tree.map(lambda x: np.asarray(x)[rows], tree))


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


class Fitted(NamedTuple):
    """The result of a batch of B problems, as NumPy arrays."""

    pose: Pose
    report: Report
    failure: np.ndarray
    """(B,) text: the terms that were not finite, and the step of the failure; empty without failure."""
    ambiguity_deg: Float[np.ndarray, "B T"]
    """As `Solution.ambiguity_deg`."""
    error_bars: ErrorBars | None = None
    """Of all problems; None if the config has none."""


class _Rows(NamedTuple):
    """R distinct problems with H hypotheses each, between two stages; R·H poses, as NumPy arrays."""

    pose: Pose
    solver: Any
    """The solver's state after the previous stage; None if the next stage does not continue its moments."""
    failure: np.ndarray
    """(R·H,) text as in `Fitted`."""
    ambiguity_deg: Float[np.ndarray, "RH T"]
    """As in `Fitted`; 0 before hypotheses are compared."""
    row: Int[np.ndarray, "B"]
    """Row of each problem of the batch."""
    hypotheses: int
    """Number of hypotheses H."""


class _Tile(NamedTuple):
    """Problems of a stage that are computed together."""

    problems: Problem
    rows: Int[np.ndarray, "G"]
    """The row of each problem, see `tile_rows`."""


def fit_batch(model: FitModel, configs: Sequence[FitConfig], batch: Batch, report_progress: ReportProgress) -> Fitted:
    """Run all stages on a batch of problems. The result of a problem does not depend on the other problems.

    Args:
        model: the bird and the camera.
        configs: configs with an equal `stages.compiled_part`.
        batch: the problems.
        report_progress: called with the number of new steps.

    Returns:
        Pose, report and failure of every problem, in the order of the batch.
    """
    rows = _initial_rows(batch)
    last = len(configs[0].stages) - 1
    for i, stage in enumerate(configs[0].stages):
        program = stage_program(configs[0], stage, model)
        hyperparameters = [stage_hyperparameters(c, c.stages[i], model.bird.keypoint_names) for c in configs]
        rows, config_of_row, targets_row = _split_rows(rows, batch, hyperparameters)
        tiles = _stage_tiles(rows, hyperparameters, config_of_row, batch.targets, targets_row, needs_mask(stage))
        carries = i < last and configs[0].stages[i + 1].carry_moments
        rows = _run_stage(program, tiles, rows, stage, carries, report_progress)
        if i < last and not (stage.keep_best and rows.hypotheses > 1):
            continue
        reports = [report(program, tile.problems, take_tile(rows.pose, tile.rows)) for tile in tiles]
        final = join_tiles(reports, len(rows.failure))
        if i == last:
            step = np.where(np.isfinite(sum(final.loss.values())), 0, stage.steps)
            rows = _name_failures(program, tiles, rows, step, stage)
        rows, best = _compare_hypotheses(rows, final, batch.targets.present[targets_row])
        kept = rows.pose, rows.solver, rows.failure, rows.ambiguity_deg, final
        pose, solver, failure, ambiguity_deg, final = jax.tree.map(lambda x, best=best: x[best], kept)
        rows = _Rows(pose, solver, failure, ambiguity_deg, rows.row, 1)
    bars = None
    if configs[0].error_bars:
        tiles = _stage_tiles(rows, hyperparameters, config_of_row, batch.targets, targets_row, needs_mask(stage))
        bars = _error_bars(with_shared(program, stage), tiles, rows, configs[0].common_size)
    return Fitted(*jax.tree.map(lambda x: x[rows.row], (rows.pose, final, rows.failure, rows.ambiguity_deg, bars)))


def _initial_rows(batch: Batch) -> _Rows:
    count, hypotheses = batch.initial_pose.global_orient.shape[:2]
    pose = jax.tree.map(lambda x: np.asarray(x).reshape(count * hypotheses, *x.shape[2:]), batch.initial_pose)
    failure = np.full(count * hypotheses, "", object)
    ambiguity_deg = np.zeros(pose.global_orient.shape[:2], np.float32)
    return _Rows(pose, None, failure, ambiguity_deg, batch.pose_row, hypotheses)


def _split_rows(
    rows: _Rows, batch: Batch, hyperparameters: Sequence[Hyperparameters]
) -> tuple[_Rows, Int[np.ndarray, "R"], Int[np.ndarray, "R"]]:
    """Split rows whose problems have different hyperparameters in the next stage.

    Two problems share a row of the next stage if they shared a row before and have equal hyperparameters.

    Returns:
        The rows of the next stage, and the config and the targets of each row.
    """
    content = [b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(each)) for each in hyperparameters]
    new_rows: dict[tuple[int, bytes], int] = {}
    pairs = zip(rows.row.tolist(), batch.config.tolist(), strict=True)
    row = np.array([new_rows.setdefault((old_row, content[config]), len(new_rows)) for old_row, config in pairs])
    first = np.unique(row, return_index=True)[1]  # the first problem of each row
    source = (rows.row[first][:, None] * rows.hypotheses + np.arange(rows.hypotheses)).ravel()
    kept = rows.pose, rows.solver, rows.failure, rows.ambiguity_deg
    pose, solver, failure, ambiguity_deg = jax.tree.map(lambda x: x[source], kept)
    split = _Rows(pose, solver, failure, ambiguity_deg, row, rows.hypotheses)
    return split, batch.config[first], batch.targets_row[first]


def _stage_tiles(
    rows: _Rows,
    hyperparameters: Sequence[Hyperparameters],
    config: Int[np.ndarray, "R"],
    targets: Targets,
    targets_row: Int[np.ndarray, "R"],
    with_masks: bool,
) -> list[_Tile]:
    """Return one problem for every hypothesis of every row, in tiles. Without `with_masks` the masks are empty."""
    if not with_masks:
        targets = replace(targets, mask=targets.mask[..., :0, :0])
    config, targets_row = (np.repeat(each, rows.hypotheses) for each in (config, targets_row))
    count, frames = rows.pose.global_orient.shape[:2]
    tiles = []
    for tile in tile_rows(count, tile_size(frames)):
        own = take_tile(targets, targets_row[tile])
        # without masks, the problems that fill up the last tile render no silhouettes
        real = (tile >= 0).reshape(-1, *(1,) * (own.has_mask.ndim - 1))
        own = replace(own, has_mask=own.has_mask & real)
        settings = jax.device_put(jax.tree.map(lambda *x: np.stack(x), *(hyperparameters[c] for c in config[tile])))
        tiles.append(_Tile(Problem(settings, take_tile(rows.pose, tile), own), tile))
    return tiles


def _run_stage(
    program: Program,
    tiles: Sequence[_Tile],
    rows: _Rows,
    stage: StageConfig,
    carries: bool,
    report_progress: ReportProgress,
) -> _Rows:
    """Take all steps of a stage, and name the failures. `carries`: the next stage continues the moments."""
    carried = rows.solver if stage.carry_moments else None
    states = [begin(program, tile.problems, take_tile(carried, tile.rows)) for tile in tiles]
    states, rejected = _take_steps(program, tiles, states, stage, report_progress)
    count = len(rows.failure)
    pose, rejected = join_tiles([state.pose for state in states], count), join_tiles(rejected, count)
    solver = join_tiles([state.solver for state in states], count) if carries else None
    step = np.where(rejected > 0, stage.steps + 1 - rejected, 0)  # all steps after the first failure are rejected
    return _name_failures(program, tiles, rows._replace(pose=pose, solver=solver), step, stage)


def _take_steps(
    program: Program,
    tiles: Sequence[_Tile],
    states: list[StageState],
    stage: StageConfig,
    report_progress: ReportProgress,
) -> tuple[list[StageState], list[Int[Array, "G"]]]:
    """Take all steps of a stage, some steps of every tile at a time, which take about `SECONDS_PER_CALL`.

    Returns:
        The state of every tile, and the number of rejected steps of every problem of the tile.
    """
    done, chunk, rejected = 0, 1, []
    count = sum(int((tile.rows >= 0).sum()) for tile in tiles)
    while done < stage.steps:
        take = min(chunk, stage.steps - done)
        start = time.perf_counter()
        advanced = [
            advance((program, tile.problems, jnp.int32(take)), state) for tile, state in zip(tiles, states, strict=True)
        ]
        states, losses, rejected = (list(each) for each in zip(*advanced, strict=True))
        mean_loss = np.mean(join_tiles(losses, count))  # waits for the result
        seconds = time.perf_counter() - start
        done += take
        report_progress(take, f"{stage.name}: loss {mean_loss:.5g} per window")
        # the first call may compile, so its duration does not show the speed of the steps
        chunk = 2 if done == take else max(1, min(4 * take, int(SECONDS_PER_CALL * take / seconds)))
    return states, rejected


def _name_failures(
    program: Program, tiles: Sequence[_Tile], rows: _Rows, step: Int[np.ndarray, "R"], stage: StageConfig
) -> _Rows:
    """Name the failures of the problems that failed at a step of a stage; `step` is 0 without failure."""
    failure = rows.failure.copy()
    for problems, at in tiles:
        real = at >= 0
        steps = np.where(real, step[at], 0)
        if steps.any():
            pose = take_tile(rows.pose, at)
            failure[at[real]] = name_failures(failure[at], steps, stage.name, program, problems, pose)[real]
    return rows._replace(failure=failure)


def _error_bars(program: Program, tiles: Sequence[_Tile], rows: _Rows, common_size: bool) -> ErrorBars:
    """Return the error bars of all rows, and log why a row that did not diverge has none."""
    found = []
    for tile in tiles:
        bars, reasons = window_error_bars(program, tile.problems, take_tile(rows.pose, tile.rows), common_size)
        found.append(jax.tree.map(lambda *x: np.stack(x), *bars))
        for row, reason in zip(tile.rows.tolist(), reasons, strict=True):
            if row >= 0 and reason and not rows.failure[row]:
                _logger.warning("a window has no error bars: %s", reason)
    return join_tiles(found, len(rows.failure))


def _compare_hypotheses(
    rows: _Rows, final: Report, present: Bool[Array | np.ndarray, "R T"]
) -> tuple[_Rows, Int[np.ndarray, "R"]]:
    """Return the rows with the ambiguity of their best hypothesis, and the position of each best hypothesis.

    A hypothesis that is not finite is never the best. Poses of frames without the bird are arbitrary and do not count.
    """
    total = np.sum(list(final.loss.values()), axis=0).reshape(-1, rows.hypotheses)
    total = np.where(np.isfinite(total), total, np.inf)
    of_row = np.argmin(total, axis=1)
    best = np.arange(len(total)) * rows.hypotheses + of_row
    if rows.hypotheses == 1:
        return rows, best
    orient = np.asarray(rows.pose.global_orient, np.float64)
    pairs = orient.reshape(-1, 3), np.repeat(orient[best], rows.hypotheses, axis=0).reshape(-1, 3)
    own, of_best = (Rotation.from_rotvec(each) for each in pairs)
    angle_deg = np.rad2deg((own.inv() * of_best).magnitude()).reshape(orient.shape[:2])
    angle_deg = np.where(np.repeat(present, rows.hypotheses, axis=0), angle_deg, np.nan)
    is_other_pose = np.nanmedian(angle_deg, axis=1).reshape(total.shape) > MIN_ANGLE_DEG
    others = np.where(is_other_pose, total, np.inf)
    second = np.argmin(others, axis=1)
    with np.errstate(invalid="ignore"):  # no finite hypothesis
        is_near = others.min(axis=1) - total.min(axis=1) < np.log(LIKELIHOOD_RATIO)
    ambiguity_deg = rows.ambiguity_deg.copy()
    of_second = angle_deg[(best - of_row + second)[is_near]]
    ambiguity_deg[best[is_near]] = np.where(of_second > MIN_ANGLE_DEG, of_second, 0)
    return rows._replace(ambiguity_deg=ambiguity_deg), best
