"""Simulate a short scene, fit it as the paper does, measure it against the truth, and draw it."""

from __future__ import annotations

import time
from pathlib import Path

from jaxfit.config import config_to_yaml, load_config
from jaxfit.errors import InputError
from jaxfit.evaluation.evaluate import Evaluation, evaluate
from jaxfit.fitting.fit import fit
from jaxfit.fitting.solution import save_solution
from jaxfit.fitting.summary import summarise
from jaxfit.formats.scene_folder import FOOTAGE, MARKER
from jaxfit.model.files import load_murre
from jaxfit.progress import terminal
from jaxfit.simulation.scene import simulate
from jaxfit.storage import check_replaceable
from jaxfit.tables import evaluation_tables, show
from jaxfit.view.overlay import overlay

__all__ = ["run_demo"]

BIRDS, FRAMES, SIZE, SEED = 5, 60, (1296, 760), 4


def run_demo(folder: Path) -> Evaluation:
    """Leave a scene, its fit, an overlay video and a contact sheet in a folder, and print what was found.

    Args:
        folder: for `scene/`, `result/`, `overlay.mp4` and `overlay.png`; an earlier demo there is replaced.

    Raises:
        InputError: the folder cannot be written, or holds something else than an earlier demo.
    """
    began = time.perf_counter()
    scene_folder, result_folder, video = folder / "scene", folder / "result", folder / "overlay.mp4"
    _check_folder(folder)
    check_replaceable(scene_folder, True, MARKER)
    check_replaceable(result_folder, True, "poses.npz")
    bird, config = load_murre(), load_config("paper")
    show(f"{BIRDS} murres on a ledge, {FRAMES} frames, simulated; what detectors would report of them is fitted")
    scene = simulate(bird, scene_folder, BIRDS, FRAMES, SIZE, seed=SEED, overwrite=True, progress=terminal)
    fitting = time.perf_counter()
    solution = fit(scene.detections, bird, config, progress=terminal, source=scene_folder)
    seconds = {"fit": time.perf_counter() - fitting}
    result = evaluate(solution, bird, scene.truth, terminal, scene_folder, truth_solution=scene.poses)
    summary = summarise(solution, bird, seconds) | {"metrics": result.overall}
    save_solution(solution, bird, config_to_yaml(config), summary, result_folder, overwrite=True)
    overlay(
        solution,
        bird,
        scene_folder / FOOTAGE,
        video,
        observations=scene.detections,
        side_views=True,
        overwrite=True,
        progress=terminal,
    )
    for table in evaluation_tables(result):
        show(table)
    show(f"done in {time.perf_counter() - began:.0f} s, of which the fit took {seconds['fit']:.0f}. Look at")
    for name, what in (
        (video, "the fitted birds on the footage, and each from its side"),
        (video.with_suffix(".png"), "a contact sheet"),
        (result_folder, "poses.npz, summary.json"),
        (scene_folder, "footage, truth and detections"),
    ):
        show(f"  {name}: {what}")
    return result


def _check_folder(folder: Path) -> None:
    if not folder.exists():
        return
    if not folder.is_dir():
        raise InputError(folder, "is a file, not a folder", "choose another --out")
    if any(folder.iterdir()) and not (folder / "scene" / MARKER).is_file():
        problem = "holds files, but no earlier demo, and is left alone"
        raise InputError(folder, problem, "choose another --out, new or empty")
