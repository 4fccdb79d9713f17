"""Training loop, with early stopping and resumption."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from jaxfit.foundation.array_files import load_npz
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks.labelled_frames import LabelledFrames, join_frames, load_frames
from jaxfit.learning.networks.network_files import freeze_normalisation
from jaxfit.learning.networks.networks import FeaturePyramid
from jaxfit.learning.networks.ranges import CHECKS

# pyright: reportMissingImports=false


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

    def optimiser(self, network: FeaturePyramid) -> torch.optim.Optimizer:
        """Create the optimiser of a network; `set_learning_rate` must be called before every step."""
        return torch.optim.AdamW(network.parameter_groups(), lr=0.0, weight_decay=self.weight_decay)

    def set_learning_rate(self, optimiser: torch.optim.Optimizer, step: int) -> None:
        """Set the learning rates of all parameters for a step, counted from 1."""
        for group in optimiser.param_groups:
            group["lr"] = group["share"] * self.learning_rate_at(step)


class Source(NamedTuple):
    """A folder of labelled frames, and the samples that are drawn from the folder."""

    folder: Path
    draw: Callable[[np.random.Generator, LabelledFrames], Any]
    """Draws one sample, a NamedTuple of arrays with the field `picture`; a module-level function or its `partial`."""
    share: float = 1.0
    """Share of the samples; the shares of all sources sum to 1."""
    keypoint_names: tuple[str, ...] | None = None
    """Names of the keypoints of the samples; None keeps the names of the frames."""
    more: tuple[Path, ...] = ()
    """Further folders, which may be written while the training runs."""
    samples_per_folder: int = 1
    """Number of samples of the training for each further folder: sample i uses 1 + i // `samples_per_folder` folders
    at most. So a sample does not depend on the time at which a folder is complete."""
    wait: Callable[[int], object] | None = None
    """Returns when this number of folders is complete."""

    def num_folders(self, sample: int) -> int:
        """Return the number of folders that sample number `sample` of the training is drawn from."""
        return min(1 + sample // self.samples_per_folder, 1 + len(self.more))


class _Samples(Dataset):
    """A dataset whose sample i depends only on the seed and i, not on the number of workers."""

    def __init__(self, sources: Sequence[Source], seed: int, first: int, count: int):
        # a worker cannot wait: the main process waits before it sends the number of a sample
        self._sources = tuple(source._replace(wait=None) for source in sources)
        self._seed, self._first, self._count = seed, first, count
        self._parts: dict[Path, LabelledFrames] = {}
        self._joined: dict[int, tuple[int, LabelledFrames]] = {}

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, i: int) -> Any:
        rng = np.random.default_rng((self._seed, self._first + i))
        k = 0 if len(self._sources) == 1 else int(rng.choice(len(self._sources), p=[s.share for s in self._sources]))
        source = self._sources[k]
        count = source.num_folders(self._first + i)
        if self._joined.get(k, (0,))[0] != count:
            self._joined[k] = count, join_frames([self._load(f, source) for f in (source.folder, *source.more)[:count]])
        return source.draw(rng, self._joined[k][1])

    def _load(self, folder: Path, source: Source) -> LabelledFrames:
        """Return the frames of a folder; each worker opens the files itself."""
        if folder not in self._parts:
            frames = load_frames(folder)
            self._parts[folder] = frames.with_keypoints(source.keypoint_names or frames.keypoint_names)
        return self._parts[folder]


class _Order:
    """The numbers of the samples in their order; a number comes when all folders that the sample needs are complete."""

    def __init__(self, sources: Sequence[Source], first: int, count: int):
        self._sources, self._first, self._count = sources, first, count

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[int]:
        for i in range(self._count):
            for source in self._sources:
                if source.wait is not None:
                    source.wait(source.num_folders(self._first + i))
            yield i


def batches(sources: Sequence[Source], batch: int, seed: int, first_step: int, last_step: int) -> Iterator[Any]:
    """Draw the batches of some steps in another process; a batch depends only on the sources, the seed and its step.

    Args:
        sources: folders of labelled frames.
        batch: number of samples of a batch.
        seed: seed of the samples.
        first_step, last_step: range of the steps, counted from 0; the last step is not included.
    """
    first, count = first_step * batch, (last_step - first_step) * batch
    yield from DataLoader(
        _Samples(sources, seed, first, count),
        batch,
        sampler=_Order(sources, first, count),
        num_workers=1,
        prefetch_factor=4,
        worker_init_fn=_use_one_thread,
        multiprocessing_context="spawn",  # a fork breaks JAX's threads
    )


def train_step(
    network: nn.Module, sample: Any, loss: Loss, optimiser: torch.optim.Optimizer, half_precision: bool
) -> dict[str, float]:
    """Take one step of an optimiser on one batch and return the terms of the loss.

    Args:
        network: maps a batch of `picture` to maps by name.
        sample: the batch.
        loss: computes the terms of the loss of a batch.
        optimiser: an optimiser of the network's parameters.
        half_precision: whether the network computes in bfloat16.
    """
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


def train(
    network: FeaturePyramid,
    draw: Callable[[np.random.Generator, LabelledFrames], Any],
    loss: Loss,
    frames_folder: Path,
    schedule: Schedule,
    seed: int = 0,
    is_folded: bool = False,
    progress: ProgressTask = silent,
    name: str = "Training",
) -> dict[str, float]:
    """Train a network in place, on a GPU if PyTorch finds a GPU, in bfloat16 where it is faster than float32.

    Args:
        network: maps a batch of `picture` to maps by name.
        draw: draws one sample, a NamedTuple of arrays with the field `picture`; must be a module-level function.
        loss: computes the terms of the loss of a batch.
        frames_folder: folder of the frames, written by `film_scenes`.
        schedule: number of steps, size of the batches, learning rate.
        seed: seed of the samples; the caller initialises the network.
        is_folded: whether the network comes from a file, so that its normalisation is folded into the convolutions.
        progress: reports every step and the loss.
        name: name of the task, for the progress report.

    Returns:
        Each term of the loss, averaged over the last tenth of the steps.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network.to(device).train()
    if is_folded:
        freeze_normalisation(network)
    network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    optimiser = schedule.optimiser(network)
    half = has_fast_bfloat16()
    recent: list[dict[str, float]] = []
    with progress(name, schedule.steps) as report_progress:
        drawn = batches([Source(frames_folder, draw)], schedule.batch, seed, 0, schedule.steps)
        for step, sample in enumerate(drawn, 1):
            schedule.set_learning_rate(optimiser, step)
            terms = train_step(network, sample, loss, optimiser, half)
            recent = [*recent[-(schedule.steps // 10) :], terms]
            report_progress(1, " ".join(f"{key} {np.mean([r[key] for r in recent[-50:]]):.4f}" for key in recent[-1]))
    network.cpu().eval()
    return {key: float(np.mean([values[key] for values in recent])) for key in recent[-1]}


def has_fast_bfloat16() -> bool:
    """Return whether the processor has instructions for bfloat16; without them, bfloat16 is slower than float32."""
    if torch.cuda.is_available():
        return True
    try:
        flags = Path("/proc/cpuinfo").read_text(errors="replace")
    except OSError:  # not Linux
        return False
    return "avx512_bf16" in flags or "amx_bf16" in flags


def _use_one_thread(_worker: int) -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


# pyright: reportMissingImports=false


_LAYOUT = {
    "fingerprint": "",
    "step": "",
    "weights": "P",
    "mean": "P",
    "square": "P",
    "best_weights": "P",
    "history": "E 2",
}
_NUMBERS = ("weights", "mean", "square", "best_weights", "history")


class Checkpoint(NamedTuple):
    """The state after some steps."""

    fingerprint: str
    """Hash of the labels and the options of the training."""
    step: int
    """Number of steps."""
    weights: np.ndarray
    """(P,) all parameters."""
    mean: np.ndarray
    """(P,) first moments of AdamW."""
    square: np.ndarray
    """(P,) second moments of AdamW."""
    best_weights: np.ndarray
    """(P,) the trained parameters with the best score so far; the initial parameters before the first measurement."""
    history: np.ndarray
    """(E, 2) step and score on the held-out part, of every measurement so far."""

    @property
    def best_step(self) -> int:
        """Number of steps of the best weights; all steps if nothing was measured.

        Of equal scores, the last is the best. The score of the initial weights (step 0) does not count.
        """
        latest_first = self.history[self.history[:, 0] > 0][::-1]
        return int(latest_first[latest_first[:, 1].argmax(), 0]) if len(latest_first) else self.step


def state_of(
    network: nn.Module,
    optimiser: torch.optim.Optimizer,
    fingerprint: str,
    step: int,
    best_weights: np.ndarray,
    history: list[tuple[int, float]],
) -> Checkpoint:
    """Return the state of a training; `best_weights` as in `Checkpoint`."""
    parameters = list(network.parameters())
    mean, square = (
        _flat(optimiser.state[p].get(name, torch.zeros_like(p)) for p in parameters)
        for name in ("exp_avg", "exp_avg_sq")
    )
    scores = np.array(history, float).reshape(-1, 2)
    return Checkpoint(fingerprint, step, flat_weights(network), mean, square, best_weights, scores)


def restore(network: nn.Module, optimiser: torch.optim.Optimizer, checkpoint: Checkpoint) -> None:
    """Put a network and its AdamW optimiser into the state of a checkpoint."""
    set_weights(network, checkpoint.weights)
    at = 0
    for p in network.parameters():
        part = slice(at, at + p.numel())
        at += p.numel()
        optimiser.state[p] = {
            "step": torch.tensor(float(checkpoint.step)),
            "exp_avg": torch.from_numpy(checkpoint.mean[part].copy()).reshape(p.shape).to(p),
            "exp_avg_sq": torch.from_numpy(checkpoint.square[part].copy()).reshape(p.shape).to(p),
        }


def flat_weights(network: nn.Module) -> np.ndarray:
    """Return all parameters of a network as one array (P,)."""
    return _flat(network.parameters())


def set_weights(network: nn.Module, weights: np.ndarray) -> None:
    """Set all parameters of a network from one array (P,)."""
    at = 0
    with torch.no_grad():
        for p in network.parameters():
            p.copy_(torch.from_numpy(weights[at : at + p.numel()]).reshape(p.shape))
            at += p.numel()


def _flat(tensors: Iterable[Tensor]) -> np.ndarray:
    return torch.cat([tensor.detach().reshape(-1).cpu() for tensor in tensors]).numpy()


def save_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint, completely or not at all."""
    write_whole(path, lambda file: np.savez(file, **checkpoint._asdict()))


def load_checkpoint(path: Path, fingerprint: str, parameters: int) -> Checkpoint | None:
    """Read the checkpoint of the same training; None if there is no file.

    Args:
        path: the file.
        fingerprint: hash of the labels and the options of this training.
        parameters: number of parameters of the network.

    Raises:
        InputError: the file cannot be read, or belongs to another training.
    """
    if not path.exists():
        return None
    arrays = load_npz(path, _LAYOUT)
    remedy = "repeat the command of that training, or remove the folder to begin again"
    if str(arrays["fingerprint"]) != fingerprint:
        raise InputError(path.parent, "holds an interrupted training with other labels or options", remedy)
    numbers = all(arrays[name].dtype.kind == "f" and np.isfinite(arrays[name]).all() for name in _NUMBERS)
    if not numbers or arrays["step"].dtype.kind != "i" or arrays["step"] < 0 or len(arrays["weights"]) != parameters:
        raise InputError(path, "is damaged", "remove the folder to begin again")
    floats = {name: arrays[name].astype(np.float32) for name in _NUMBERS[:-1]}
    return Checkpoint(fingerprint, int(arrays["step"]), **floats, history=arrays["history"])


# pyright: reportMissingImports=false


PATIENCE = 4
"""Number of measurements without a better score after which the training stops."""


def continue_training(
    model: FeaturePyramid,
    loss: Loss,
    sources: Sequence[Source],
    schedule: Schedule,
    seed: int,
    path: Path,
    fingerprint: str,
    score: Callable[[], float] | None = None,
    progress: ProgressTask = silent,
    name: str = "Training",
) -> Checkpoint:
    """Train a network in place from the state in a file, or from its beginning if there is no file.

    The same arguments give the same result, with and without an interruption, on the same processor with the same
    number of threads.

    Args:
        model: the network, with the initial weights.
        loss: computes the terms of the loss of a batch.
        sources: labelled and simulated frames.
        schedule: number of steps, size of the batches, learning rate.
        seed: seed of the samples.
        path: file of the state, written after every measurement.
        fingerprint: hash of everything that determines the training.
        score: measures the network, the higher the better; None trains without measurements.
        progress: reports every step.
        name: name of the task, for the progress report.

    Returns:
        The last state, which holds the best trained weights.

    Raises:
        InputError: the file belongs to another training, or is damaged.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model.to(device).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    optimiser = schedule.optimiser(model)
    state = load_checkpoint(path, fingerprint, len(flat_weights(model)))
    if state is None:
        history = [(0, score())] if score is not None else []
        state = state_of(model, optimiser, fingerprint, 0, flat_weights(model), history)
    restore(model, optimiser, state)
    interval = math.ceil(schedule.steps / CHECKS)
    half = has_fast_bfloat16()
    with progress(name, schedule.steps) as report_progress:
        report_progress(state.step, _note(state))
        if _is_finished(state, schedule):
            model.cpu().eval()
            return state
        recent: list[float] = []
        drawn = batches(sources, schedule.batch, seed, state.step, schedule.steps)
        for step, sample in enumerate(drawn, state.step + 1):
            model.train()
            freeze_normalisation(model)
            schedule.set_learning_rate(optimiser, step)
            terms = train_step(model, sample, loss, optimiser, half)
            recent = [*recent[-20:], sum(terms.values())]
            report_progress(1, f"loss {np.mean(recent):.3f}, {_note(state)}")
            if step % interval == 0 or step == schedule.steps:
                state = _measured(model, optimiser, state, step, score)
                save_checkpoint(state, path)
                if _is_finished(state, schedule):
                    break
    model.cpu().eval()
    return state


def _measured(
    model: FeaturePyramid,
    optimiser: torch.optim.Optimizer,
    state: Checkpoint,
    step: int,
    score: Callable[[], float] | None,
) -> Checkpoint:
    """Return the state after a measurement; the best weights are the last weights if nothing is measured.

    The initial weights are never the best weights, so that a training that does not help has a score of its own.
    """
    history = [(int(at), float(value)) for at, value in state.history]
    best = flat_weights(model)
    if score is not None:
        history.append((step, score()))
        if history[-1][1] < max(value for at, value in history if at > 0):
            best = state.best_weights
    return state_of(model, optimiser, state.fingerprint, step, best, history)


def _is_finished(state: Checkpoint, schedule: Schedule) -> bool:
    """Whether all steps are taken, or the score did not improve for `PATIENCE` measurements."""
    scores = state.history[:, 1]
    waited = int(scores[::-1].argmax()) if len(scores) else 0  # of equal scores, the last is the best
    return state.step >= schedule.steps or waited >= PATIENCE


def _note(state: Checkpoint) -> str:
    return f"best score during training {state.history[:, 1].max():.3f}" if len(state.history) else ""
