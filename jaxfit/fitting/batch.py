"""All stages of a batch of problems, in tiles, with their failures. `fitting/hypotheses.py` has the rows of stages."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxfit.config.fit import FitConfig, StageConfig
from jaxfit.fitting.bodies import BodyEvidence, body_evidence, stages_of_pass
from jaxfit.fitting.diagnose import name_failures
from jaxfit.fitting.error_bars import ErrorBars, window_error_bars
from jaxfit.fitting.hypotheses import Hypotheses, compare_hypotheses, split_rows
from jaxfit.fitting.posterior import with_shared
from jaxfit.fitting.problem import Hyperparameters, Problem, Program
from jaxfit.fitting.solve import (
    FitModel,
    advance,
    begin,
    needs_mask,
    report,
    shared_parameters,
    stage_hyperparameters,
    stage_program,
    with_offsets,
)
from jaxfit.fitting.tiles import join_tiles, take_tile, tile_rows, tile_size
from jaxfit.foundation.progress import ReportProgress
from jaxfit.foundation.threads import in_threads, usable_cores
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose
from jaxfit.objective.posed_window import Targets

_logger = logging.getLogger(__name__)

A = TypeVar("A")
TILES_AT_ONCE = 2
"""Most tiles that are computed at the same time. Each needs its own memory, and most parts of a step use all cores."""
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
    ambiguity_deg: Float[np.ndarray, "S T"] | None = None
    """Of each initial pose, from earlier stages; None for the first stage."""
    body_covariance: Float[np.ndarray, "S P P"] | None = None
    """Of the body that each initial pose has (`fitting/bodies.py`); None without given bodies."""
    keypoint_scale: Float[np.ndarray, "S"] | None = None
    """Of the keypoint errors of the track, as a multiple of the scale in the config; None without given bodies."""
    tells_body: bool = True
    """Whether the bodies are estimated from these windows."""


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
    body: BodyEvidence | None = None
    """What the window says about the body of its bird; None if the last stage of the config shares no body."""


def fit_batch(
    model: FitModel, configs: Sequence[FitConfig], batch: Batch, report_progress: ReportProgress
) -> FittedWindow:
    """Run the stages on a batch of problems. The result of a problem does not depend on the other problems.

    If a stage shares the body (`share_body`), the stages up to this stage run for a batch without given bodies, and
    the later stages for a batch with bodies. The stage itself runs only for windows that tell the body.

    Args:
        model: the bird and the camera.
        configs: configs with an equal `stages.compiled_part`.
        batch: the problems.
        report_progress: called with the number of new steps.

    Returns:
        The results of all problems, with a leading axis B, in the order of the batch.
    """
    initial = batch.initial_pose
    stages = stages_of_pass(configs[0], batch.body_covariance is not None, batch.tells_body)
    last = stages[-1]
    count, hypotheses, frames = initial.global_orient.shape[:3]
    pose = jax.tree.map(lambda x: np.asarray(x).reshape(count * hypotheses, *x.shape[2:]), initial)
    pose = with_offsets(model, pose)
    failure, ambiguity_deg = np.full(len(pose.transl), "", object), np.zeros((len(pose.transl), frames), np.float32)
    if batch.ambiguity_deg is not None:
        ambiguity_deg = np.repeat(batch.ambiguity_deg, hypotheses, axis=0)
    rows = Hypotheses(pose, None, failure, ambiguity_deg, batch.pose_row, hypotheses)
    for i in stages:
        stage = configs[0].stages[i]
        program = stage_program(configs[0], stage, model)
        hyperparameters = [stage_hyperparameters(c, c.stages[i], model.bird.keypoint_names) for c in configs]
        rows, first = split_rows(rows, batch.config, hyperparameters)
        run = _stage_run(stage, program, rows, hyperparameters, batch, first)
        carries = i < last and configs[0].stages[i + 1].carry_moments
        rows = _take_steps(run, rows, carries, report_progress)
        if i < last and not (stage.keep_best and rows.count > 1):
            continue
        final = run.joined(run.of_tiles(report, run.taken(rows.pose)))
        if i == last:
            step = np.where(np.isfinite(sum(final.loss.values())), 0, stage.steps)
            rows = _name_failures(run, rows, step)
        rows, best = compare_hypotheses(rows, final.loss, batch.targets.present[batch.targets_row[first]])
        rows, final = rows.rows(best, count=1), jax.tree.map(lambda x, best=best: x[best], final)
    bars = body = None
    if stage.share_body:
        run = _stage_run(stage, program, rows, hyperparameters, batch, first)
        found = run.of_tiles(body_evidence, run.taken(rows.pose))
        body = _stacked(run, rows, found, "a window says nothing about the body of its bird")
    elif configs[0].error_bars and last == len(configs[0].stages) - 1:
        covariance, used = None, stage
        if batch.body_covariance is not None:
            names = shared_parameters(configs[0].stages[stages[0] - 1])
            covariance = batch.body_covariance[batch.pose_row[first]]
            own = [replace(c.stages[last], optimised=(*c.stages[last].optimised, *names)) for c in configs]
            pairs = zip(configs, own, strict=True)
            used, hyperparameters = own[0], [stage_hyperparameters(*pair, model.bird.keypoint_names) for pair in pairs]
        run = _stage_run(used, with_shared(program, used), rows, hyperparameters, batch, first)
        bars = _error_bars(run, rows, configs[0].common_size, covariance)
    pose = replace(rows.pose, betas=rows.pose.betas[:, : model.rig.num_shapes])
    fitted = FittedWindow(
        pose, final.loss, final.keypoints_cam, final.keypoints_px, rows.failure, rows.ambiguity_deg, bars, body
    )
    return jax.tree.map(lambda x: x[rows.row], fitted)


class _StageRun(NamedTuple):
    """One stage of all rows."""

    stage: StageConfig
    program: Program
    tiles: list[tuple[Problem, Int[np.ndarray, "G"]]]
    """The problems of each tile: one for every hypothesis of every row; and their positions, −1 for no problem."""
    count: int
    """Number of problems."""

    def taken(self, rows: Any) -> list[Any]:
        """Return the rows of each tile, of a pytree of arrays with one row for each problem."""
        return [take_tile(rows, tile) for _, tile in self.tiles]

    def of_tiles(self, function: Callable[..., A], *others: Sequence[Any]) -> list[A]:
        """Return a function of the program, the problems and one item of each of `others` of every tile.

        Threads compute some tiles at the same time, because not all steps of a computation use several cores.
        """

        def of_tile(arguments: tuple[Any, ...]) -> A:
            return jax.block_until_ready(function(self.program, *arguments))

        problems = [p for p, _ in self.tiles]
        return list(in_threads(of_tile, zip(problems, *others, strict=True), min(usable_cores(), TILES_AT_ONCE)))

    def joined(self, parts: Iterable[Any]) -> Any:
        """Return the results of all tiles as NumPy arrays, one row for each problem."""
        return join_tiles(list(parts), self.count)


def _stage_run(
    stage: StageConfig,
    program: Program,
    rows: Hypotheses,
    hyperparameters: Sequence[Hyperparameters],
    batch: Batch,
    first: Int[np.ndarray, "R"],
) -> _StageRun:
    """Return the run of a stage. `first` is the first problem of each row. Without mask terms, the masks are empty."""
    targets = batch.targets
    if not needs_mask(stage):
        targets = replace(targets, mask=targets.mask[..., :0, :0])
    config, targets_row, problem = (
        np.repeat(values[first], rows.count) for values in (batch.config, batch.targets_row, batch.pose_row)
    )
    run = _StageRun(stage, program, [], len(rows.failure))
    for tile in tile_rows(run.count, tile_size(rows.ambiguity_deg.shape[1])):
        seen = take_tile(targets, targets_row[tile])
        # without masks, the problems that fill up the last tile render no silhouettes
        real = (tile >= 0).reshape(-1, *(1,) * (seen.has_mask.ndim - 1))
        seen = replace(seen, has_mask=seen.has_mask & real)
        settings = jax.tree.map(lambda *x: np.stack(x), *(hyperparameters[c] for c in config[tile]))
        if batch.keypoint_scale is not None and "keypoint_likelihood" in settings.settings:
            own, factor = settings.settings["keypoint_likelihood"], batch.keypoint_scale[problem[tile]]
            own |= {name: own[name] * factor for name in ("sd_sure_px", "sd_unsure_px")}
        settings = jax.device_put(settings)
        run.tiles.append((Problem(settings, take_tile(rows.pose, tile), seen), tile))
    return run


def _take_steps(run: _StageRun, rows: Hypotheses, carries: bool, report_progress: ReportProgress) -> Hypotheses:
    """Take all steps of a stage, and name the failures. `carries`: the next stage continues the moments.

    Some steps of every tile are taken at a time, which last about `SECONDS_PER_CALL`.
    """
    stage, program = run.stage, run.program
    carried = rows.solver if stage.carry_moments else None
    states = [begin(program, p, own) for (p, _), own in zip(run.tiles, run.taken(carried), strict=True)]
    done, chunk, rejected = 0, 1, []
    while done < stage.steps:
        take = min(chunk, stage.steps - done)
        start = time.perf_counter()
        steps = jnp.int32(take)
        advanced = run.of_tiles(lambda program, p, state, steps=steps: advance((program, p, steps), state), states)
        states, losses, rejected = (list(parts) for parts in zip(*advanced, strict=True))
        mean_loss = np.mean(run.joined(losses))  # waits for the result
        seconds = time.perf_counter() - start
        done += take
        report_progress(take, f"{stage.name}: loss {mean_loss:.5g} per window")
        # the first call may compile, so its duration does not show the speed of the steps
        chunk = 2 if done == take else max(1, min(4 * take, int(SECONDS_PER_CALL * take / seconds)))
    rejected = run.joined(rejected)
    rows = rows._replace(
        pose=run.joined(state.pose for state in states),
        solver=run.joined(state.solver for state in states) if carries else None,
    )
    # all steps after the first failure are rejected
    return _name_failures(run, rows, np.where(rejected > 0, stage.steps + 1 - rejected, 0))


def _name_failures(run: _StageRun, rows: Hypotheses, step: Int[np.ndarray, "RH"]) -> Hypotheses:
    """Name the failures of the problems that failed at a step of a stage; `step` is 0 without failure."""
    failure = rows.failure.copy()
    for p, tile in run.tiles:
        real = tile >= 0
        steps = np.where(real, step[tile], 0)
        if steps.any():
            pose = take_tile(rows.pose, tile)
            failure[tile[real]] = name_failures(failure[tile], steps, run.stage.name, run.program, p, pose)[real]
    return rows._replace(failure=failure)


def _error_bars(
    run: _StageRun, rows: Hypotheses, common_size: bool, body_covariance: Float[np.ndarray, "R P P"] | None
) -> ErrorBars:
    """Return the error bars of all rows, and log why a row that did not diverge has none."""

    def of_tile(program: Program, p: Problem, pose: Pose, of_bodies: Any) -> tuple[list[ErrorBars], list[str]]:
        return window_error_bars(program, p, pose, common_size, of_bodies)

    found = run.of_tiles(of_tile, run.taken(rows.pose), run.taken(body_covariance))
    return _stacked(run, rows, found, "a window has no error bars")


def _stacked(run: _StageRun, rows: Hypotheses, found: Sequence[tuple[Sequence[Any], Sequence[str]]], what: str) -> Any:
    """Return the results of the problems of all tiles, and log the reasons of rows that did not diverge."""
    for (_, tile), (_, reasons) in zip(run.tiles, found, strict=True):
        for row, reason in zip(tile.tolist(), reasons, strict=True):
            if row >= 0 and reason and not rows.failure[row]:
                _logger.warning("%s: %s", what, reason)
    return run.joined(jax.tree.map(lambda *x: np.stack(x), *results) for results, _ in found)
