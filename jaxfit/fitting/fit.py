"""The fit as a whole: observations and a bird in, posed birds out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxfit.config.fit import FitConfig
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.fitting.batch import Lanes, fit_batch, frames_per_batch
from jaxfit.fitting.collect import Collector
from jaxfit.fitting.diagnose import check_terms
from jaxfit.fitting.prepare import Preparation, camera_of, start_key, targets_key
from jaxfit.fitting.stages import program
from jaxfit.fitting.start import Start
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Rig, fold_bird
from jaxfit.model.pose import Pose
from jaxfit.objective.posed_window import Targets, priors_of
from jaxfit.progress import ProgressTask, silent

__all__ = ["fit", "fit_runs"]

logger = logging.getLogger(__name__)


def fit(
    observations: Observations,
    bird: Bird,
    config: FitConfig,
    start: Start | None = None,
    progress: ProgressTask = silent,
    source: object = "observations",
) -> Solution:
    """Pose every bird of a video (or of a set of photographs).

    Args:
        observations: keypoints and masks; their keypoints must be the bird's, in any order.
        bird: the model.
        config: what to do.
        start: where to start; None searches by `config.initialise`.
        progress: where progress is shown.
        source: what the observations are called in an error.

    Returns:
        The poses, with a status for every track: `ok`, `no usable frame` or `diverged`.

    Raises:
        InputError: no bird, keypoints that are not the model's, no track with a usable frame, crops that cannot
            be made, a term that cannot be used.
    """
    return fit_runs(Preparation(observations, bird, start, source), bird, [config], progress)[0]


def fit_runs(
    prepared: Preparation, bird: Bird, configs: Sequence[FitConfig], progress: ProgressTask = silent
) -> list[Solution]:
    """Fit the same birds under several configs at once, as one compiled program.

    Args:
        prepared: the observations.
        bird: the model.
        configs: equal but for what needs no other program, see `stages.program`.
        progress: where progress is shown.

    Returns:
        What `fit` returns, for every config.

    Raises:
        InputError: as `fit`.
        ValueError: configs that need different programs.
    """
    if any(program(config) != program(configs[0]) for config in configs):
        raise ValueError("configs must be one program: equal but for weights, settings, step sizes and preparation")
    # shape directions that nothing moves would only cost time
    shaped = prepared.starts_with_shape or any("betas" in stage.optimised for stage in configs[0].stages)
    used = bird if shaped else _without_shape(bird)
    rig, priors, camera = fold_bird(used), priors_of(used), camera_of(configs[0])
    check_terms(configs[0], used, rig, priors, camera)
    windows = [prepared.windows(config) for config in configs]
    pairs = np.array([(r, w) for r, each in enumerate(windows) for w in range(len(each))])
    size = min(max(frames_per_batch(bird, configs[0]) // configs[0].window, 1), len(pairs))
    batches = range(0, len(pairs), size)
    collectors = [Collector(prepared.observations, each, bird, camera) for each in windows]
    birds = len(np.unique(windows[0].track))
    what = f"{birds} {'bird' if birds == 1 else 'birds'}" + (f" × {len(configs)} runs" if len(configs) > 1 else "")
    logger.info("%s, %d windows of %d frames, %d batches", what, len(pairs), configs[0].window, len(batches))
    steps = sum(stage.steps for stage in configs[0].stages)
    with progress(f"Fitting {what}", steps * len(batches)) as report_progress:
        for first in batches:
            real = pairs[first : first + size]
            report_progress(0, "starting poses")
            batch = _gather(prepared, used, rig, configs, real, size)
            fitted = fit_batch(used, rig, priors, configs, camera, *batch, report_progress)
            for lane, (r, w) in enumerate(real.tolist()):
                collectors[r].add(w, fitted, lane)
    return [collector.finish() for collector in collectors]


class _Batch(NamedTuple):
    targets: Targets
    start: Pose
    lanes: Lanes


def _gather(
    prepared: Preparation, bird: Bird, rig: Rig, configs: Sequence[FitConfig], pairs: np.ndarray, size: int
) -> _Batch:
    """A batch of `size` lanes for some pairs of run and window; what runs share stands there once.

    Every batch has the same shape, so that one compiled program serves all: a short one is filled up with lanes of
    its own, which start for themselves and so are computed.
    """
    targets: dict[tuple, int] = {}  # window → its row
    starts: dict[tuple, int] = {}
    wanted, poses, lanes = [], [], []
    for r in np.unique(pairs[:, 0]):
        config, rows = configs[r], pairs[pairs[:, 0] == r, 1]
        cut, begin = targets_key(config), start_key(config)
        if len(new := _place(targets, cut, rows)):
            wanted.append((config, new))
        if len(new := _place(starts, begin, rows)):
            poses.append(prepared.starting_poses(bird, rig, config, new))
        lanes += [(r, targets[cut, w], starts[begin, w]) for w in rows]
    fillers = [(*lanes[i % len(lanes)][:2], len(starts) + i) for i in range(size - len(lanes))]
    filled = np.array([lanes[i % len(lanes)][2] for i in range(size - len(lanes))], int)
    start = jax.tree.map(lambda *x: jnp.concatenate(x), *poses)
    start = jax.tree.map(lambda x: jnp.concatenate([x, x[filled]]), start)
    return _Batch(prepared.targets(wanted), start, Lanes(*np.array(lanes + fillers).T))


def _place(held: dict[tuple, int], key: tuple, rows: np.ndarray) -> np.ndarray:
    """Give each window that `held` lacks the next row; returns those."""
    new = [w for w in rows if (key, w) not in held]
    held |= {(key, w): len(held) + i for i, w in enumerate(new)}
    return np.array(new, int)


def _without_shape(bird: Bird) -> Bird:
    return eqx.tree_at(
        lambda b: (b.shape_basis, b.shape_variance), bird, (bird.shape_basis[:0], bird.shape_variance[:0])
    )
