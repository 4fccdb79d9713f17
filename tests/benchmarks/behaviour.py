"""Measure features and bouts of behaviour on simulated scenes, whose birds have known poses and behaviours.

    python tests/benchmarks/behaviour.py truth detections pixels --seeds 1000 1020 --store DIR

`truth` describes the exact poses, `detections` a fit to simulated detections (config `fast`), `pixels` a fit to what
the networks detect in the film. Poses are placed on the ledge as by `jaxfit ledge`, without a
calibrated camera for fits. The store keeps fits, so that a change of the rules repeats none (one scene: 35 s by
detections, 2 minutes by pixels). The thresholds of `configs/behaviour.yaml` were chosen on seeds 100 to 119; seeds 1000
to 1019 are for the report. `take_off` and `landing` count as flight, because the simulator knows flights only.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.stats import bootstrap

import jaxfit
from jaxfit.behaviour.birds import flock_of
from jaxfit.behaviour.bouts import NO_POSE, find_bouts
from jaxfit.behaviour.describe import describe
from jaxfit.behaviour.rules import load_behaviour_config
from jaxfit.cli.main import use_cache
from jaxfit.config.fit import load_config
from jaxfit.data.formats import FOOTAGE
from jaxfit.data.solution import load_solution, save_solution
from jaxfit.evaluation.truth import match_tracks
from jaxfit.fitting.fit import fit
from jaxfit.fitting.ledge import ledge_config, on_ledge
from jaxfit.fitting.ledge_plane import estimate_ledge
from jaxfit.perception.track import track_video
from jaxfit.simulation.behaviour import BEHAVIOURS
from jaxfit.simulation.scene import simulate, stage_scene

BIRD = jaxfit.load_murre()
NAMES = {"stand": "standing", "incubate": "incubating", "preen": "preening", "walk": "walking", "approach": "walking",
         "flap": "flapping", "jab": "attack", "fly_off": "flight"}  # fmt: skip
"""Behaviour of the simulator → behaviour of the rules."""
ROWS = tuple(dict.fromkeys(NAMES.values()))
COLUMNS = (*ROWS, "bow", "other")
ALSO_FLIGHT = {"take_off": "flight", "landing": "flight"}
BIRDS, FRAMES, FPS = 7, 100, 25.0


def fitted(kind, seed, store):
    """Return a scene, and its poses in a world on the ledge, with the track ids of the truth."""
    scene = stage_scene(BIRD, BIRDS, FRAMES, fps=FPS, seed=seed)
    if kind == "truth":
        s = scene.poses  # as one camera knows them: every bird has the size of the model
        size = s.poses.scale[..., None]
        one = {"transl": s.poses.transl / size, "keypoints_cam": s.keypoints.cam / size[..., None]}
        camera = scene.view.camera("cliff", BIRD.metres_per_unit)
        return scene, on_ledge(s.with_arrays(scale=np.ones_like(s.poses.scale), **one), BIRD, camera)
    folder = store / f"{kind}_{seed}"
    if not folder.is_dir():
        config = ledge_config(load_config("fast"))
        observations = scene.detections if kind == "detections" else filmed(seed)
        save_solution(fit(observations, BIRD, config), BIRD, "", {}, folder)
    solution = match_tracks(load_solution(folder)[0], scene.truth)[0]
    return scene, on_ledge(solution, BIRD, estimate_ledge(solution, BIRD).camera)


def filmed(seed):
    """Return what the networks detect in the film of a scene."""
    with tempfile.TemporaryDirectory() as folder:
        simulate(BIRD, Path(folder) / "scene", BIRDS, FRAMES, fps=FPS, seed=seed)
        return track_video(Path(folder) / "scene" / FOOTAGE)


def described(solution, config):
    """Return features and states, with the positions of the tracks in the truth; other tracks are left out."""
    flock = flock_of(solution, BIRD, np.arange(FRAMES) / FPS)
    description = describe(flock, config.features)
    return description, find_bouts(description, config)


def f1_table(confusions):
    """Return behaviour → F1, its 95 % interval over birds, and their number, from confusion matrices of birds."""
    found = {}
    for i, name in enumerate(ROWS):
        hits = 2.0 * confusions[:, i, i]
        total = (confusions[:, i].sum(axis=1) + confusions[:, :, i].sum(axis=1)).astype(float)
        interval = bootstrap((hits, total), lambda a, b, axis: a.sum(axis) / np.maximum(b.sum(axis), 1), paired=True,
                             method="percentile", n_resamples=2000, rng=0).confidence_interval  # fmt: skip
        found[name] = hits.sum() / max(total.sum(), 1), interval.low, interval.high, int((total > 0).sum())
    return found


def difference(feature, own, true):
    """Return errors of a feature: angles in degrees, lengths as shares of the truth.

    The world of a fit is turned about the vertical, so headings are compared up to a rotation.
    """
    error = own - true
    if feature.circular:
        turn = np.angle(np.nanmean(np.exp(1j * np.radians(error))), deg=True) if "heading" in feature.name else 0.0
        error = (error - turn + 180) % 360 - 180
    elif feature.unit == "length":
        error = error / np.where(np.abs(true) > 1e-6, true, np.nan)
    return np.abs(error)


def show(text):
    """Print a line at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def measure(kind, seeds, store, config):
    """Print the tables of one kind of poses."""
    confusions, errors = [], {}
    for seed in seeds:
        scene, solution = fitted(kind, seed, store)
        description, ethogram = described(solution, config)
        exact = described(fitted("truth", seed, store)[1], config)[0] if kind != "truth" else description
        found = np.array([COLUMNS.index(ALSO_FLIGHT.get(name, name)) for name in ethogram.names])[ethogram.state]
        for n, track in enumerate(solution.track_id.tolist()):
            if not 1 <= track <= BIRDS:
                continue  # a track that follows no bird
            # a tracker may lack the first frames
            at = solution.frame_index
            true = [ROWS.index(NAMES[BEHAVIOURS[b]]) for b in scene.birds[track - 1].behaviour[at]]
            seen, matrix = ethogram.state[n] != NO_POSE, np.zeros((len(COLUMNS), len(COLUMNS)), int)
            np.add.at(matrix, (np.array(true)[seen], found[n][seen]), 1)
            confusions.append(matrix)
            for each in description.features:
                own, other = description.values[each.name][n], exact.values[each.name][track - 1, at]
                errors.setdefault(each.name, []).append(difference(each, own, other))
    total = np.sum(confusions, axis=0)
    show(f"\n{kind}, seeds {seeds[0]} to {seeds[-1]}, {len(confusions)} birds: frames (rows: truth), F1 and interval")
    show("".join(f"{name:>11}" for name in ("", *COLUMNS, "F1", "95 %", "birds")))
    for i, (name, (f1, low, high, birds)) in enumerate(f1_table(np.array(confusions)).items()):
        cells = "".join(f"{count:11d}" for count in total[i])
        show(f"{name:>11}{cells}{f1:11.2f}{f'{low:.2f}–{high:.2f}':>11}{birds:11d}")
    if kind == "truth":
        return
    show(f"\n{kind}: difference from the features of the exact poses (lengths as shares): median, 90 %")
    for each in description.features:
        values = np.concatenate(errors[each.name])
        if each.unit != "id" and np.isfinite(values).any():
            low, high = np.nanquantile(values, [0.5, 0.9])
            show(f"{each.name:>26} {low:8.3f} {high:8.3f} {'share' if each.unit == 'length' else each.unit}")


def main():
    """Measure the kinds of poses that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="+", choices=("truth", "detections", "pixels"))
    parser.add_argument("--seeds", type=int, nargs=2, default=(1000, 1020), metavar=("FIRST", "LAST+1"))
    parser.add_argument("--store", type=Path, required=True, help="folder of fits")
    parser.add_argument("--config", default="behaviour")
    options = parser.parse_args()
    use_cache()
    options.store.mkdir(parents=True, exist_ok=True)
    for kind in options.kinds:
        measure(kind, range(*options.seeds), options.store, load_behaviour_config(options.config))


if __name__ == "__main__":
    main()
