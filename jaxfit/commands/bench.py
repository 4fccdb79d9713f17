"""Measure speed on this machine."""

from __future__ import annotations

import argparse

from jaxfit.model.files import find_bird
from jaxfit.progress import terminal
from jaxfit.tables import plain_json, show_facts

__all__ = ["bench"]


def bench(options: argparse.Namespace) -> None:
    from jaxfit.benchmarks.fit import bench_fit
    from jaxfit.benchmarks.render import bench_render
    from jaxfit.benchmarks.silhouette import bench_silhouette

    bird = find_bird(options.model) if options.model else None
    if options.what == "silhouette":
        result = bench_silhouette(vertices=bird and bird.vertices, faces=bird and bird.faces)
    elif options.what == "render":
        result = bench_render(bird)
    else:
        result = bench_fit(bird or find_bird("murre"), options.birds, options.frames, progress=terminal)
    if options.json:
        print(plain_json(result))  # noqa: T201
    else:
        show_facts(result)
