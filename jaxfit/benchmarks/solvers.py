"""Benchmark of the solvers: loss over time in a stage of the paper's config."""

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

from jaxfit.config.fit import StageConfig, load_config
from jaxfit.data.observations import Observations
from jaxfit.fitting.adam import ADAM
from jaxfit.fitting.fit import check_observations, windows_of
from jaxfit.fitting.levenberg_marquardt import LEVENBERG_MARQUARDT
from jaxfit.fitting.problem import Problem, Program, Solver, problem_loss
from jaxfit.fitting.solve import Report, advance, begin, report
from jaxfit.fitting.stages import fit_model, needs_mask, stage_hyperparameters, stage_program
from jaxfit.fitting.tasks import initial_poses_of
from jaxfit.fitting.windows import load_targets
from jaxfit.model.bird import Bird
from jaxfit.model.pose import Pose
from jaxfit.progress import ProgressTask, ReportProgress, silent
from jaxfit.storage.files import write_whole

__all__ = ["LBFGS", "bench_solvers", "plot_solvers"]


def _pose(z: Pose, problem: Problem) -> Pose:
    """Return the pose for the variable z of L-BFGS: the change from the anchor in units of Adam's step size.

    In these units, all parameters have a similar scale.
    """
    step_size = problem.hyperparameters.step_size
    return jax.tree.map(lambda anchor, step, z: anchor + step * z, problem.anchor, step_size, z)


def _loss_of(program: Program):
    def loss(z: Pose, problem: Problem) -> tuple[Float[Array, ""], Float[Array, ""]]:
        value = problem_loss(program, problem, _pose(z, problem))
        return value, value

    return loss


def _minimiser() -> optx.OptaxMinimiser:
    # the default, a zoom line search, needs more time for the same loss
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
"""L-BFGS, only for this comparison: it is not fast enough for `stages.SOLVERS`."""

SCHEDULES = {
    "keypoints": {
        "adam": (ADAM, 600, 25),
        "lbfgs": (LBFGS, 400, 25),
        "levenberg_marquardt": (LEVENBERG_MARQUARDT, 25, 1),
    },
    "mask": {"adam": (ADAM, 400, 10), "levenberg_marquardt": (LEVENBERG_MARQUARDT, 25, 1)},
}
"""For each stage and solver, largest number of steps, and number of steps between two reports of the loss. In the mask
stage, the line search of L-BFGS renders many silhouettes a step, so L-BFGS is slower than Adam there."""


def bench_solvers(
    observations: Observations,
    bird: Bird,
    stage_name: str = "keypoints",
    limit: int | None = None,
    repeats: int = 5,
    progress: ProgressTask = silent,
) -> dict[str, Any]:
    """Minimise a stage of the paper's config with each solver, all windows as one batch.

    The mask stage begins where Adam ends the keypoint stage.

    The solvers run alternately, and times are medians. Times exclude compilation and the reports of the loss.

    Args:
        observations: the birds of the fit.
        bird: the model.
        stage_name: `keypoints` or `mask`.
        limit: largest number of steps of a solver. None: the number in `SCHEDULES`.
        repeats: number of runs of each solver.
        progress: shows the progress of all runs.

    Returns:
        For each solver, a dictionary with its curve: `steps`, `seconds` and `loss` (the objective, summed over all
        windows). Also `stage`, `birds` and `windows`; `adam_s`, the seconds of Adam's whole stage; for each other
        solver `…_s`, the seconds until its loss is at most Adam's final loss (None: never), and `…_ratio`, these
        seconds over `adam_s`; for every solver `…_loss`, its final loss.
    """
    config, schedules = load_config("paper"), SCHEDULES[stage_name]
    observations = check_observations(observations, bird, "observations")
    windows, model = windows_of(observations, config, "observations"), fit_model(bird, config)
    count = len(windows)
    initial_pose = initial_poses_of(windows, config, model)

    def problems_of(stage: StageConfig, anchor: Pose) -> tuple[Program, Problem]:
        hyperparameters = stage_hyperparameters(config, stage, bird.keypoint_names)
        repeated = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * count), hyperparameters)
        mask_px = config.crop.size_px if needs_mask(stage) else 0
        targets = load_targets(windows, mask_px, config.grow_masks_px)
        return stage_program(config, stage, model), Problem(repeated, anchor, jax.tree.map(jnp.asarray, targets))

    program, problems = problems_of(config.stages[0], jax.tree.map(lambda x: x[:, 0], initial_pose))
    if stage_name == "mask":
        state, _, _ = advance((program, problems, jnp.int32(config.stages[0].steps)), begin(program, problems, None))
        program, problems = problems_of(config.stages[1], state.pose)
    result: dict[str, Any] = {"stage": stage_name, "birds": len(np.unique(windows.track)), "windows": count}
    step_counts = {name: min(steps, limit or steps) for name, (_, steps, _) in schedules.items()}

    def run(name: str, report_progress: ReportProgress) -> tuple[list[int], list[float], list[float]]:
        solver, _, interval = schedules[name]
        solver_program = program._replace(solver=solver)
        state = begin(solver_program, problems, None)
        steps, seconds, loss = [0], [0.0], [_total_loss(report(solver_program, problems, problems.anchor))]
        while steps[-1] < step_counts[name]:
            take = min(interval, step_counts[name] - steps[-1])
            start = time.perf_counter()
            state, _, rejected = advance((solver_program, problems, jnp.int32(take)), state)
            jax.block_until_ready(rejected)
            seconds.append(seconds[-1] + time.perf_counter() - start)
            steps.append(steps[-1] + take)
            loss.append(_total_loss(report(solver_program, problems, state.pose)))
            report_progress(take, f"{name}: loss {loss[-1]:.5g}")
        return steps, seconds, loss

    seconds_of_runs: dict[str, list[list[float]]] = {name: [] for name in schedules}
    with progress("Minimising", (repeats + 1) * sum(step_counts.values())) as report_progress:
        for repeat in range(repeats + 1):
            for name in schedules:
                steps, seconds, loss = run(name, report_progress)
                if repeat:  # the first run compiles
                    seconds_of_runs[name].append(seconds)
                result[name] = {"steps": steps, "loss": loss}
    for name, seconds in seconds_of_runs.items():
        result[name]["seconds"] = np.median(seconds, axis=0).tolist()
    target, adam_s = result["adam"]["loss"][-1], result["adam"]["seconds"][-1]
    result |= {"adam_s": adam_s, "adam_loss": target}
    for name in list(schedules)[1:]:
        result[f"{name}_loss"] = result[name]["loss"][-1]
        reached = [s for s, loss in zip(result[name]["seconds"], result[name]["loss"], strict=True) if loss <= target]
        result[f"{name}_s"] = reached[0] if reached else None
        result[f"{name}_ratio"] = reached[0] / adam_s if reached else None
    return result


def _total_loss(final: Report) -> float:
    """Return the objective, summed over all windows."""
    return float(sum(share.sum() for share in final.loss.values()))


def plot_solvers(result: dict[str, Any], path: Path) -> None:
    """Plot the curves of `bench_solvers` as a PNG: loss over time (needs the extra `report`)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.2), layout="constrained")
    panel = figure.subplots()
    for name in SCHEDULES[result["stage"]]:
        curve = result[name]
        marker = "o" if len(curve["steps"]) <= 30 else None
        label = f"{name.replace('_', '-')}, {curve['steps'][-1]} steps"
        panel.plot(curve["seconds"], curve["loss"], marker=marker, markersize=3, label=label)
    panel.axhline(result["adam_loss"], color="grey", linewidth=0.8, linestyle=":", label="final loss of Adam")
    panel.set(
        xlabel="time in s (median)",
        ylabel="objective, sum over all windows",
        yscale="log",
        title=f"Stage {result['stage']}: loss over time",
    )
    panel.grid(True, which="both", alpha=0.2)
    panel.legend(frameon=False)
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=110, metadata={"Software": None}))
