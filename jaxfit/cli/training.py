"""`train`, `calibrate`."""

from __future__ import annotations

import argparse
import logging
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from jaxfit.cli.observations import image_size, keypoint_map
from jaxfit.cli.tables import EscapedTable, right_aligned, show, show_facts
from jaxfit.config.yaml_file import rounded
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.files import check_new_file
from jaxfit.foundation.progress import terminal

if TYPE_CHECKING:
    from jaxfit.learning.networks.fine_tune import FineTuned
    from jaxfit.learning.networks.labels import LeftOut

_logger = logging.getLogger(__name__)

BUILTIN_SCENES, LABEL_SCENES = 160, 20
"""Default number of simulated scenes of a training from the beginning, and of a training on labels."""
_SHOWN = 20
"""Largest number of left-out labels that are printed."""
_ROWS = {
    "mean_iou": "mean mask IoU",
    "ap50": "AP50",
    "pck_05": "PCK@0.05",
    "pck_10": "PCK@0.10",
    "error": "mean error, % of bird length",
    "score": "score: mean of rows 1 and 2",
    "tracked_iou": "mean mask IoU with tracked masks",
}
_CHOSEN = {
    "base": "The base network",
    "rescaled": "The base network at the new scale",
    "trained": "The trained network",
}
_COLUMNS = {"base": "base network", "rescaled": "base, new scale", "trained": "trained", "teacher": "teacher"}


def train(options: argparse.Namespace) -> None:
    """Train one network and write the network as an ONNX file: on labels, or on simulated footage only."""
    require_extra("train", "train")
    check_new_file(options.out, options.overwrite)
    if options.video and options.labels:
        raise InputError("--video", "is given with labels", "give the film of the labels by --images")
    if options.video and options.network != "segmenter":
        raise InputError("--video", "is given for keypoints", "a teacher makes masks: give labels by --labels")
    if options.network == "outline":
        if options.labels or options.base:
            raise InputError("train outline", "takes no labels and no base", "it learns from simulated outlines only")
        _train_outline(options)
        return
    if options.model:
        raise InputError("--model", f"is given for {options.network}", "only `train outline` takes a model")
    if options.labels or options.video:
        _train_on_labels(options)
        return
    for name in ("images", "masks"):
        if getattr(options, name):
            raise InputError(f"--{name}", "needs labels", "give the files of the labels by --labels")
    if options.teacher != "auto":
        raise InputError("--teacher", "is given without a film", "give --video, or labels by --labels")
    _train_on_simulation(options)


def _train_on_simulation(options: argparse.Namespace) -> None:
    scenes = BUILTIN_SCENES if options.scenes is None else options.scenes
    from jaxfit.learning.networks.training import Simulation, default_schedule, train_network

    start = time.perf_counter()
    schedule = default_schedule(options.network, options.base)
    if options.steps is not None:
        schedule = schedule._replace(steps=options.steps)
    folder = options.frames or Path("training_frames")
    simulation = Simulation(folder, scenes, options.varied, options.wings)
    losses = train_network(options.network, options.out, simulation, schedule, options.seed, terminal, options.base)
    loss = ", ".join(f"{name} {value:.3f}" for name, value in losses.items())
    minutes = (time.perf_counter() - start) / 60
    show(f"{options.network} trained in {minutes:.0f} min, loss {loss} → {options.out}; in 8 bits *_8bit.onnx")


def _train_outline(options: argparse.Namespace) -> None:
    from jaxfit.learning.networks.training import SCHEDULES, train_outline
    from jaxfit.model.files import find_bird, load_murre

    start, schedule = time.perf_counter(), SCHEDULES["outline"]
    if options.steps is not None:
        schedule = schedule._replace(steps=options.steps)
    birds = [*([find_bird(options.model)] * 2 if options.model else []), load_murre()]
    folder = options.frames or Path("training_frames")
    species = {} if options.scenes is None else {"species": options.scenes}
    losses = train_outline(
        options.out, birds, folder, schedule=schedule, seed=options.seed, progress=terminal, **species
    )
    minutes = (time.perf_counter() - start) / 60
    show(f"outline trained in {minutes:.0f} min, loss {losses['position']:.3f} → {options.out}")


def _train_on_labels(options: argparse.Namespace) -> None:
    scenes = LABEL_SCENES if options.scenes is None else options.scenes
    from jaxfit.learning.networks.fine_tune import LABELLED_SHARE, Settings, default_schedule, fine_tune
    from jaxfit.learning.networks.label_data import LabelFiles
    from jaxfit.learning.networks.scenes import missing_scenes

    start = time.perf_counter()
    teacher = options.teacher if options.labels or options.teacher != "auto" else "general"
    if options.video:
        if teacher == "none":
            raise InputError("--teacher", "is `none` without labels", "give --teacher general, or labels by --labels")
        files = LabelFiles((), (options.video,))
    else:
        files = LabelFiles(tuple(options.labels), tuple(options.images or ()), options.masks)
    steps = options.steps
    schedule = None if steps is None else default_schedule(options.network, 0)._replace(steps=steps)
    settings = Settings(options.base or "builtin", options.holdout, scenes, schedule, options.seed, teacher)
    frames = options.frames or Path("simulated_frames")
    missing = missing_scenes(frames, scenes)
    if missing:
        simulated = f"{100 * (1 - LABELLED_SHARE):.0f} %"
        show(
            f"{counted(missing, 'simulated scene')} will be filmed into {frames} before the network is trained. "
            f"{simulated} of the samples are simulated birds, so that the network does not forget birds that the "
            "labels lack. Later trainings use the scenes again."
        )
    result = fine_tune(options.network, files, options.out, frames, settings, progress=terminal)
    _show_left_out(result.left_out)
    _show_result(result)
    minutes = (time.perf_counter() - start) / 60
    if result.chosen == "trained":
        show(f"{options.network} trained in {minutes:.1f} min, {result.best_step} steps → {options.out}")
    else:
        show(f"{options.network} not changed by the training ({minutes:.1f} min) → {options.out}")
    if result.doubt:
        suggest = f"jaxfit suggest {options.video} --segmenter {options.out} --teacher {teacher}"
        text = "%s: the network may be wrong: %s; label some frames and train on them: %s"
        _logger.warning(text, options.out, result.doubt, suggest)


def _show_left_out(left_out: Sequence[LeftOut]) -> None:
    """Print the labels that were not used."""
    if not left_out:
        return
    show(f"{counted(len(left_out), 'label')} left out:")
    for label in left_out[:_SHOWN]:
        show(f"  {label}")
    if len(left_out) > _SHOWN:
        show(f"  … and {len(left_out) - _SHOWN} more")


def _show_result(result: FineTuned) -> None:
    """Print the parts of the labels, the accuracy of all candidates on the held-out part, and which one is written."""
    parts = result.pictures
    training = counted(parts["training"], "labelled picture")
    show(f"{training} for the training, {parts['holdout']} held out, {parts['gap']} in between ({result.rule})")
    if result.teacher:
        show(result.teacher)
    if any(name != base for name, base in result.names.items()):
        starts = ", ".join(f"{name} from {base or 'new weights'}" for name, base in result.names.items())
        show(f"keypoints start from those of the base network: {starts}")
    if not result.accuracy:
        show("nothing is held out, so the accuracy of the network is unknown")
        return
    table = right_aligned("on the held-out pictures", *(_COLUMNS[name] for name in result.accuracy))
    table.columns[0].justify = "left"
    for key in result.accuracy["trained"]:
        digits = 1 if key == "error" else 3
        table.add_row(_ROWS[key], *(f"{column[key]:.{digits}f}" for column in result.accuracy.values()))
    show(table)
    show(f"{_CHOSEN[result.chosen]} has the best score of the networks that can be written. {_written(result)}")
    if result.accuracy.get("teacher", {}).get("score", 0.0) > result.accuracy[result.chosen]["score"]:
        show("The teacher has a better score on the held-out labels. Compare both on this film (--segmenter).")


def _written(result: FineTuned) -> str:
    """Return a sentence about the network that is written."""
    if result.chosen == "trained":
        return (
            f"It is from step {result.best_step} of {result.steps}; the network that is written was trained again for "
            "as many steps, on all labelled pictures."
        )
    scale = "its own scale" if result.chosen == "base" else "the scale of the labels"
    return f"Its weights are written without training, with {scale}."


def calibrate(options: argparse.Namespace) -> None:
    """Estimate the errors of detections from labelled frames, and write a config that holds them."""
    from jaxfit.data.formats.recognise import read_observations
    from jaxfit.data.keypoint_names import map_keypoints
    from jaxfit.evaluation.detection_noise import estimate_noise, facts, noise_yaml
    from jaxfit.evaluation.truth import read_truth
    from jaxfit.foundation.files import check_new_file, check_writable, write_whole

    check_new_file(options.out, options.overwrite)
    check_writable(options.out)
    truth = read_truth(options.truth, options.video, image_size(options))
    detected = read_observations(options.detections, options.video, image_size(options))
    true_names, names = truth.observations.keypoint_names, detected.keypoint_names
    if true_names != names:
        mapped = keypoint_map(true_names, options.truth, names, options.names)
        truth = replace(truth, observations=map_keypoints(truth.observations, mapped, names))
    noise = estimate_noise(detected, truth, options.detections, terminal)
    check_new_file(options.out, options.overwrite)  # again, because the estimate may have taken minutes
    write_whole(options.out, noise_yaml(noise, options.detections, options.truth).encode())
    table = right_aligned("setting", "value", "from", "to")
    table.columns[0].justify = "left"
    for path, value in noise.settings.items():
        ends = ("–" if math.isnan(end) else rounded(end) for end in noise.intervals[path])
        table.add_row(path, rounded(value), *ends)
    table.caption = (
        "in pixels of a 256-pixel crop; from, to: 95 % bootstrap interval over birds (none for a single bird)"
    )
    show(table)
    show_facts(facts(noise))
    scales = EscapedTable()
    scales.add_column("keypoint")
    scales.add_column("scale", justify="right")
    for name, factor in noise.factors.items():
        scales.add_row(name, f"{factor:.2f}")
    scales.caption = "scale: relative to the scale of all keypoints"
    show(scales)
    if noise.outline is None:
        show("the labels hold no masks of the matched birds: the config leaves out mask_smooth_l1")
    counts = (counted(noise.frames, "frame"), counted(noise.birds, "bird"), counted(noise.keypoints, "keypoint"))
    show(f"{', '.join(counts)}, {counted(noise.masks, 'mask')} → {options.out}")
    show(f"next: jaxfit fit {options.detections} --config {options.out} --out result")
