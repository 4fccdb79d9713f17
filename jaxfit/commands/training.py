"""Train the built-in networks anew."""

from __future__ import annotations

import argparse
import time

from jaxfit.errors import InputError
from jaxfit.progress import terminal
from jaxfit.tables import show

__all__ = ["train"]


def train(options: argparse.Namespace) -> None:
    from importlib.util import find_spec

    if not all(find_spec(package) for package in ("torch", "onnx", "onnxscript")):
        raise InputError("train", "needs PyTorch and ONNX, which are not installed", 'pip install "jaxfit[train]"')
    from jaxfit.training.train import SCHEDULES, train_network

    began = time.perf_counter()
    if options.out.exists() and not options.overwrite:
        raise InputError(options.out, "exists already", "choose another --out or pass --overwrite")
    steps = SCHEDULES[options.network].steps if options.steps is None else options.steps
    schedule = SCHEDULES[options.network]._replace(steps=steps)
    where = options.out, options.frames
    losses = train_network(options.network, *where, options.scenes, schedule, options.seed, progress=terminal)
    loss = ", ".join(f"{name} {value:.3f}" for name, value in losses.items())
    show(f"{options.network} in {(time.perf_counter() - began) / 60:.0f} min, loss {loss} → {options.out}")
