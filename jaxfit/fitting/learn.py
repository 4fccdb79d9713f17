"""Weights and scales of the objective from the data: empirical Bayes with the effective number of errors.

A term whose weight or scale is learnt has, up to constants, the form E = ½·β·Σ w‖e‖² − ½·N·log β, with the precision β:
1/s² for the scale s of keypoint errors, λ for the weight of `mask_smooth_l1`. The weights w are those of Student's t,
(ν + n)/(ν + β‖e‖²) for groups of n errors, and 1 for squares. The Laplace approximation of the evidence is largest
where

    β = γ / Σ w‖e‖²,   γ = N − tr(Σ·H),

with H the curvature of the term and Σ the covariance of the posterior. A fit takes up a part of the errors, which
tr(Σ·H) counts.

A round computes γ and Σ w‖e‖² at the poses of a sample of windows, sets β, and continues the fit with the new values.

Errors of the outline are not independent from pixel to pixel: `fitting/evidence.py` counts them.

Hyperpriors: the values of the config count as `PRIOR_COUNT` observations, and limit the result to a factor of
`MAX_FACTOR`. The weight of the mask does not fall below its value in the config: the errors of the outline contain
errors of the poses, so the learnt weight is a lower limit. A smaller weight would move the fit away from the masks, and
the errors would then lower the weight again.

Offsets of the keypoints (`fitting/keypoint_offsets.py`) are learnt in the same rounds, before the scales.

Offsets are not learnt from keypoints that the network `outline` made: these are the points of the model.

Not learnt: the weight of `pose_prior` and the scales of the motion terms.

Source: MacKay 1992, *Bayesian interpolation* (γ and the fixed point); Lange, Little and Taylor 1989, *Robust
statistical modeling using the t distribution* (w); Tipping 2001, *Sparse Bayesian learning and the relevance vector
machine* (several precisions at once).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from jaxfit.config.build import with_values
from jaxfit.config.fit import FitConfig, term_settings
from jaxfit.config.yaml_file import config_to_yaml, rounded
from jaxfit.data.observations import FROM_OUTLINE, Observations
from jaxfit.fitting.batch import Batch, fit_batch, frames_per_batch
from jaxfit.fitting.bodies import stages_of_pass
from jaxfit.fitting.evidence import KEYPOINTS, MASK, Evidence, measure
from jaxfit.fitting.keypoint_offsets import first_offsets, learn_offsets
from jaxfit.fitting.solve import FitModel, fit_model
from jaxfit.fitting.tasks import FitTask, gather_batch
from jaxfit.fitting.windows import Windows
from jaxfit.foundation.progress import ProgressTask, silent

MAX_WINDOWS, MAX_FRAMES = 30, 800
"""Size of the sample. Further frames change the learnt values little."""
LARGEST_SHARE, ALWAYS_WINDOWS, ALWAYS_FRAMES = 0.4, 2, 30
"""Largest share of the windows in the sample, and the number of windows and of frames that the sample may always have.
Learning takes about 2.5 times as long as the fit of the sample, so that learning and fit take at most twice as long as
the fit."""
ROUNDS = 3
CONVERGED = 0.05
"""Relative change of all values, below which no further round follows."""
PRIOR_COUNT = 10.0
MAX_FACTOR = 30.0
MAX_CHANGE = 10.0
"""Largest factor on a value in one round."""
MIN_KEYPOINTS, MIN_FRAMES, MIN_MASKS = 100, 10, 10
"""Fewer detected keypoints, frames or masks in the sample do not determine the values that depend on them: N errors
give a scale with a relative standard error of about 1/√(2N)."""
MIN_PER_FRAME = 4
"""Least mean number of detected keypoints in a frame: fewer keypoints hardly determine the orientation of a bird."""

OFFSETS = "keypoint_offsets"
SETTINGS: Mapping[str, tuple[str, ...]] = {
    KEYPOINTS: ("sd_sure_px", "sd_unsure_px"),
    MASK: ("weight",),
}
"""Learnt settings of each term. Settings of one term change by one factor."""

_logger = logging.getLogger(__name__)


Value = float | list[float]
"""A number, or the three numbers of an offset."""


def shown_value(value: Value) -> str:
    """Return a learnt value as text."""
    return f"[{', '.join(f'{number:g}' for number in value)}]" if isinstance(value, list) else f"{value:g}"


class Learnt(NamedTuple):
    """Learnt values."""

    config: FitConfig
    """The config with the learnt values and without `learn_weights`."""
    values: dict[str, Value]
    """Path of a config key → learnt value; empty if nothing was learnt."""
    remarks: tuple[str, ...]
    """Reasons why values were not learnt."""

    def to_yaml(self) -> str:
        """Return the content of `learnt.yaml`: the whole config, with comments about what was learnt."""
        lines = [f"learnt from the data: {path} = {shown_value(value)}" for path, value in self.values.items()]
        return "".join(f"# {line}\n" for line in [*lines, *self.remarks]) + config_to_yaml(self.config)


def learn(
    model: FitModel,
    config: FitConfig,
    windows: Windows,
    progress: ProgressTask = silent,
    source: object = "observations",
) -> tuple[dict[str, Value], tuple[str, ...]]:
    """Return `Learnt.values` and `Learnt.remarks`: weights and scales of the terms of the last stage, and offsets.

    The result depends on the windows and the config only. Terms that the last stage lacks, or whose learnt settings the
    last stage overrides, keep their values. Without `keypoint_likelihood`, nothing is learnt: other keypoint terms are
    no likelihoods, so that no scale has a unit.

    Args:
        model: the bird, the camera, and initial poses.
        config: the config of the fit, with stages that the observations allow.
        windows: all windows.
        progress: shows progress.
        source: name of the observations in messages.
    """
    # a body for each window: the stage that optimises the bodies is the last, so that their numbers count in γ
    first_pass = stages_of_pass(config, has_bodies=False)
    one_pass = tuple(replace(config.stages[i], share_body=False) for i in first_pass)
    first, remarks = replace(config, learn_weights=(), stages=one_pass), []
    some = windows[choose_windows(windows, frames_per_batch(model.bird, config) // config.window)]
    names = _learnable(config, some, remarks)
    values: dict[str, Value] = {}
    if names:
        steps = one_pass[-1].steps
        total = sum(stage.steps for stage in one_pass[:-1]) + steps // 2 + (ROUNDS - 1) * (steps // 4)
        with progress(f"Learning weights from {len(some)} windows", total) as report_progress:
            values = _learn_values(model, first, some, names, report_progress, remarks)
    for remark in remarks:
        _logger.warning("%s: %s", source, remark)
    shown = ", ".join(f"{path} = {shown_value(value)}" for path, value in values.items())
    _logger.info("learnt: %s", shown or "nothing")
    return values, tuple(remarks)


def without_offsets_of_outlines(config: FitConfig, observations: Observations) -> tuple[FitConfig, tuple[str, ...]]:
    """Return the config without offsets to learn if the network `outline` made all keypoints, and the remark about it.

    The network was trained on the points of the model, so that the offsets would be its errors.
    """
    made = np.asarray(observations.keypoint_origin)[observations.confidence.any(-1)]
    if OFFSETS not in config.learn_weights or not made.size or (made != FROM_OUTLINE).any():
        return config, ()
    learnt = tuple(name for name in config.learn_weights if name != OFFSETS)
    return replace(config, learn_weights=learnt), (f"no {OFFSETS} are learnt: outlines gave all keypoints",)


def choose_windows(windows: Windows, most: int = MAX_WINDOWS) -> Int[np.ndarray, "S"]:
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
    share = max(int(LARGEST_SHARE * len(windows)), ALWAYS_WINDOWS, -(-ALWAYS_FRAMES // windows.present.shape[1]))
    count = min(int(np.searchsorted(frames, MAX_FRAMES)) + 1, max(most, 1), MAX_WINDOWS, share)
    return np.sort(ordered[:count])


def _learnable(config: FitConfig, windows: Windows, remarks: list[str]) -> list[str]:
    """Return the names of the terms whose settings are learnt, and add reasons why others are not to `remarks`."""
    stage, settings = config.stages[-1], config.stage_settings(config.stages[-1])
    if KEYPOINTS not in stage.terms:
        remarks.append(f"no weights are learnt: the last stage has no {KEYPOINTS}")
        return []
    keypoints, frames = int((windows.confidence > 0).sum()), int(windows.present.sum())
    if keypoints < max(MIN_KEYPOINTS, MIN_PER_FRAME * frames) or frames < MIN_FRAMES:
        remarks.append(f"no weights are learnt: {keypoints} keypoints in {frames} frames are too few")
        return []
    masks = int((windows.has_mask & windows.present).sum())
    names = []
    for name in config.learn_weights:
        if name == OFFSETS:
            names.append(name)
            continue
        if name not in stage.terms or set(SETTINGS[name]) & set(term_settings(stage.override.get(name, {}))):
            continue
        if settings[name]["weight"] <= 0:
            continue
        if name == MASK and config.edge != "unbiased":
            remarks.append(f"the weight of {MASK} is not learnt: it needs `edge: unbiased`")
        elif name == MASK and masks < MIN_MASKS:
            remarks.append(f"the weight of {MASK} is not learnt: {masks} masks are too few")
        else:
            names.append(name)
    return names


def _learn_values(
    model: FitModel,
    config: FitConfig,
    windows: Windows,
    names: Sequence[str],
    report_progress: Any,
    remarks: list[str],
) -> dict[str, Value]:
    """Return the learnt values, by the paths of their keys."""
    stage, first = config.stages[-1], config
    task = FitTask([config], [windows], [(0, w) for w in range(len(windows))])
    batch = gather_batch(model, task)
    stages = (*config.stages[:-1], replace(stage, steps=max(stage.steps // 2, 1)))
    fitted = fit_batch(model, [replace(config, stages=stages, error_bars=False)], batch, report_progress)
    more = replace(stage, steps=max(stage.steps // 4, 1), carry_moments=False, keep_best=False)
    terms = [name for name in names if name != OFFSETS]
    offsets = first_offsets(model.bird, config.keypoint_offsets)
    values = _current(config, terms)
    for n in range(ROUNDS):
        usable, old = fitted.failure == "", values
        if OFFSETS in names:
            seen = jax.tree.map(lambda x, rows=usable: np.asarray(x)[rows], (fitted.pose, batch.targets))
            known = model.bird, model.rig, model.camera
            offsets = learn_offsets(*known, offsets, *seen, config.stage_settings(stage)[KEYPOINTS])
            config = replace(config, keypoint_offsets=offsets.by_name(model.bird))
            model = fit_model(model.bird, config)
        evidence = measure(model, config, stage, batch.targets, fitted.pose, usable, terms)
        if evidence is None:
            remarks.append("no weights are learnt: no window of the sample has a posterior")
            return {}
        values = _updated(config, first, evidence)
        config = with_values(config, values)
        _logger.debug("round %d: %s, %s", n + 1, values, evidence)
        converged = all(abs(np.log(values[path] / old[path])) < CONVERGED for path in values)
        if n == ROUNDS - 1 or (converged and OFFSETS not in names):
            break
        count = len(fitted.failure)
        start = jax.tree.map(lambda x: jnp.asarray(x)[:, None], fitted.pose)
        rows = np.arange(count)
        again = Batch(batch.targets, start, np.zeros(count, int), batch.targets_row, rows)
        one_stage = replace(config, stages=(more,), error_bars=False)
        fitted = fit_batch(model, [one_stage], again, report_progress)
    for name in (name for name in terms if evidence[name].count == 0):
        remarks.append(f"{name}: its values are not learnt, because the poses take up most of its errors")
    learnt: dict[str, Value] = {path: float(rounded(value)) for path, value in values.items()}
    if OFFSETS in names:
        learnt |= {f"{OFFSETS}.{name}": list(offset) for name, offset in config.keypoint_offsets.items()}
    return learnt


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
        if count == 0:
            values |= {each: now[each] for each in _paths(name)}
            continue
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
    low, high = max(MAX_FACTOR ** -float(power), least), MAX_FACTOR ** float(power)
    change = MAX_CHANGE ** float(power)
    return float(np.clip(np.clip(1 / variance, precision / change, precision * change), low, high))
