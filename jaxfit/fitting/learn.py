"""Weights and scales of the objective from the data: empirical Bayes with the effective number of errors.

A term whose weight or scale is learnt has, up to constants, the form E = ½·β·Σ w‖e‖² − ½·N·log β, with the precision β:
1/s² for the scale s of keypoint errors, λ for the weight of `mask_smooth_l1`. The weights w are those of Student's t,
(ν + n)/(ν + β‖e‖²) for groups of n errors, and 1 for squares. The Laplace approximation of the evidence is largest
where

    β = γ / Σ w‖e‖²,   γ = N − tr(Σ·H),

with H the curvature of the term and Σ the covariance of the posterior. A fit takes up a part of the errors, which
tr(Σ·H) counts.

A round computes γ and Σ w‖e‖² at the poses of a sample of windows, sets β, and continues the fit with the new values.

Errors of the outline are not independent from pixel to pixel: `fitting/outline_noise.py` counts them.

Hyperpriors: the values of the config count as `PRIOR_COUNT` observations, and limit the result to a factor of
`MOST_FACTOR`. The weight of the mask does not fall below its value in the config: the errors of the outline contain
errors of the poses, so the learnt weight is a lower limit. A smaller weight would move the fit away from the masks, and
the errors would then lower the weight again.

Not learnt, with reasons in docs/configs.md: the weight of `pose_prior` and the scales of the motion terms.

Source: MacKay 1992, *Bayesian interpolation* (γ and the fixed point); Lange, Little and Taylor 1989, *Robust
statistical modeling using the t distribution* (w); Tipping 2001, *Sparse Bayesian learning and the relevance vector
machine* (several precisions at once).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfit.config.build import with_values
from jaxfit.config.fit import FitConfig, StageConfig, term_settings
from jaxfit.config.yaml_file import config_to_yaml, rounded
from jaxfit.fitting.batch import Batch, fit_batch, frames_per_batch, take_tile, tile_rows, tile_size
from jaxfit.fitting.initial_poses import InitialPoses
from jaxfit.fitting.outline_noise import independent_errors, outline_errors, shown_frames
from jaxfit.fitting.posterior import (
    Blocks,
    Columns,
    broad_precision,
    posterior_of,
    window_blocks,
    with_shared,
)
from jaxfit.fitting.solve import FitModel, Problem, Program, problem_window, stage_hyperparameters, stage_program
from jaxfit.fitting.tasks import FitShared, FitTask, Run, gather_batch
from jaxfit.fitting.windows import Windows
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.model.kinematics import Pose
from jaxfit.objective.curvature import frame_rows
from jaxfit.objective.objective import evaluate_curvature
from jaxfit.objective.residuals import as_list
from jaxfit.raster.silhouette import silhouette

MOST_WINDOWS, MOST_FRAMES = 30, 800
"""Size of the sample. Further frames change the learnt values little."""
LARGEST_SHARE, LEAST_WINDOWS = 0.4, 2
"""Largest share of the windows in the sample, and the number of windows that the sample may always have. Learning takes
about 2.5 times as long as the fit of the sample, so that learning and fit take at most twice as long as the fit."""
ROUNDS = 3
CONVERGED = 0.05
"""Relative change of all values, below which no further round follows."""
PRIOR_COUNT = 10.0
MOST_FACTOR = 30.0
MOST_CHANGE = 10.0
"""Largest factor on a value in one round."""
LEAST_KEYPOINTS, LEAST_FRAMES, LEAST_MASKS = 200, 20, 20
"""Fewer detected keypoints, frames or masks in the sample do not determine the values that depend on them."""
LEAST_MEAN_WEIGHT = 0.1
"""Least mean weight of the keypoint errors that an update uses."""
LEAST_SHARE = 0.1
"""Least part of N that remains after tr(Σ·H), which is only an approximation."""

KEYPOINTS, MASK = "keypoint_likelihood", "mask_smooth_l1"
SETTINGS: Mapping[str, tuple[str, ...]] = {
    KEYPOINTS: ("sd_sure_px", "sd_unsure_px"),
    MASK: ("weight",),
}
"""Learnt settings of each term. Settings of one term change by one factor."""

_logger = logging.getLogger(__name__)


class Learnt(NamedTuple):
    """Learnt values."""

    config: FitConfig
    """The config with the learnt values and without `learn_weights`."""
    values: dict[str, float]
    """Path of a config key → learnt value; empty if nothing was learnt."""
    remarks: tuple[str, ...]
    """Reasons why values were not learnt."""

    def to_yaml(self) -> str:
        """Return the content of `learnt.yaml`: the whole config, with comments about what was learnt."""
        lines = [f"learnt from the data: {path} = {value:g}" for path, value in self.values.items()]
        return "".join(f"# {line}\n" for line in [*lines, *self.remarks]) + config_to_yaml(self.config)


class Evidence(NamedTuple):
    """What a sample of windows says about the precision β of one term."""

    count: float
    """γ: effective number of errors."""
    energy: float
    """β·Σ w‖e‖² at the current β; equal to γ where the evidence is largest."""


def learn(
    model: FitModel,
    config: FitConfig,
    windows: Windows,
    initial_poses: InitialPoses | None = None,
    progress: ProgressTask = silent,
    source: object = "observations",
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return `Learnt.values` and `Learnt.remarks`: weights and scales of the terms of the last stage.

    The result depends on the windows and the config only. Terms that the last stage lacks, or whose learnt settings the
    last stage overrides, keep their values. Without `keypoint_likelihood`, nothing is learnt: other keypoint terms are
    no likelihoods, so that no scale has a unit.

    Args:
        model: the bird and the camera.
        config: the config of the fit, with stages that the observations allow.
        windows: all windows.
        initial_poses: as for the fit.
        progress: shows progress.
        source: name of the observations in messages.
    """
    first, remarks = replace(config, learn_weights=()), []
    some = windows[choose_windows(windows, frames_per_batch(model.bird, config) // config.window)]
    names = _learnable(config, some, remarks)
    values: dict[str, float] = {}
    if names:
        steps = config.stages[-1].steps
        total = sum(stage.steps for stage in config.stages[:-1]) + steps // 2 + (ROUNDS - 1) * (steps // 4)
        with progress(f"Learning weights from {len(some)} windows", total) as report_progress:
            values = _learn_values(model, first, FitShared(model, initial_poses), some, names, report_progress, remarks)
    for remark in remarks:
        _logger.warning("%s: %s", source, remark)
    _logger.info("learnt: %s", ", ".join(f"{path} = {value:g}" for path, value in values.items()) or "nothing")
    return values, tuple(remarks)


def choose_windows(windows: Windows, most: int = MOST_WINDOWS) -> Int[np.ndarray, "S"]:
    """Return the rows of a sample of windows: of each track in turn, at random times. It is always the same.

    Args:
        windows: all windows.
        most: largest number of windows, beside the limits of this module.
    """
    shuffled = np.random.default_rng(0).permutation(len(windows))
    turn: dict[int, int] = {}
    turns = [turn[n] for n in windows.track[shuffled].tolist() if turn.update({n: turn.get(n, -1) + 1}) is None]
    ordered = shuffled[np.argsort(turns, kind="stable")]
    frames = np.cumsum(windows.present[ordered].sum(1))
    share = max(int(LARGEST_SHARE * len(windows)), LEAST_WINDOWS)
    count = min(int(np.searchsorted(frames, MOST_FRAMES)) + 1, max(most, 1), MOST_WINDOWS, share)
    return np.sort(ordered[:count])


def _learnable(config: FitConfig, windows: Windows, remarks: list[str]) -> list[str]:
    """Return the names of the terms whose settings are learnt, and add reasons why others are not to `remarks`."""
    stage, settings = config.stages[-1], config.stage_settings(config.stages[-1])
    if KEYPOINTS not in stage.terms:
        remarks.append(f"no weights are learnt: the last stage has no {KEYPOINTS}")
        return []
    keypoints, frames = int((windows.confidence > 0).sum()), int(windows.present.sum())
    if keypoints < LEAST_KEYPOINTS or frames < LEAST_FRAMES:
        remarks.append(f"no weights are learnt: {keypoints} keypoints in {frames} frames are too few")
        return []
    masks = int((windows.has_mask & windows.present).sum())
    names = []
    for name in config.learn_weights:
        if name not in stage.terms or set(SETTINGS[name]) & set(term_settings(stage.override.get(name, {}))):
            continue
        if settings[name]["weight"] <= 0:
            continue
        if name == MASK and config.edge != "unbiased":
            remarks.append(f"the weight of {MASK} is not learnt: it needs `edge: unbiased`")
        elif name == MASK and masks < LEAST_MASKS:
            remarks.append(f"the weight of {MASK} is not learnt: {masks} masks are too few")
        else:
            names.append(name)
    return names


def _learn_values(
    model: FitModel,
    config: FitConfig,
    shared: FitShared,
    windows: Windows,
    names: Sequence[str],
    report_progress: Any,
    remarks: list[str],
) -> dict[str, float]:
    """Return the learnt values of some terms, by the paths of their keys."""
    stage, first = config.stages[-1], config
    task = FitTask([Run(config, windows)], [(0, w) for w in range(len(windows))])
    batch = gather_batch(shared, task)
    stages = (*config.stages[:-1], replace(stage, steps=max(stage.steps // 2, 1)))
    fitted = fit_batch(model, [replace(config, stages=stages, error_bars=False)], batch, report_progress)
    more = replace(stage, steps=max(stage.steps // 4, 1), carry_moments=False, keep_best=False)
    values: dict[str, float] = {}
    for n in range(ROUNDS):
        usable = fitted.failure == ""
        evidence = measure(model, config, stage, batch.targets, fitted.pose, usable, names)
        if evidence is None:
            remarks.append("no weights are learnt: no window of the sample has a posterior")
            return {}
        old, values = _current(config, names), _updated(config, first, evidence)
        config = with_values(config, values)
        _logger.debug("round %d: %s, %s", n + 1, values, evidence)
        if n == ROUNDS - 1 or all(abs(np.log(values[path] / old[path])) < CONVERGED for path in values):
            break
        count = len(fitted.failure)
        start = jax.tree.map(lambda x: jnp.asarray(x)[:, None], fitted.pose)
        rows = np.arange(count)
        again = Batch(batch.targets, start, np.zeros(count, int), batch.targets_row, rows)
        one_stage = replace(config, stages=(more,), error_bars=False)
        fitted = fit_batch(model, [one_stage], again, report_progress)
    return {path: float(rounded(value)) for path, value in values.items()}


def _paths(name: str) -> list[str]:
    return [f"terms.{name}.{setting}" for setting in SETTINGS[name]]


def _current(config: FitConfig, names: Sequence[str]) -> dict[str, float]:
    """Return path → value of the learnt keys in a config, or their defaults."""
    settings = config.stage_settings(config.stages[-1])
    return {path: settings[name][path.rsplit(".", 1)[1]] for name in names for path in _paths(name)}


def _updated(config: FitConfig, first: FitConfig, evidence: Mapping[str, Evidence]) -> dict[str, float]:
    """Return the values after one round."""
    names = list(evidence)
    now, default = _current(config, names), _current(first, names)
    values = {}
    for name, (count, energy) in evidence.items():
        path = _paths(name)[0]
        is_weight = path.endswith(".weight")
        ratio = now[path] / default[path]
        precision = ratio if is_weight else ratio**-2  # in units of the default
        power, least = (1, 1.0) if is_weight else (2, 0.0)
        new = updated_precision(precision, Evidence(count, energy), power, least)
        factor = new if is_weight else new**-0.5
        values |= {each: default[each] * factor for each in _paths(name)}
    return values


def updated_precision(precision: float, evidence: Evidence, power: int = 1, least: float = 0.0) -> float:
    """Return the precision after one round, in units of the default, 1.

    1/β = (γ·v + n₀)/(γ + n₀) with v = energy/(β·γ), the variance that the data give, and n₀ = `PRIOR_COUNT`.

    Args:
        precision: β before.
        evidence: of the term.
        power: the value of the config is β^(±1/power); its bounds are those of this module.
        least: least precision.
    """
    count, energy = max(evidence.count, 0.0), max(evidence.energy, 1e-12)
    variance = (energy / precision + PRIOR_COUNT) / (count + PRIOR_COUNT)
    low, high = max(MOST_FACTOR ** -float(power), least), MOST_FACTOR ** float(power)
    change = MOST_CHANGE ** float(power)
    return float(np.clip(np.clip(1 / variance, precision / change, precision * change), low, high))


def measure(
    model: FitModel,
    config: FitConfig,
    stage: StageConfig,
    targets: Any,
    pose: Pose,
    usable: np.ndarray,
    names: Sequence[str],
) -> dict[str, Evidence] | None:
    """Return the evidence of some windows about each of some terms; None if no window has a posterior.

    Args:
        model: the bird and the camera.
        config: the config with the current values.
        stage: the stage whose terms count.
        targets: of W windows.
        pose: poses of the windows.
        usable: (W,) bool: the windows that count.
        names: the terms.
    """
    program = with_shared(stage_program(config, stage, model), stage)
    hyperparameters = stage_hyperparameters(config, stage, model.bird.keypoint_names)
    count, size = len(usable), tile_size(pose.global_orient.shape[1])
    sums = {name: np.zeros(3) for name in names}  # number of errors, tr(Σ·H), energy
    outlines: list[Float[np.ndarray, "M 3"]] = []
    found = False
    for rows in tile_rows(count, size):
        own = take_tile(targets, rows)
        own = replace(own, has_mask=own.has_mask & (rows >= 0)[:, None] & own.present)
        settings = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *[hyperparameters] * len(rows))
        anchor = take_tile(pose, rows)
        problems = Problem(settings, anchor, own)
        full = window_blocks(program, problems, anchor)
        local = jax.tree.map(np.asarray, _frame_statistics(program, problems, anchor))
        for b, row in enumerate(rows.tolist()):
            if row < 0 or not usable[row]:
                continue
            own_pose, statistics, target = jax.tree.map(lambda x, b=b: x[b], (anchor, local, own))
            added = _window_sums(program, full[b], own_pose, statistics)
            if added is None:
                continue
            found = True
            for name in names:
                sums[name] += added[name]
            if MASK in names:
                masks = np.asarray(target.mask), np.asarray(target.has_mask)
                outlines.append(outline_errors(statistics.silhouette, *masks, program))
    if not found:
        return None
    evidence = {name: _evidence(*sums[name]) for name in names}
    if KEYPOINTS in names:
        dof = float(hyperparameters.settings[KEYPOINTS]["dof"])
        evidence[KEYPOINTS] = expanded(evidence[KEYPOINTS], dof)
    if MASK in names:
        area = (program.camera.size_px / program.raster.size_px) ** 2
        weight = float(hyperparameters.settings[MASK]["weight"]) * area
        masks, taken, _ = sums[MASK].tolist()
        evidence[MASK] = mask_evidence(np.concatenate(outlines), masks, taken, weight, program.raster.blur.filter_sd_px)
    return evidence


def _evidence(total: float, taken: float, energy: float) -> Evidence:
    return Evidence(max(total - taken, LEAST_SHARE * total), energy)


def expanded(evidence: Evidence, dof: float) -> Evidence:
    """Return the evidence about the scale of a bivariate Student t, with the energy divided by the mean weight w.

    The mean of w is 1 + (2/ν)(1 − energy/count). At the fixed point the mean is 1, and the energy does not change.
    Three rounds then reach 97 % of a scale that is 4 times the initial value (ν = 4); without the division, 70 %.

    Source: Kent, Tyler and Vardi 1994, *A curious likelihood identity for the multivariate t-distribution*.

    Args:
        evidence: the effective number of errors, and β·Σ w‖e‖².
        dof: degrees of freedom ν.
    """
    mean_weight = 1 + 2 / dof * (1 - evidence.energy / evidence.count)
    return evidence._replace(energy=evidence.energy / max(mean_weight, LEAST_MEAN_WEIGHT))


def mask_evidence(
    outlines: Float[np.ndarray, "M 3"], masks: float, taken: float, weight: float, sigma: float
) -> Evidence:
    """Return the evidence about the weight of the mask term.

    Args:
        outlines: `outline_error` of some masks.
        masks: number of all masks.
        taken: tr(Σ·H) over all masks.
        weight: current weight, for pixels of the silhouette.
        sigma: width of the filter, in pixels of the silhouette.
    """
    count, variance = independent_errors(outlines, sigma)
    return _evidence(masks * count, taken, masks * count * weight * variance)


class _FrameStatistics(NamedTuple):
    """Quantities of the terms at some poses."""

    energy: Float[Array, "*B"]
    """λ·Σ w‖r‖² of the keypoints."""
    keypoints: Float[Array, "*B"]
    """Number of detected keypoints."""
    masks: Float[Array, "*B"]
    """Number of masks."""
    curvature: dict[str, Float[Array, "*B T D D"]]
    """H of each frame, of both terms."""
    silhouette: Float[Array, "*B M H W"]


@eqx.filter_jit
def _frame_statistics(program: Program, problems: Problem, pose: Pose) -> _FrameStatistics:
    def one(problem: Problem, pose: Pose) -> _FrameStatistics:
        window = problem_window(program, problem, pose)
        settings = problem.hyperparameters.settings
        curvature = {}
        T, D = frame_rows(pose, program.shared).shape
        for name in (each for each in (KEYPOINTS, MASK) if each in settings):
            H = evaluate_curvature(window, program.terms, {name: settings[name]}, second_order=True)
            units = jnp.broadcast_to(jnp.eye(D)[:, None], (D, T, D))
            curvature[name] = jax.lax.map(H.product, units).transpose(1, 2, 0)
        of_keypoints = dict(settings[KEYPOINTS])
        weight = of_keypoints.pop("weight")
        energy = sum(
            jnp.sum(each.weight * 2 * each.kernel.slope(squared) * squared)
            for each in as_list(program.terms[KEYPOINTS].function(window, **of_keypoints))
            for squared in [jnp.sum(each.values**2, axis=-1)]
        )
        energy = jnp.asarray(weight * energy)
        shown = jnp.zeros((0, 0, 0))
        if MASK in settings:
            raster = program.raster
            at = shown_frames(T)
            shown = jax.vmap(
                lambda v: silhouette(v, window.faces, raster.size_px, blur=raster.blur, backend=raster.backend)
            )(window.vertices_screen[at])
        detected = jnp.sum((problem.targets.confidence > 0) & problem.targets.present[:, None], dtype=jnp.float32)
        masks = jnp.sum(problem.targets.has_mask, dtype=jnp.float32)
        return _FrameStatistics(energy, detected, masks, curvature, shown)

    return jax.vmap(one)(problems, pose)


def _window_sums(
    program: Program, full: tuple[Blocks, Columns] | str, pose: Pose, local: _FrameStatistics
) -> dict[str, np.ndarray] | None:
    """Return, for each term: number of errors (masks: number of masks), tr(Σ·H), energy. None without a posterior."""
    if isinstance(full, str):
        return None
    posterior = posterior_of(*full, broad_precision(program, pose))
    if isinstance(posterior, str):
        return None
    covariance = posterior.posterior.frame_covariance()
    both = np.concatenate([full[1].own, full[1].shared])
    taken = {name: np.sum(covariance * H[:, both[:, None], both]) for name, H in local.curvature.items()}
    sums = {KEYPOINTS: np.array([2 * local.keypoints, taken[KEYPOINTS], local.energy])}
    if MASK in taken:
        sums[MASK] = np.array([local.masks, taken[MASK], 0.0])
    return sums
