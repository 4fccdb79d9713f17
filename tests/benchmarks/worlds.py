"""Compare configs of the fit on nine worlds with known truth, with intervals and paired ratios over birds.

A world is a kind of data (`world_scenes.py`). No number of a shipped config may be chosen on one world alone, and no
shipped config may be significantly worse than `paper` (windows) or `aves` (pictures) in me_p, aligned 3D error or IoU
in any world. Seeds below 500 are for tuning. Seeds from 500 are for the final report and are looked at once.

    python tests/benchmarks/worlds.py --configs paper map my.yaml --worlds 1 3 4 --seeds 200 201 --out results.json

A config is the name of a shipped config or a YAML file. Further words change its values: `--configs paper map
"map terms.pose_prior=0.8 grow_masks_px=0"`. With `--out`, runs are stored and not repeated; a change of the code that
is measured repeats them.

Every cell has three lines: the metric; its 95 % interval over birds; the ratio to the first config on the same birds,
with an interval. `*` marks a ratio whose interval excludes 1. With fewer than 10 birds, intervals are too narrow.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from jaxtyping import Float
from rich.console import Console
from rich.table import Table
from scipy.stats import chi2
from world_scenes import WORLDS, Scene, keypoints_of

import jaxfit
from jaxfit.cli.main import use_cache
from jaxfit.config.build import with_values
from jaxfit.config.checks import ConfigKeyError
from jaxfit.config.fit import FitConfig, load_config
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.solution import Solution
from jaxfit.evaluation.bootstrap import BirdSums, paired_ratio
from jaxfit.evaluation.calibration import keypoint_errors
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.metrics import distances, procrustes_align
from jaxfit.evaluation.spatial import best_scale, crop_rotation
from jaxfit.evaluation.truth import Truth, match, match_tracks
from jaxfit.fitting.fit import fit
from jaxfit.fitting.initial_poses import InitialPoses
from jaxfit.fitting.views import fit_views
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import ProgressTask, silent, terminal
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose, fold_bird

FIRST_REPORT_SEED = 500
"""Seeds from here on are for the final report."""
METRICS = {
    "me_p": ("me_p", 1, 4),
    "me_v": ("me_v", 1, 4),
    "aligned/length": ("aligned 3D %", 100, 3),
    "aligned": ("aligned 3D", 1, 4),
    "mpjpe/length": ("MPJPE %", 100, 3),
    "placed/length": ("in place %", 100, 3),
    "iou": ("IoU", 1, 4),
    "pck@0.05": ("PCK@0.05", 1, 4),
    "size_error": ("size error %", 100, 2),
    "size_bias": ("size bias %", 100, 2),
    "bone_error": ("bones %", 100, 2),
    "bone_error_mean_bird": ("mean bird %", 100, 2),
    "in_0.68": ("in 68 %", 100, 1),
    "in_0.95": ("in 95 %", 100, 1),
}
"""Metric → heading, factor, decimals. `aligned` is the PA-MPJPE of the keypoints in model units; `…/length` is a share
of the rest distance from bill tip to tail tip. `bones %` is the error of the bone lengths, beside that of the mean bird
of the model; `in 68 %` is the percentage of keypoints in space inside the 68 % region of the error bars. `in place
%` is the error of the keypoints without any alignment, for several cameras, which tell place and size."""
GATED = ("me_p", "aligned", "iou")
"""Metrics in which a shipped config may not be significantly worse than the reference."""
MEASURED_PACKAGES = (
    *("config", "data", "evaluation", "fitting", "foundation", "model", "objective", "perception", "raster"),
    *("cameras", "simulation", "video"),
)
"""Packages whose content decides whether a stored run is still valid."""


class Config(NamedTuple):
    """A config of the comparison."""

    name: str
    config: FitConfig

    @property
    def key(self) -> str:
        """Hash of all values."""
        return hashlib.sha256(config_to_yaml(self.config).encode()).hexdigest()[:16]


def read_named_config(text: str) -> Config:
    """Return the config that a text names: a shipped config or a YAML file, and words `path=value` that change it.

    Raises:
        InputError: there is no such config, or a path or a value is wrong.
    """
    source, *words = text.split()
    changes = {path: yaml.safe_load(value) for path, _, value in (word.partition("=") for word in words)}
    try:
        config = with_values(load_config(source), changes)
    except ConfigKeyError as error:
        raise InputError(text, error.problem, error.remedy) from None
    return Config(" ".join([Path(source).stem, *words]), config)


def code_hash() -> str:
    """Return a hash of the code that a run depends on: scenes, Python modules and compiled kernels."""
    package, digest = Path(jaxfit.__file__).parent, hashlib.sha256()
    files = [Path(__file__).with_name("world_scenes.py")]
    for name in MEASURED_PACKAGES:
        files += sorted(path for path in (package / name).rglob("*") if path.suffix in (".py", ".so", ".npz", ".onnx"))
    for path in files:
        digest.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def rest_length(bird: Bird, pose: Pose) -> Float[np.ndarray, "N T"]:
    """Return the distance from bill tip to tail tip with straight joints, but the bones, shape and scale of the poses.

    Args:
        bird: the model.
        pose: poses with leading axes (N, T).
    """
    straight = dataclasses.replace(pose, body_pose=np.zeros_like(pose.body_pose))
    points = np.asarray(keypoints_of(fold_bird(bird), straight), np.float64)
    bill, tail = (bird.keypoint_names.index(name) for name in ("bill_tip", "tail_tip"))
    return np.linalg.norm(points[:, :, bill] - points[:, :, tail], axis=-1)


def errors_3d(solution: Solution, scene: Scene, pictures: bool) -> dict[str, Float[np.ndarray, "N T _"]]:
    """Return the 3D errors of the keypoints of every bird and frame, as `BirdSums.of` takes them.

    `SpatialErrors` defines the errors. There the points are joints, and joints of other species cannot be compared.
    Here the points are keypoints. The factor of the size belongs to a track, and for pictures to a frame. With several
    cameras, the size is the rest length itself, not the apparent size, and errors without alignment are added.

    Args:
        solution: a result with the track ids of the truth.
        scene: the scene, with true poses.
        pictures: whether frames are single pictures.
    """
    truth, bird = scene.poses, scene.bird
    n, t, shared = match(solution, truth.track_id, truth.frame_index)
    measured = shared & solution.valid & truth.valid[n, t]
    x0, y0, side = truth.crops.square_px[truth.valid][0].astype(np.float64)
    focal = truth.crops.focal_px * side / truth.crops.crop_px
    R = crop_rotation(
        solution.crops.square_px[..., :2] + solution.crops.square_px[..., 2:] / 2, [x0 + side / 2, y0 + side / 2], focal
    )
    p, q = solution.keypoints.cam.astype(np.float64), truth.keypoints.cam[n, t].astype(np.float64)
    placed = distances(p, q, np.broadcast_to(measured[..., None], p.shape[:-1]))
    depth_p, depth_q = p[..., 2].mean(-1), q[..., 2].mean(-1)
    p = (p - p.mean(2, keepdims=True)) @ np.swapaxes(R, -1, -2)
    q = q - q.mean(2, keepdims=True)
    if pictures:
        p = p * best_scale(p[:, :, None], q[:, :, None], measured[..., None])[..., None, None]
    else:
        p = p * best_scale(p, q, measured)[:, None, None, None]
    length = rest_length(scene.true_bird or bird, truth.poses)[n, t]
    counted = np.broadcast_to(measured[..., None], p.shape[:-1])
    direct, aligned = distances(p, q, counted), distances(procrustes_align(p, q, counted), q, counted)
    focal_p = solution.crops.focal_px * solution.crops.square_px[..., 2] / solution.crops.crop_px
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = rest_length(bird, solution.poses) / length
        if scene.views is None:
            ratio = ratio * (focal_p / depth_p) / (focal / depth_q)
    ratio = np.where(measured, ratio, np.nan)[..., None]
    return {
        **({} if scene.views is None else {"placed/length": placed / length[..., None]}),
        "mpjpe/length": direct / length[..., None],
        "aligned": aligned,
        "aligned/length": aligned / length[..., None],
        "size_error": np.abs(ratio - 1),
        "size_bias": ratio - 1,
        **coverage(solution, truth),
    }


def coverage(solution: Solution, truth: Solution) -> dict[str, Float[np.ndarray, "N T K"]]:
    """Return whether each keypoint in space lies inside the regions of 68 and 95 % (1 or 0); NaN without error bars."""
    inside = {f"in_{level}": np.full(solution.keypoints.cam.shape[:-1], np.nan) for level in (0.68, 0.95)}
    if solution.error_bars is not None:
        errors = keypoint_errors(solution, truth)
        squared = errors.squared()
        for level in (0.68, 0.95):
            within = np.where(np.isfinite(squared), squared <= chi2.ppf(level, 3), np.nan)
            inside[f"in_{level}"][errors.counted] = within
    return inside


def measure(solution: Solution, scene: Scene, pictures: bool) -> tuple[BirdSums, int]:
    """Return the errors of a result per bird, and the number of true birds and frames without a pose."""
    solution, _ = match_tracks(solution, scene.exact)
    evaluation = evaluate(solution, scene.bird, Truth(scene.exact, scene.poses, scene.true_bird))
    sums = evaluation.sums
    if scene.poses is not None:
        tracks = solution.track_id.tolist()
        rows = [tracks.index(int(bird)) for bird in sums.birds]
        own = {name: values[rows] for name, values in errors_3d(solution, scene, pictures).items()}
        spatial = BirdSums.of(sums.birds, own)
        sums = BirdSums(sums.birds, sums.numerators | spatial.numerators, sums.counts | spatial.counts)
    # pictures of one species are not independent of each other
    names = tuple(scene.observations.species.get(int(bird), bird) for bird in sums.birds)
    return BirdSums(names, sums.numerators, sums.counts), evaluation.missing


class Line(NamedTuple):
    """The results of one config in one world, or in a part of a world."""

    name: str
    sums: BirdSums
    seconds: float
    """Duration of the fits, without compilation."""
    missing: int
    """Number of true birds and frames without a pose."""


def run(scenes: Sequence[Scene], config: Config, pictures: bool, compiled: set[Any]) -> list[dict[str, Any]]:
    """Fit the scenes of one seed and measure the results.

    Args:
        scenes: the scenes.
        config: the config.
        pictures: whether frames are single pictures.
        compiled: keys of programs that this process has compiled. The first fit of a program is preceded by a fit
            with one step per stage, so that `seconds` is without compilation.

    Returns:
        For each scene its part of the world, `sums`, `seconds` and `missing`.
    """
    results = []
    for scene in scenes:
        init = scene.initial_poses if config.name.split()[0] == "aves" else None
        key = config.key, scene.bird.name, scene.part, scene.observations.present.shape
        if key not in compiled:
            one_step = tuple(dataclasses.replace(stage, steps=1) for stage in config.config.stages)
            fitted(scene, dataclasses.replace(config.config, stages=one_step), init)
            compiled.add(key)
        start = time.perf_counter()
        solution = fitted(scene, config.config, init, terminal)
        seconds = time.perf_counter() - start
        sums, missing = measure(solution, scene, pictures)
        sums = dataclasses.asdict(sums)
        results.append({"part": scene.part, "sums": sums, "seconds": seconds, "missing": missing})
    return results


def fitted(scene: Scene, config: FitConfig, init: InitialPoses | None, progress: ProgressTask = silent) -> Solution:
    """Fit a scene, of one camera or of several."""
    if scene.views is not None:
        return fit_views(scene.views, scene.bird, config, progress)
    return fit(scene.observations, scene.bird, config, init, progress)


def pooled(results: Sequence[tuple[str, BirdSums]]) -> BirdSums:
    """Return the sums of several results, with birds named ``result/bird``; sums of equal names are added."""
    metrics = list(results[0][1].counts)
    numerators: dict[str, Counter[str]] = {metric: Counter() for metric in metrics}
    counts: dict[str, Counter[str]] = {metric: Counter() for metric in metrics}
    birds = tuple(dict.fromkeys(f"{name}/{bird}" for name, sums in results for bird in sums.birds))
    for name, sums in results:
        for metric in metrics:
            for bird, numerator, count in zip(sums.birds, sums.numerators[metric], sums.counts[metric], strict=True):
                numerators[metric][f"{name}/{bird}"] += numerator
                counts[metric][f"{name}/{bird}"] += count
    return BirdSums(
        birds,
        {metric: tuple(values[bird] for bird in birds) for metric, values in numerators.items()},
        {metric: tuple(values[bird] for bird in birds) for metric, values in counts.items()},
    )


def line_of(name: str, runs: Mapping[str, Sequence[Mapping[str, Any]]], part: str | None) -> Line:
    """Return the results of a config over some stored runs of one world.

    Args:
        name: of the config.
        runs: seed → results of `run`.
        part: part of the world; None for all parts.
    """
    kept = [(seed, result) for seed, results in runs.items() for result in results if part in (None, result["part"])]
    sums = pooled(
        [(seed, BirdSums(**{**result["sums"], "birds": tuple(result["sums"]["birds"])})) for seed, result in kept]
    )
    return Line(name, sums, sum(result["seconds"] for _, result in kept), sum(result["missing"] for _, result in kept))


def table(title: str, lines: Sequence[Line], pictures: bool) -> Table:
    """Return a table of some configs; ratios are to the first config."""
    shown = [name for name in METRICS if name in lines[0].sums.counts and not (pictures and name == "me_v")]
    result = Table("", *(METRICS[name][0] for name in shown), "seconds", "missing", title=title)
    for line in lines:
        cells = []
        for name in shown:
            _, factor, decimals = METRICS[name]
            value, low, high = (
                f"{factor * x:.{decimals}f}" for x in (line.sums.value(name), *line.sums.interval(name))
            )
            cell = f"{value}\n{low}…{high}"
            if line is not lines[0] and name != "size_bias":
                ratio = paired_ratio([(line.sums, lines[0].sums)], name)
                mark = "*" if ratio.low > 1 or ratio.high < 1 else ""
                cell += f"\n{ratio.value:.3f} ({ratio.low:.2f}…{ratio.high:.2f}){mark}"
            cells.append(cell)
        result.add_row(line.name, *cells, f"{line.seconds:.1f}", str(line.missing))
    return result


def verdict(lines: Sequence[Line], reference: str) -> list[str]:
    """Return the sentences about the configs that are significantly worse than the reference config."""
    known = [line for line in lines if line.name == reference]
    if not known:
        return [f"`{reference}` is not among the configs, so nothing is compared with it"]
    texts = []
    for line in lines:
        worse = []
        for name in (name for name in GATED if name in line.sums.counts and line is not known[0]):
            ratio = paired_ratio([(line.sums, known[0].sums)], name)
            if (ratio.high < 1) if name == "iou" else (ratio.low > 1):
                worse.append(f"{METRICS[name][0]} × {ratio.value:.3f} ({ratio.low:.3f} to {ratio.high:.3f})")
        if worse:
            texts.append(f"WORSE than {reference}: {line.name} in {', '.join(worse)}")
    return texts or [f"no config is significantly worse than {reference} in me_p, aligned 3D error or IoU"]


def report(number: int, configs: Mapping[str, Mapping[str, Sequence[Mapping[str, Any]]]]) -> None:
    """Print the tables and verdicts of one world.

    Args:
        number: of the world.
        configs: name of a config → seed → results of `run`.
    """
    world, console = WORLDS[number], Console(width=250)
    first = next(iter(configs.values()))
    parts = sorted({result["part"] for results in first.values() for result in results})
    for part in [None, *(parts if len(parts) > 1 else [])]:
        lines = [line_of(name, runs, part) for name, runs in configs.items()]
        birds, poses = lines[0].sums.birds, sum(lines[0].sums.counts["iou"])
        title = f"World {number}: {world.name}{f', {part}' if part else ''}; seeds {', '.join(first)}; "
        console.print(table(f"{title}{len(birds)} {world.birds}, {poses} poses", lines, world.pictures))
        for sentence in verdict(lines, world.reference):
            console.print(sentence)


def compare(
    configs: Sequence[Config],
    worlds: Sequence[int],
    seeds: Sequence[int],
    quick: bool,
    path: Path | None,
    equal: bool = False,
) -> None:
    """Fit and measure all runs that the file does not hold, store them, and print the report of every world."""
    stored = json.loads(path.read_text()) if path and path.exists() else {}
    code, compiled = code_hash(), set()
    for number in worlds:
        world, results = WORLDS[number], {config.name: {} for config in configs}
        for seed in seeds if world.seeds else ["all"]:
            scenes: list[Scene] = []
            for config in configs:
                key = f"world {number}, seed {seed}, {config.key}, code {code}"
                key += f"{', quick' if quick else ''}{', equal' if equal else ''}"
                if key not in stored:
                    scenes = scenes or world.draw(int(seed) if world.seeds else 0, quick, equal)
                    stored[key] = run(scenes, config, world.pictures, compiled)
                    if path:
                        write_whole(path, json.dumps(stored).encode())
                results[config.name][str(seed)] = stored[key]
        report(number, results)


def check_seeds(seeds: Sequence[int]) -> str | None:
    """Return a reminder if the seeds are those of the report.

    Raises:
        InputError: seeds for tuning and seeds of the report are mixed.
    """
    report = [seed >= FIRST_REPORT_SEED for seed in seeds]
    if any(report) and not all(report):
        problem = f"mixes seeds below {FIRST_REPORT_SEED} (tuning) and from {FIRST_REPORT_SEED} (report)"
        raise InputError("--seeds", problem, "use two calls")
    return f"seeds from {FIRST_REPORT_SEED}: for the final report only; do not tune on them" if any(report) else None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command. Returns 2 for wrong arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--configs", nargs="+", required=True, help="shipped names or YAML files, the first for ratios")
    parser.add_argument("--worlds", nargs="+", type=int, default=list(WORLDS), choices=list(WORLDS))
    parser.add_argument("--seeds", nargs="+", type=int, required=True)
    parser.add_argument("--out", type=Path, help="JSON file of the runs; runs that it holds are not repeated")
    parser.add_argument("--equal", action="store_true", help="birds with the body of the model, where that is possible")
    parser.add_argument("--quick", action="store_true", help="small scenes, to try the command")
    options = parser.parse_args(arguments)
    try:
        reminder = check_seeds(options.seeds)
        configs = [read_named_config(text) for text in options.configs]
        if reminder:
            sys.stdout.write(f"NOTE: {reminder}\n")
        use_cache()
        compare(configs, options.worlds, options.seeds, options.quick, options.out, options.equal)
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
