"""What a sample of windows says about the precision of a term: the effective number of errors, and their energy.

`fitting/learn.py` has the equations and their sources.

Errors of an outline are not independent from pixel to pixel. If the outline is displaced by an error with a Gaussian
correlation of length τ, the filtered mask error ẽ (σ: the width of the filter) has

    N = L/√(2π(τ² + 2σ²)),   r = Σ(ẽ filtered to the width 2σ)²/Σẽ² = ½·√((τ² + 2σ²)/(τ² + 8σ²)),

with the length L of the outline. r gives τ, as a median over masks. The variance Σẽ²/N is a mean over masks: it
contains the outlines that the fit does not reach, so that the weight does not count all outlines as known.

The precision N/Σẽ² makes the mask term know the mean displacement of a piece of the outline as well as the data do: for
a standard deviation s of the displacement, it is √2·σ/(τ·s²).

Source: ours, for outlines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from jaxfit.config.fit import FitConfig, StageConfig
from jaxfit.fitting.posterior import Blocks, Columns, broad_precision, posterior_of, window_blocks, with_shared
from jaxfit.fitting.problem import Problem, Program, problem_window
from jaxfit.fitting.solve import FitModel, stage_hyperparameters, stage_program
from jaxfit.fitting.tiles import take_tile, tile_rows, tile_size
from jaxfit.model.kinematics import Pose
from jaxfit.objective.curvature import frame_rows
from jaxfit.objective.objective import evaluate_curvature
from jaxfit.objective.residuals import as_list
from jaxfit.raster.silhouette import silhouette
from jaxfit.raster.silhouette_reference import UNKNOWN

KEYPOINTS, MASK = "keypoint_likelihood", "mask_smooth_l1"
MIN_MEAN_WEIGHT = 0.1
"""Least mean weight of the keypoint errors that an update uses."""
MIN_SHARE = 0.5
"""Least part of the N errors that the fit must leave. tr(Σ·H), the part that the fit takes up, is an approximation by
the curvature. Where it is larger, its error decides about the value, and the value of the config stays."""

MASKS_PER_WINDOW = 25
"""Number of masks of a window whose errors are filtered."""
LARGEST_RATIO = 0.49
"""Largest r, for which τ is 12σ. For a displacement of the whole outline, r is ½."""


class Evidence(NamedTuple):
    """What a sample of windows says about the precision β of one term."""

    count: float
    """γ: effective number of errors; 0 if the fit takes up so many errors that they determine nothing."""
    energy: float
    """β·Σ w‖e‖² at the current β; equal to γ where the evidence is largest."""


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
    count = total - taken
    return Evidence(count, energy) if count >= MIN_SHARE * total else Evidence(0.0, 0.0)


def expanded(evidence: Evidence, dof: float) -> Evidence:
    """Return the evidence about the scale of a bivariate Student t, with the energy divided by the mean weight w.

    The mean of w is 1 + (2/ν)(1 − energy/count). At the fixed point the mean is 1, and the energy does not change.
    Three rounds then reach 97 % of a scale that is 4 times the initial value (ν = 4); without the division, 70 %.

    Source: Kent, Tyler and Vardi 1994, *A curious likelihood identity for the multivariate t-distribution*.

    Args:
        evidence: the effective number of errors, and β·Σ w‖e‖².
        dof: degrees of freedom ν.
    """
    if evidence.count == 0:
        return evidence
    # w = (ν + 2)/(ν + q) and Σ w·q = energy: ν·Σ w = (ν + 2)·M − energy for M keypoints, and count = 2M
    mean_weight = 1 + 2 / dof * (1 - evidence.energy / evidence.count)
    return evidence._replace(energy=evidence.energy / max(mean_weight, MIN_MEAN_WEIGHT))


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
            # these terms link no frames, so that a probe in all frames at once gives one column of all blocks
            units = jnp.broadcast_to(jnp.eye(D)[:, None], (D, T, D))
            curvature[name] = jax.lax.map(H.product, units).transpose(1, 2, 0)
        of_keypoints = dict(settings[KEYPOINTS])
        weight = of_keypoints.pop("weight")
        # E = Σ w·ρ(s) has the gradient of the squares Σ w·ρ′(s)·s at the same errors; 2ρ′ is their precision
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
    # tr(Σ·H): the terms have blocks of single frames, so the blocks of Σ of single frames are enough
    covariance = posterior.covariance().of_frames()
    both = np.concatenate([full[1].own, full[1].shared])
    taken = {name: np.sum(covariance * H[:, both[:, None], both]) for name, H in local.curvature.items()}
    sums = {KEYPOINTS: np.array([2 * local.keypoints, taken[KEYPOINTS], local.energy])}
    if MASK in taken:
        sums[MASK] = np.array([local.masks, taken[MASK], 0.0])
    return sums


def shown_frames(frames: int) -> np.ndarray:
    """Return the positions of the frames whose outlines are compared."""
    return np.unique(np.linspace(0, frames - 1, min(frames, MASKS_PER_WINDOW)).round().astype(int))


def outline_errors(
    shown: Float[np.ndarray, "M H W"],
    mask: np.ndarray,
    has_mask: np.ndarray,
    program: Program,
) -> Float[np.ndarray, "M 3"]:
    """Return Σẽ², Σ(ẽ filtered to twice the width)², and the length of the outline in pixels, of each mask."""
    sigma, rows = program.raster.blur.filter_sd_px, []
    for silhouette_px, t in zip(shown, shown_frames(len(has_mask)).tolist(), strict=True):
        if has_mask[t]:
            unknown = mask[t] == UNKNOWN
            rows.append(outline_error(silhouette_px, (mask[t] != 0) & ~unknown, unknown, sigma))
    return np.array(rows).reshape(-1, 3)


def outline_error(
    shown: Float[np.ndarray, "H W"], mask: np.ndarray, unknown: np.ndarray, sigma: float
) -> tuple[float, float, float]:
    """Return Σẽ², Σ(ẽ filtered to twice the width)², and the length of the outline in pixels, of one mask.

    Args:
        shown: the filtered silhouette.
        mask, unknown: the pixels of the mask, and those without information.
        sigma: width of the filter of the silhouette, in pixels.
    """
    known = np.ones(mask.shape, bool)
    if unknown.any():
        known = scipy.ndimage.gaussian_filter(unknown.astype(np.float32), sigma, mode="constant") < 0.01
    error = np.where(known, shown - scipy.ndimage.gaussian_filter(mask.astype(np.float32), sigma, mode="constant"), 0)
    wider = scipy.ndimage.gaussian_filter(error, np.sqrt(3) * sigma, mode="constant")
    length = (np.hypot(*np.gradient(shown)) * known).sum()
    return float((error**2).sum()), float((wider**2).sum()), float(length)


def outline_correlation_px(ratio: float, sigma: float) -> float:
    """Return the correlation length τ of the displacement of an outline, from the ratio r; 0 for r ≤ ¼."""
    q = min(4 * min(ratio, LARGEST_RATIO) ** 2, 1.0)  # (τ² + 2σ²)/(τ² + 8σ²)
    return float(np.sqrt(max((8 * q - 2) * sigma**2 / (1 - q), 0.0)))


def independent_errors(outlines: Float[np.ndarray, "M 3"], sigma: float) -> tuple[float, float]:
    """Return the mean number N of independent errors of a mask, and the mean over masks of Σẽ²/N.

    Args:
        outlines: `outline_error` of some masks.
        sigma: width of the filter, in pixels of the silhouette.
    """
    squared, wider, length = outlines[(outlines[:, 0] > 0) & (outlines[:, 2] > 0)].T
    if not len(squared):
        return 0.0, 0.0
    tau = outline_correlation_px(float(np.median(wider / squared)), sigma)
    count = length / np.sqrt(2 * np.pi * (tau**2 + 2 * sigma**2))
    return float(count.mean()), float((squared / count).mean())
