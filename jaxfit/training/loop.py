"""The training loop of both networks."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from jaxfit.progress import ProgressTask, silent
from jaxfit.training.scenes import LabelledFrames, load_frames

__all__ = ["Schedule", "train"]


class Schedule(NamedTuple):
    """Length and learning rate of a training."""

    steps: int
    batch: int
    learning_rate: float
    """Maximum of AdamW's learning rate: a rise over the first tenth, then a cosine decay (one cycle)."""
    weight_decay: float = 0.02


class _Samples(Dataset):
    """A dataset whose sample i depends only on the seed and i, not on the number of workers."""

    def __init__(self, draw: Callable[..., Any], folder: Path, seed: int, count: int):
        self._draw, self._folder, self._seed, self._count = draw, folder, seed, count
        self._frames: LabelledFrames | None = None

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, i: int) -> Any:
        if self._frames is None:  # each worker opens the frames itself
            self._frames = load_frames(self._folder)
        return self._draw(np.random.default_rng((self._seed, i)), self._frames)


def train(
    network: nn.Module,
    draw: Callable[[np.random.Generator, LabelledFrames], Any],
    loss: Callable[[dict[str, Tensor], Any], dict[str, Tensor]],
    frames_folder: Path,
    schedule: Schedule,
    seed: int = 0,
    progress: ProgressTask = silent,
    name: str = "Training",
) -> dict[str, float]:
    """Train a network in place, with bfloat16 autocast, on a GPU if PyTorch finds a GPU.

    Args:
        network: maps a batch of `picture` to maps by name.
        draw: draws one sample, a NamedTuple of arrays with the field `picture`; must be a module-level function.
        loss: computes the terms of the loss of a batch.
        frames_folder: folder of the frames, written by `film_scenes`.
        schedule: number of steps, size of the batches, learning rate.
        seed: seed of the samples; the caller initialises the network.
        progress: reports every step and the loss.
        name: name of the task, for the progress report.

    Returns:
        Each term of the loss, averaged over the last tenth of the steps.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network.to(device).train()
    network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    samples = _Samples(draw, frames_folder, seed, schedule.steps * schedule.batch)
    loader = DataLoader(
        samples,
        schedule.batch,
        num_workers=1,
        prefetch_factor=4,
        worker_init_fn=_use_one_thread,
        multiprocessing_context="spawn",  # a fork breaks JAX's threads
    )
    optimiser = torch.optim.AdamW(network.parameters(), lr=schedule.learning_rate, weight_decay=schedule.weight_decay)
    scheduler = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, schedule.learning_rate, schedule.steps, pct_start=0.1, cycle_momentum=False
    )
    recent: list[dict[str, float]] = []
    with progress(name, schedule.steps) as report_progress:
        for sample in loader:
            sample = type(sample)(*(part.to(device) for part in sample))
            picture = sample.picture.contiguous(memory_format=torch.channels_last)
            with torch.autocast(device.type, torch.bfloat16):
                maps = network(picture)
            terms = loss(maps, sample)
            optimiser.zero_grad(set_to_none=True)
            torch.stack(list(terms.values())).sum().backward()
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
            scheduler.step()
            recent = [*recent[-(schedule.steps // 10) :], {key: float(term.detach()) for key, term in terms.items()}]
            report_progress(1, " ".join(f"{key} {np.mean([r[key] for r in recent[-50:]]):.4f}" for key in recent[-1]))
    network.cpu().eval()
    return {key: float(np.mean([values[key] for values in recent])) for key in recent[-1]}


def _use_one_thread(_worker: int) -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
