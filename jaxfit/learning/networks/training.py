"""Training of a network: samples, steps, early stopping, resumption; training on simulated frames only."""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import own_version
from jaxfit.foundation.files import check_writable, write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.foundation.reading import reading
from jaxfit.learning.networks import keypoints, outlines, segmenter
from jaxfit.learning.networks.eight_bits import INPUTS, SUFFIX, write_eight_bits
from jaxfit.learning.networks.labelled_frames import load_frames
from jaxfit.learning.networks.network_files import (
    base_file,
    freeze_normalisation,
    load_keypoint_base,
    load_segmenter_base,
    store_training_activations,
    training_inputs,
    write_network,
)
from jaxfit.learning.networks.networks import FeaturePyramid
from jaxfit.learning.networks.scenes import film_scenes
from jaxfit.model.anatomy import MURRE_KEYPOINTS
from jaxfit.model.bird import Bird
from jaxfit.perception.segmentation import load_segmenter

SPECIES = 600
"""Number of species in the training of the network `outline`."""
SCENES = 160
"""Number of training scenes, with seeds from 0; seeds of 1000 and more are for tests."""
CONTINUED_RATE = 1e-3
"""Learning rate of a training that starts from another network."""
CHECKS = 10
"""Number of measurements on the held-out pictures during a training on labels."""
PATIENCE = 4
"""Number of measurements without a better score after which the training stops."""

Loss = Callable[[dict[str, Tensor], Any], dict[str, Tensor]]
"""Function of the outputs of a network and of a batch that computes the terms of the loss."""


class Schedule(NamedTuple):
    """Length and learning rate of a training."""

    steps: int
    batch: int
    learning_rate: float
    """Maximum of AdamW's learning rate: a rise over the first tenth, then a cosine decay (one cycle)."""
    weight_decay: float = 0.02

    def learning_rate_at(self, step: int) -> float:
        """Return the learning rate of a step, counted from 1."""
        rise = max(1.0, self.steps / 10)
        if step < rise:
            return self.learning_rate * step / rise
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * (step - rise) / max(self.steps - rise, 1.0)))


SCHEDULES = {
    "segmenter": Schedule(2400, 8, 2e-3),
    "keypoints": Schedule(4000, 24, 2e-3),
    "outline": Schedule(3000, 64, 2e-3),
}
"""Schedules of networks with random initial weights."""


class Source(NamedTuple):
    """Folders of labelled frames, and the samples that are drawn from them."""

    folders: tuple[Path, ...]
    draw: Callable[[np.random.Generator, Any], Any]
    """Draws one sample, a NamedTuple of arrays with the field `picture`; a module-level function or its `partial`."""
    share: float = 1.0
    """Share of the samples; the shares of all sources sum to 1."""
    keypoint_names: tuple[str, ...] | None = None
    """Names of the keypoints of the samples; None keeps the names of the frames."""
    load: Callable[..., Any] = load_frames
    """Loads the folders for `draw`."""


class Samples(Dataset):
    """A dataset whose sample i depends only on the seed and `first` + i, not on the process that draws it."""

    def __init__(self, sources: Sequence[Source], seed: int, first: int, count: int):
        self._sources, self._seed, self._first, self._count = sources, seed, first, count
        self._frames: dict[int, Any] = {}

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, i: int) -> Any:
        rng = np.random.default_rng((self._seed, self._first + i))
        shares = [source.share for source in self._sources]
        k = 0 if len(shares) == 1 else int(rng.choice(len(shares), p=shares))
        source = self._sources[k]
        if k not in self._frames:  # the process that draws opens the files itself
            frames = source.load(*source.folders)
            names = source.keypoint_names
            self._frames[k] = frames.with_keypoints(names) if names else frames
        return source.draw(rng, self._frames[k])


def batches(sources: Sequence[Source], batch: int, seed: int, first_step: int, last_step: int) -> Iterator[Any]:
    """Draw the batches of some steps in another process; a batch depends only on the sources, the seed and its step.

    Args:
        sources: folders of labelled frames.
        batch: number of samples of a batch.
        seed: seed of the samples.
        first_step, last_step: range of the steps, counted from 0; the last step is not included.
    """
    yield from DataLoader(
        Samples(sources, seed, first_step * batch, (last_step - first_step) * batch),
        batch,
        num_workers=1,
        prefetch_factor=4,
        worker_init_fn=_use_one_thread,
        multiprocessing_context="spawn",  # a fork breaks JAX's threads
    )


def _use_one_thread(_worker: int) -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


class Trained(NamedTuple):
    """The result of a training."""

    step: int
    """Number of steps that were taken."""
    history: list[tuple[int, float]]
    """Step and score on the held-out part, of every measurement."""
    best: dict[str, Tensor]
    """The trained weights with the best score; the last weights if nothing was measured."""
    losses: dict[str, float]
    """Each term of the loss, averaged over the last tenth of the steps."""

    @property
    def best_step(self) -> int:
        """Number of steps of the best weights; all steps if nothing was measured.

        Of equal scores, the last is the best. The score of the initial weights (step 0) does not count.
        """
        scored = [(score, step) for step, score in self.history if step > 0]
        return max(scored)[1] if scored else self.step


def train(
    network: FeaturePyramid,
    loss: Loss,
    sources: Sequence[Source],
    schedule: Schedule,
    seed: int,
    is_folded: bool = True,
    path: Path | None = None,
    fingerprint: str = "",
    score: Callable[[], float] | None = None,
    progress: ProgressTask = silent,
    name: str = "Training",
) -> Trained:
    """Train a network in place, on a GPU if PyTorch finds a GPU, in bfloat16 where it is faster than float32.

    With a file of the state, the training continues from the state in the file. The same arguments give the same
    result, with and without an interruption, on the same processor with the same number of threads.

    Args:
        network: the network, with the initial weights.
        loss: computes the terms of the loss of a batch.
        sources: labelled and simulated frames.
        schedule: number of steps, size of the batches, learning rate.
        seed: seed of the samples; the caller initialises the network.
        is_folded: whether the network comes from a file, so that its normalisation is folded into the convolutions.
        path: file of the state, written after every measurement; None stores nothing.
        fingerprint: hash of everything that determines the training.
        score: measures the network, the higher the better; None trains without measurements.
        progress: reports every step.
        name: name of the task, for the progress report.

    Raises:
        InputError: the file of the state belongs to another training, or is damaged.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network.to(device).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    optimiser = torch.optim.AdamW(network.parameter_groups(), lr=0.0, weight_decay=schedule.weight_decay)
    if path is not None and path.exists():
        state = _load_state(path, fingerprint, network, optimiser, device)
    else:
        state = Trained(0, [(0, score())] if score is not None else [], {}, {})
    interval, half = math.ceil(schedule.steps / CHECKS), has_fast_bfloat16()
    recent: list[dict[str, float]] = []
    with progress(name, schedule.steps) as report_progress:
        report_progress(state.step, _note(state))
        drawn = batches(sources, schedule.batch, seed, state.step, schedule.steps)
        for step, sample in enumerate(() if _is_finished(state, schedule) else drawn, state.step + 1):
            network.train()
            if is_folded:
                freeze_normalisation(network)
            for group in optimiser.param_groups:
                group["lr"] = group["share"] * schedule.learning_rate_at(step)
            recent = [*recent[-max(schedule.steps // 10, 20) :], _step(network, sample, loss, optimiser, half)]
            means = " ".join(f"{key} {np.mean([terms[key] for terms in recent[-50:]]):.3f}" for key in recent[-1])
            report_progress(1, ", ".join(filter(None, (means, _note(state)))))
            if step % interval == 0 or step == schedule.steps:
                state = _measured(network, state, step, score)
                if path is not None:
                    _save_state(path, fingerprint, state, network, optimiser)
                if _is_finished(state, schedule):
                    break
    network.cpu().eval()
    tenth = recent[-max(schedule.steps // 10, 1) :]
    return state._replace(
        losses={key: float(np.mean([terms[key] for terms in tenth])) for key in tenth[0]} if tenth else {}
    )


def _step(
    network: nn.Module, sample: Any, loss: Loss, optimiser: torch.optim.Optimizer, half_precision: bool
) -> dict[str, float]:
    """Take one step of an optimiser on one batch and return the terms of the loss."""
    device = next(network.parameters()).device
    sample = type(sample)(*(part.to(device) for part in sample))
    picture = sample.picture.contiguous(memory_format=torch.channels_last)
    with torch.autocast(device.type, torch.bfloat16, enabled=half_precision):
        maps = network(picture)
    terms = loss(maps, sample)
    optimiser.zero_grad(set_to_none=True)
    torch.stack(list(terms.values())).sum().backward()
    nn.utils.clip_grad_norm_(network.parameters(), 5.0)
    optimiser.step()
    return {key: float(term.detach()) for key, term in terms.items()}


def has_fast_bfloat16() -> bool:
    """Return whether the processor has instructions for bfloat16; without them, bfloat16 is slower than float32."""
    if torch.cuda.is_available():
        return True
    try:
        flags = Path("/proc/cpuinfo").read_text(errors="replace")
    except OSError:  # not Linux
        return False
    return "avx512_bf16" in flags or "amx_bf16" in flags


def weights_of(network: nn.Module) -> dict[str, Tensor]:
    """Return a copy of all weights of a network, on the CPU."""
    return {name: value.detach().cpu().clone() for name, value in network.state_dict().items()}


def _measured(network: FeaturePyramid, state: Trained, step: int, score: Callable[[], float] | None) -> Trained:
    """Return the state after a measurement; the best weights are the last weights if nothing is measured.

    The initial weights are never the best weights, so that a training that does not help has a score of its own.
    """
    best, history = weights_of(network), state.history
    if score is not None:
        history = [*history, (step, float(score()))]
        if history[-1][1] < max(value for at, value in history if at > 0):
            best = state.best
    return Trained(step, history, best, {})


def _is_finished(state: Trained, schedule: Schedule) -> bool:
    """Whether all steps are taken, or the score did not improve for `PATIENCE` measurements."""
    scores = [score for _, score in reversed(state.history)]
    waited = scores.index(max(scores)) if scores else 0  # of equal scores, the last is the best
    return state.step >= schedule.steps or waited >= PATIENCE


def _note(state: Trained) -> str:
    return f"best score during training {max(score for _, score in state.history):.3f}" if state.history else ""


def _save_state(
    path: Path, fingerprint: str, state: Trained, network: nn.Module, optimiser: torch.optim.Optimizer
) -> None:
    """Write the state of a training, completely or not at all."""
    content = {"fingerprint": fingerprint, "step": state.step, "history": state.history, "best": state.best}
    content |= {"network": network.state_dict(), "optimiser": optimiser.state_dict()}
    write_whole(path, lambda file: torch.save(content, file))


def _load_state(
    path: Path, fingerprint: str, network: nn.Module, optimiser: torch.optim.Optimizer, device: torch.device
) -> Trained:
    """Put network and optimiser into the state of a file, and return the training so far; executes no code of it."""
    with reading(path, "the state of a training", "remove the folder to begin again"):
        content = torch.load(path, map_location=device, weights_only=True)
        if content["fingerprint"] != fingerprint:
            remedy = "repeat the command of that training, or remove the folder to begin again"
            raise InputError(path.parent, "holds an interrupted training with other labels or options", remedy)
        network.load_state_dict(content["network"])
        optimiser.load_state_dict(content["optimiser"])
        best = {name: value.cpu() for name, value in content["best"].items()}
        return Trained(content["step"], [tuple(entry) for entry in content["history"]], best, {})


def check_numbers(has_labels: bool, steps: int | None, scenes: int, seed: int, **shares: float) -> None:
    """Check the numbers of a training, and raise InputError for a number outside its range.

    Args:
        has_labels: whether a person or a teacher made labels.
        steps: number of steps; None for the default.
        scenes: number of simulated scenes.
        seed: seed of the samples.
        shares: `holdout`, `varied` or `wings`.
    """
    fewest_steps, fewest_scenes = (CHECKS, 0) if has_labels else (20, 1)
    if steps is not None and steps < fewest_steps:
        raise InputError("train: steps", f"is {steps}", f"give {fewest_steps} or more")
    if not fewest_scenes <= scenes <= 900:  # seeds of 1000 and more are for tests
        raise InputError("train: scenes", f"is {scenes}", f"give {fewest_scenes} to 900")
    if seed < 0:
        raise InputError("train: seed", f"is {seed}", "give a whole number from 0")
    for name, share in shares.items():
        largest = 0.5 if name == "holdout" else 1
        if not 0 <= share <= largest:
            raise InputError(f"train: {name}", f"is {share}", f"give a share of 0 to {largest}")


class Simulation(NamedTuple):
    """The simulated frames of a training."""

    folder: Path
    """Folder of the scenes, about 32 MB per scene; scenes that it lacks are filmed."""
    scenes: int = SCENES
    """Number of scenes, at most 900."""
    varied: float = 0.0
    """Share of the scenes with other birds in other landscapes."""
    wings: float = 0.0
    """Share of the scenes in which the birds flap or fly."""


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
    base: str | Path | None = None,
) -> dict[str, float]:
    """Train a built-in network on simulated frames and write two files: in floats, and in 8 bits (`eight_bits`).

    The weights differ slightly between processors.

    Args:
        which: `segmenter` or `keypoints`.
        path: the `.onnx` file to write; an existing file is replaced.
        simulation: the simulated frames.
        schedule: schedule of the training; None uses `default_schedule`.
        seed: seed of the initial weights and of the samples.
        progress: reports scenes and steps.
        base: the network to start from, as in `base_file`; None starts from random weights, and a segmenter from the
            encoder of the built-in segmenter.

    Returns:
        Each term of the loss, averaged over the last tenth of the steps.

    Raises:
        ValueError: unknown `which`.
        InputError: a number outside its range, or a folder with other contents.
    """
    if which not in ("segmenter", "keypoints"):
        raise ValueError(f"which must be segmenter or keypoints, not {which!r}")
    schedule = schedule or default_schedule(which, base)
    check_numbers(False, schedule.steps, simulation.scenes, seed, varied=simulation.varied, wings=simulation.wings)
    _check_name(path)
    torch.manual_seed(seed)
    network = _initial_network(which, base)
    scenes = simulation.scenes
    folders = film_scenes(simulation.folder, scenes, simulation.varied, simulation.wings, progress)
    frames = load_frames(*folders)
    module = segmenter if which == "segmenter" else keypoints
    sources = [Source(folders, module.draw_sample)]
    losses = train(
        network, module.loss, sources, schedule, seed, base is not None, progress=progress, name=f"Training {which}"
    ).losses
    photographs = ", but the encoder was trained on photographs before" if which == "segmenter" else ""
    facts = {
        "trained_by": f"jaxfit {own_version()} train {which}" + (f", from {Path(base).name}" if base else ""),
        "trained_on": f"{len(frames.pictures)} simulated frames of {scenes} scenes; no real footage{photographs}",
        "schedule": json.dumps(schedule._asdict()),
        "loss": json.dumps({name: round(value, 5) for name, value in losses.items()}),
    }
    write_network(which, network, facts, path)
    # a keypoint network sees the birds that a segmenter detects
    birds_of = load_segmenter("builtin") if which == "keypoints" else None
    store_training_activations(which, path, [frames], birds_of, progress)
    inputs = training_inputs(which, path, [frames], birds_of, INPUTS)
    write_eight_bits(path, inputs, Path(path).with_stem(Path(path).stem + SUFFIX))
    return losses


def train_outline(
    path: str | Path,
    birds: Sequence[Bird],
    folder: Path,
    species: int = SPECIES,
    schedule: Schedule | None = None,
    seed: int = 0,
    progress: ProgressTask = silent,
) -> dict[str, float]:
    """Train the network that detects keypoints from outlines on simulated outlines, and write it.

    Args:
        path: the `.onnx` file to write; an existing file is replaced.
        birds: models from which the species are drawn in turn.
        folder: folder of the outlines; they are drawn if it lacks them.
        species, schedule, seed, progress: as in `outlines.draw_outlines` and `train_network`.

    Returns:
        The term of the loss, averaged over the last tenth of the steps.

    Raises:
        InputError: a number outside its range.
    """
    schedule = schedule or SCHEDULES["outline"]
    check_numbers(False, schedule.steps, 1, seed)
    _check_name(path)
    file = folder / f"outlines_{species}_{'_'.join(bird.name for bird in birds)}_{seed}.npz"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        drawn = outlines.draw_outlines(birds, species, seed, progress)
        write_whole(file, lambda opened: np.savez(opened, **drawn._asdict()))
    torch.manual_seed(seed)
    network = outlines.outline_network()
    sources = [Source((file,), outlines.draw_sample, load=outlines.load_outlines)]
    losses = train(
        network, outlines.loss, sources, schedule, seed, False, progress=progress, name="Training outline"
    ).losses
    facts = {
        "trained_by": f"jaxfit {own_version()} train outline",
        "trained_on": f"simulated outlines of {species} species of the models {', '.join(bird.name for bird in birds)}",
        "schedule": json.dumps(schedule._asdict()),
        "loss": json.dumps({name: round(value, 5) for name, value in losses.items()}),
    }
    write_network("outline", network, facts, path, outlines.NAMES, crops=outlines.CROPS)
    return losses


def _check_name(path: str | Path) -> None:
    """Check the file of a network before the training, not after it."""
    if Path(path).suffix != ".onnx":
        raise InputError(path, "is not the name of an ONNX file", "give a name with the suffix .onnx")
    check_writable(path)


def _initial_network(which: str, base: str | Path | None) -> FeaturePyramid:
    """Return the network before the training."""
    path = base_file(which, base or "builtin")
    if base is not None:
        return load_segmenter_base(path) if which == "segmenter" else load_keypoint_base(path, MURRE_KEYPOINTS)[0]
    if which == "keypoints":
        return keypoints.keypoint_network()
    network = segmenter.segmenter_network()
    # the encoder was trained on photographs, and its first stages are fixed; all other layers have random weights
    network.down.load_state_dict(load_segmenter_base(path).down.state_dict())
    return network
