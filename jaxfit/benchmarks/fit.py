"""How long the paper's fit takes for a scene of several birds, and how close it comes to the truth."""

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


def bench_fit(
    bird: Bird,
    birds: int = 9,
    frames: int = 100,
    config: FitConfig | None = None,
    seed: int = 0,
    progress: ProgressTask = silent,
) -> dict[str, Any]:
    """Fit a simulated scene with a whole config (default: the paper's) and measure it.

    The scene: smooth random motion of `bird`, keypoints with 2 px of noise and 5 % outliers, whole masks.
    A first run with one step a stage compiles (or finds the compiled programs of an earlier run); the second
    is timed.

    Returns:
        `minutes` of the timed fit and `compile_s` of the first; `ms_per_frame_step` (time per bird, frame and
        step over all stages); `birds`, `frames`, `faces`, `steps`; `peak_memory_gb` of the process; and the
        quality against truth: `pck@0.05`, `iou`, `me_p`, `me_v`, `pa_mpjpe` (keypoints, model units).
    """
    config = load_config("paper") if config is None else config
    poses, observations = noisy_scene(bird, birds, frames, seed)
    short = dataclasses.replace(config, stages=tuple(dataclasses.replace(stage, steps=1) for stage in config.stages))
    began = time.perf_counter()
    fit(observations, bird, short)
    compiled = time.perf_counter()
    solution = fit(observations, bird, config, progress=progress)
    seconds = time.perf_counter() - compiled
    quality = evaluate(solution, bird, detect(bird, poses)).overall
    steps = [stage.steps for stage in config.stages]
    unit = 1e9 if sys.platform == "darwin" else 1e6  # macOS counts bytes, Linux kilobytes
    return {
        "minutes": seconds / 60,
        "compile_s": compiled - began,
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
    """Smooth random motion of several birds, one after the other's seed, and what is detected of it."""
    poses = [smooth_motion(bird, frames, seed + n) for n in range(birds)]
    return poses, detect(bird, poses, NOISE_PX, OUTLIERS, seed)


def keypoints_error(solution: Solution, bird: Bird, truth: list[Pose]) -> float:
    """Mean 3D distance of keypoints after aligning every frame (Procrustes), model units."""
    rig = fold_bird(bird)
    true_cam = np.stack([window_keypoints(rig, window_transforms(rig, pose), pose) for pose in truth])
    return pa_mpjpe(solution.keypoints_cam, true_cam, np.isfinite(solution.keypoints_cam).all(-1))
