"""Windows through all stages, batch by batch, within the memory at hand."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxfit.config.fit import FitConfig
from jaxfit.fitting.diagnose import name_failures
from jaxfit.fitting.lane import Hyperparameters, Problem
from jaxfit.fitting.solve import Report, StageState, advance, begin, report
from jaxfit.fitting.stages import needs_mask, stage_hyperparameters, stage_problem
from jaxfit.model.bird import Bird
from jaxfit.model.camera import Camera
from jaxfit.model.kinematics import Rig
from jaxfit.model.pose import Pose
from jaxfit.objective.posed_window import Priors, Targets
from jaxfit.progress import ReportProgress

__all__ = ["Fitted", "Lanes", "fit_batch", "frames_per_batch"]

SECONDS_A_CALL = 1.0
"""How long the solver may run between two looks at progress and Ctrl-C."""


class Fitted(NamedTuple):
    """What became of a batch of L lanes, as NumPy arrays."""

    pose: Pose
    report: Report
    failure: np.ndarray
    """(L,) text: which terms were the first whose value or gradient was not finite, and when; empty where none was."""


def frames_per_batch(bird: Bird, config: FitConfig) -> int:
    """Frames that fit into `config.memory_gb`: per frame about ten arrays of the mesh and two of the crop."""
    per_frame = 10 * 12 * bird.vertices.shape[0] + 2 * config.crop.size_px**2 + 100_000
    return max(int(config.memory_gb * 1e9 / per_frame), 1)


class Lanes(NamedTuple):
    """A batch of L lanes: each one window under one config."""

    config: Int[np.ndarray, "L"]
    """Position of its config; all configs of a batch are one `program`."""
    targets: Int[np.ndarray, "L"]
    """Row of the targets that it is fitted to."""
    start: Int[np.ndarray, "L"]
    """Row of the initial poses. Lanes of one initial pose are computed once while their hyperparameters are equal:
    only lanes of one row of targets may share one."""


def fit_batch(
    bird: Bird,
    rig: Rig,
    priors: Priors,
    configs: Sequence[FitConfig],
    camera: Camera,
    targets: Targets,
    start: Pose,
    lanes: Lanes,
    report_progress: ReportProgress,
) -> Fitted:
    """Run all stages on L lanes.

    Args:
        configs: equal but for what their hyperparameters hold, see `stages.program`.
        targets: leading axis E (NumPy; masks are sent to a stage only where it needs them).
        start: leading axes S, H: H hypotheses of each start.
        lanes: which window under which config each lane is.
        report_progress: told the steps done.
    """
    starts, hypotheses = start.global_orient.shape[:2]
    pose = jax.tree.map(lambda x: x.reshape(starts * hypotheses, *x.shape[2:]), start)
    failure = np.full(starts * hypotheses, "", object)
    before: StageState | None = None
    row = lanes.start  # of each lane in what is computed, hypotheses side by side
    stages = configs[0].stages
    for i, stage in enumerate(stages):
        problem = stage_problem(configs[0], stage, rig, priors, camera)
        each = [stage_hyperparameters(config, config.stages[i], bird.keypoint_names) for config in configs]
        first, now = _distinct(row, lanes.config, each)
        pose, before, failure = _rows((pose, before, failure), row[first], hypotheses)
        row = now
        hyperparameters = _side_by_side([each[k] for k in lanes.config[first]], hypotheses)
        seen = _seen(targets, lanes.targets[first], hypotheses, needs_mask(stage))
        state = begin(problem, hyperparameters, pose, seen, before if stage.carry_moments else None)
        state, refused = _run((problem, hyperparameters, seen), state, stage.steps, stage.name, report_progress)
        broke = np.where(refused > 0, stage.steps + 1 - refused, 0)  # from then on it stood still
        failure = name_failures(failure, broke, stage.name, problem, hyperparameters, seen, state.pose, state.start)
        last = i == len(stages) - 1
        if hypotheses > 1 and (stage.keep_best or last):
            keep = _best(report(problem, hyperparameters, state.pose, state.start, seen), len(first), hypotheses)
            state, failure, hyperparameters, seen = jax.tree.map(
                lambda x, keep=keep: x[keep], (state, failure, hyperparameters, seen)
            )
            hypotheses = 1
        pose, before = state.pose, state
        if last:
            final = report(problem, hyperparameters, pose, state.start, seen)
            total = np.asarray(sum(final.loss.values()))
            broke = np.where(np.isfinite(total), 0, stage.steps)
            failure = name_failures(failure, broke, stage.name, problem, hyperparameters, seen, pose, state.start)
    pose, final, failure = jax.tree.map(lambda x: np.asarray(x)[row], (pose, final, failure))
    return Fitted(pose, final, failure)


def _distinct(
    row: Int[np.ndarray, "L"], config: Int[np.ndarray, "L"], hyperparameters: Sequence[Hyperparameters]
) -> tuple[Int[np.ndarray, "D"], Int[np.ndarray, "L"]]:
    """The first lane of each of D distinct ones, and each lane's row among those: lanes that stood in one row and
    have equal hyperparameters stay together."""
    held = [b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(each)) for each in hyperparameters]
    rows: dict[tuple[int, bytes], int] = {}
    now = np.array([rows.setdefault((int(r), held[k]), len(rows)) for r, k in zip(row, config, strict=True)])
    return np.unique(now, return_index=True)[1], now


def _rows(tree: Any, rows: Int[np.ndarray, "D"], hypotheses: int) -> Any:
    """Rows of everything, with all their hypotheses."""
    at = jnp.asarray((rows[:, None] * hypotheses + np.arange(hypotheses)).ravel())
    return jax.tree.map(lambda x: x[at], tree)


def _side_by_side(hyperparameters: Sequence[Hyperparameters], hypotheses: int) -> Hyperparameters:
    return jax.tree.map(lambda *x: jnp.asarray(np.repeat(np.stack(x), hypotheses, axis=0)), *hyperparameters)


def _seen(targets: Targets, rows: Int[np.ndarray, "D"], hypotheses: int, with_mask: bool) -> Targets:
    """Targets for every hypothesis of every row, without masks where nothing looks at them."""
    mask = targets.mask if with_mask else targets.mask[..., :0, :0]
    at = np.repeat(rows, hypotheses)
    return jax.tree.map(lambda x: jnp.asarray(x[at]), replace(targets, mask=mask))


def _run(
    fixed: tuple[Problem, Hyperparameters, Targets],
    state: StageState,
    steps: int,
    name: str,
    report_progress: ReportProgress,
) -> tuple[StageState, Array]:
    """Take a stage's steps in calls of about a second, so that progress shows and Ctrl-C works."""
    done, chunk = 0, 1
    refused = jnp.zeros(state.pose.global_orient.shape[0], int)
    while done < steps:
        take = min(chunk, steps - done)
        began = time.perf_counter()
        state, loss, refused = advance((*fixed, jnp.int32(take)), state)
        mean_loss = float(jnp.mean(loss))  # waits for the result
        seconds = time.perf_counter() - began
        done += take
        report_progress(take, f"{name}: loss {mean_loss:.5g} a window")
        # the first call compiles: it says nothing about speed
        chunk = 2 if done == take else max(1, min(4 * take, int(SECONDS_A_CALL * take / seconds)))
    return state, refused


def _best(final: Report, windows: int, hypotheses: int) -> Array:
    """Lane of the hypothesis of least objective, for every window."""
    total = jnp.stack(list(final.loss.values())).sum(axis=0).reshape(windows, hypotheses)
    best = jnp.argmin(jnp.where(jnp.isfinite(total), total, jnp.inf), axis=1)
    return jnp.arange(windows) * hypotheses + best
