"""Fine-tuning of a network on labelled footage, in two trainings, and the accuracy on held-out pictures.

The first training uses a part of the labelled pictures. The score on the held-out pictures determines the number of
steps. Then three networks are compared on the held-out pictures: the base network as its file is, the base network at
the scale of the labels, and the trained network. If the trained network is the best, the second training uses all
labelled pictures for this number of steps, and its network is written. Every sample comes from a labelled or from a
simulated frame. A teacher adds masks of unlabelled frames of the same film, or makes all labels (`teacher.py`). The
state is stored at regular intervals, so that the same call continues an interrupted training with the same result.
Accuracy is measured as `jaxfit track` and `jaxfit evaluate` use a network.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from jaxfit.data.observations import Observations
from jaxfit.evaluation.detection import assign, average_precision, overlap
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import own_version
from jaxfit.foundation.files import check_writable
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks import keypoints, segmenter
from jaxfit.learning.networks.label_data import (
    ALL_FRAMES,
    FRAMES,
    PICTURES,
    TRACKED,
    FineTuningData,
    LabelFiles,
    Scale,
    fingerprint,
    owner_of,
    prepare_data,
    prepare_frames,
    read_label_files,
)
from jaxfit.learning.networks.labelled_frames import load_frames
from jaxfit.learning.networks.labels import (
    CENTRE,
    LabelledPicture,
    LabelSet,
    LeftOut,
    StoredPicture,
    load_reference_birds,
)
from jaxfit.learning.networks.network_files import (
    Probabilities,
    base_file,
    load_keypoint_base,
    load_segmenter_base,
    store_training_activations,
    write_network,
)
from jaxfit.learning.networks.networks import FeaturePyramid
from jaxfit.learning.networks.scenes import film_scenes
from jaxfit.learning.networks.teacher import Taught, open_teacher, teach
from jaxfit.learning.networks.training import Schedule, Source, Trained, check_numbers, train, weights_of
from jaxfit.perception.keypoint_layouts import HeatmapLayout, KeypointInput, read_metadata
from jaxfit.perception.keypoints import OnnxKeypoints, crop_settings, load_keypoint_detector
from jaxfit.perception.network import Instance, KeypointDetector, OnnxModel, Port, Segmenter, instance_of
from jaxfit.perception.segmentation import LONGER_SIDE_PX, BottomUp, load_segmenter

_logger = logging.getLogger(__name__)

LABELLED_SHARE = 0.6
"""Share of the samples from labelled frames; all others are simulated."""
LABELLED_SCENE_SHARE = 0.3
"""Share of the labelled samples with a random scene; most samples keep the scene of the footage."""
MIN_COMMON_KEYPOINTS = 4
"""With fewer keypoints in common, the keypoint network sees no simulated frames."""
CHECKED_PICTURES = 16
"""Largest number of held-out pictures of a measurement during the training; the last measurement uses all."""
LEARNT_IOU = 0.5
"""With a smaller IoU on held-out frames, the masks of the teacher have no common rule, as those of birds have."""
CHECKPOINT, CHECKPOINT_ALL = "checkpoint.pt", "checkpoint_all.pt"
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
    """Number of simulated scenes; 0 trains on labels only."""
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
        frames_folder: folder of simulated scenes, about 32 MB per scene; absent scenes are filmed.
        settings: base network, hold-out, schedule, seed.
        progress: reports every part of the work.

    Raises:
        InputError: a setting outside its range, unusable labels, too few labels for a hold-out, a base network of
            another layout, or an interrupted training with other labels or settings.
    """
    if network not in ("segmenter", "keypoints"):
        raise ValueError(f"network must be segmenter or keypoints, not {network!r}")
    path, folder = Path(path), Path(f"{path}.training")
    if path.suffix != ".onnx":
        raise InputError(path, "is not the name of an ONNX file", "give a name with the suffix .onnx")
    steps = None if settings.schedule is None else settings.schedule.steps
    check_numbers(True, steps, settings.scenes, settings.seed, holdout=settings.holdout)
    check_writable(path)  # before the training, not after it
    if folder.is_dir():  # it is removed at the end
        own = ".", PICTURES, FRAMES, ALL_FRAMES, TRACKED, CHECKED, "checkpoint"
        others = sorted(file.name for file in folder.iterdir() if not file.name.startswith(own))
        if others:
            problem = f"holds other files than those of a training: {others[0]}"
            raise InputError(folder, problem, "move these files, or choose another --out")
    base = base_file(network, settings.base)
    teacher = open_teacher(settings.teacher) if network == "segmenter" else None
    taught: Taught | None = None
    try:
        if files.labels:
            labels = read_label_files(network, files, progress)
        else:
            if teacher is None or len(files.images) != 1:
                raise InputError("train: labels", "are missing", "give --labels, or --video with --teacher")
            (folder / TRACKED).mkdir(parents=True, exist_ok=True)
            taught = teach(files.images[0], teacher, folder / TRACKED, progress)
            labels = LabelSet((CENTRE,), tuple(picture.labels for picture in taught.pictures))
            files, teacher = LabelFiles(files.images, files.images), None
        names = labels.keypoint_names
        torch.manual_seed(settings.seed)
        starts: tuple[str, ...] = names
        if network == "segmenter":
            model = load_segmenter_base(base)
        else:
            model, starts = load_keypoint_base(base, names)
        references = load_reference_birds() if settings.scenes else None
        data = prepare_data(network, files, settings.holdout, references, folder, labels, progress, teacher)
        if network == "keypoints" and not keypoints.has_usable_bird(data.frames):
            problem = f"no bird of the training part has {min(keypoints.MIN_VISIBLE, len(names))} visible keypoints"
            raise InputError(files.labels[0], problem, "label more keypoints")
        base_scale = _base_scale(network, base, data.scale)
        scenes = film_scenes(frames_folder, settings.scenes, progress=progress) if settings.scenes else ()
        if scenes and network == "keypoints":
            visible = load_frames(*scenes).with_keypoints(names).visibility == 2
            scenes = scenes if (visible.sum(-1) >= min(MIN_COMMON_KEYPOINTS, len(names))).any() else ()
        schedule = settings.schedule or default_schedule(network, len(data.split.training))
        own_names = dict(zip(names, starts, strict=True))
        work = _FineTuning(
            network, model, base, base_scale, own_names, data, scenes, schedule, settings.seed, folder, progress
        )
        result = work.run(path, teacher)
    except BaseException as error:
        if not (folder / CHECKPOINT).exists():
            shutil.rmtree(folder, ignore_errors=True)
        elif not isinstance(error, InputError):
            _logger.warning("%s holds the work so far; the same command continues there", folder)
        raise
    return result._replace(doubt=_doubt(taught, result)) if taught else result


@dataclass
class _FineTuning:
    """The two trainings of a network on prepared data, and the comparison of the networks."""

    network: str
    model: FeaturePyramid
    base: Path
    base_scale: Scale
    names: dict[str, str]
    """As in `keypoint_accuracy`."""
    data: FineTuningData
    scenes: tuple[Path, ...]
    """Folders of simulated frames."""
    schedule: Schedule
    seed: int
    folder: Path
    progress: ProgressTask

    def run(self, path: Path, teacher: Segmenter | None) -> FineTuned:
        """Train, compare the networks, write the best network and remove the folder."""
        data, initial = self.data, weights_of(self.model)
        first = self._train(FRAMES, CHECKPOINT, initial, self.schedule.steps, self._score if data.holdout else None)
        frames, labelled = data.frames, len(data.frames.pictures)
        accuracy: dict[Candidate, dict[str, float]] = {}
        if data.holdout:
            accuracy["base"] = self._accuracy(self.base, self.names)
            if data.scale != self.base_scale:
                accuracy["rescaled"] = self._accuracy_of_weights(initial)
            accuracy["trained"] = self._accuracy_of_weights(first.best)
        chosen: Candidate = "trained"  # of equal candidates, the last
        for candidate in reversed(accuracy):
            if accuracy[candidate]["score"] > accuracy[chosen]["score"]:
                chosen = candidate
        if data.holdout and teacher is not None:
            accuracy["teacher"] = self._accuracy_of_segmenter(teacher)
        if chosen != "trained":
            labelled = 0
            self.model.load_state_dict(initial)
        elif data.holdout:
            pictures = [*data.pictures, *data.tracked]
            frames = prepare_frames(self.folder / ALL_FRAMES, pictures, data.keypoint_names, data.scale, self.network)
            labelled = len(frames.pictures)
            last = self._train(ALL_FRAMES, CHECKPOINT_ALL, initial, first.best_step, None)
            self.model.load_state_dict(last.best)
        else:
            self.model.load_state_dict(first.best)
        simulated = [load_frames(*self.scenes)] if self.scenes else []
        filmed = sum(len(part.pictures) for part in simulated)
        steps = first.best_step if labelled else 0
        facts = {
            "trained_by": f"jaxfit {own_version()} train {self.network}, fine-tuned from {self.base.name}",
            "trained_on": f"{labelled} labelled pictures and {filmed} simulated frames",
            "schedule": json.dumps(self.schedule._replace(steps=steps)._asdict()),
            "holdout": f"{len(data.holdout)} pictures, {data.split.rule}",
            "holdout_score": json.dumps([[float(step), round(score, 4)] for step, score in first.history]),
        }
        self._write(self.base_scale if chosen == "base" else data.scale, facts, path)
        store_training_activations(self.network, path, [frames, *simulated], progress=self.progress)
        shutil.rmtree(self.folder)
        return FineTuned(
            accuracy=accuracy,
            chosen=chosen,
            left_out=data.left_out,
            pictures={
                "training": len(data.split.training),
                "holdout": len(data.holdout),
                "gap": len(data.split.gap),
                "tracked": len(data.tracked),
            },
            rule=data.split.rule,
            names=self.names,
            best_step=first.best_step,
            steps=first.step,
            teacher=data.teacher,
        )

    def _train(
        self, frames: str, state: str, initial: Mapping[str, Tensor], steps: int, score: Callable[[], float] | None
    ) -> Trained:
        """Train from the initial weights on one folder of labelled frames."""
        self.model.load_state_dict(initial)
        if self.network == "segmenter":
            # the new segmenter sees the footage at one scale, so it needs no wide range of scales
            draw, loss = partial(segmenter.draw_sample, wide_share=0.0), segmenter.loss
        else:
            draw, loss = keypoints.draw_sample, keypoints.loss
        share = LABELLED_SHARE if self.scenes else 1.0
        sources = [Source((self.folder / frames,), partial(draw, scene_share=LABELLED_SCENE_SHARE), share)]
        if self.scenes:
            names = self.data.keypoint_names if self.network == "keypoints" else None
            sources.append(Source(self.scenes, draw, 1 - LABELLED_SHARE, names))
        mark = fingerprint(self.data, self.scenes, self.base, (self.network, self.schedule, self.seed))
        part = " (2 of 2, on all labels)" if frames != FRAMES else " (1 of 2)" if self.data.holdout else ""
        return train(
            self.model,
            loss,
            sources,
            self.schedule._replace(steps=steps),
            self.seed,
            path=self.folder / state,
            fingerprint=f"{mark} {frames}",
            score=score,
            progress=self.progress,
            name=f"Training {self.network}" + part,
        )

    def _score(self) -> float:
        """Measure the network in training: the mean of two measures of the final table."""
        unseen = [*self.data.holdout, *self.data.tracked_holdout]
        places = np.unique(np.linspace(0, len(unseen) - 1, CHECKED_PICTURES).round().astype(int))
        pictures = [unseen[i] for i in places.tolist()]
        self.model.eval()
        if self.network == "segmenter":
            return single_score(segmenter_accuracy(torch_segmenter(self.model, self.data.scale), pictures))
        detector = torch_detector(self.model, self.data.keypoint_names, self.data.scale)
        return single_score(keypoint_accuracy(detector, pictures, {name: name for name in self.data.keypoint_names}))

    def _accuracy(self, path: Path, names: Mapping[str, str]) -> dict[str, float]:
        """Measure a network file on all held-out pictures, as perception uses the file."""
        if self.network == "segmenter":
            return self._accuracy_of_segmenter(load_segmenter(path, kind="bottom_up"))
        accuracy = keypoint_accuracy(load_keypoint_detector(path), self.data.holdout, names)
        return accuracy | {"score": single_score(accuracy)}

    def _accuracy_of_segmenter(self, network: Segmenter) -> dict[str, float]:
        """Measure a segmenter on all held-out labels, and its masks on the tracked frames that are held out."""
        accuracy = segmenter_accuracy(network, self.data.holdout)
        accuracy["score"] = single_score(accuracy)
        if self.data.tracked_holdout:
            accuracy["tracked_iou"] = segmenter_accuracy(network, self.data.tracked_holdout)["mean_iou"]
        return accuracy

    def _accuracy_of_weights(self, weights: Mapping[str, Tensor]) -> dict[str, float]:
        """Measure weights at the scale of the labels, on all held-out pictures, through a network file."""
        self.model.load_state_dict(weights)
        self._write(self.data.scale, {}, self.folder / CHECKED)
        return self._accuracy(self.folder / CHECKED, {name: name for name in self.data.keypoint_names})

    def _write(self, scale: Scale, facts: Mapping[str, str], path: Path) -> None:
        names = self.data.keypoint_names
        write_network(self.network, self.model, facts, path, names, scale.longer_side_px, scale.crops)


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


CROPS = 16
"""Number of crops in one run of a keypoint network."""


class _TorchModel(OnnxModel):
    """A PyTorch network with the interface of an ONNX file, so that the same code reads its outputs."""

    def __init__(
        self,
        run: Callable[[Tensor], Sequence[Tensor]],
        device: torch.device,
        outputs: Sequence[str],
        metadata: Mapping[str, str],
    ):
        self.path, self.metadata = Path("network in training"), metadata
        self.inputs = (Port("pictures", (1, 3, None, None), "tensor(float)"),)
        self.outputs = tuple(Port(name, (None,) * 4, "tensor(float)") for name in outputs)
        self._run = run
        self._device = device

    def __call__(self, *inputs: np.ndarray) -> dict[str, np.ndarray]:
        """Run the network once, as `OnnxModel`."""
        with torch.inference_mode():
            values = self._run(torch.from_numpy(inputs[0]).to(self._device))
        return {port.name: value.cpu().numpy() for port, value in zip(self.outputs, values, strict=True)}


def torch_segmenter(network: nn.Module, scale: Scale) -> BottomUp:
    """Return the segmenter of a network in training."""
    outputs, metadata = ("foreground", "centre", "offset"), {"longer_side": str(scale.longer_side_px)}
    device = next(network.parameters()).device
    return BottomUp(_TorchModel(Probabilities(network), device, outputs, metadata), names=["bird"])


def torch_detector(network: nn.Module, names: Sequence[str], scale: Scale) -> OnnxKeypoints:
    """Return the keypoint detector of a network in training."""
    side, device = keypoints.SIDE_PX, next(network.parameters()).device
    maps = keypoints.KeypointMaps(network, len(names)).to(device)
    model = _TorchModel(lambda pictures: [maps(pictures)], device, ("heatmaps",), {})
    model_input = KeypointInput((side, side), None, False, np.float32, False, (0.0,) * 3, (255.0,) * 3)
    layout = HeatmapLayout("heatmaps", None, False, (side, side), "none", "centres", 1.0)
    cells = side // keypoints.STRIDE
    return OnnxKeypoints(
        model, model_input, layout, names, scale.crops, CROPS, {"heatmaps": (len(names), cells, cells)}
    )


def segmenter_accuracy(segmenter: Segmenter, pictures: Sequence[StoredPicture]) -> dict[str, float]:
    """Measure a segmenter on held-out pictures.

    Returns:
        `mean_iou`: mean IoU of the masks over the labelled birds, 0 for a bird without a detection; one-to-one
        matches with the greatest sum of IoUs. `ap50`: average precision at an IoU of 0.5.
    """
    true = _observations(pictures, [_true_instances(picture.labels) for picture in pictures])
    detected = _observations(pictures, [segmenter(picture.pixels()) for picture in pictures])
    matches = overlap(detected, true)
    ious = [iou[assign(iou, 1e-9)].sum() for iou in matches.iou]
    ap50, _ = average_precision(detected, true, matches)
    return {"mean_iou": float(np.sum(ious) / max(int(matches.true.sum()), 1)), "ap50": ap50}


def keypoint_accuracy(
    detector: KeypointDetector, pictures: Sequence[StoredPicture], names: Mapping[str, str]
) -> dict[str, float]:
    """Measure a keypoint detector on held-out pictures, with the labelled masks or boxes.

    Args:
        detector: the detector.
        pictures: held-out pictures.
        names: name of a labelled keypoint → name of the detector, for all labelled keypoints in their order; an empty
            text for a keypoint that the detector lacks.

    Returns:
        `pck_05` and `pck_10`: share of the visible labelled keypoints with an error below 5 and 10 % of the longer side
        of the bird; a keypoint that the detector lacks is wrong. `error`: mean error in per cent of the longer side,
        over the keypoints that the detector has.
    """
    place = np.array([detector.keypoint_names.index(name) if name else -1 for name in names.values()])
    errors = []
    for picture in pictures:
        instances = _true_instances(picture.labels)
        birds = [(bird, instance) for bird, instance in zip(picture.labels.birds, instances, strict=True) if instance]
        points_px, _ = detector(picture.pixels(), [instance for _, instance in birds])
        for (bird, instance), detected_px in zip(birds, points_px, strict=True):
            error = np.linalg.norm(detected_px[place] - bird.keypoints_px, axis=-1) / max(instance.mask.shape)
            errors.append(np.where(place < 0, np.inf, error)[bird.visibility == 2])
    values = np.concatenate([*errors, np.zeros(0)])
    if not len(values):
        return {"pck_05": float("nan"), "pck_10": float("nan"), "error": float("nan")}
    known = values[np.isfinite(values)]
    error = 100 * float(known.mean()) if len(known) else float("nan")
    return {"pck_05": float((values < 0.05).mean()), "pck_10": float((values < 0.10).mean()), "error": error}


def single_score(accuracy: Mapping[str, float]) -> float:
    """Return the figure that compares networks: the mean of mean IoU and AP50, or of PCK@0.05 and PCK@0.10."""
    names = ("mean_iou", "ap50") if "ap50" in accuracy else ("pck_05", "pck_10")
    return sum(accuracy[name] for name in names) / 2


def _true_instances(picture: LabelledPicture) -> list[Instance | None]:
    """Return the labelled birds; None for a bird that other birds hide."""
    owner = owner_of(picture.birds, picture.size_px)
    return [instance_of(owner == n, 1.0, "bird") for n in range(1, len(picture.birds) + 1)]


def _observations(pictures: Sequence[StoredPicture], instances: Sequence[Sequence[Instance | None]]) -> Observations:
    """Return the birds of every picture as observations without keypoints; bird n of a picture is track n."""
    T, N = len(pictures), max(1, *map(len, instances))
    present, score = np.zeros((N, T), bool), np.zeros((N, T), np.float32)
    box, masks = np.zeros((N, T, 4), np.float32), {}
    for t, (picture, birds) in enumerate(zip(pictures, instances, strict=True)):
        width, height = picture.labels.size_px
        for n, bird in enumerate(birds):
            if bird is None:
                continue
            present[n, t], score[n, t], box[n, t] = True, bird.score, bird.box_px
            masks[n, t] = bird.encode(width, height)
    return Observations(
        track_id=np.arange(N),
        frame_index=np.arange(T),
        present=present,
        keypoints_px=np.zeros((N, T, 1, 2), np.float32),
        confidence=np.zeros((N, T, 1), np.float32),
        box_px=box,
        image_size_px=np.array([picture.labels.size_px for picture in pictures]),
        file_name=np.array([picture.labels.name for picture in pictures]),
        keypoint_names=("centre",),
        masks=masks,
        score=score,
    )
