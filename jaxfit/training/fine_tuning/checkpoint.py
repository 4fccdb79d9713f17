"""State of an interrupted training as one `.npz` file, without pickle."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from jaxfit.errors import InputError
from jaxfit.storage.files import write_whole
from jaxfit.storage.npz import load_npz

__all__ = [
    "Checkpoint",
    "flat_weights",
    "load_checkpoint",
    "restore",
    "save_checkpoint",
    "set_weights",
    "state_of",
]

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
