"""The loop of a fine-tuning: it stops early, and continues after an interruption."""

# pyright: reportMissingImports=false

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from jaxfit.progress import ProgressTask, silent
from jaxfit.training.fine_tuning.base_network import freeze_normalisation
from jaxfit.training.fine_tuning.checkpoint import (
    Checkpoint,
    flat_weights,
    load_checkpoint,
    restore,
    save_checkpoint,
    state_of,
)
from jaxfit.training.loop import Loss, Schedule, Source, batches, has_fast_bfloat16, train_step
from jaxfit.training.networks import FeaturePyramid

__all__ = ["CHECKS", "continue_training"]

CHECKS = 10
"""Number of measurements on the held-out pictures during a training."""
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
    return f"best score on the held-out part {state.history[:, 1].max():.3f}" if len(state.history) else ""
