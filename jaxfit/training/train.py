"""One command for each built-in network: film scenes, train on them, write the ONNX file."""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
from importlib import metadata
from pathlib import Path

import torch
from torch import Tensor, nn

from jaxfit.errors import InputError
from jaxfit.model.anatomy import MURRE_KEYPOINTS
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.files import check_writable
from jaxfit.training import keypoints, segmenter
from jaxfit.training.export import export_onnx
from jaxfit.training.loop import Schedule, train
from jaxfit.training.networks import FeaturePyramid
from jaxfit.training.scenes import FRAMES_A_SCENE, LabelledFrames, film_scenes, load_frames

__all__ = ["SCENES", "SCHEDULES", "train_network"]

SCENES = 160
"""Scenes learnt from, by seeds from 0; seeds of 1000 and more are left to tests."""
SCHEDULES = {"segmenter": Schedule(3600, 12, 2e-3), "keypoints": Schedule(4000, 24, 2e-3)}
"""Figures of the networks that the package brings along."""


def train_network(
    which: str,
    path: str | Path,
    frames_folder: str | Path,
    scenes: int = SCENES,
    schedule: Schedule | None = None,
    seed: int = 0,
    progress: ProgressTask = silent,
) -> dict[str, float]:
    """Train one of the built-in networks and write it; numbers differ a little from one processor to another.

    Args:
        which: `segmenter` or `keypoints`.
        path: the `.onnx` file to write; an earlier one is replaced.
        frames_folder: where the simulated frames are, or are filmed to; about 32 MB a scene.
        scenes: how many to learn from, at most 900.
        schedule: of training; None takes that of `SCHEDULES`.
        seed: of the network's first numbers and of the samples.
        progress: told of scenes and steps.

    Returns:
        Each part of the loss, averaged over the last tenth of training.

    Raises:
        ValueError: another `which`.
        InputError: numbers that make no sense, or a folder that holds something else.
    """
    if which not in SCHEDULES:
        raise ValueError(f"which must be one of {', '.join(SCHEDULES)}, not {which!r}")
    schedule = schedule or SCHEDULES[which]
    if not 1 <= scenes <= 900:
        raise InputError("train: scenes", f"{scenes} is no number to learn from", "give 1 to 900")
    if schedule.steps < 20:
        raise InputError("train: steps", f"{schedule.steps} teach nothing", "give 20 or more")
    if Path(path).suffix != ".onnx":
        raise InputError(path, "is named as no network", "end it in .onnx")
    check_writable(path)  # before the work, not after it
    frames = _frames(Path(frames_folder), scenes, progress)
    torch.manual_seed(seed)
    if which == "segmenter":
        network, module = segmenter.segmenter_network(), segmenter
    else:
        network, module = keypoints.keypoint_network(), keypoints
    folder = Path(frames_folder)
    losses = train(network, module.draw_sample, module.loss, folder, schedule, seed, progress, f"Training {which}")
    facts = {
        "trained_by": f"jaxfit {metadata.version('jaxfit')} train {which}",
        "trained_on": f"{len(frames.pictures)} simulated frames of {scenes} scenes; no real footage",
        "schedule": json.dumps(schedule._asdict()),
        "loss": json.dumps({name: round(value, 5) for name, value in losses.items()}),
    }
    (_write_segmenter if which == "segmenter" else _write_keypoints)(network, facts, path)
    return losses


def _frames(folder: Path, scenes: int, progress: ProgressTask) -> LabelledFrames:
    if not folder.exists():
        return film_scenes(folder, range(scenes), progress=progress)
    frames = load_frames(folder)
    if len(frames.pictures) != scenes * FRAMES_A_SCENE:
        found = len(frames.pictures) // FRAMES_A_SCENE
        raise InputError(folder, f"holds {found} scenes, not {scenes}", "choose another folder, or that many scenes")
    return frames


class _Probabilities(nn.Module):
    """The segmenter as it is exported."""

    def __init__(self, network: FeaturePyramid):
        super().__init__()
        self.network = network

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        maps = self.network(pictures)
        return torch.sigmoid(maps["foreground"]), maps["centre"], maps["offset"]


def _write_segmenter(network: FeaturePyramid, facts: dict[str, str], path: str | Path) -> None:
    notes = {"names": repr({0: "bird"}), "longer_side": "864", **facts}
    free = {2: "height", 3: "width"}
    export_onnx(
        _Probabilities(network).eval(),
        torch.rand(1, 3, 256, 320),
        free,
        ("foreground", "centre", "offset"),
        notes,
        path,
    )


def _write_keypoints(network: FeaturePyramid, facts: dict[str, str], path: str | Path) -> None:
    side = keypoints.SIDE_PX
    notes = {
        "keypoint_names": ",".join(MURRE_KEYPOINTS),
        "mean": "0",
        "std": "255",
        "colour": "bgr",
        "input_size": f"{side},{side}",
        **facts,
    }
    peaks = keypoints.Peaks(network, len(MURRE_KEYPOINTS)).eval()
    export_onnx(peaks, torch.rand(2, 3, side, side), {0: "birds"}, ("heatmaps",), notes, path)
