"""The commands: each is one short function that calls the library and prints what came of it."""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfit.errors import InputError
from jaxfit.formats.coco import read_coco
from jaxfit.model.files import find_bird, save_bird
from jaxfit.progress import terminal
from jaxfit.tables import counted, evaluation_tables, plain_json, right_aligned, show, show_facts, track_table

if TYPE_CHECKING:
    from jaxfit.config import ReconstructConfig

_logger = logging.getLogger(__name__)

__all__ = [
    "bench",
    "demo",
    "evaluate",
    "fit",
    "model_import",
    "model_info",
    "model_view",
    "overlay",
    "reconstruct",
    "simulate",
    "track",
    "train",
]


def track(options: argparse.Namespace) -> None:
    from jaxfit.formats.coco import write_coco
    from jaxfit.perception.track import find_tracks
    from jaxfit.storage import check_writable
    from jaxfit.view.checks import check_outputs

    began = time.perf_counter()
    if options.video.exists():  # or tracking says so
        check_outputs([options.out], options.video, options.overwrite)  # before the work, not after it
    check_writable(options.out)
    config = _reconstruct_config(options).track
    tracking = find_tracks(options.video, config, progress=terminal)
    write_coco(tracking.observations, options.out)
    if tracking.nothing:
        _logger.warning("%s", tracking.nothing)
    else:
        show(track_table(tracking.observations))
    _left_out(tracking.short, config.min_track_frames)
    birds, frames = tracking.observations.present.shape
    seconds = time.perf_counter() - began
    show(f"{counted(birds, 'bird')} over {counted(frames, 'frame')} in {seconds:.1f} s → {options.out}")


def reconstruct(options: argparse.Namespace) -> None:
    from jaxfit.pipeline import OBSERVATIONS, OVERLAY, reconstruct

    began = time.perf_counter()
    config = _reconstruct_config(options)
    bird = find_bird(options.model)
    done = reconstruct(options.video, options.out, bird, config, overwrite=options.overwrite, progress=terminal)
    show(track_table(done.tracking.observations, done.solution))
    _left_out(done.tracking.short, config.track.min_track_frames)
    birds = counted(done.summary["tracks"], "bird")
    show(f"{counted(done.summary['poses'], 'pose')} of {birds} in {time.perf_counter() - began:.0f} s. Look at")
    for name, what in (
        (OVERLAY, "the posed birds on the footage"),
        (OVERLAY.replace(".mp4", ".png"), "a contact sheet"),
        (OBSERVATIONS, "what was found in it"),
        ("poses.npz", "the poses"),
        ("summary.json", "how it was made, and figures"),
    ):
        if (options.out / name).is_file():
            show(f"  {options.out / name}: {what}")


def _reconstruct_config(options: argparse.Namespace) -> ReconstructConfig:
    """The config of `--config`, with what other options say laid over it."""
    from jaxfit.config import load_reconstruct_config

    def given(**values: Any) -> dict[str, Any]:
        return {name: value for name, value in values.items() if value is not None}

    config = load_reconstruct_config(options.config)
    classes = tuple(options.classes.split(",")) if options.classes else None
    track = replace(
        config.track,
        frames=replace(config.track.frames, **given(start=options.start, stop=options.stop, step=options.step)),
        segmenter=replace(config.track.segmenter, **given(file=options.segmenter, classes=classes)),
        keypoints=replace(config.track.keypoints, **given(file=options.keypoints)),
    )
    return replace(config, track=track)


def _left_out(short: dict[int, int], least: int) -> None:
    if short:
        frames = ", ".join(f"{track} ({count})" for track, count in list(short.items())[:10])
        more = ", …" if len(short) > 10 else ""
        show(f"left out: {counted(len(short), 'track')} of fewer than {least} frames: {frames}{more}")


def fit(options: argparse.Namespace) -> None:
    from jaxfit.config import config_to_yaml, load_config
    from jaxfit.fitting.fit import fit
    from jaxfit.fitting.solution import save_solution
    from jaxfit.fitting.start import load_start
    from jaxfit.fitting.summary import summarise
    from jaxfit.storage import check_replaceable

    began = time.perf_counter()
    check_replaceable(options.out, options.overwrite, "poses.npz")  # before the work, not after it
    config = load_config(options.config)
    bird = find_bird(options.model)
    observations = read_coco(options.observations)
    start = load_start(options.init, observations, bird) if options.init else None
    read = time.perf_counter()
    solution = fit(observations, bird, config, start, terminal, source=options.observations)
    seconds = {"read": read - began, "fit": time.perf_counter() - read}
    summary = summarise(solution, bird, seconds)
    save_solution(solution, bird, config_to_yaml(config), summary, options.out, options.overwrite)
    table = right_aligned("track", "frames", "objective")
    table.add_column("status")
    total = np.sum(list(solution.loss.values()), axis=0)
    for n, track in enumerate(solution.track_id):
        frames = int(solution.valid[n].sum())
        table.add_row(str(track), str(frames), f"{total[n] / max(frames, 1):.1f}", str(solution.status[n]))
    table.title = "objective: final value per frame"
    show(table)
    poses, birds = counted(summary["poses"], "pose"), counted(summary["tracks"], "bird")
    counts = ", ".join(f"{count} {status}" for status, count in summary["status"].items())
    show(f"{poses} of {birds} ({counts}) in {seconds['fit']:.1f} s → {options.out}")


def evaluate(options: argparse.Namespace) -> None:
    from jaxfit.evaluation.evaluate import evaluate
    from jaxfit.evaluation.matching import match_tracks
    from jaxfit.evaluation.truth import read_truth
    from jaxfit.fitting.solution import load_solution
    from jaxfit.observation_tables import matching_line

    if options.result.is_file():
        _evaluate_observations(options)
        return
    solution, bird = load_solution(options.result)
    truth, poses, truth_bird = read_truth(options.truth)
    solution, matching = match_tracks(solution, truth, options.match, options.truth)
    result = evaluate(solution, bird, truth, terminal, options.truth, truth_solution=poses, truth_bird=truth_bird)
    if options.json:
        counts = {name: getattr(result, name) for name in ("frames", "missing", "unmatched", "frames_3d")}
        named = {"matched_by": matching.by, "follows": matching.follows}
        print(plain_json({**result.overall, **counts, "tracks": result.tracks, **named}))  # noqa: T201
        return
    for table in evaluation_tables(result):
        show(table)
    if matching.by == "overlap":
        show(matching_line(matching))
    if result.missing:
        show(f"no figure counts {counted(result.missing, 'annotated bird')} without a pose in this result")
    if result.unmatched:
        show(f"no figure counts {counted(result.unmatched, 'pose')} of tracks or frames that the truth lacks")


def _evaluate_observations(options: argparse.Namespace) -> None:
    from dataclasses import asdict

    from jaxfit.evaluation.observed import evaluate_observations
    from jaxfit.evaluation.truth import read_truth
    from jaxfit.observation_tables import observation_tables, uncounted_lines

    result = evaluate_observations(read_coco(options.result), read_truth(options.truth)[0], options.truth)
    if options.json:
        keypoints = {name: row._asdict() for name, row in result.keypoints.items()}
        print(plain_json(asdict(result) | {"keypoints": keypoints}))  # noqa: T201
        return
    for table in observation_tables(result):
        show(table)
    for line in uncounted_lines(result):
        show(line)


def simulate(options: argparse.Namespace) -> None:
    from jaxfit.simulation.scene import simulate

    began = time.perf_counter()
    scene = simulate(
        find_bird("murre"),
        options.out,
        birds=options.birds,
        frames=options.frames,
        size=_size(options.size),
        fps=options.fps,
        seed=options.seed,
        codec=options.codec,
        overwrite=options.overwrite,
        progress=terminal,
    )
    boxes, found = int(scene.truth.present.sum()), int(scene.detections.present.sum())
    show(
        f"{counted(options.birds, 'bird')} over {counted(options.frames, 'frame')}: {counted(boxes, 'true pose')}, "
        f"{counted(found, 'detection')}, in {time.perf_counter() - began:.0f} s → {options.out}"
    )


def train(options: argparse.Namespace) -> None:
    from importlib.util import find_spec

    if not all(find_spec(package) for package in ("torch", "onnx", "onnxscript")):
        raise InputError("train", "needs PyTorch and ONNX, which are not installed", 'pip install "jaxfit[train]"')
    from jaxfit.training.train import SCHEDULES, train_network

    began = time.perf_counter()
    if options.out.exists() and not options.overwrite:
        raise InputError(options.out, "exists already", "choose another --out or pass --overwrite")
    steps = SCHEDULES[options.network].steps if options.steps is None else options.steps
    schedule = SCHEDULES[options.network]._replace(steps=steps)
    where = options.out, options.frames
    losses = train_network(options.network, *where, options.scenes, schedule, options.seed, progress=terminal)
    loss = ", ".join(f"{name} {value:.3f}" for name, value in losses.items())
    show(f"{options.network} in {(time.perf_counter() - began) / 60:.0f} min, loss {loss} → {options.out}")


def overlay(options: argparse.Namespace) -> None:
    from jaxfit.fitting.solution import load_solution
    from jaxfit.view.overlay import overlay, overlay_frame

    solution, bird = load_solution(options.result)
    seen = read_coco(options.observations) if options.observations else None
    drawn = {"observations": seen, "side_views": options.side_views, "overwrite": options.overwrite}
    if options.frame is not None:
        overlay_frame(solution, bird, options.video, options.frame, options.out, **drawn)
        show(f"frame {options.frame} → {options.out}")
        return
    overlay(solution, bird, options.video, options.out, codec=options.codec, progress=terminal, **drawn)
    show(f"overlay → {options.out}, contact sheet → {options.out.with_suffix('.png')}")


def demo(options: argparse.Namespace) -> None:
    from jaxfit.demo import run_demo

    run_demo(options.out)


def model_import(options: argparse.Namespace) -> None:
    from jaxfit.model.sources import import_sources

    bird = import_sources(options.kind, options.sources)
    save_bird(bird, options.out)
    show(f"{bird.name}: {bird.vertices.shape[0]} vertices, {bird.num_keypoints} keypoints → {options.out}")


def model_info(options: argparse.Namespace) -> None:
    from jaxfit.model.describe import describe_bird

    facts = describe_bird(find_bird(options.file))
    if options.json:
        print(plain_json(facts))  # noqa: T201
    else:
        show_facts(facts)


def model_view(options: argparse.Namespace) -> None:
    from jaxfit.model.murre import POSTURES
    from jaxfit.view.six_views import six_views

    if options.posture and options.posture not in POSTURES:
        raise InputError("model view: posture", f"{options.posture!r} is none", f"known are {', '.join(POSTURES)}")
    six_views(find_bird(options.file), options.out, options.posture)
    show(f"six views → {options.out}")


def bench(options: argparse.Namespace) -> None:
    from jaxfit.benchmarks.fit import bench_fit
    from jaxfit.benchmarks.render import bench_render
    from jaxfit.benchmarks.silhouette import bench_silhouette

    bird = find_bird(options.model) if options.model else None
    if options.what == "silhouette":
        result = bench_silhouette(vertices=bird and bird.vertices, faces=bird and bird.faces)
    elif options.what == "render":
        result = bench_render(bird)
    else:
        result = bench_fit(bird or find_bird("murre"), options.birds, options.frames, progress=terminal)
    if options.json:
        print(plain_json(result))  # noqa: T201
    else:
        show_facts(result)


def _size(text: str) -> tuple[int, int]:
    sides = text.lower().replace("×", "x").split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() for side in sides):
        raise InputError("simulate: size", f"{text!r} is none", "give width and height as in 2592x1520")
    return int(sides[0]), int(sides[1])
