"""Fine-tuning of a network on labelled footage, in two trainings.

The first training uses a part of the labelled pictures. The score on the held-out pictures determines the number of
steps. Then three networks are compared on the held-out pictures: the base network as its file is, the base network at
the scale of the labels, and the trained network. If the trained network is the best, the second training uses all
labelled pictures for this number of steps, and its network is written. Every sample comes from a labelled or from a
simulated frame. A teacher adds masks of unlabelled frames of the same film, or makes all labels (`teacher.py`). The
state is stored at regular intervals, so that the same call continues an interrupted training with
the same result.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import own_version
from jaxfit.foundation.files import check_writable
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks import keypoints, segmenter
from jaxfit.learning.networks.familiarity import store_training_activations
from jaxfit.learning.networks.filming import Filming
from jaxfit.learning.networks.label_checks import LeftOut
from jaxfit.learning.networks.label_data import (
    ALL_FRAMES,
    FRAMES,
    PICTURES,
    TRACKED,
    FineTuningData,
    LabelFiles,
    Scale,
    fingerprint,
    prepare_data,
    prepare_frames,
    read_label_files,
)
from jaxfit.learning.networks.labels import LabelSet
from jaxfit.learning.networks.loop import (
    Checkpoint,
    Schedule,
    Source,
    continue_training,
    flat_weights,
    set_weights,
)
from jaxfit.learning.networks.network_files import (
    Probabilities,
    base_file,
    load_keypoint_base,
    load_segmenter_base,
    write_keypoints,
    write_segmenter,
)
from jaxfit.learning.networks.networks import FeaturePyramid
from jaxfit.learning.networks.ranges import check_numbers
from jaxfit.learning.networks.reference_birds import load_reference_birds
from jaxfit.learning.networks.teacher import Taught, as_labels, open_teacher, teach
from jaxfit.learning.networks.validation import (
    keypoint_accuracy,
    keypoint_detector,
    segmenter_accuracy,
    single_score,
    torch_segmenter,
)
from jaxfit.perception.keypoint_layouts import read_metadata
from jaxfit.perception.keypoints import crop_settings, load_keypoint_detector
from jaxfit.perception.network import OnnxModel, Segmenter
from jaxfit.perception.segmentation import LONGER_SIDE_PX, load_segmenter

_logger = logging.getLogger(__name__)

LABELLED_SHARE = 0.6
"""Share of the samples from labelled frames; all others are simulated."""
LABELLED_SCENE_SHARE = 0.3
"""Share of the labelled samples with a random scene; most samples keep the scene of the footage."""
MIN_COMMON_KEYPOINTS = 4
"""With fewer keypoints in common, the keypoint network sees no simulated frames."""
STEPS_PER_SCENE = 8
"""Number of steps after which the samples come from one more simulated scene, so that the training can begin when the
first scene is filmed. The default number of 20 scenes is in use after 152 steps; the shortest training has 240."""
CHECKED_PICTURES = 16
"""Largest number of held-out pictures of a measurement during the training; the last measurement uses all."""
LEARNT_IOU = 0.5
"""With a smaller IoU on held-out frames, the masks of the teacher have no common rule, as those of birds have."""
CHECKPOINT, CHECKPOINT_ALL = "checkpoint.npz", "checkpoint_all.npz"
"""States of the training on a part of the labelled pictures, and of the training on all."""
CHECKED = "checked.onnx"
"""A network that is measured and then removed."""

Candidate = Literal["base", "rescaled", "trained", "teacher"]
"""A network that is compared: the base network, the base network at the scale of the labels, the trained network, and
the teacher, which is not written."""


class Settings(NamedTuple):
    """Settings of a fine-tuning."""

    base: str | Path = "builtin"
    holdout: float = 0.2
    """Share of the labelled pictures that are held out; 0 trains without a check and without early stopping."""
    scenes: int = 20
    """Number of simulated scenes, unless the folder holds the frames of all scenes in one file; 0 trains on labels
    only."""
    schedule: Schedule | None = None
    """None chooses a schedule by the number of labelled pictures."""
    seed: int = 0
    """Seed of the samples and of new layers."""
    teacher: str = "none"
    """Segmenter that makes labels of a film, or tracks the masks of labels: as in `open_teacher`."""


class FineTuned(NamedTuple):
    """Result of a fine-tuning."""

    accuracy: dict[Candidate, dict[str, float]]
    """Accuracy of every candidate on the held-out pictures; `score` is the figure of `single_score`.

    The trained network is the network of the first training: the written network has seen the held-out pictures.
    `rescaled` is missing if the labels need no other scale. Empty without held-out pictures."""
    chosen: Candidate
    """The candidate with the best score; the last of equal candidates."""
    left_out: list[LeftOut]
    """Labels that were not used."""
    pictures: dict[str, int]
    """Number of labelled pictures: `training`, `holdout`, `gap`; and `tracked`: other frames, by the teacher."""
    rule: str
    """How pictures were held out."""
    names: dict[str, str]
    """Keypoint → the keypoint of the base network that it starts from; an empty text for new weights."""
    best_step: int
    """Number of steps of the trained network."""
    steps: int
    """Number of steps on a part of the labelled pictures."""
    teacher: str = ""
    """What the teacher did, for the user; empty without a teacher."""
    doubt: str = ""
    """Why the masks of a teacher may be wrong; empty with labels of a person."""


def default_schedule(network: str, pictures: int) -> Schedule:
    """Return the schedule for a number of labelled pictures."""
    steps = min(max(200 + 4 * pictures, 240), 1000)
    return Schedule(steps, 6 if network == "segmenter" else 16, 5e-4)


def fine_tune(
    network: str,
    files: LabelFiles,
    path: str | Path,
    frames_folder: str | Path,
    settings: Settings = Settings(),
    progress: ProgressTask = silent,
) -> FineTuned:
    """Train a built-in or an earlier network further on labelled pictures, and write the new network.

    All birds of a labelled picture must be labelled: a segmenter learns every other pixel as background. The folder
    `PATH.training` holds the state of the training until the network is written.

    Args:
        network: `segmenter` or `keypoints`.
        files: files of the labels, pictures and masks; without labels, the only video of `images` is the film in which
            the teacher makes the labels.
        path: the `.onnx` file to write; an existing file is replaced.
        frames_folder: folder of simulated scenes, about 32 MB per scene; absent scenes are filmed while the network
            trains.
        settings: base network, hold-out, schedule, seed.
        progress: reports every part of the work.

    Raises:
        InputError: a setting outside its range, unusable labels, too few labels for a hold-out, a base network of
            another layout, or an interrupted training with other labels or settings.
    """
    path, folder = Path(path), Path(f"{path}.training")
    _check(network, path, settings)
    base = base_file(network, settings.base)
    teacher = open_teacher(settings.teacher) if network == "segmenter" else None
    taught: Taught | None = None
    if files.labels:
        labels = read_label_files(network, files, progress)
    else:
        taught, labels, files = _taught(files, teacher, folder, progress)
    simulated = Filming(Path(frames_folder), settings.scenes, progress) if settings.scenes else None
    torch.manual_seed(settings.seed)
    found: tuple[str, ...] = labels.keypoint_names
    if network == "segmenter":
        model = load_segmenter_base(base)
    else:
        model, found = load_keypoint_base(base, labels.keypoint_names)
    with ExitStack() as filming:
        # the filming takes minutes, so it begins when all labels and pictures are read
        film = nullcontext if simulated is None else partial(filming.enter_context, simulated)
        try:
            references = None if simulated is None else load_reference_birds()
            confirming = None if taught else teacher
            data = prepare_data(
                network, files, settings.holdout, references, folder, labels, progress, confirming, film
            )
            base_scale = _base_scale(network, base, data.scale)
        except BaseException:
            if not (folder / CHECKPOINT).exists():
                _remove(folder)
            raise
        named = dict(zip(data.keypoint_names, found, strict=True))
        own = network, model, base, base_scale, named, data, simulated, folder, path, settings, progress
        try:
            result = _fine_tune(*own, confirming)
        except BaseException as error:
            if (folder / CHECKPOINT).exists() and not isinstance(error, InputError):
                _logger.warning("%s holds the work so far; the same command continues there", folder)
            raise
        return result._replace(doubt=_doubt(taught, result)) if taught else result


def _taught(
    files: LabelFiles, teacher: Segmenter | None, folder: Path, progress: ProgressTask
) -> tuple[Taught, LabelSet, LabelFiles]:
    """Return the labels of the teacher for a film, and the film as their file."""
    if teacher is None or len(files.images) != 1:
        raise InputError("train: labels", "are missing", "give --labels, or --video with --teacher")
    (folder / TRACKED).mkdir(parents=True, exist_ok=True)
    taught = teach(files.images[0], teacher, folder / TRACKED, progress)
    return taught, as_labels(taught), LabelFiles(files.images, files.images)


def _fine_tune(
    network: str,
    model: FeaturePyramid,
    base: Path,
    base_scale: Scale,
    names: dict[str, str],
    data: FineTuningData,
    simulated: Filming | None,
    folder: Path,
    path: Path,
    settings: Settings,
    progress: ProgressTask,
    teacher: Segmenter | None = None,
) -> FineTuned:
    """Train the base network on prepared data, and write the best network; `names` as in `keypoint_accuracy`."""
    scales: dict[Candidate, Scale] = {"base": base_scale, "rescaled": data.scale, "trained": data.scale}
    schedule = settings.schedule or default_schedule(network, len(data.split.training))
    mark = fingerprint(data, simulated, base, (network, schedule, settings.seed))
    initial = flat_weights(model)

    def train(frames: str, state: str, steps: int, score: Callable[[], float] | None) -> Checkpoint:
        """Train from the initial weights on one folder of labelled frames."""
        set_weights(model, initial)
        loss = segmenter.loss if network == "segmenter" else keypoints.loss
        sources = _sources(network, folder / frames, data, simulated, schedule)
        what = f"Training {network}" if frames == FRAMES else f"Training {network} on all labels"
        own = schedule._replace(steps=steps)
        checkpoint = continue_training(
            model, loss, sources, own, settings.seed, folder / state, f"{mark} {frames}", score, progress, what
        )
        set_weights(model, checkpoint.best_weights)
        return checkpoint

    checkpoint = train(FRAMES, CHECKPOINT, schedule.steps, _score(network, model, data) if data.holdout else None)
    frames, labelled = data.frames, len(data.frames.pictures)
    accuracy: dict[Candidate, dict[str, float]] = {}
    if data.holdout:
        accuracy["base"] = _accuracy(network, base, data, names)
        if scales["rescaled"] != scales["base"]:
            accuracy["rescaled"] = _measured(network, model, initial, data, folder / CHECKED)
        accuracy["trained"] = _measured(network, model, checkpoint.best_weights, data, folder / CHECKED)
    chosen = _best(accuracy)
    if data.holdout and teacher is not None:
        accuracy["teacher"] = _of_segmenter(teacher, data)
    if chosen != "trained":
        labelled = 0
        set_weights(model, initial)
    elif data.holdout:
        everything = [*data.pictures, *data.tracked]
        frames = prepare_frames(folder / ALL_FRAMES, everything, data.keypoint_names, data.scale, network)
        labelled = len(frames.pictures)
        train(ALL_FRAMES, CHECKPOINT_ALL, checkpoint.best_step, None)
    used = [frames]
    if simulated is not None:
        used.append(simulated.frames(_scenes_in_use(simulated, checkpoint.step)))
    filmed = sum(len(own.pictures) for own in used[1:])
    facts = _facts(network, base, data, labelled, filmed, schedule, checkpoint)
    _write(network, model, data.keypoint_names, scales[chosen], facts, path)
    store_training_activations(network, path, used, progress=progress)
    _remove(folder)
    return _summary(accuracy, chosen, data, names, checkpoint)


def _doubt(taught: Taught, result: FineTuned) -> str:
    """Return why the labels of a teacher may be wrong."""
    reasons = ["no label of a person has checked the masks of the teacher"]
    if 2 * taught.confirmed < taught.detected:
        reasons.append(
            f"a second run on smaller mirror images confirms only {taught.confirmed} of {taught.detected} frames"
        )
    iou = result.accuracy.get("trained", {}).get("mean_iou", 1.0)
    if iou < LEARNT_IOU:
        reasons.append(f"the network does not learn the masks: mean IoU {iou:.2f} on held-out frames")
    return "; ".join(reasons)


def _summary(
    accuracy: dict[Candidate, dict[str, float]],
    chosen: Candidate,
    data: FineTuningData,
    names: dict[str, str],
    checkpoint: Checkpoint,
) -> FineTuned:
    return FineTuned(
        accuracy,
        chosen,
        data.left_out,
        {
            "training": len(data.split.training),
            "holdout": len(data.holdout),
            "gap": len(data.split.gap),
            "tracked": len(data.tracked),
        },
        data.split.rule,
        names,
        checkpoint.best_step,
        checkpoint.step,
        data.teacher,
    )


def _check(network: str, path: Path, settings: Settings) -> None:
    if network not in ("segmenter", "keypoints"):
        raise ValueError(f"network must be segmenter or keypoints, not {network!r}")
    if path.suffix != ".onnx":
        raise InputError(path, "is not the name of an ONNX file", "give a name with the suffix .onnx")
    steps = None if settings.schedule is None else settings.schedule.steps
    check_numbers(True, steps, settings.scenes, settings.seed, holdout=settings.holdout)
    check_writable(path)  # before the training, not after it


def _sources(
    network: str, frames: Path, data: FineTuningData, simulated: Filming | None, schedule: Schedule
) -> list[Source]:
    """Return the labelled and the simulated frames with their shares."""
    # the new segmenter sees the footage at one scale, so it needs no wide range of scales
    draw = partial(segmenter.draw_sample, wide_share=0.0) if network == "segmenter" else keypoints.draw_sample
    labelled = Source(frames, partial(draw, scene_share=LABELLED_SCENE_SHARE))
    if simulated is None:
        return [labelled]
    if network == "keypoints":
        mapped = simulated.frames(1).with_keypoints(data.keypoint_names)
        least = min(MIN_COMMON_KEYPOINTS, len(data.keypoint_names))
        if not ((mapped.visibility == 2).sum(-1) >= least).any():
            return [labelled]
    names = data.keypoint_names if network == "keypoints" else None
    first, *more = simulated.folders
    growth = tuple(more), STEPS_PER_SCENE * schedule.batch, simulated.wait
    return [labelled._replace(share=LABELLED_SHARE), Source(first, draw, 1 - LABELLED_SHARE, names, *growth)]


def _scenes_in_use(simulated: Filming, steps: int) -> int:
    """Return the number of scenes that the samples of the last of some steps come from, as `_sources` says."""
    return min(1 + max(steps - 1, 0) // STEPS_PER_SCENE, len(simulated.folders))


def _score(network: str, model: FeaturePyramid, data: FineTuningData) -> Callable[[], float]:
    """Return a function that measures a network in training: the mean of two measures of the final table."""
    unseen = [*data.holdout, *data.tracked_holdout]
    places = np.unique(np.linspace(0, len(unseen) - 1, CHECKED_PICTURES).round().astype(int))
    pictures = [unseen[i] for i in places.tolist()]
    names = {name: name for name in data.keypoint_names}

    def score() -> float:
        model.eval()
        if network == "segmenter":
            own = torch_segmenter(Probabilities(model), data.scale.longer_side_px)
            return single_score(segmenter_accuracy(own, pictures))
        maps = keypoints.KeypointMaps(model, len(names)).to(next(model.parameters()).device)
        detector = keypoint_detector(maps, data.keypoint_names, data.scale)
        return single_score(keypoint_accuracy(detector, pictures, names))

    return score


def _accuracy(network: str, path: Path, data: FineTuningData, names: dict[str, str]) -> dict[str, float]:
    """Measure a network file on all held-out pictures, as perception uses the file."""
    if network == "segmenter":
        return _of_segmenter(load_segmenter(path, kind="bottom_up"), data)
    accuracy = keypoint_accuracy(load_keypoint_detector(path), data.holdout, names)
    return accuracy | {"score": single_score(accuracy)}


def _of_segmenter(segmenter: Segmenter, data: FineTuningData) -> dict[str, float]:
    """Measure a segmenter on all held-out labels, and its masks on the tracked frames that are held out."""
    accuracy = segmenter_accuracy(segmenter, data.holdout)
    tracked = segmenter_accuracy(segmenter, data.tracked_holdout)["mean_iou"] if data.tracked_holdout else None
    return accuracy | {"score": single_score(accuracy)} | ({} if tracked is None else {"tracked_iou": tracked})


def _measured(
    network: str, model: FeaturePyramid, weights: np.ndarray, data: FineTuningData, file: Path
) -> dict[str, float]:
    """Measure weights at the scale of the labels, on all held-out pictures, through a network file."""
    set_weights(model, weights)
    _write(network, model, data.keypoint_names, data.scale, {}, file)
    return _accuracy(network, file, data, {name: name for name in data.keypoint_names})


def _best(accuracy: dict[Candidate, dict[str, float]]) -> Candidate:
    """Return the candidate with the best score, the last of equal candidates; the trained one without a score."""
    best: Candidate = "trained"
    for candidate in reversed(accuracy):
        if accuracy[candidate]["score"] > accuracy[best]["score"]:
            best = candidate
    return best


def _base_scale(network: str, base: Path, scale: Scale) -> Scale:
    """Return the scale of the file of the base network, for the footage of `scale`.

    Raises:
        InputError: the file holds an invalid scale.
    """
    model = OnnxModel(base)
    if network == "segmenter":
        load_segmenter(base, kind="bottom_up")  # checks the scale
        return scale._replace(longer_side_px=int(model.metadata.get("longer_side", LONGER_SIDE_PX)))
    return scale._replace(crops=crop_settings(read_metadata(model)))


def _facts(
    network: str,
    base: Path,
    data: FineTuningData,
    labelled: int,
    simulated: int,
    schedule: Schedule,
    checkpoint: Checkpoint,
) -> dict[str, str]:
    trained_on = f"{labelled} labelled pictures and {simulated} simulated frames"
    return {
        "trained_by": f"jaxfit {own_version()} train {network}, fine-tuned from {base.name}",
        "trained_on": trained_on,
        "schedule": json.dumps(schedule._replace(steps=checkpoint.best_step if labelled else 0)._asdict()),
        "holdout": f"{len(data.holdout)} pictures, {data.split.rule}",
        "holdout_score": json.dumps(np.round(checkpoint.history, 4).tolist()),
    }


def _write(network: str, model: Any, names: tuple[str, ...], scale: Scale, facts: dict[str, str], path: Path) -> None:
    if network == "segmenter":
        write_segmenter(model, facts, path, scale.longer_side_px)
    else:
        write_keypoints(model, names, facts, path, scale.crops)


def _remove(folder: Path) -> None:
    """Remove the files of a finished training; files of other programs stay."""
    for name in (PICTURES, FRAMES, ALL_FRAMES, TRACKED):
        shutil.rmtree(folder / name, ignore_errors=True)
    for name in (CHECKPOINT, CHECKPOINT_ALL, CHECKED):
        (folder / name).unlink(missing_ok=True)
    if folder.exists() and not any(folder.iterdir()):
        folder.rmdir()
