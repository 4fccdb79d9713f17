"""Windows through all stages, batch by batch, within the memory at hand."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxfit.camera import Camera
from jaxfit.config import FitConfig
from jaxfit.fitting.solve import Problem, Report, StageState, advance, begin, report
from jaxfit.fitting.stages import needs_mask, stage_problem
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Rig
from jaxfit.model.pose import Pose
from jaxfit.objective.scene import Evidence, Priors
from jaxfit.progress import Tick

__all__ = ["Fitted", "fit_batch", "frames_per_batch"]

SECONDS_A_CALL = 1.0
"""How long the solver may run between two looks at progress and Ctrl-C."""


class Fitted(NamedTuple):
    """What became of a batch of W windows."""

    pose: Pose
    report: Report
    diverged: Bool[np.ndarray, "W"]
    """Whether any step was refused because its gradient was not finite, or the end itself is not."""


def frames_per_batch(bird: Bird, config: FitConfig) -> int:
    """Frames that fit into `config.memory_gb`: per frame about ten arrays of the mesh and two of the crop."""
    per_frame = 10 * 12 * bird.vertices.shape[0] + 2 * config.crop.size_px**2 + 100_000
    return max(int(config.memory_gb * 1e9 / per_frame), 1)


def fit_batch(
    bird: Bird,
    rig: Rig,
    priors: Priors,
    config: FitConfig,
    camera: Camera,
    evidence: Evidence,
    start: Pose,
    tick: Tick,
) -> Fitted:
    """Run all stages on W windows.

    Args:
        evidence: leading axis W (NumPy; masks are sent to a stage only where it needs them).
        start: leading axes W, H: H hypotheses of each window.
        tick: told the steps done.
    """
    windows, hypotheses = start.global_orient.shape[:2]
    pose = jax.tree.map(lambda x: x.reshape(windows * hypotheses, *x.shape[2:]), start)
    refused = jnp.zeros(windows * hypotheses, int)
    before: StageState | None = None
    for i, stage in enumerate(config.stages):
        problem = stage_problem(config, stage, bird, rig, priors, camera)
        seen = _lanes(evidence, hypotheses, needs_mask(stage))
        state = begin(problem, pose, seen, before if stage.carry_moments else None)
        state, new_refused = _run(problem, seen, state, stage.steps, stage.name, tick)
        refused = refused + new_refused
        last = i == len(config.stages) - 1
        if hypotheses > 1 and (stage.keep_best or last):
            keep = _best(report(problem, state.pose, state.start, seen), windows, hypotheses)
            state, refused = jax.tree.map(lambda x, keep=keep: x[keep], (state, refused))
            hypotheses = 1
            seen = _lanes(evidence, 1, needs_mask(stage))
        pose, before = state.pose, state
        if last:
            final = report(problem, pose, state.start, seen)
    total = sum(np.asarray(value) for value in final.loss.values())
    return Fitted(pose, final, (np.asarray(refused) > 0) | ~np.isfinite(total))


def _run(
    problem: Problem, evidence: Evidence, state: StageState, steps: int, name: str, tick: Tick
) -> tuple[StageState, Array]:
    """Take a stage's steps in calls of about a second, so that progress shows and Ctrl-C works."""
    done, chunk = 0, 1
    refused = jnp.zeros(evidence.present.shape[0], int)
    while done < steps:
        take = min(chunk, steps - done)
        began = time.perf_counter()
        state, loss, refused = advance((problem, evidence, jnp.int32(take)), state)
        mean_loss = float(jnp.mean(loss))  # waits for the result
        seconds = time.perf_counter() - began
        done += take
        tick(take, f"{name}: loss {mean_loss:.5g} a window")
        # the first call compiles: it says nothing about speed
        chunk = 2 if done == take else max(1, min(4 * take, int(SECONDS_A_CALL * take / seconds)))
    return state, refused


def _lanes(evidence: Evidence, hypotheses: int, with_mask: bool) -> Evidence:
    """Evidence for every hypothesis of every window, without masks where nothing looks at them."""
    mask = evidence.mask if with_mask else evidence.mask[..., :0, :0]
    lanes = replace(evidence, mask=mask)
    return jax.tree.map(lambda x: jnp.asarray(np.repeat(x, hypotheses, axis=0) if hypotheses > 1 else x), lanes)


def _best(final: Report, windows: int, hypotheses: int) -> Array:
    """Lane of the hypothesis of least objective, for every window."""
    total = jnp.stack(list(final.loss.values())).sum(axis=0).reshape(windows, hypotheses)
    best = jnp.argmin(jnp.where(jnp.isfinite(total), total, jnp.inf), axis=1)
    return jnp.arange(windows) * hypotheses + best
