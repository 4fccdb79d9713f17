"""`ablate`, `bench`."""

from __future__ import annotations

import argparse
import time
from typing import Any

from rich.table import Table

from jaxfit.cli.tables import counted, right_aligned, show
from jaxfit.data.formats.coco import read_coco
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.files import check_writable
from jaxfit.foundation.progress import terminal
from jaxfit.foundation.reading import json_text
from jaxfit.model.files import find_bird


def ablate(options: argparse.Namespace) -> None:
    """Fit and measure every run of a grid, and print the metrics and the verdicts on claims."""
    require_extra("report", "ablate")
    from jaxfit.evaluation.ablation.ablate import ablate
    from jaxfit.evaluation.ablation.report import FILES
    from jaxfit.evaluation.ablation.table import CAPTION, claims_table, results_table
    from jaxfit.foundation.workers import open_cluster

    start = time.perf_counter()
    bird = find_bird(options.model)
    given = (options.observations, options.truth, options.out, options.grid, bird, options.match, terminal)
    with open_cluster(options.workers, options.scheduler) as cluster:
        done = ablate(*given, allow_import=options.allow_import, cluster=cluster)
    show(results_table(done.results, "simple"))
    show(CAPTION)
    if done.verdicts:
        show("\n" + claims_table(done.verdicts, "simple"))
    earlier = len(done.results) - done.fitted
    reused = f", {counted(earlier, 'earlier run')} reused" if earlier else ""
    show(f"\n{counted(done.fitted, 'run')} fitted in {(time.perf_counter() - start) / 60:.1f} min{reused}. Files:")
    for name, text in FILES.items():
        show(f"  {options.out / name}: {text}")


_ROWS = {
    "adam_loss": ("final loss, adam", "1"),
    "adam_s": ("time of the whole stage, adam", "s"),
    "birds": ("birds", ""),
    "compile_s": ("first fit, with compilation", "s"),
    "crops": ("crops in a batch", ""),
    "crops_per_s": ("crops: faces and depth", "crops/s"),
    "faces": ("faces of the mesh", ""),
    "frame_faces": ("faces in a full frame", ""),
    "frames": ("frames", ""),
    "full_frame_ms": ("full frame with all birds", "ms"),
    "full_frames_per_s": ("full frames with all birds", "frames/s"),
    "gradient_error": ("relative error of the gradient", "1"),
    "interpolated_crops_per_s": ("crops: interpolated colours", "crops/s"),
    "iou": ("IoU of the masks", "1"),
    "isa": ("instruction set of the kernels", ""),
    "loss_ms_per_frame": ("loss only", "ms/frame"),
    "mask_ms": ("hard mask of a bird in a full frame", "ms"),
    "matmul_ms": ("matrix product for comparison", "ms"),
    "matmul_ratio": ("loss and gradient of a frame, over the matrix product", "1"),
    "me_p": ("me_p", "1"),
    "me_v": ("me_v", "1"),
    "minutes": ("fit", "min"),
    "ms_per_frame": ("loss and gradient", "ms/frame"),
    "ms_per_frame_step": ("fit, for each bird, frame and step", "ms"),
    "pa_mpjpe": ("PA-MPJPE", "model units"),
    "pck@0.05": ("PCK@0.05", "1"),
    "peak_memory_gb": ("peak memory", "GB"),
    "size": ("side of the images", "px"),
    "stage": ("stage", ""),
    "steps": ("steps of the stages", ""),
    "threads": ("CPU cores", ""),
    "windows": ("windows", ""),
}
"""Key of a result → its name and unit in the table."""
_SOLVER_ROWS = {
    "_loss": ("final loss, {}", "1"),
    "_ratio": ("the same, over the time of adam", "1"),
    "_s": ("time until the final loss of adam, {}", "s"),
}
"""End of a key that begins with the name of a solver → name and unit."""


def bench(options: argparse.Namespace) -> None:
    """Measure one part of jaxfit and print the result."""
    from jaxfit.config.fit import load_config
    from jaxfit.evaluation.benchmarks.fit import bench_fit, bench_solvers, noisy_scene, plot_solvers
    from jaxfit.evaluation.benchmarks.outline import bench_outline
    from jaxfit.evaluation.benchmarks.raster import bench_render, bench_silhouette

    bird = find_bird(options.model) if options.model else None
    if options.what == "silhouette":
        result = bench_silhouette(vertices=bird and bird.vertices, faces=bird and bird.faces)
    elif options.what == "outline":
        bird = bird or find_bird("murre")
        result = bench_outline({bird.name: bird})
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
        return
    for table in outline_tables(result) if options.what == "outline" else bench_tables(result):
        show(table)


def outline_tables(result: dict[str, Any]) -> list[Table]:
    """Return a table of the excess of the silhouettes for each mesh and edge; the title holds the time."""
    tables: dict[tuple[str, str], Table] = {}
    for name, rows in result.items():
        for key, values in rows.items():
            if key == "ms_per_frame":
                for edge, ms in values.items():
                    tables[name, edge].title = f"{tables[name, edge].title}; loss and gradient {ms:.2f} ms/frame"
                continue
            edge, blur, size = key.split(", ")
            title = f"{name}, {edge}: px by which the silhouette lies outside the mesh"
            table = tables.setdefault((name, edge), right_aligned("blur", "px", *values, title=title))
            cells = (f"{value:+.3f}" for value in values.values())
            table.add_row(blur.removeprefix("blur "), size.removesuffix(" px"), *cells)
    return list(tables.values())


def bench_tables(result: dict[str, Any]) -> list[Table]:
    """Return a table of the values of a benchmark with their units, and a table for each list of measurements.

    The curves of the solvers are left out: `--plot` and `--json` hold the curves.
    """
    main, others = right_aligned("", "value", "unit"), []
    main.columns[0].justify = main.columns[2].justify = "left"
    for key, value in result.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            headings = (", ".join(filter(None, _row(name))) for name in value[0])
            others.append(right_aligned(*headings, title=key))
            for row in value:
                others[-1].add_row(*map(_text, row.values()))
        elif not isinstance(value, dict):
            name, unit = _row(key)
            main.add_row(name, _text(value), unit)
    return [main, *others]


def _row(key: str) -> tuple[str, str]:
    """Return name and unit of a value."""
    if key in _ROWS:
        return _ROWS[key]
    end = next(end for end in _SOLVER_ROWS if key.endswith(end))
    name, unit = _SOLVER_ROWS[end]
    return name.format(key.removesuffix(end).replace("_", "-")), unit


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_text, value))
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    if isinstance(value, int):
        return f"{value:,}"
    return "–" if value is None else str(value)
