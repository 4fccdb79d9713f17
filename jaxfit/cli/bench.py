"""Command that measures speed on this machine."""

from __future__ import annotations

import argparse

from jaxfit.cli.tables import show_facts
from jaxfit.data.formats.coco import read_coco
from jaxfit.extras import require_extra
from jaxfit.model.files import find_bird
from jaxfit.progress import terminal
from jaxfit.storage.files import check_writable
from jaxfit.storage.json_values import json_text

__all__ = ["bench"]


def bench(options: argparse.Namespace) -> None:
    """Measure one part of jaxfit and print the result."""
    from jaxfit.benchmarks.fit import bench_fit, noisy_scene
    from jaxfit.benchmarks.render import bench_render
    from jaxfit.benchmarks.silhouette import bench_silhouette
    from jaxfit.benchmarks.solvers import bench_solvers, plot_solvers
    from jaxfit.config.fit import load_config

    bird = find_bird(options.model) if options.model else None
    if options.what == "silhouette":
        result = bench_silhouette(vertices=bird and bird.vertices, faces=bird and bird.faces)
    elif options.what == "render":
        result = bench_render(bird)
    elif options.what == "solvers":
        bird = bird or find_bird("murre")
        if options.plot:  # before the long work
            require_extra("report", "--plot")
            check_writable(options.plot)
        path = options.observations
        observations = read_coco(path) if path else noisy_scene(bird, options.birds, options.frames)[1]
        result = bench_solvers(observations, bird, options.stage, progress=terminal)
        if options.plot:
            plot_solvers(result, options.plot)
    else:
        config = load_config(options.config)
        result = bench_fit(bird or find_bird("murre"), options.birds, options.frames, config, progress=terminal)
    if options.json:
        print(json_text(result))  # noqa: T201
    else:
        # the plot and JSON have the curves, which are dicts
        show_facts({key: value for key, value in result.items() if not isinstance(value, dict)})
