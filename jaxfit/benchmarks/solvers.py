"""How fast different solvers lower the objective of a stage without masks: loss over time, side by side."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, Float, Int

from jaxfit.config.fit import load_config
from jaxfit.data.observations import Observations
from jaxfit.fitting.adam import ADAM
from jaxfit.fitting.fit import check_observations, windows_of
from jaxfit.fitting.initial_pose_search import search_initial_poses
from jaxfit.fitting.levenberg_marquardt import LEVENBERG_MARQUARDT
from jaxfit.fitting.problem import Problem, Program, Solver, problem_loss
from jaxfit.fitting.solve import Report, advance, begin, report
from jaxfit.fitting.stages import fit_model, stage_hyperparameters, stage_program
from jaxfit.fitting.windows import load_targets
from jaxfit.model.bird import Bird
from jaxfit.model.pose import Pose
from jaxfit.progress import ProgressTask, ReportProgress, silent
from jaxfit.storage.files import write_whole

__all__ = ["LBFGS", "bench_solvers", "plot_solvers"]


def _pose(z: Pose, problem: Problem) -> Pose:
    """Return the pose of L-BFGS' variable z: the change since the anchor, in units of Adam's step.

    All parameters are then of one scale.
    """
    step_size = problem.hyperparameters.step_size
    return jax.tree.map(lambda anchor, step, z: anchor + step * z, problem.anchor, step_size, z)


def _loss_of(program: Program):
    def loss(z: Pose, problem: Problem) -> tuple[Float[Array, ""], Float[Array, ""]]:
        value = problem_loss(program, problem, _pose(z, problem))
        return value, value

    return loss


def _minimiser() -> optx.OptaxMinimiser:
    # the default, a zoom line search, takes longer for the same loss
    search = optax.scale_by_backtracking_linesearch(max_backtracking_steps=15)
    return optx.OptaxMinimiser(optax.lbfgs(linesearch=search), rtol=0.0, atol=0.0)


def _init(program: Program, problem: Problem, carried: Any) -> Any:
    z, scalar = jax.tree.map(jnp.zeros_like, problem.anchor), jax.ShapeDtypeStruct((), jnp.float32)
    state = _minimiser().init(_loss_of(program), z, problem, {}, scalar, scalar, frozenset())
    return z, state, jnp.float32(jnp.inf)


def _step(program: Program, problem: Problem, pose: Pose, state: Any) -> tuple[Pose, Any]:
    z, state, _ = state
    z, state, loss = _minimiser().step(_loss_of(program), z, problem, {}, state, frozenset())
    return _pose(z, problem), (z, state, loss)


def _outcome(state: Any) -> tuple[Float[Array, ""], Int[Array, ""]]:
    return state[2], jnp.int32(0)


LBFGS = Solver(_init, _step, _outcome)
"""For this comparison only: it does not earn a place among `stages.SOLVERS`."""

RACE = {"adam": (ADAM, 600, 25), "lbfgs": (LBFGS, 400, 25), "levenberg_marquardt": (LEVENBERG_MARQUARDT, 25, 1)}
"""What runs, how many steps at most, and after how many the loss is looked at."""


def bench_solvers(
    observations: Observations,
    bird: Bird,
    limit: int | None = None,
    repeats: int = 5,
    progress: ProgressTask = silent,
) -> dict[str, Any]:
    """Minimise the keypoint stage of the paper's config with each solver, all windows as one batch.

    Solvers take turns, and times are medians. Compilation and the reports of the loss are not counted.

    Args:
        observations: what is fitted.
        bird: the model.
        limit: at most this many steps of any solver; None for as many as it needs.
        repeats: how often each runs.
        progress: told of every step.

    Returns:
        For each solver `steps`, `seconds` and `loss`, its curve: the objective summed over all windows after that many
        steps. `birds`, `windows`; `adam_s`: Adam's whole stage; for the others `…_s`: seconds until their loss is
        no higher than Adam's last (None: never), and `…_ratio`: those over Adam's seconds; `…_loss`: the last.
    """
    config = load_config("paper")
    stage = config.stages[0]
    observations = check_observations(observations, bird, "observations")
    windows, model = windows_of(observations, config, "observations"), fit_model(bird, config)
    count = len(windows)
    initial_pose = search_initial_poses(
        bird,
        model.rig,
        jnp.asarray(windows.keypoints_px),
        jnp.asarray(windows.confidence),
        config.initialise,
        model.camera,
        config.common_size,
    )
    one = stage_hyperparameters(config, stage, bird.keypoint_names)
    problems = Problem(
        hyperparameters=jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * count), one),
        anchor=jax.tree.map(lambda x: x[:, 0], initial_pose),
        targets=jax.tree.map(jnp.asarray, load_targets(windows, mask_px=0)),
    )
    program = stage_program(config, stage, model)
    result: dict[str, Any] = {"birds": len(np.unique(windows.track)), "windows": count}
    most = {name: min(steps, limit or steps) for name, (_, steps, _) in RACE.items()}

    def run(name: str, report_progress: ReportProgress) -> tuple[list[int], list[float], list[float]]:
        solver, _, portion = RACE[name]
        own = program._replace(solver=solver)
        state = begin(own, problems, None)
        steps, seconds, loss = [0], [0.0], [_total(report(own, problems, problems.anchor))]
        while steps[-1] < most[name]:
            take = min(portion, most[name] - steps[-1])
            began = time.perf_counter()
            state, _, rejected = advance((own, problems, jnp.int32(take)), state)
            jax.block_until_ready(rejected)
            seconds.append(seconds[-1] + time.perf_counter() - began)
            steps.append(steps[-1] + take)
            loss.append(_total(report(own, problems, state.pose)))
            report_progress(take, f"{name}: loss {loss[-1]:.5g}")
        return steps, seconds, loss

    turns: dict[str, list[list[float]]] = {name: [] for name in RACE}
    with progress("Minimising", (repeats + 1) * sum(most.values())) as report_progress:
        for turn in range(repeats + 1):
            for name in RACE:
                steps, seconds, loss = run(name, report_progress)
                if turn:  # the first compiles
                    turns[name].append(seconds)
                result[name] = {"steps": steps, "loss": loss}
    for name, seconds in turns.items():
        result[name]["seconds"] = np.median(seconds, axis=0).tolist()
    target, adam_s = result["adam"]["loss"][-1], result["adam"]["seconds"][-1]
    result |= {"adam_s": adam_s, "adam_loss": target}
    for name in list(RACE)[1:]:
        result[f"{name}_loss"] = result[name]["loss"][-1]
        reached = [s for s, loss in zip(result[name]["seconds"], result[name]["loss"], strict=True) if loss <= target]
        result[f"{name}_s"] = reached[0] if reached else None
        result[f"{name}_ratio"] = reached[0] / adam_s if reached else None
    return result


def _total(final: Report) -> float:
    return float(sum(share.sum() for share in final.loss.values()))


def plot_solvers(result: dict[str, Any], path: Path) -> None:
    """Draw the curves of `bench_solvers` as a PNG: loss over seconds (needs the extra `report`)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.2), layout="constrained")
    panel = figure.subplots()
    for name in RACE:
        curve = result[name]
        marker = "o" if len(curve["steps"]) <= 30 else None
        label = f"{name.replace('_', '-')}, {curve['steps'][-1]} steps"
        panel.plot(curve["seconds"], curve["loss"], marker=marker, markersize=3, label=label)
    panel.axhline(result["adam_loss"], color="grey", linewidth=0.8, linestyle=":", label="Adam's last")
    panel.set(
        xlabel="seconds (medians)",
        ylabel="objective, all windows",
        yscale="log",
        title="Keypoint stage: loss over time",
    )
    panel.grid(True, which="both", alpha=0.2)
    panel.legend(frameon=False)
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=110, metadata={"Software": None}))
