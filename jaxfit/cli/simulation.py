"""Commands for simulated scenes."""

from __future__ import annotations

import argparse
import time

from jaxfit.cli.tables import counted, show
from jaxfit.errors import InputError
from jaxfit.model.files import find_bird
from jaxfit.progress import terminal

__all__ = ["demo", "simulate"]


def simulate(options: argparse.Namespace) -> None:
    """Simulate a scene and write its footage and ground truth."""
    from jaxfit.simulation.scene import simulate

    start = time.perf_counter()
    scene = simulate(
        find_bird("murre"),
        options.out,
        birds=options.birds,
        frames=options.frames,
        size=_size(options.size),
        fps=options.fps,
        seed=options.seed,
        codec=options.codec,
        overwrite=options.overwrite,
        progress=terminal,
    )
    poses, detections = int(scene.truth.present.sum()), int(scene.detections.present.sum())
    show(
        f"{counted(options.birds, 'bird')} over {counted(options.frames, 'frame')}: {counted(poses, 'true pose')}, "
        f"{counted(detections, 'detection')}, in {time.perf_counter() - start:.0f} s → {options.out}"
    )


def demo(options: argparse.Namespace) -> None:
    """Run the demo."""
    from jaxfit.cli.demo import run_demo

    run_demo(options.out, options.verbose)


def _size(text: str) -> tuple[int, int]:
    """Return width and height in pixels from a text such as `2592x1520`."""
    sides = text.lower().replace("×", "x").split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() for side in sides):
        raise InputError("--size", f"{text!r} is not a picture size", "give width and height as in 2592x1520")
    return int(sides[0]), int(sides[1])
