"""Command that trains the built-in networks."""

from __future__ import annotations

import argparse
import time

from jaxfit.cli.tables import show
from jaxfit.extras import require_extra
from jaxfit.progress import terminal
from jaxfit.storage.files import check_new_file

__all__ = ["train"]


def train(options: argparse.Namespace) -> None:
    """Train one network on simulated footage and write the network as an ONNX file."""
    require_extra("train", "train")
    from jaxfit.training.train import SCHEDULES, train_network

    start = time.perf_counter()
    check_new_file(options.out, options.overwrite)
    steps = SCHEDULES[options.network].steps if options.steps is None else options.steps
    schedule = SCHEDULES[options.network]._replace(steps=steps)
    paths = options.out, options.frames
    losses = train_network(options.network, *paths, options.scenes, schedule, options.seed, progress=terminal)
    loss = ", ".join(f"{name} {value:.3f}" for name, value in losses.items())
    show(f"{options.network} trained in {(time.perf_counter() - start) / 60:.0f} min, loss {loss} → {options.out}")
