"""Simulate a short scene, reconstruct it from its footage alone, and measure what came of it against the truth."""

from __future__ import annotations

import time
from pathlib import Path

from jaxfit.cli.observation_tables import matching_line, observation_tables
from jaxfit.cli.tables import evaluation_tables, plain_json, show, track_table
from jaxfit.config.reconstruct import load_reconstruct_config
from jaxfit.data.formats.scene_folder import FOOTAGE, MARKER
from jaxfit.errors import InputError
from jaxfit.evaluation.evaluate import Evaluation, evaluate
from jaxfit.evaluation.matching import match_tracks
from jaxfit.evaluation.observed import evaluate_observations
from jaxfit.model.files import load_murre
from jaxfit.pipeline import OVERLAY, reconstruct
from jaxfit.progress import terminal
from jaxfit.simulation.scene import simulate
from jaxfit.storage.files import check_replaceable, write_whole

__all__ = ["run_demo"]

BIRDS, FRAMES, SIZE, SEED = 5, 60, (1296, 760), 1003
METRICS = "evaluation.json"


def run_demo(folder: Path) -> Evaluation:
    """Leave a scene and what was made of its footage in a folder, and print how well it agrees with the truth.

    Args:
        folder: for `scene/`, `result/` and `evaluation.json`; an earlier demo there is replaced.

    Raises:
        InputError: the folder cannot be written, or holds something else than an earlier demo.
    """
    began = time.perf_counter()
    scene_folder, result_folder = folder / "scene", folder / "result"
    _check_folder(folder)
    check_replaceable(scene_folder, True, MARKER)
    check_replaceable(result_folder, True, "poses.npz")
    bird, config = load_murre(), load_reconstruct_config()
    show(f"{BIRDS} murres on a ledge, {FRAMES} frames, simulated; then reconstructed from the footage alone")
    scene = simulate(bird, scene_folder, BIRDS, FRAMES, SIZE, seed=SEED, overwrite=True, progress=terminal)
    done = reconstruct(scene_folder / FOOTAGE, result_folder, bird, config, overwrite=True, progress=terminal)
    found = done.tracking.observations
    seen = evaluate_observations(found, scene.truth, scene_folder)
    solution, matching = match_tracks(done.solution, scene.truth, "overlap", scene_folder)
    result = evaluate(solution, bird, scene.truth, terminal, scene_folder, truth_solution=scene.poses)
    metrics = {"detection": seen.detection, "tracking": seen.tracking, **result.overall}
    write_whole(folder / METRICS, plain_json(metrics).encode())
    show(track_table(found, done.solution))
    for table in observation_tables(seen):
        show(table)
    show(matching_line(matching))
    for table in evaluation_tables(result):
        show(table)
    seconds = done.summary["seconds"]
    parts = ", ".join(f"{name} {seconds[name]:.0f}" for name in ("track", "fit", "overlay"))
    show(f"done in {time.perf_counter() - began:.0f} s ({parts}). Look at")
    for path, what in (
        (result_folder / OVERLAY, "the posed birds on the footage, and each from its side"),
        ((result_folder / OVERLAY).with_suffix(".png"), "a contact sheet"),
        (result_folder, "observations.json, poses.npz, summary.json"),
        (scene_folder, "footage and truth"),
        (folder / METRICS, "the figures above"),
    ):
        show(f"  {path}: {what}")
    return result


def _check_folder(folder: Path) -> None:
    if not folder.exists():
        return
    if not folder.is_dir():
        raise InputError(folder, "is a file, not a folder", "choose another --out")
    if any(folder.iterdir()) and not (folder / "scene" / MARKER).is_file():
        problem = "holds files, but no earlier demo, and is left alone"
        raise InputError(folder, problem, "choose another --out, new or empty")
