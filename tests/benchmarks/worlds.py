"""Compare configs of the fit on six worlds with known truth, with intervals and paired ratios over birds.

A world is a kind of data (`world_scenes.py`). No number of a shipped config may be chosen on one world alone, and no
shipped config may be significantly worse than `paper` (windows) or `aves` (pictures) in me_p, aligned 3D error or IoU
in any world. Seeds below 500 are for tuning. Seeds from 500 are for the final report and are looked at once.

    python tests/benchmarks/worlds.py --configs paper map my.yaml --worlds 1 3 4 --seeds 200 201 --out results.json

A config is the name of a shipped config or a YAML file. Further words change its values: `--configs paper map
"map terms.pose_prior=0.8 grow_masks_px=0"`. With `--out`, runs are stored and not repeated; a change of the code that
is measured repeats them. `--show` prints the tables of stored runs.

Every config has three rows: the metrics; their 95 % intervals over birds; the ratios to the first config on the same
birds, with intervals. `*` marks a ratio whose interval excludes 1. With fewer than 10 birds, intervals are too narrow.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from jaxtyping import Float
from world_scenes import WORLDS, Scene, keypoints_of

import jaxfit
from jaxfit.cli.main import use_cache
from jaxfit.config.build import with_values
from jaxfit.config.checks import ConfigKeyError
from jaxfit.config.fit import FitConfig, load_config
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.solution import Solution
from jaxfit.evaluation.bootstrap import BirdSums, paired_ratio
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.metrics import distances, procrustes_align
from jaxfit.evaluation.spatial import best_scale, crop_rotation
from jaxfit.evaluation.truth import match, match_tracks
from jaxfit.fitting.fit import fit
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import terminal
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
    "iou": ("IoU", 1, 4),
    "pck@0.05": ("PCK@0.05", 1, 4),
    "size_error": ("size error %", 100, 2),
    "size_bias": ("size bias %", 100, 2),
}
"""Metric → heading, factor, decimals. `aligned` is the PA-MPJPE of the keypoints in model units; `…/length` is a share
of the rest distance from bill tip to tail tip."""
GATED = ("me_p", "aligned", "iou")
"""Metrics in which a shipped config may not be significantly worse than the reference."""
MEASURED_PACKAGES = (
    *("config", "data", "evaluation", "fitting", "foundation", "model", "objective", "perception", "raster"),
    *("simulation", "video"),
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
    Here the points are keypoints. The factor of the size belongs to a track, and for pictures to a frame.

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
    depth_p, depth_q = p[..., 2].mean(-1), q[..., 2].mean(-1)
    p = (p - p.mean(2, keepdims=True)) @ np.swapaxes(R, -1, -2)
    q = q - q.mean(2, keepdims=True)
    if pictures:
        p = p * best_scale(p[:, :, None], q[:, :, None], measured[..., None])[..., None, None]
    else:
        p = p * best_scale(p, q, measured)[:, None, None, None]
    length = rest_length(bird, truth.poses)[n, t]
    counted = np.broadcast_to(measured[..., None], p.shape[:-1])
    direct, aligned = distances(p, q, counted), distances(procrustes_align(p, q, counted), q, counted)
    focal_p = solution.crops.focal_px * solution.crops.square_px[..., 2] / solution.crops.crop_px
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = (rest_length(bird, solution.poses) * focal_p / depth_p) / (length * focal / depth_q)
    ratio = np.where(measured, ratio, np.nan)[..., None]
    return {
        "mpjpe/length": direct / length[..., None],
        "aligned": aligned,
        "aligned/length": aligned / length[..., None],
        "size_error": np.abs(ratio - 1),
        "size_bias": ratio - 1,
    }


def measure(solution: Solution, scene: Scene, pictures: bool) -> tuple[BirdSums, int]:
    """Return the errors of a result per bird, and the number of true birds and frames without a pose."""
    solution, _ = match_tracks(solution, scene.exact)
    evaluation = evaluate(solution, scene.bird, scene.exact)
    sums = evaluation.sums
    if scene.poses is not None:
        tracks = solution.track_id.tolist()
        rows = [tracks.index(int(bird)) for bird in sums.birds]
        own = {name: values[rows] for name, values in errors_3d(solution, scene, pictures).items()}
        spatial = BirdSums.of(sums.birds, own)
        sums = BirdSums(sums.birds, sums.numerators | spatial.numerators, sums.counts | spatial.counts)
    return sums, evaluation.missing


def run(scenes: Sequence[Scene], config: Config, pictures: bool, compiled: set[Any]) -> dict[str, Any]:
    """Fit the scenes of one seed and measure the results.

    Args:
        scenes: the scenes.
        config: the config.
        pictures: whether frames are single pictures.
        compiled: keys of programs that this process has compiled. The first fit of a program is preceded by a fit
            with one step per stage, so that `seconds` is without compilation.

    Returns:
        An entry of the stored results.
    """
    parts: dict[str, dict[str, Any]] = {}
    for scene in scenes:
        init = scene.initial_poses if config.name.split()[0] == "aves" else None
        key = config.key, scene.bird.name, scene.part, scene.observations.present.shape
        start = time.perf_counter()
        if key not in compiled:
            one_step = tuple(dataclasses.replace(stage, steps=1) for stage in config.config.stages)
            fit(scene.observations, scene.bird, dataclasses.replace(config.config, stages=one_step), init)
            compiled.add(key)
        ready = time.perf_counter()
        solution = fit(scene.observations, scene.bird, config.config, init, terminal)
        seconds, compile_s = time.perf_counter() - ready, ready - start
        sums, missing = measure(solution, scene, pictures)
        part = parts.setdefault(scene.part, {"seconds": 0.0, "compile_s": 0.0, "missing": 0, "scenes": []})
        part |= {"seconds": part["seconds"] + seconds, "compile_s": part["compile_s"] + compile_s}
        part["missing"] += missing
        part["scenes"].append(dataclasses.asdict(sums))
    return {"parts": parts}


def pooled(parts: Sequence[tuple[str, BirdSums]]) -> BirdSums:
    """Return the sums of several results, named ``result/bird``; sums of equal names are added.

    Args:
        parts: pairs of the name of a result and its sums.
    """
    metrics = list(parts[0][1].counts)
    totals: dict[str, dict[str, list[float]]] = {}
    for prefix, sums in parts:
        for b, bird in enumerate(sums.birds):
            own = totals.setdefault(f"{prefix}/{bird}", {metric: [0.0, 0] for metric in metrics})
            for metric in metrics:
                own[metric][0] += sums.numerators[metric][b]
                own[metric][1] += sums.counts[metric][b]
    return BirdSums(
        tuple(totals),
        {metric: tuple(each[metric][0] for each in totals.values()) for metric in metrics},
        {metric: tuple(int(each[metric][1]) for each in totals.values()) for metric in metrics},
    )


class Line(NamedTuple):
    """The results of one config in one world."""

    name: str
    sums: BirdSums
    seconds: float
    """Duration of the fits, without compilation."""
    missing: int
    """Number of true birds and frames without a pose."""


def line_of(name: str, runs: Sequence[Mapping[str, Any]], part: str | None) -> Line:
    """Return the results over some stored runs of one world.

    Args:
        name: of the config.
        runs: stored runs.
        part: part of the world; None for all parts.
    """
    kept = [(str(run["seed"]), own) for run in runs for key, own in run["parts"].items() if part in (None, key)]
    sums = [
        (seed, BirdSums(tuple(scene["birds"]), scene["numerators"], scene["counts"]))
        for seed, own in kept
        for scene in own["scenes"]
    ]
    seconds, missing = sum(own["seconds"] for _, own in kept), sum(own["missing"] for _, own in kept)
    return Line(name, pooled(sums), seconds, missing)


def table(lines: Sequence[Line], pictures: bool) -> str:
    """Return an aligned table of some configs; ratios are to the first config."""
    shown = [name for name in METRICS if name in lines[0].sums.counts and not (pictures and name == "me_v")]
    rows = [["", *(METRICS[name][0] for name in shown), "seconds", "missing"]]
    for line in lines:
        rows.append([line.name])
        intervals, ratios = [""], ["  × first" if line is not lines[0] else ""]
        for name in shown:
            _, factor, decimals = METRICS[name]
            low, high = line.sums.interval(name)
            rows[-1].append(f"{factor * line.sums.value(name):.{decimals}f}")
            intervals.append(f"{factor * low:.{decimals}f}…{factor * high:.{decimals}f}")
            if line is lines[0] or name == "size_bias":
                ratios.append("")
                continue
            ratio = paired_ratio([(line.sums, lines[0].sums)], name)
            mark = "*" if ratio.low > 1 or ratio.high < 1 else ""
            ratios.append(f"{ratio.value:.3f} ({ratio.low:.2f}…{ratio.high:.2f}){mark}")
        rows[-1] += [f"{line.seconds:.1f}", str(line.missing)]
        rows += [intervals] + ([ratios] if line is not lines[0] else [])
    filled = [row + [""] * (len(rows[0]) - len(row)) for row in rows]
    widths = [max(map(len, column)) for column in zip(*filled, strict=True)]

    def aligned(row: Sequence[str]) -> str:
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        return "  ".join([row[0].ljust(widths[0]), *cells[1:]]).rstrip()

    return "\n".join(map(aligned, filled))


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


def world_report(number: int, configs: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return the tables and verdicts of one world.

    Args:
        number: of the world.
        configs: name of a config → its stored runs, all with the same seeds.
    """
    world = WORLDS[number]
    first = next(iter(configs.values()))
    names = sorted({part for run in first for part in run["parts"]})
    blocks = []
    for part in [None, *(names if len(names) > 1 else [])]:
        lines = [line_of(name, runs, part) for name, runs in configs.items()]
        seeds = ", ".join(sorted({str(run["seed"]) for run in first}))
        birds, poses = lines[0].sums.birds, sum(lines[0].sums.counts["iou"])
        title = f"World {number}: {world.name}{f', {part}' if part else ''}; seeds {seeds}; "
        title += f"{len(birds)} {world.birds}, {poses} poses"
        blocks.append("\n".join([title, table(lines, world.pictures), *verdict(lines, world.reference)]))
    return "\n\n".join(blocks)


class Store:
    """Stored runs, in a JSON file that is written after every run."""

    def __init__(self, path: Path | None):
        self.path = path
        self.runs: list[dict[str, Any]] = json.loads(path.read_text())["runs"] if path and path.exists() else []

    def find(self, **keys: Any) -> dict[str, Any] | None:
        """Return the latest run with the given entries."""
        found = (run for run in reversed(self.runs) if all(run[key] == value for key, value in keys.items()))
        return next(found, None)

    def add(self, run: dict[str, Any]) -> None:
        """Append a run and write the file."""
        self.runs.append(run)
        if self.path:
            write_whole(self.path, json.dumps({"runs": self.runs}).encode())


def say(text: str) -> None:
    """Print a text; long lines of tables stay whole."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def compare(configs: Sequence[Config], worlds: Sequence[int], seeds: Sequence[int], quick: bool, store: Store) -> None:
    """Fit and measure all runs that are not stored, and print the report of every world."""
    code, compiled = code_hash(), set()
    for number in worlds:
        world, results = WORLDS[number], {config.name: [] for config in configs}
        for seed in seeds if world.seeds else ["all"]:
            scenes: list[Scene] = []
            for config in configs:
                keys = {"world": number, "seed": seed, "config_key": config.key, "code": code, "quick": quick}
                known = store.find(**keys)
                if known is None:
                    scenes = scenes or world.draw(seed if world.seeds else 0, quick)
                    known = keys | {"config": config.name} | run(scenes, config, world.pictures, compiled)
                    store.add(known)
                results[config.name].append(known)
        say(f"\n{world_report(number, results)}")


def show(configs: Sequence[str], worlds: Sequence[int], seeds: Sequence[int], quick: bool, store: Store) -> None:
    """Print the reports of stored runs of any version of the code; the latest run of a seed counts."""
    for number in worlds:
        results = {}
        for name in configs or dict.fromkeys(run["config"] for run in store.runs):
            keys = {"world": number, "config": name, "quick": quick}
            wanted = seeds or dict.fromkeys(run["seed"] for run in store.runs if run["world"] == number)
            wanted = wanted if WORLDS[number].seeds else ["all"]
            runs = [found for seed in wanted if (found := store.find(seed=seed, **keys))]
            if runs:
                results[name] = runs
        if results:
            say(f"\n{world_report(number, results)}")


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
    parser.add_argument("--configs", nargs="+", default=[], help="shipped names or YAML files, the first for ratios")
    parser.add_argument("--worlds", nargs="+", type=int, default=list(WORLDS), choices=list(WORLDS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[])
    parser.add_argument("--out", type=Path, help="JSON file of the runs; runs that it holds are not repeated")
    parser.add_argument("--quick", action="store_true", help="small scenes, to try the command")
    parser.add_argument("--show", action="store_true", help="only print the tables of the runs in --out")
    options = parser.parse_args(arguments)
    try:
        reminder = check_seeds(options.seeds)
        store = Store(options.out)
        if options.show:
            show(options.configs, options.worlds, options.seeds, options.quick, store)
            return 0
        configs = [read_named_config(text) for text in options.configs]
        if not configs or not options.seeds:
            parser.error("--configs and --seeds are needed")
        if reminder:
            say(f"NOTE: {reminder}")
        use_cache()
        compare(configs, options.worlds, options.seeds, options.quick, store)
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
