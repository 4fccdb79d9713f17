"""Run all stages of a fit on a batch of problems."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxfit.config.fit import FitConfig, StageConfig
from jaxfit.fitting.diagnose import name_failures
from jaxfit.fitting.problem import Hyperparameters, Problem, Program
from jaxfit.fitting.solve import Report, StageState, advance, begin, report
from jaxfit.fitting.stages import FitModel, needs_mask, stage_hyperparameters, stage_program
from jaxfit.model.bird import Bird
from jaxfit.model.pose import Pose
from jaxfit.objective.posed_window import Targets
from jaxfit.progress import ReportProgress

__all__ = ["Batch", "Fitted", "bytes_per_frame", "fit_batch", "frames_per_batch"]

SECONDS_PER_CALL = 1.0
"""Target duration of one call of the solver. Between calls, progress is reported and Ctrl-C takes effect."""


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


class _Rows(NamedTuple):
    """R distinct problems with H hypotheses each, between two stages; R·H poses."""

    pose: Pose
    solver: Any
    """The solver's state after the previous stage; None before the first stage."""
    failure: np.ndarray
    """(R·H,) text as in `Fitted`."""
    row: Int[np.ndarray, "B"]
    """Row of each problem of the batch."""
    hypotheses: int
    """Number of hypotheses H."""


def fit_batch(model: FitModel, configs: Sequence[FitConfig], batch: Batch, report_progress: ReportProgress) -> Fitted:
    """Run all stages on a batch of problems.

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
        problems = _stage_problems(rows, hyperparameters, config_of_row, batch.targets, targets_row, needs_mask(stage))
        rows = _run_stage(program, problems, rows, stage, report_progress)
        if rows.hypotheses > 1 and (stage.keep_best or i == last):
            rows, problems = _keep_best(program, problems, rows)
    final = report(program, problems, rows.pose)
    total = np.asarray(sum(final.loss.values()))
    step = np.where(np.isfinite(total), 0, stage.steps)
    failure = name_failures(rows.failure, step, stage.name, program, problems, rows.pose)
    return Fitted(*jax.tree.map(lambda x: np.asarray(x)[rows.row], (rows.pose, final, failure)))


def _initial_rows(batch: Batch) -> _Rows:
    count, hypotheses = batch.initial_pose.global_orient.shape[:2]
    pose = jax.tree.map(lambda x: x.reshape(count * hypotheses, *x.shape[2:]), batch.initial_pose)
    return _Rows(pose, None, np.full(count * hypotheses, "", object), batch.pose_row, hypotheses)


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
    source = jnp.asarray((rows.row[first][:, None] * rows.hypotheses + np.arange(rows.hypotheses)).ravel())
    pose, solver, failure = jax.tree.map(lambda x: x[source], (rows.pose, rows.solver, rows.failure))
    return _Rows(pose, solver, failure, row, rows.hypotheses), batch.config[first], batch.targets_row[first]


def _stage_problems(
    rows: _Rows,
    hyperparameters: Sequence[Hyperparameters],
    config: Int[np.ndarray, "R"],
    targets: Targets,
    targets_row: Int[np.ndarray, "R"],
    with_masks: bool,
) -> Problem:
    """Return one problem for every hypothesis of every row. Without `with_masks` the masks are empty."""
    if not with_masks:
        targets = replace(targets, mask=targets.mask[..., :0, :0])
    source = np.repeat(targets_row, rows.hypotheses)
    repeated = [hyperparameters[c] for c in np.repeat(config, rows.hypotheses)]
    return Problem(
        hyperparameters=jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *repeated),
        anchor=rows.pose,
        targets=jax.tree.map(lambda x: jnp.asarray(x[source]), targets),
    )


def _run_stage(
    program: Program, problems: Problem, rows: _Rows, stage: StageConfig, report_progress: ReportProgress
) -> _Rows:
    """Take all steps of a stage, and name the failures."""
    state = begin(program, problems, rows.solver if stage.carry_moments else None)
    state, rejected = _take_steps(program, problems, state, stage, report_progress)
    step = np.where(rejected > 0, stage.steps + 1 - rejected, 0)  # all steps after the first failure are rejected
    failure = name_failures(rows.failure, step, stage.name, program, problems, state.pose)
    return rows._replace(pose=state.pose, solver=state.solver, failure=failure)


def _take_steps(
    program: Program, problems: Problem, state: StageState, stage: StageConfig, report_progress: ReportProgress
) -> tuple[StageState, Int[np.ndarray, "R"]]:
    """Take all steps of a stage in several calls, each of about `SECONDS_PER_CALL`."""
    done, chunk = 0, 1
    rejected = np.zeros(state.pose.global_orient.shape[0], int)
    while done < stage.steps:
        take = min(chunk, stage.steps - done)
        start = time.perf_counter()
        state, loss, rejected = advance((program, problems, jnp.int32(take)), state)
        mean_loss = float(jnp.mean(loss))  # waits for the result
        seconds = time.perf_counter() - start
        done += take
        report_progress(take, f"{stage.name}: loss {mean_loss:.5g} per window")
        # the first call may compile, so its duration does not show the speed of the steps
        chunk = 2 if done == take else max(1, min(4 * take, int(SECONDS_PER_CALL * take / seconds)))
    return state, np.asarray(rejected)


def _keep_best(program: Program, problems: Problem, rows: _Rows) -> tuple[_Rows, Problem]:
    """Keep the hypothesis with the smallest objective of every row."""
    best = _best_hypotheses(report(program, problems, rows.pose), rows.hypotheses)
    pose, solver, failure, problems = jax.tree.map(lambda x: x[best], (rows.pose, rows.solver, rows.failure, problems))
    return _Rows(pose, solver, failure, rows.row, 1), problems


def _best_hypotheses(final: Report, hypotheses: int) -> Int[Array, "R"]:
    """Return the position of the best hypothesis of every row. A hypothesis that is not finite is never the best."""
    total = jnp.stack(list(final.loss.values())).sum(axis=0).reshape(-1, hypotheses)
    best = jnp.argmin(jnp.where(jnp.isfinite(total), total, jnp.inf), axis=1)
    return jnp.arange(len(total)) * hypotheses + best
