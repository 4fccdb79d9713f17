"""The demo: simulate a short scene, reconstruct the scene from its footage, measure and export the result."""

from __future__ import annotations

import time
from pathlib import Path

from jaxfit.cli.observation_tables import matching_line, observation_tables
from jaxfit.cli.tables import evaluation_tables, show, track_table
from jaxfit.config.reconstruct import load_reconstruct_config
from jaxfit.data.formats.scene_folder import FOOTAGE, MARKER
from jaxfit.errors import InputError
from jaxfit.evaluation.evaluate import Evaluation, evaluate
from jaxfit.evaluation.matching import match_tracks
from jaxfit.evaluation.observed import evaluate_observations
from jaxfit.evaluation.truth import Truth
from jaxfit.export.export import export_result
from jaxfit.model.files import load_murre
from jaxfit.pipeline import OVERLAY, reconstruct
from jaxfit.progress import terminal
from jaxfit.report.write import REPORT
from jaxfit.simulation.scene import simulate
from jaxfit.storage.files import check_replaceable, check_writable, write_whole
from jaxfit.storage.json_values import json_text
from jaxfit.storage.temporary import remove_leftovers

__all__ = ["run_demo"]

BIRDS, FRAMES, SIZE, SEED = 5, 60, (1296, 760), 1003
METRICS, ANIMATION = "evaluation.json", "birds.glb"


def run_demo(folder: Path) -> Evaluation:
    """Write a simulated scene and its reconstruction to a folder, and print how well the two agree.

    Args:
        folder: receives `scene/`, `result/`, `evaluation.json` and `birds.glb`; an earlier demo in the folder is
            replaced.

    Returns:
        The metrics of the reconstruction.

    Raises:
        InputError: the folder cannot be written, or holds files other than an earlier demo.
    """
    start = time.perf_counter()
    scene_folder, result_folder = folder / "scene", folder / "result"
    _check_folder(folder)
    check_replaceable(scene_folder, True, MARKER)
    check_replaceable(result_folder, True, "poses.npz")
    bird, config = load_murre(), load_reconstruct_config()
    show(f"simulating {BIRDS} murres on a ledge over {FRAMES} frames, then reconstructing them from the footage alone")
    scene = simulate(bird, scene_folder, BIRDS, FRAMES, SIZE, seed=SEED, overwrite=True, progress=terminal)
    done = reconstruct(scene_folder / FOOTAGE, result_folder, bird, config, overwrite=True, progress=terminal)
    observations = done.tracking.observations
    truth = Truth(scene.truth, scene.poses, source=scene_folder)
    observed = evaluate_observations(observations, truth)
    solution, matching = match_tracks(done.solution, truth, "overlap")
    result = evaluate(solution, bird, truth, terminal)
    export_result(result_folder, "glb", folder / ANIMATION, one_file=True, overwrite=True, progress=terminal)
    metrics = {"detection": observed.detection, "tracking": observed.tracking, **result.overall}
    write_whole(folder / METRICS, json_text(metrics).encode())
    show(track_table(observations, done.solution))
    for table in observation_tables(observed):
        show(table)
    show(matching_line(matching))
    for table in evaluation_tables(result):
        show(table)
    seconds = done.summary["seconds"]
    parts = ", ".join(f"{name} {seconds[name]:.0f}" for name in ("track", "fit", "overlay"))
    show(f"done in {time.perf_counter() - start:.0f} s ({parts}). Files:")
    for path, text in (
        (result_folder / REPORT, "warnings, quality and pictures: open it in a browser"),
        (result_folder / OVERLAY, "the posed birds on the footage, and every bird from its side"),
        ((result_folder / OVERLAY).with_suffix(".png"), "a contact sheet, with a legend"),
        (result_folder, "observations.json, poses.npz, summary.json"),
        (scene_folder, "footage and ground truth"),
        (folder / METRICS, "the metrics above"),
        (folder / ANIMATION, "the animated birds, for Blender (File > Import > glTF 2.0)"),
    ):
        show(f"  {path}: {text}")
    return result


def _check_folder(folder: Path) -> None:
    """Raise InputError unless the folder is absent, empty or an earlier demo."""
    check_writable(folder)
    if not folder.exists():
        return
    if not folder.is_dir():
        raise InputError(folder, "is a file, not a folder", "choose another --out")
    remove_leftovers(folder)
    if any(folder.iterdir()) and not (folder / "scene" / MARKER).is_file():
        problem = "holds files that are not an earlier demo"
        raise InputError(folder, problem, "choose another --out, new or empty")
