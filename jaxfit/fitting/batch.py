"""A batch of problems through all stages of a fit."""

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

__all__ = ["Batch", "Fitted", "fit_batch", "frames_per_batch"]

SECONDS_A_CALL = 1.0
"""How long the solver may run before progress is shown and Ctrl-C is noticed."""


def frames_per_batch(bird: Bird, config: FitConfig) -> int:
    """Return the number of frames that fit into `config.memory_gb`.

    A frame takes about ten arrays of the mesh and two of the silhouette.
    """
    per_frame = 10 * 12 * bird.vertices.shape[0] + 2 * config.crop.size_px**2 + 100_000
    return max(int(config.memory_gb * 1e9 / per_frame), 1)


class Batch(NamedTuple):
    """B problems, each one window under one config. Problems may share targets and initial poses."""

    targets: Targets
    """Leading axis E, NumPy: masks go to a stage only where the stage compares masks."""
    initial_pose: Pose
    """Leading axes S, H: H hypotheses for each initial pose."""
    config: Int[np.ndarray, "B"]
    """Position of each problem's config."""
    targets_row: Int[np.ndarray, "B"]
    """Row of each problem's targets."""
    pose_row: Int[np.ndarray, "B"]
    """Row of each problem's initial pose. Problems with one initial pose must have the same targets: they are computed
    once for as long as their hyperparameters are equal too."""


class Fitted(NamedTuple):
    """The result of a batch of B problems, as NumPy arrays."""

    pose: Pose
    report: Report
    failure: np.ndarray
    """(B,) text: which terms were the first that were not finite, and at which step; empty without failure."""


class _Rows(NamedTuple):
    """R distinct problems with H hypotheses each, side by side, between two stages."""

    pose: Pose
    solver: Any
    """The solver's state after the stage before; None before the first stage."""
    failure: np.ndarray
    """(R·H,) text as in `Fitted`."""
    row: Int[np.ndarray, "B"]
    """Row of each problem of the batch."""
    hypotheses: int


def fit_batch(model: FitModel, configs: Sequence[FitConfig], batch: Batch, report_progress: ReportProgress) -> Fitted:
    """Run all stages on a batch of problems.

    Args:
        model: the bird and the camera.
        configs: configs with an equal `stages.compiled_part`.
        batch: the problems.
        report_progress: called with the number of steps done.
    """
    rows = _initial_rows(batch)
    last = len(configs[0].stages) - 1
    for i, stage in enumerate(configs[0].stages):
        program = stage_program(configs[0], stage, model)
        each = [stage_hyperparameters(config, config.stages[i], model.bird.keypoint_names) for config in configs]
        rows, config_of_row, targets_row = _merge_equal(rows, batch, each)
        problems = _stage_problems(rows, each, config_of_row, batch.targets, targets_row, needs_mask(stage))
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


def _merge_equal(
    rows: _Rows, batch: Batch, hyperparameters: Sequence[Hyperparameters]
) -> tuple[_Rows, Int[np.ndarray, "R"], Int[np.ndarray, "R"]]:
    """Return the distinct rows of the coming stage, and the config and the targets of each of them.

    Problems that were in one row and have equal hyperparameters stay together; the others get rows of their own.
    """
    content = [b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(each)) for each in hyperparameters]
    numbers: dict[tuple[int, bytes], int] = {}
    pairs = zip(rows.row.tolist(), batch.config.tolist(), strict=True)
    row = np.array([numbers.setdefault((before, content[c]), len(numbers)) for before, c in pairs])
    first = np.unique(row, return_index=True)[1]
    at = jnp.asarray((rows.row[first][:, None] * rows.hypotheses + np.arange(rows.hypotheses)).ravel())
    pose, solver, failure = jax.tree.map(lambda x: x[at], (rows.pose, rows.solver, rows.failure))
    return _Rows(pose, solver, failure, row, rows.hypotheses), batch.config[first], batch.targets_row[first]


def _stage_problems(
    rows: _Rows,
    hyperparameters: Sequence[Hyperparameters],
    config: Int[np.ndarray, "R"],
    targets: Targets,
    targets_row: Int[np.ndarray, "R"],
    with_masks: bool,
) -> Problem:
    """Return one problem for every hypothesis of every row, without masks where no term compares masks."""
    if not with_masks:
        targets = replace(targets, mask=targets.mask[..., :0, :0])
    at = np.repeat(targets_row, rows.hypotheses)
    own = [hyperparameters[c] for c in np.repeat(config, rows.hypotheses)]
    return Problem(
        hyperparameters=jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *own),
        anchor=rows.pose,
        targets=jax.tree.map(lambda x: jnp.asarray(x[at]), targets),
    )


def _run_stage(
    program: Program, problems: Problem, rows: _Rows, stage: StageConfig, report_progress: ReportProgress
) -> _Rows:
    """Take all steps of a stage, and name what failed."""
    state = begin(program, problems, rows.solver if stage.carry_moments else None)
    state, rejected = _take_steps(program, problems, state, stage, report_progress)
    step = np.where(rejected > 0, stage.steps + 1 - rejected, 0)  # all steps after the first failure are rejected
    failure = name_failures(rows.failure, step, stage.name, program, problems, state.pose)
    return rows._replace(pose=state.pose, solver=state.solver, failure=failure)


def _take_steps(
    program: Program, problems: Problem, state: StageState, stage: StageConfig, report_progress: ReportProgress
) -> tuple[StageState, Int[np.ndarray, "R"]]:
    """Take a stage's steps in calls of about a second, so that progress is shown and Ctrl-C works."""
    done, chunk = 0, 1
    rejected = np.zeros(state.pose.global_orient.shape[0], int)
    while done < stage.steps:
        take = min(chunk, stage.steps - done)
        began = time.perf_counter()
        state, loss, rejected = advance((program, problems, jnp.int32(take)), state)
        mean_loss = float(jnp.mean(loss))  # waits for the result
        seconds = time.perf_counter() - began
        done += take
        report_progress(take, f"{stage.name}: loss {mean_loss:.5g} a window")
        # the first call compiles, so that its time is no measure of speed
        chunk = 2 if done == take else max(1, min(4 * take, int(SECONDS_A_CALL * take / seconds)))
    return state, np.asarray(rejected)


def _keep_best(program: Program, problems: Problem, rows: _Rows) -> tuple[_Rows, Problem]:
    """Keep the hypothesis of the smallest objective of every row."""
    best = _best(report(program, problems, rows.pose), rows.hypotheses)
    pose, solver, failure, problems = jax.tree.map(lambda x: x[best], (rows.pose, rows.solver, rows.failure, problems))
    return _Rows(pose, solver, failure, rows.row, 1), problems


def _best(final: Report, hypotheses: int) -> Int[Array, "R"]:
    total = jnp.stack(list(final.loss.values())).sum(axis=0).reshape(-1, hypotheses)
    best = jnp.argmin(jnp.where(jnp.isfinite(total), total, jnp.inf), axis=1)
    return jnp.arange(len(total)) * hypotheses + best
