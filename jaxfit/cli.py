"""The command line. Every command is one short function that calls the library and prints what came of it."""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxfit import __version__
from jaxfit.errors import InputError
from jaxfit.progress import terminal

__all__ = ["main"]


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code: 0 done, 2 unusable input, 130 stopped by Ctrl-C."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(format="%(message)s", level=logging.INFO if options.verbose else logging.WARNING)
    use_cache()
    try:
        options.run(options)
    except InputError as error:
        print(f"jaxfit: {error}", file=sys.stderr)  # noqa: T201
        return 2
    except KeyboardInterrupt:
        print("jaxfit: stopped; nothing was written", file=sys.stderr)  # noqa: T201
        return 130
    except BrokenPipeError:  # the reader of our output went away
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return 0


def use_cache() -> None:
    """Keep compiled programs between runs, in the user's cache folder."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxfit"
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def _fit(options: argparse.Namespace) -> None:
    from jaxfit.config import config_to_yaml, load_config
    from jaxfit.fitting.fit import fit
    from jaxfit.fitting.solution import save_solution
    from jaxfit.fitting.start import load_start
    from jaxfit.fitting.summary import summarise
    from jaxfit.formats.coco import read_coco
    from jaxfit.model.files import load_bird
    from jaxfit.storage import check_replaceable

    began = time.perf_counter()
    check_replaceable(options.out, options.overwrite, "poses.npz")  # before the work, not after it
    config = load_config(options.config)
    bird = load_bird(options.model)
    observations = read_coco(options.observations)
    start = load_start(options.init, observations, bird) if options.init else None
    read = time.perf_counter()
    solution = fit(observations, bird, config, start, terminal, source=options.observations)
    seconds = {"read": read - began, "fit": time.perf_counter() - read}
    summary = summarise(solution, bird, seconds)
    save_solution(solution, bird, config_to_yaml(config), summary, options.out, options.overwrite)
    table = Table("track", "frames", "objective", "status")
    for column in table.columns[:3]:
        column.justify = "right"
    total = np.sum(list(solution.loss.values()), axis=0)
    for n, track in enumerate(solution.track_id):
        frames = int(solution.valid[n].sum())
        table.add_row(str(track), str(frames), f"{total[n] / max(frames, 1):.1f}", str(solution.status[n]))
    table.title = "objective: final value per frame"
    _print(table)
    counts = ", ".join(f"{count} {status}" for status, count in summary["status"].items())
    _print(
        f"{summary['poses']} poses of {summary['tracks']} birds ({counts}) in {seconds['fit']:.1f} s → {options.out}"
    )


def _evaluate(options: argparse.Namespace) -> None:
    from jaxfit.evaluation.evaluate import COLUMNS, evaluate
    from jaxfit.fitting.solution import load_solution
    from jaxfit.formats.coco import read_coco

    solution, bird = load_solution(options.result)
    result = evaluate(solution, bird, read_coco(options.truth), terminal, options.truth)
    if options.json:
        content = {
            **result.overall,
            "frames": result.frames,
            "missing": result.missing,
            "tracks": result.tracks,
        }
        _print_json(content)
        return
    table = Table("track", "frames", *COLUMNS)
    for column in table.columns:
        column.justify = "right"
    for track, row in result.tracks.items():
        table.add_row(str(track), f"{row['frames']:.0f}", *(_figure(row[name]) for name in COLUMNS))
    table.add_section()
    table.add_row("all", str(result.frames), *(_figure(result.overall[name]) for name in COLUMNS))
    table.caption = (
        "PCK: share of keypoints within 5 or 10 % of the annotated mask's longer side; IoU: mesh against mask; "
        "me_p, me_v: RMS position and velocity error over the mesh mask's longer side"
    )
    _print(table)
    if result.missing:
        _print(f"{result.missing} annotated birds have no pose in this result and enter no figure")


def _model_import(options: argparse.Namespace) -> None:
    from jaxfit.model.files import save_bird
    from jaxfit.model.sources import import_sources

    bird = import_sources(options.kind, options.sources)
    save_bird(bird, options.out)
    _print(f"{bird.name}: {bird.vertices.shape[0]} vertices, {bird.num_keypoints} keypoints → {options.out}")


def _model_info(options: argparse.Namespace) -> None:
    from jaxfit.model.describe import describe_bird
    from jaxfit.model.files import load_bird

    facts = describe_bird(load_bird(options.file))
    if options.json:
        _print_json(facts)
        return
    _print_facts(facts)


def _bench(options: argparse.Namespace) -> None:
    from jaxfit.benchmarks.fit import bench_fit
    from jaxfit.benchmarks.silhouette import bench_silhouette
    from jaxfit.model.files import load_bird
    from jaxfit.reference_data import reference_bird

    bird = load_bird(options.model) if options.model else None
    if options.what == "silhouette":
        result = bench_silhouette(vertices=bird and bird.vertices, faces=bird and bird.faces)
    else:
        bird = bird or reference_bird()
        if bird is None:
            remedy = "give one by --model, as `jaxfit model import` writes it, or set JAXFIT_REFERENCE"
            raise InputError("bench fit", "needs a bird", remedy)
        result = bench_fit(bird, options.birds, options.frames, progress=terminal)
    if options.json:
        _print_json(result)
        return
    _print_facts(result)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="jaxfit", description="3D pose and shape of birds from video, on a CPU.")
    parser.add_argument("--version", action="version", version=f"jaxfit {__version__}")
    parser.add_argument("-v", "--verbose", action="store_true", help="say more about what is done")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    fit = commands.add_parser("fit", help="pose the birds of a COCO file of keypoints and masks")
    fit.add_argument("observations", type=Path, metavar="OBS.json")
    fit.add_argument("--model", type=Path, required=True, help="bird model (.npz), as `jaxfit model import` writes it")
    fit.add_argument("--config", default="paper", help="name of a shipped config (paper, baseline, …) or a YAML file")
    fit.add_argument("--init", type=Path, help="starting poses (.npz): a regressor's, or an earlier poses.npz")
    fit.add_argument("--out", type=Path, required=True, help="folder for the result")
    fit.add_argument("--overwrite", action="store_true", help="replace an earlier result in that folder")
    fit.set_defaults(run=_fit)

    evaluate = commands.add_parser("evaluate", help="compare a result with annotations")
    evaluate.add_argument("result", type=Path, metavar="DIR")
    evaluate.add_argument("--truth", type=Path, required=True, help="COCO file of annotations")
    evaluate.add_argument("--json", action="store_true", help="print JSON instead of a table")
    evaluate.set_defaults(run=_evaluate)

    model = commands.add_parser("model", help="import and inspect bird models")
    actions = model.add_subparsers(required=True, metavar="ACTION")
    importer = actions.add_parser("import", help="import a published model")
    importer.add_argument("kind", choices=("avian-mesh", "aves"))
    importer.add_argument("sources", type=Path, nargs="+", help="its files, or the folder that holds them")
    importer.add_argument("--out", type=Path, required=True, help="model file to write (.npz)")
    importer.set_defaults(run=_model_import)
    info = actions.add_parser("info", help="what a model file holds")
    info.add_argument("file", type=Path)
    info.add_argument("--json", action="store_true")
    info.set_defaults(run=_model_info)

    bench = commands.add_parser("bench", help="measure speed on this machine")
    bench.add_argument("what", choices=("silhouette", "fit"))
    bench.add_argument("--model", type=Path, help="measure with this model's mesh instead of a generated one")
    bench.add_argument("--birds", type=int, default=9, help="fit: birds (default 9)")
    bench.add_argument("--frames", type=int, default=100, help="fit: frames a bird (default 100)")
    bench.add_argument("--json", action="store_true")
    bench.set_defaults(run=_bench)
    return parser


def _print(what: Any) -> None:
    Console(soft_wrap=not isinstance(what, Table), highlight=False).print(what)


def _print_facts(facts: dict[str, Any]) -> None:
    table = Table(show_header=False)
    table.add_column()
    table.add_column(overflow="fold")
    for key, value in facts.items():
        table.add_row(key.replace("_", " "), _fact(value))
    _print(table)


def _print_json(content: Any) -> None:
    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {str(k): plain(v) for k, v in value.items()}
        if isinstance(value, list | tuple):
            return [plain(v) for v in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    print(json.dumps(plain(content), indent=2))  # noqa: T201


def _figure(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.4f}"


def _fact(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join("/".join(map(str, v)) if isinstance(v, list) else _fact(v) for v in value)
    return "–" if value is None else str(value)
