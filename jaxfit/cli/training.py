"""Train the built-in networks anew."""

from __future__ import annotations

import argparse
import time

from jaxfit.cli.tables import show
from jaxfit.extras import require_extra
from jaxfit.progress import terminal
from jaxfit.storage.files import check_new_file

__all__ = ["train"]


def train(options: argparse.Namespace) -> None:
    require_extra("train", "train")
    from jaxfit.training.train import SCHEDULES, train_network

    began = time.perf_counter()
    check_new_file(options.out, options.overwrite)
    steps = SCHEDULES[options.network].steps if options.steps is None else options.steps
    schedule = SCHEDULES[options.network]._replace(steps=steps)
    where = options.out, options.frames
    losses = train_network(options.network, *where, options.scenes, schedule, options.seed, progress=terminal)
    loss = ", ".join(f"{name} {value:.3f}" for name, value in losses.items())
    show(f"{options.network} in {(time.perf_counter() - began) / 60:.0f} min, loss {loss} → {options.out}")
