"""Measure speed and quality and compare them with the committed baseline.

The tolerances are small for quality and large for time, because machines differ and are noisy. Times are also given as
a ratio to a fixed matrix product in the same run. `--update` replaces the baseline. `--full` adds the scene of 9 birds
× 100 frames (about ten minutes on two cores).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from reference_data import reference_bird, reference_folder
from rich.console import Console
from rich.table import Table
from speed import bench_fit, bench_render, bench_silhouette

from jaxfit.cli.main import use_cache
from jaxfit.config.fit import load_config
from jaxfit.data.formats.coco import read_coco
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.fitting.fit import fit
from jaxfit.fitting.initial_poses import load_initial_poses
from jaxfit.foundation.progress import terminal
from jaxfit.model.bird import Bird

BASELINE = Path(__file__).with_name("baseline.json")


@dataclass(frozen=True)
class Metric:
    """A measured value, the direction of improvement, and the allowed worsening against the baseline."""

    name: str
    value: float
    unit: str
    better: str
    """Direction of improvement, `less` or `more`."""
    tolerance: float
    """Allowed worsening: a fraction of the baseline for `less`, an absolute value for `more`."""

    def worse(self, baseline: float) -> bool:
        """Whether the value is worse than the baseline by more than the tolerance."""
        if self.better == "less":
            return self.value > baseline * (1 + self.tolerance)
        return self.value < baseline - self.tolerance


def soft_silhouette() -> Iterator[Metric]:
    """Measure the mask loss and its gradient on a generated mesh with as many faces as AVES."""
    result = bench_silhouette()
    yield Metric("silhouette: loss and gradient", result["ms_per_frame"], "ms/frame", "less", 1.0)
    yield Metric("silhouette: ratio to matrix product", result["matmul_ratio"], "1", "less", 0.5)
    yield Metric("silhouette: gradient error", result["gradient_error"], "1", "less", 1.0)


def renderer() -> Iterator[Metric]:
    """Measure the z-buffer on crops and the overlay of nine birds on a full frame, with the same generated mesh."""
    result = bench_render()
    yield Metric("render: crop", result["crop_ms"], "ms", "less", 2.0)
    yield Metric("render: anti-aliased crop", result["interpolated_crop_ms"], "ms", "less", 2.0)
    yield Metric("render: 9 birds on a full frame", result["full_frame_ms"], "ms", "less", 2.0)
    yield Metric("render: one bird's mask in a full frame", result["mask_ms"], "ms", "less", 2.0)


def photographs(bird: Bird, reference: Path) -> Iterator[Metric]:
    """Measure fits of photographs of five species, with and without initial poses from a regressor."""
    for name in ("aves", "photo"):
        config, rows, seconds = load_config(name), [], 0.0
        for path in sorted((reference / "cub").glob("*.json")):
            observations = read_coco(path)
            initial_file = path.with_suffix(".init.npz")
            initial_poses = load_initial_poses(initial_file, observations, bird) if name == "aves" else None
            one_step = tuple(dataclasses.replace(stage, steps=1) for stage in config.stages)
            fit(observations, bird, dataclasses.replace(config, stages=one_step), initial_poses)  # compiles
            start = time.perf_counter()
            solution = fit(observations, bird, config, initial_poses, terminal)
            seconds += time.perf_counter() - start
            overall = evaluate(solution, bird, observations).overall
            rows.append([overall["pck@0.05"], overall["pck@0.10"], overall["iou"]])
        pck05, pck10, iou = np.mean(rows, axis=0)
        yield Metric(f"photographs, {name}: PCK@0.05", pck05, "1", "more", 0.005)
        yield Metric(f"photographs, {name}: PCK@0.10", pck10, "1", "more", 0.005)
        yield Metric(f"photographs, {name}: IoU", iou, "1", "more", 0.003)
        yield Metric(f"photographs, {name}: 73 images", seconds, "s", "less", 1.0)


def windows(bird: Bird) -> Iterator[Metric]:
    """Measure the paper's setting against single frames and against `fast` on 2 simulated birds × 100 frames."""
    results = {
        name: bench_fit(bird, load_config(name), birds=2, seed=7, progress=terminal)
        for name in ("paper", "baseline", "fast")
    }
    for name in ("me_p", "me_v", "pa_mpjpe"):
        ratio = results["paper"][name] / results["baseline"][name]
        yield Metric(f"windows: {name}, paper", results["paper"][name], "1", "less", 0.1)
        yield Metric(f"windows: {name}, paper over baseline", ratio, "1", "less", 0.1)
        ratio = results["fast"][name] / results["paper"][name]
        yield Metric(f"windows: {name}, fast over paper", ratio, "1", "less", 0.05)
    ratio = results["fast"]["minutes"] / results["paper"]["minutes"]
    yield Metric("windows: time, fast over paper", ratio, "1", "less", 0.5)


def scene(bird: Bird) -> Iterator[Metric]:
    """Measure a fit of 9 birds × 100 frames with the paper's 600 + 400 steps."""
    result = bench_fit(bird, load_config("paper"), birds=9, progress=terminal)
    yield Metric("scene of 9 birds: fit", result["minutes"], "min", "less", 1.0)
    yield Metric("scene of 9 birds: first run's compilation", result["compile_s"], "s", "less", 2.0)
    yield Metric("scene of 9 birds: peak memory", result["peak_memory_gb"], "GB", "less", 0.5)


def main() -> int:
    """Run the benchmarks. Returns 1 if a metric is worse than tolerated."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--update", action="store_true", help="replace the baseline")
    parser.add_argument("--full", action="store_true", help="also run the scene of 9 birds × 100 frames")
    parser.add_argument("--json", type=Path, help="also write the metrics to this file")
    options = parser.parse_args()
    use_cache()
    console = Console()
    reference, bird = reference_folder(), reference_bird()
    metrics = [*soft_silhouette(), *renderer()]
    if reference is not None and bird is not None:
        metrics += photographs(bird, reference)
        metrics += windows(bird)
        metrics += scene(bird) if options.full else ()
    else:
        console.print("no reference data (JAXFIT_REFERENCE): only the silhouette and the renderer are measured")
    known = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    table = Table("metric", "value", "baseline", "unit", "better", "")
    failed = False
    for metric in metrics:
        before = known.get(metric.name)
        worse = before is not None and metric.worse(before)
        failed |= worse
        verdict = "WORSE" if worse else "new" if before is None else ""
        shown = "–" if before is None else f"{before:.4g}"
        table.add_row(metric.name, f"{metric.value:.4g}", shown, metric.unit, metric.better, verdict)
    console.print(table)
    values = {metric.name: float(f"{metric.value:.6g}") for metric in metrics}
    if options.json:
        options.json.write_text(json.dumps(values, indent=2, ensure_ascii=False) + "\n")
    if options.update:
        BASELINE.write_text(json.dumps(known | values, indent=2, ensure_ascii=False) + "\n")
        return 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
