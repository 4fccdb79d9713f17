"""Training of a built-in network: simulate frames, train, write the ONNX file."""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import torch

from jaxfit.data.formats.fields import read_json
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import own_version
from jaxfit.foundation.files import check_writable, write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks import keypoints, segmenter
from jaxfit.learning.networks.familiarity import store_training_activations
from jaxfit.learning.networks.labelled_frames import LabelledFrames, load_frames
from jaxfit.learning.networks.loop import Schedule, train
from jaxfit.learning.networks.network_files import (
    base_file,
    load_keypoint_base,
    load_segmenter_base,
    write_keypoints,
    write_segmenter,
)
from jaxfit.learning.networks.networks import FeaturePyramid, load_photograph_weights
from jaxfit.learning.networks.ranges import check_numbers
from jaxfit.learning.networks.scenes import FRAMES_PER_SCENE, film_scenes
from jaxfit.model.anatomy import MURRE_KEYPOINTS
from jaxfit.perception.segmentation import load_segmenter

SCENES = 160
"""Number of training scenes, with seeds from 0; seeds of 1000 and more are for tests."""
SCHEDULES = {"segmenter": Schedule(2400, 8, 2e-3), "keypoints": Schedule(4000, 24, 2e-3)}
"""Schedules of networks with random initial weights."""
CONTINUED_RATE = 1e-3
"""Learning rate of a training that starts from another network."""


class Simulation(NamedTuple):
    """The simulated frames of a training."""

    folder: Path
    """Folder of the frames, created if it does not exist; about 32 MB per scene."""
    scenes: int = SCENES
    """Number of scenes, at most 900."""
    varied: float = 0.0
    """Share of the scenes with other birds in other landscapes, if the footage is simulated first."""
    wings: float = 0.0
    """Share of the scenes in which the birds flap or fly, if the footage is simulated first."""


def default_schedule(which: str, base: str | Path | None = None) -> Schedule:
    """Return the schedule of a training with random initial weights, or from a base network."""
    schedule = SCHEDULES[which]
    return schedule if base is None else schedule._replace(steps=schedule.steps // 2, learning_rate=CONTINUED_RATE)


def train_network(
    which: str,
    path: str | Path,
    simulation: Simulation,
    schedule: Schedule | None = None,
    seed: int = 0,
    progress: ProgressTask = silent,
    encoder: str | Path | None = None,
    base: str | Path | None = None,
) -> dict[str, float]:
    """Train a built-in network and write it; the weights differ slightly between processors.

    Args:
        which: `segmenter` or `keypoints`.
        path: the `.onnx` file to write; an existing file is replaced.
        simulation: the simulated frames.
        schedule: schedule of the training; None uses `default_schedule`.
        seed: seed of the initial weights and of the samples.
        progress: reports scenes and steps.
        encoder: weights of EfficientNet-lite0 for the encoder of a segmenter, as in `load_photograph_weights`; None
            uses the encoder of the built-in segmenter.
        base: the network to start from, as in `base_file`; None starts from random weights.

    Returns:
        Each term of the loss, averaged over the last tenth of the steps.

    Raises:
        ValueError: unknown `which`.
        InputError: a number outside its range, or a folder with other contents.
    """
    if which not in SCHEDULES:
        raise ValueError(f"which must be one of {', '.join(SCHEDULES)}, not {which!r}")
    schedule = schedule or default_schedule(which, base)
    if encoder is not None and which != "segmenter":
        raise InputError("train: encoder", "is given for a keypoint network", "train a segmenter, or leave it out")
    if encoder is not None and base is not None:
        raise InputError("train: encoder", "is given with a base network", "give one of the two")
    check_numbers(False, schedule.steps, simulation.scenes, seed, varied=simulation.varied, wings=simulation.wings)
    if Path(path).suffix != ".onnx":
        raise InputError(path, "is not the name of an ONNX file", "give a name with the suffix .onnx")
    check_writable(path)  # before the training, not after it
    torch.manual_seed(seed)
    network, module = _initial_network(which, encoder, base)
    frames = _load_or_film(simulation, progress)
    what = module.draw_sample, module.loss, simulation.folder, schedule, seed, base is not None
    losses = train(network, *what, progress, f"Training {which}")
    photographs = ", but the encoder was trained on photographs before" if which == "segmenter" else ""
    facts = {
        "trained_by": f"jaxfit {own_version()} train {which}" + (f", from {Path(base).name}" if base else ""),
        "trained_on": f"{len(frames.pictures)} simulated frames of {simulation.scenes} scenes; no real footage"
        + photographs,
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


def _initial_network(
    which: str, encoder: str | Path | None, base: str | Path | None
) -> tuple[FeaturePyramid, ModuleType]:
    """Return the network before the training, and the module of its samples and loss."""
    if which == "segmenter":
        network = _segmenter_with_encoder(encoder) if base is None else load_segmenter_base(base_file(which, base))
        return network, segmenter
    if base is None:
        return keypoints.keypoint_network(), keypoints
    return load_keypoint_base(base_file(which, base), MURRE_KEYPOINTS)[0], keypoints


def _segmenter_with_encoder(encoder: str | Path | None) -> FeaturePyramid:
    """Create a segmenter with a trained encoder; all other layers have random weights."""
    network = segmenter.segmenter_network()
    if encoder is None:
        builtin = load_segmenter_base(base_file("segmenter", "builtin"))
        network.down.load_state_dict(builtin.down.state_dict())
    else:
        load_photograph_weights(network.down, encoder)
    return network


_SHARES = "shares.json"
"""The shares of `Simulation` with which the frames of a folder were filmed."""


def _load_or_film(simulation: Simulation, progress: ProgressTask) -> LabelledFrames:
    """Load the frames, or simulate the frames if the folder does not exist."""
    folder, scenes, varied, wings = simulation
    shares = {"varied": varied, "wings": wings}
    if not folder.exists():
        frames = film_scenes(folder, range(scenes), progress=progress, varied=varied, wings=wings)
        write_whole(folder / _SHARES, json.dumps(shares).encode())
        return frames
    frames, path = load_frames(folder), folder / _SHARES
    stored = read_json(path).value if path.is_file() else {"varied": 0.0, "wings": 0.0}
    if stored != shares:
        raise InputError(
            folder, f"holds scenes of {stored}, not of {shares}", "give another folder, or remove this one"
        )
    if len(frames.pictures) != scenes * FRAMES_PER_SCENE:
        existing = len(frames.pictures) // FRAMES_PER_SCENE
        remedy = "give another folder or the same number of scenes"
        raise InputError(folder, f"holds {existing} scenes, not {scenes}", remedy)
    return frames
