"""Benchmarks of a fit: time and error, loss of solvers over time."""

from __future__ import annotations

import dataclasses
import resource
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, Float, Int

from jaxfit.config.fit import FitConfig, StageConfig, load_config
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.metrics import pa_mpjpe
from jaxfit.fitting.fit import check_observations, fit, windows_of
from jaxfit.fitting.levenberg_marquardt import LEVENBERG_MARQUARDT
from jaxfit.fitting.problem import Problem, Program, Solver, problem_loss
from jaxfit.fitting.solve import (
    ADAM,
    Report,
    advance,
    begin,
    fit_model,
    needs_mask,
    report,
    stage_hyperparameters,
    stage_program,
)
from jaxfit.fitting.tasks import initial_poses_of
from jaxfit.fitting.windows import load_targets
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import ProgressTask, ReportProgress, silent
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose, fold_bird, window_keypoints, window_transforms
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect

NOISE_PX, OUTLIERS = 2.0, 0.05
"""Standard deviation of the detected keypoints in pixels, and fraction of outliers."""


def bench_fit(
    bird: Bird,
    birds: int = 9,
    frames: int = 100,
    config: FitConfig | None = None,
    seed: int = 0,
    progress: ProgressTask = silent,
) -> dict[str, Any]:
    """Measure the time and the errors of a fit of a simulated scene.

    The scene has smooth random motion, keypoints with 2 px of noise and 5 % outliers, and complete masks. A first fit
    with one step per stage compiles the programs (or loads them from the cache of an earlier run). The second fit is
    measured.

    Args:
        bird: the model.
        birds: number of birds.
        frames: number of frames.
        config: config of the fit. The default is the paper's config.
        seed: seed of motion and noise.
        progress: shows the progress of the second fit.

    Returns:
        `minutes` (duration of the second fit), `compile_s` (duration of the first fit), `ms_per_frame_step` (time per
        bird, frame and step over all stages), `birds`, `frames`, `faces`, `steps`, `peak_memory_gb` of the process, and
        the errors against the truth: `pck@0.05`, `iou`, `me_p`, `me_v`, `pa_mpjpe` (keypoints, model units).
    """
    config = load_config("paper") if config is None else config
    poses, observations = noisy_scene(bird, birds, frames, seed)
    short = dataclasses.replace(config, stages=tuple(dataclasses.replace(stage, steps=1) for stage in config.stages))
    start = time.perf_counter()
    fit(observations, bird, short)
    compiled = time.perf_counter()
    solution = fit(observations, bird, config, progress=progress)
    seconds = time.perf_counter() - compiled
    quality = evaluate(solution, bird, detect(bird, poses)).overall
    steps = [stage.steps for stage in config.stages]
    unit = 1e9 if sys.platform == "darwin" else 1e6  # ru_maxrss is in bytes on macOS, and in kilobytes on Linux
    return {
        "minutes": seconds / 60,
        "compile_s": compiled - start,
        "ms_per_frame_step": 1e3 * seconds / (birds * frames * sum(steps)),
        "birds": birds,
        "frames": frames,
        "faces": len(bird.faces),
        "steps": steps,
        "peak_memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit,
        **{name: quality[name] for name in ("pck@0.05", "iou", "me_p", "me_v")},
        "pa_mpjpe": keypoints_error(solution, bird, poses),
    }


def noisy_scene(bird: Bird, birds: int, frames: int, seed: int = 0) -> tuple[list[Pose], Observations]:
    """Return smooth random motion of several birds (seeds `seed`, `seed` + 1, …) and noisy detections of the birds."""
    poses = [smooth_motion(bird, frames, seed + n) for n in range(birds)]
    return poses, detect(bird, poses, NOISE_PX, OUTLIERS, seed)


def keypoints_error(solution: Solution, bird: Bird, truth: list[Pose]) -> float:
    """Return the mean 3D error of keypoints after Procrustes alignment of every frame, in model units."""
    rig = fold_bird(bird)
    true_cam = np.stack([window_keypoints(rig, window_transforms(rig, pose), pose) for pose in truth])
    return pa_mpjpe(solution.keypoints.cam, true_cam, np.isfinite(solution.keypoints.cam).all(-1))


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
        limit: largest number of steps of a solver, also of Adam before the mask stage. None: the number in
            `SCHEDULES`.
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
        targets = load_targets(windows, mask_px)
        return stage_program(config, stage, model), Problem(repeated, anchor, jax.tree.map(jnp.asarray, targets))

    program, problems = problems_of(config.stages[0], jax.tree.map(lambda x: x[:, 0], initial_pose))
    if stage_name == "mask":
        before = min(config.stages[0].steps, limit or config.stages[0].steps)
        state, _, _ = advance((program, problems, jnp.int32(before)), begin(program, problems, None))
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
    return result | _compared(result, list(schedules)[1:])


def _compared(curves: dict[str, Any], others: list[str]) -> dict[str, Any]:
    """Return the final losses, and when the other solvers reach Adam's, as `bench_solvers` names them."""
    target, adam_s = curves["adam"]["loss"][-1], curves["adam"]["seconds"][-1]
    compared = {"adam_s": adam_s, "adam_loss": target}
    for name in others:
        seconds, losses = curves[name]["seconds"], curves[name]["loss"]
        reached = [s for s, loss in zip(seconds, losses, strict=True) if loss <= target]
        compared[f"{name}_loss"] = losses[-1]
        compared[f"{name}_s"] = reached[0] if reached else None
        compared[f"{name}_ratio"] = reached[0] / adam_s if reached else None
    return compared


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
