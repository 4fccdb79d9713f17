"""`simulate`, `demo`."""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from jaxfit.behaviour.result import behaviour_of_result
from jaxfit.cli.observations import matching_line, observation_tables, parsed_size
from jaxfit.cli.tables import evaluation_tables, flag_quality_line, show, track_table
from jaxfit.config.build import with_values
from jaxfit.config.reconstruct import load_reconstruct_config
from jaxfit.data.formats import FOOTAGE, MARKER
from jaxfit.data.result_folder import OVERLAY, POSES
from jaxfit.evaluation.evaluate import Evaluation, evaluate
from jaxfit.evaluation.tracking import ObservationsEvaluation, evaluate_observations
from jaxfit.evaluation.truth import Matching, Truth, match_tracks
from jaxfit.export.export import export_result
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.files import check_replaceable, check_writable, remove_leftovers, write_whole
from jaxfit.foundation.progress import terminal
from jaxfit.foundation.reading import json_text
from jaxfit.model.files import find_bird, load_murre
from jaxfit.perception.trust import Trust
from jaxfit.pipeline import reconstruct
from jaxfit.simulation.scene import simulate
from jaxfit.view.report.page import Measured
from jaxfit.view.report.write import REPORT, report_of_result

if TYPE_CHECKING:
    from jaxfit.cameras.camera import Camera

BIRDS, FRAMES, SIZE, SEED = 5, 60, (1296, 760), 1003
METRICS, ANIMATION = "evaluation.json", "birds.glb"


def demo(options: argparse.Namespace) -> None:
    """Write a simulated scene and its reconstruction to a folder, and print how well the two agree.

    The command prints ten lines; with `--verbose`, all tables too. The report of the result holds all tables. An
    earlier demo in the folder is replaced.

    Raises:
        InputError: the folder cannot be written, or holds files other than an earlier demo.
    """
    folder = options.out
    start = time.perf_counter()
    scene_folder, result_folder = folder / "scene", folder / "result"
    _check_folder(folder)
    check_replaceable(scene_folder, True, MARKER)
    check_replaceable(result_folder, True, POSES)
    bird, config = load_murre(), with_values(load_reconstruct_config(), {"track.segmenter.file": "builtin"})
    show(f"simulating {BIRDS} murres on a ledge over {FRAMES} frames, then reconstructing them from the footage alone")
    scene = simulate(bird, scene_folder, BIRDS, FRAMES, SIZE, seed=SEED, overwrite=True, progress=terminal)
    done = reconstruct(scene_folder / FOOTAGE, result_folder, bird, config, overwrite=True, progress=terminal)
    observations = done.tracking.observations
    truth = Truth(scene.truth, scene.poses, source=scene_folder)
    observed = evaluate_observations(observations, truth)
    solution, matching = match_tracks(done.solution, truth, "overlap")
    result = evaluate(solution, bird, truth, terminal)
    export_result(result_folder, "glb", folder / ANIMATION, overwrite=True, progress=terminal)
    metrics = {"detection": observed.detection, "tracking": observed.tracking, **result.overall}
    write_whole(folder / METRICS, json_text(metrics).encode())
    compared = [*observation_tables(observed), *evaluation_tables(result, matching.follows)]
    numbers = matching_line(matching)
    measured = [_measured(table) for table in compared]
    measured[-1] = measured[-1]._replace(note=f"{measured[-1].note}; {numbers}")
    describe = partial(behaviour_of_result, progress=terminal)
    report_of_result(result_folder, scene_folder / FOOTAGE, measured=measured, describe=describe)
    if options.verbose:
        for output in (track_table(observations, done.solution), *compared, flag_quality_line(result), numbers):
            show(output)
    for line in _answer(done.tracking.trust, observed, result, matching):
        show(line)
    seconds = done.summary["seconds"]
    parts = ", ".join(f"{name} {seconds[name]:.0f}" for name in ("track", "fit", "overlay"))
    show(f"done in {time.perf_counter() - start:.0f} s ({parts}). Open next:")
    for path, text in (
        (result_folder / REPORT, "pictures, warnings and tables of all metrics, in a browser"),
        (result_folder / OVERLAY, "the posed birds on the footage, and every bird from its side"),
        (folder / ANIMATION, "the animated birds, for Blender (File > Import > glTF 2.0)"),
    ):
        show(f"  {path}: {text}")
    show("for your own film: jaxfit reconstruct VIDEO --out result")


def _answer(trust: Trust, observed: ObservationsEvaluation, result: Evaluation, matching: Matching) -> list[str]:
    """Return the lines that say what was found, and how good the result is."""
    birds = counted(len(matching.follows) + len(matching.missed), "bird")
    found = len(matching.follows) + len(matching.unmatched)
    wrong = f"; {counted(len(matching.unmatched), 'track')} too wrong to measure" if matching.unmatched else ""
    found_wrong, of_wrong = (round(result.flags.get(name, 0)) for name in ("found", "wrong"))
    flagged = f"; {found_wrong} of {of_wrong} wrong poses flagged" if of_wrong else ""
    detection, keypoints = observed.detection, observed.keypoints["all"]
    tracks = {bird: track for track, bird in matching.follows.items()}
    errors = {tracks[bird]: row["mpjpe/length"] for bird, row in result.tracks.items()}
    worst = max(errors, key=lambda track: errors[track])
    return [
        f"tracks: {found} for {birds} over {counted(observed.counts['frames'], 'frame')}, "
        f"identities exchanged {observed.tracking['switches']} times, trust is {trust.level}",
        f"detections: {100 * detection['recall']:.0f} % of the birds in all frames, "
        f"{100 * detection['precision']:.0f} % are right, "
        f"mean IoU of the masks {detection['mean_iou']:.2f} (1 is perfect)",
        f"keypoints: {100 * keypoints.annotated_pck_05:.0f} % within 5 % of the bird's size, hidden keypoints included",
        f"poses: joints {100 * result.overall['mpjpe/length']:.1f} % of the body length from the truth, "
        f"worst track {worst} ({100 * errors[worst]:.1f} %){wrong}{flagged}",
    ]


def _measured(table: Table) -> Measured:
    """Return a table of the terminal for the report."""
    headings = [str(column.header) for column in table.columns]
    rows = zip(*(map(str, column.cells) for column in table.columns), strict=True)
    return Measured(headings, list(rows), str(table.caption or ""))


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


def simulate_scene(options: argparse.Namespace) -> None:
    """Simulate a scene and write its footage and ground truth."""
    from jaxfit.simulation.rig import simulate_rig

    start = time.perf_counter()
    size = parsed_size(options.size)
    names = ("birds", "frames", "fps", "seed", "bone_sd", "keypoint_offset", "codec", "overwrite")
    numbers = {name: getattr(options, name) for name in names}
    if options.cameras is None:
        if options.distortion:
            raise InputError("--distortion", "is given without --cameras", "give the number of cameras by --cameras")
        scenes = [simulate(find_bird("murre"), options.out, size=size, progress=terminal, **numbers)]
    else:
        rig = _cameras(options)
        scenes = simulate_rig(
            find_bird("murre"), options.out, rig, size=size, distorted=options.distortion, progress=terminal, **numbers
        ).scenes
    poses, detections = scenes[0].truth.present.sum(), sum(scene.detections.present.sum() for scene in scenes)
    filmed = f" by {counted(len(scenes), 'camera')}" if options.cameras else ""
    show(
        f"{counted(options.birds, 'bird')} over {counted(options.frames, 'frame')}{filmed}: "
        f"{counted(int(poses), 'true pose')}, {counted(int(detections), 'detection')}, "
        f"in {time.perf_counter() - start:.0f} s → {options.out}"
    )


def _cameras(options: argparse.Namespace) -> int | tuple[Camera, ...]:
    """Return the number of cameras, or the cameras of a file."""
    from jaxfit.cameras.files import read_cameras

    if options.cameras.isascii() and options.cameras.isdigit():
        return int(options.cameras)
    if options.distortion:
        raise InputError("--distortion", "is given with a file of cameras", "the file holds the distortion")
    return read_cameras(options.cameras)
