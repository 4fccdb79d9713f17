"""Training of a built-in network: simulate frames, train, write the ONNX file."""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
from pathlib import Path

import torch

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import own_version
from jaxfit.foundation.files import check_writable
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks import keypoints, segmenter
from jaxfit.learning.networks.familiarity import store_training_activations
from jaxfit.learning.networks.labelled_frames import LabelledFrames, load_frames
from jaxfit.learning.networks.loop import Schedule, train
from jaxfit.learning.networks.network_files import base_file, load_segmenter_base, write_keypoints, write_segmenter
from jaxfit.learning.networks.networks import FeaturePyramid, load_photograph_weights
from jaxfit.learning.networks.scenes import FRAMES_PER_SCENE, film_scenes
from jaxfit.model.anatomy import MURRE_KEYPOINTS
from jaxfit.perception.segmentation import load_segmenter

SCENES = 160
"""Number of training scenes, with seeds from 0; seeds of 1000 and more are for tests."""
SCHEDULES = {"segmenter": Schedule(2400, 8, 2e-3), "keypoints": Schedule(4000, 24, 2e-3)}
"""Schedules of the built-in networks."""


def train_network(
    which: str,
    path: str | Path,
    frames_folder: str | Path,
    scenes: int = SCENES,
    schedule: Schedule | None = None,
    seed: int = 0,
    progress: ProgressTask = silent,
    varied: float = 0.0,
    encoder: str | Path | None = None,
) -> dict[str, float]:
    """Train a built-in network and write it; the weights differ slightly between processors.

    Args:
        which: `segmenter` or `keypoints`.
        path: the `.onnx` file to write; an existing file is replaced.
        frames_folder: folder of the simulated frames, created if it does not exist; about 32 MB per scene.
        scenes: number of training scenes, at most 900.
        schedule: schedule of the training; None uses `SCHEDULES`.
        seed: seed of the initial weights and of the samples.
        progress: reports scenes and steps.
        varied: share of the scenes with other birds in other landscapes, if the footage is simulated first.
        encoder: weights of EfficientNet-lite0 for the encoder of a segmenter, as in `load_photograph_weights`; None
            uses the encoder of the built-in segmenter.

    Returns:
        Each term of the loss, averaged over the last tenth of the steps.

    Raises:
        ValueError: unknown `which`.
        InputError: a number outside its range, or a folder with other contents.
    """
    if which not in SCHEDULES:
        raise ValueError(f"which must be one of {', '.join(SCHEDULES)}, not {which!r}")
    schedule = schedule or SCHEDULES[which]
    if encoder is not None and which != "segmenter":
        raise InputError("train: encoder", "is given for a keypoint network", "train a segmenter, or leave it out")
    if not 1 <= scenes <= 900:
        raise InputError("train: scenes", f"is {scenes}", "give 1 to 900")
    if not 0 <= varied <= 1:
        raise InputError("train: varied", f"is {varied}", "give a share of 0 to 1")
    if schedule.steps < 20:
        raise InputError("train: steps", f"is {schedule.steps}", "give 20 or more")
    if Path(path).suffix != ".onnx":
        raise InputError(path, "is not the name of an ONNX file", "give a name with the suffix .onnx")
    check_writable(path)  # before the training, not after it
    folder = Path(frames_folder)
    frames = _load_or_film(folder, scenes, varied, progress)
    torch.manual_seed(seed)
    if which == "segmenter":
        network, module = _segmenter_with_encoder(encoder), segmenter
    else:
        network, module = keypoints.keypoint_network(), keypoints
    losses = train(network, module.draw_sample, module.loss, folder, schedule, seed, progress, f"Training {which}")
    photographs = ", but the encoder was trained on photographs before" if which == "segmenter" else ""
    facts = {
        "trained_by": f"jaxfit {own_version()} train {which}",
        "trained_on": f"{len(frames.pictures)} simulated frames of {scenes} scenes; no real footage{photographs}",
        "schedule": json.dumps(schedule._asdict()),
        "loss": json.dumps({name: round(value, 5) for name, value in losses.items()}),
    }
    if which == "segmenter":
        write_segmenter(network, facts, path)
    else:
        write_keypoints(network, MURRE_KEYPOINTS, facts, path)
    # a keypoint network sees the birds that a segmenter detects
    birds = None if which == "segmenter" else load_segmenter("builtin")
    store_training_activations(which, path, [frames], birds, progress)
    return losses


def _segmenter_with_encoder(encoder: str | Path | None) -> FeaturePyramid:
    """Create a segmenter with a trained encoder; all other layers have random weights."""
    network = segmenter.segmenter_network()
    if encoder is None:
        builtin = load_segmenter_base(base_file("segmenter", "builtin"))
        network.down.load_state_dict(builtin.down.state_dict())
    else:
        load_photograph_weights(network.down, encoder)
    return network


def _load_or_film(folder: Path, scenes: int, varied: float, progress: ProgressTask) -> LabelledFrames:
    """Load the frames, or simulate the frames if the folder does not exist."""
    if not folder.exists():
        return film_scenes(folder, range(scenes), progress=progress, varied=varied)
    frames = load_frames(folder)
    if len(frames.pictures) != scenes * FRAMES_PER_SCENE:
        existing = len(frames.pictures) // FRAMES_PER_SCENE
        remedy = "give another folder or the same number of scenes"
        raise InputError(folder, f"holds {existing} scenes, not {scenes}", remedy)
    return frames
