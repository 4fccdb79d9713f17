"""Benchmark of the fit: time and errors for a simulated scene of several birds."""

from __future__ import annotations

import dataclasses
import resource
import sys
import time
from typing import Any

import numpy as np

from jaxfit.config.fit import FitConfig, load_config
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.metrics import pa_mpjpe
from jaxfit.fitting.fit import fit
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import fold_bird, window_keypoints, window_transforms
from jaxfit.model.pose import Pose
from jaxfit.progress import ProgressTask, silent
from jaxfit.simulation.detections import detect
from jaxfit.simulation.motion import smooth_motion

__all__ = ["bench_fit", "keypoints_error", "noisy_scene"]

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
    return pa_mpjpe(solution.keypoints_cam, true_cam, np.isfinite(solution.keypoints_cam).all(-1))
