"""Bodies: bone lengths and shape of each bird from windows of its whole track.

A stage with `share_body` optimises bone lengths and shape in every window, with the priors of the model. For a window,
let A be the marginal precision of these numbers b (the poses integrated out, `fitting/posterior.py`), P the precision
of the prior with the mean μ, and m the optimum. The data of the window then say

    I = A − P,   s = (A − Q)·(m − μ),

information and score about b − μ. Q is the precision of the broad prior, which A and P contain, and the optimum does
not. The score is s = I·(b − μ) plus noise, with the covariance N = f·I/κ + M of parts that the fit does not assume:

- Errors that are larger than the config says: f is the misfit factor of the track (`fitting/error_bars.py`).
- Errors that agree between frames. A keypoint that lies 1 % too low in one frame lies too low in the next frame. A body
  that all frames share takes up such errors, and free bones then make the poses worse. So n frames count as n_eff = κ·n
  frames only, with

      1/n_eff = Σ_k n·r̄_k² / Σ_k n·(mean of r_k²),

  the share of the mean over the track in the squared errors r of the keypoints, summed over keypoints. For independent
  errors, n_eff is the number of frames; for errors that do not change, n_eff is 1. Errors longer than `LONGEST` times
  the median length of a window are shortened to this length.
- A posture that lasts. The pose prior counts the frames of a window as independent draws, but a bird hardly changes its
  posture. M = U·Uᵀ, U = A·V, with the deviation V of `sandwich.constant_deviation` for the body.

The windows of a track are added, and the body is the mean of

    b − μ ~ N(Σ·ΣI·N⁻¹s, Σ),   Σ = (P + ΣI·N⁻¹·I)⁻¹.

Left and right bones differ by about 1 % (`ASYMMETRY_SD`), whatever the prior of the model says about them.

Tracks of one species, such as photographs, may have similar bodies (`share_body: species`). With the covariance C of
the prior, the body of a species differs from μ by m ~ N(0, (1 − d)·C), and a bird from its species by N(0, d·C), with
one share d for bones and one for shape. The bodies are the means of their joint posterior, and d has the largest
marginal likelihood on a grid. So d = 1 if birds of one species differ as much as any birds, and the bodies then do not
depend on each other; d is near 0 if all tracks have one body. A track alone has the prior N(0, C) for every d.

Keypoints of a detector lie beside those of the model (`keypoint_offsets`), and its masks are too large or too small:
these offsets are further shape coefficients of the fit, of which one moves the mesh along its normals and no keypoint,
and the others move no vertex. So I and s are about bodies and offsets. All tracks have the same offsets, with a
prior whose width has the largest marginal likelihood on a grid. For the offsets, a share of the posture that lasts is
common to all tracks (`COMMON_POSTURE`): s = I·x + U·v + noise, with one v for all tracks.

A second fit with fixed bodies follows, so that no window has a body of its own: the poses of a window would otherwise
fit a body that the other windows contradict.

Source: Kish 1965, *Survey Sampling* (n_eff, the design effect of clusters); Palmer and Strobeck 1986, *Fluctuating
asymmetry: measurement, analysis, patterns* (differences between left and right of about 1 %); Efron and Morris 1975,
*Data analysis using Stein's estimator and its generalizations* (a variance that is learnt from the groups). The rest is
ours.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple, cast

import jax
import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxfit.config.fit import FitConfig
from jaxfit.data.solution import Solution
from jaxfit.fitting.error_bars import window_misfits
from jaxfit.fitting.keypoint_offsets import longest_distance, offset_directions
from jaxfit.fitting.posterior import BROAD_BONE_SD, BROAD_SHAPE_SD, window_posteriors
from jaxfit.fitting.problem import Problem, Program
from jaxfit.fitting.sandwich import constant_deviation
from jaxfit.fitting.solve import FitModel, needs_mask, shared_parameters
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose
from jaxfit.objective.posed_window import Priors

_logger = logging.getLogger(__name__)

ASYMMETRY_SD = 0.01
"""Standard deviation of the difference between a left and a right bone, relative to their length."""
LONGEST = 3.0
"""Largest length of an error, in units of the median of its window: outliers do not decide n_eff."""

BODY_FRAMES = 800
"""Most frames, of all windows together, that the body of a track is estimated from. Because errors agree between
frames, the 1,500 frames of a measured film are worth 3 to 20 (n_eff), so further windows change little
(docs/method/bodies.md)."""

COMMON_POSTURE = 0.5
"""Share of the variance of a lasting posture that all birds of a film have in common, for the offsets of keypoints:
birds of one film do the same in the same place, and nothing says how much."""
DIFFERENT, MIN_VARIANCE = 1e-4, 1e-3
"""Two halves of a track disagree where one body explains their difference with a smaller probability. Directions whose
difference has a smaller variance, in units of the prior, do not count."""

WIDTHS = 0.1, 0.2, 0.4, 0.7, 1.0, 2.0
"""Grid of the width of the prior of the offsets, in units of `keypoint_offsets.PRIOR_SHARE`."""

SHARES = 0.01, 0.03, 0.1, 0.2, 0.4, 0.7, 1.0
"""Grid of the shares d."""


class BodyEvidence(NamedTuple):
    """What a window says about the body of its bird, P numbers; NumPy arrays. A batch adds a leading axis B."""

    mean: Float[np.ndarray, "*B P"]
    """m: the optimised bone lengths and shape coefficients."""
    precision: Float[np.ndarray, "*B P P"]
    """A; NaN for a window without a posterior."""
    posture: Float[np.ndarray, "*B P D"]
    """U: change of the score by a posture that differs from the mean of the prior in the whole window, in units of the
    prior."""
    error_sum: Float[np.ndarray, "*B K 2"]
    """Sum over the frames of the errors of each keypoint, crop pixels, shortened."""
    error_squares: Float[np.ndarray, "*B K"]
    """Sum of their squared lengths."""
    errors: Float[np.ndarray, "*B K"]
    """Their number."""
    misfit: Float[np.ndarray, "*B"]
    """Misfit factor of the keypoint errors (`fitting/error_bars.py`)."""


class Body(NamedTuple):
    """The bone lengths and the shape of one bird."""

    bone_length: Float[np.ndarray, "bones"]
    """Relative to the rest skeleton."""
    betas: Float[np.ndarray, "S"]
    offsets: Float[np.ndarray, "D"]
    """Of the outlines of masks, model units, and of the keypoints, along `keypoint_offsets.offset_directions`; equal
    for all birds. D is 0 for fixed offsets."""
    covariance: Float[np.ndarray, "P P"]
    """Σ of the numbers that the stage optimises: bone lengths, shape coefficients, offsets."""
    frames: float
    """n_eff: the number of independent frames that the data of the track are worth."""
    determined: float
    """Number of determined numbers, P − tr(Σ·P₀) with the precision P₀ of the prior: 0 if the body is the prior's."""
    keypoint_scale: float = 1.0
    """Scale of the keypoint errors of the track, as a multiple of the scale in the config."""
    agree: bool = True
    """Whether the first and the second half of the windows agree about the body; they disagree for two birds."""


def stages_of_pass(config: FitConfig, has_bodies: bool, tells_body: bool = True) -> range:
    """Return the positions of the stages before the bodies are known, or with given bodies.

    Args:
        config: the config.
        has_bodies: whether the bodies are known.
        tells_body: whether the bodies are estimated from the windows. If not, the first pass only finds poses to begin
            with: the stages that share the body or compare masks, and those between, are left out.
    """
    shared = config.body_stage
    if shared is None:
        return range(len(config.stages))
    if has_bodies:
        return range(shared + 1, len(config.stages))
    if tells_body:
        return range(shared + 1)
    return range(next(i for i, stage in enumerate(config.stages) if i == shared or needs_mask(stage)))


def windows_of_bodies(track: Int[np.ndarray, "W"], config: FitConfig) -> Bool[np.ndarray, "W"]:
    """Return the windows that the bodies are estimated from: of each track, evenly spaced windows of at most
    `BODY_FRAMES` frames in all, and two at least. If all of them diverge, the body is that of the model.

    Args:
        track: the position of the track of each window; windows of a track are in the order of time.
        config: the config.
    """
    most = max(BODY_FRAMES // config.window, 2)  # two windows show whether they are of one bird
    others = stages_of_pass(config, has_bodies=False, tells_body=False)
    left_out = config.stages[len(others) : len(stages_of_pass(config, has_bodies=False))]
    # all windows run all stages where the others would have no stage, or where a stage chooses their hypothesis
    chosen = np.full(len(track), not others or not left_out or any(stage.keep_best for stage in left_out))
    for n in np.unique(track):
        rows = np.flatnonzero(track == n)
        chosen[rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int)]] = True
    return chosen


def _body_numbers(config: FitConfig) -> tuple[str, ...]:
    """Return the parameters of a body that the config estimates, in their order; none without `share_body`."""
    return () if config.body_stage is None else shared_parameters(config.stages[config.body_stage])


def body_evidence(program: Program, problems: Problem, pose: Pose) -> tuple[list[BodyEvidence], list[str]]:
    """Return what each of B windows says about its body, and the reason why it says nothing; empty without a reason.

    Args:
        program: the program of the stage that shares the body.
        problems: B problems.
        pose: their optima.
    """
    found, reasons = [], []
    posteriors = window_posteriors(program, problems, pose)
    misfits, fitted_px = window_misfits(program, problems, pose, posteriors)
    problems, pose = jax.tree.map(np.asarray, (problems, pose))
    for b, posterior in enumerate(posteriors):
        values = [np.asarray(getattr(pose, name)[b], np.float64) for name in program.shared]
        mean = np.concatenate(values)
        whitener = np.asarray(program.priors.pose_whitener, np.float64)
        precision, posture = np.full((len(mean), len(mean)), np.nan), np.zeros((len(mean), len(whitener)))
        if not isinstance(posterior, str):
            # the inverse of the block of H⁻¹ integrates the poses and the size out; the body is its last columns
            precision = np.linalg.inv(_last_block(posterior.factors.corner, len(mean)))
            if "pose_prior" in program.terms:
                weight = float(problems.hyperparameters.settings["pose_prior"]["weight"][b])
                present = np.asarray(problems.targets.present[b], bool)
                _, shared = constant_deviation(posterior, whitener, 3, weight, present)
                posture = precision @ shared[len(shared) - len(mean) :]
        targets = problems.targets
        seen = np.asarray(targets.confidence[b] > 0) & np.asarray(targets.present[b])[:, None]
        on = np.asarray(problems.hyperparameters.keypoints_on[b])
        seen &= np.tile(on > 0, seen.shape[1] // len(on))  # of all views
        error = np.where(seen[..., None], fitted_px[b] - np.asarray(targets.keypoints_px[b]), 0)
        length = np.linalg.norm(error, axis=-1)
        longest = LONGEST * np.median(length[seen]) if seen.any() else 0.0
        error = error * np.minimum(1, longest / np.maximum(length, 1e-9))[..., None]
        counts = error.sum(0), (error**2).sum((0, 2)), seen.sum(0).astype(float)
        found.append(BodyEvidence(mean, precision, posture, *counts, misfits[b]))
        reasons.append(posterior if isinstance(posterior, str) else "")
    return found, reasons


def _last_block(matrix: Float[np.ndarray, "n n"], size: int) -> Float[np.ndarray, "size size"]:
    """Return the block of the last rows and columns; their number may be 0."""
    first = len(matrix) - size
    return matrix[first:, first:]


def estimate_bodies(
    track: Int[np.ndarray, "W"],
    evidence: Sequence[BodyEvidence | None],
    model: FitModel,
    config: FitConfig,
    species: Int[np.ndarray, "N"] | None = None,
) -> dict[int, Body]:
    """Return the body of each track.

    Args:
        track: the position of the track of each window.
        evidence: of each window; None for a window that failed or was not asked.
        model: the model of the fit.
        config: the config, whose shared stage has the weights of the priors.
        species: number of the species of each track; None for one species.
    """
    bird, names = model.bird, _body_numbers(config)
    mean, precision, broad = _prior(model.priors, config)
    offsets = model.rig.of_detector
    P, common_posture = len(mean), COMMON_POSTURE if offsets else 0.0
    postures = 3 * (bird.num_joints - 1) if offsets else 0
    # the numbers of a body, the offsets, and the posture that all birds have in common
    of_numbers = _symmetric(precision, bird) if "bone_length" in names else precision
    prior = np.asarray(scipy.linalg.block_diag(of_numbers, np.eye(postures)))
    usable = [w for w, each in enumerate(evidence) if each is not None and np.isfinite(each.precision).all()]

    def of_data(own: Sequence[BodyEvidence], misfit: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Return ΣGᵀN⁻¹G and ΣGᵀN⁻¹s of some windows, with G = [I, U], and n_eff."""
        frames = sum(each.errors.max(initial=0) for each in own)
        counted = min(1 / max(_common_share(own), 1e-9), frames) if own else 0.0
        kappa, information, score = counted / max(frames, 1.0), np.zeros_like(prior), np.zeros(len(prior))
        for each in own if kappa else ():
            # rounding and ridges may leave slightly negative directions, which say nothing
            values, vectors = np.linalg.eigh((each.precision + each.precision.T) / 2 - precision)
            own_information = (vectors * np.maximum(values, 0)) @ vectors.T
            # the noise of the score; the small part of the prior keeps directions without data finite
            posture = (1 - common_posture) * each.posture @ each.posture.T
            noise = own_information * misfit / kappa + posture + 1e-9 * precision
            G = np.concatenate([own_information, common_posture**0.5 * each.posture[:, :postures]], axis=1)
            gain = np.linalg.solve(noise, G).T
            information += gain @ G
            score += gain @ (each.precision - broad) @ (each.mean - mean)
        return (information + information.T) / 2, score, counted

    def alone(own: Sequence[BodyEvidence], misfit: float) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and covariance of a body and of the offsets, from some windows of one track."""
        information, score, _ = of_data(own, misfit)
        covariance = np.linalg.inv(prior + information)
        return (covariance @ score)[:P], covariance[:P, :P]

    tracks = np.unique(track)
    own = [[cast(BodyEvidence, evidence[w]) for w in usable if track[w] == n] for n in tracks]
    misfits = [float(np.median([each.misfit for each in windows])) if windows else 1.0 for windows in own]
    information, score, counted = zip(*map(of_data, own, misfits), strict=True)
    is_bone = np.arange(P - offsets) < ("bone_length" in names) * (bird.num_joints - 1)
    group = None
    if config.stages[cast(int, config.body_stage)].share_body == "species":
        group = np.zeros(len(tracks), int) if species is None else species[tracks]
    found = _of_tracks(np.stack(information), np.stack(score), group, prior, is_bone, offsets)
    if offsets:
        outline, *along = found[0][0][P - offsets : P]
        shift, length = np.tensordot(along, offset_directions(bird), axes=1), longest_distance(bird)
        share = np.sqrt((shift**2).sum(1).mean()) / length
        _logger.info("the keypoints lie %.1f %% of the length of the bird beside those of the model (RMS)", 100 * share)
        _logger.info(
            "the outlines of masks lie %.1f %% of the length of the bird outside the mesh", 100 * outline / length
        )
    bodies = {}
    of_model = np.asarray(bird.bone_mean, np.float32), np.zeros(bird.num_shapes, np.float32)
    for i, (n, (change, covariance)) in enumerate(zip(tracks.tolist(), found, strict=True)):
        at, numbers = slice(P - offsets), mean + change[:P]
        determined = P - offsets - float(np.trace(covariance[at, at] @ prior[at, at]))
        halves = own[i][: len(own[i]) // 2], own[i][len(own[i]) // 2 :]
        first, second = (alone(half, misfits[i]) for half in halves)
        agree = not halves[0] or _agree(first, second, prior[:P, :P])
        scale = misfits[i] ** 0.5 if "keypoint_likelihood" in config.learn_weights else 1.0
        parts = *_split(numbers[at], names, *of_model), numbers[P - offsets :].astype(np.float32)
        bodies[n] = Body(*parts, covariance[:P, :P], counted[i], determined, scale, agree)
    return bodies


def _of_tracks(
    information: Float[np.ndarray, "N Q Q"],
    score: Float[np.ndarray, "N Q"],
    species: Int[np.ndarray, "N"] | None,
    prior: Float[np.ndarray, "Q Q"],
    is_bone: Bool[np.ndarray, "P"],
    offsets: int,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return mean and covariance of x of each track: the difference of its body from the model, P numbers, and then c,
    numbers that all tracks have in common.

    Args:
        information, score: what the data of each track say about x: −½xᵀGx + hᵀx.
        species: of each track; None for bodies that do not depend on each other.
        prior: precision of x.
        is_bone: which numbers of a body are bone lengths; the others are shape coefficients.
        offsets: how many of the first numbers of c are offsets, whose prior has the most likely width of `WIDTHS`.
    """
    b, c = slice(len(is_bone)), slice(len(is_bone), None)
    # in units of the prior of a body, C = I
    unit = np.linalg.inv(np.linalg.cholesky(prior[b, b]))
    G, h, B = unit @ information[:, b, b] @ unit.T, score[:, b] @ unit.T, unit @ information[:, b, c]
    members = [np.arange(len(score))] if species is None else [species == each for each in np.unique(species)]
    one = np.eye(len(is_bone))

    def joint(shares: tuple[float, float], width: float) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the marginal log-likelihood of the shares and the width, and means and covariances of all tracks."""
        prior_c = prior[c, c].copy()
        prior_c[range(offsets), range(offsets)] /= width**2
        d = np.where(is_bone, *shares)
        # given m and c, x has the mean V·(h − B·c) + K·m and the covariance V; the data say −½mᵀGK·m + (Kᵀ(h − B·c))ᵀm
        K = np.linalg.inv(one + d[:, None] * G)
        V, GK, Kt = K * d, G @ K, K.swapaxes(1, 2)
        Kh, KB = np.einsum("nab,nb->na", Kt, h), Kt @ B
        likelihood = np.einsum("na,nab,nb->", h, V, h) + np.linalg.slogdet(K)[1].sum()
        mean, covariance, slope = np.einsum("nab,nb->na", V, h), V.copy(), -V @ B
        of_c, right_c = prior_c + information[:, c, c].sum(0), score[:, c].sum(0)
        of_c += (B.swapaxes(1, 2) @ slope).sum(0)
        right_c -= np.einsum("nac,na->c", B, mean)
        for some in members:
            precision = one + (1 - d)[:, None] * GK[some].sum(0)
            S, right, by_c = np.linalg.inv(precision) * (1 - d), Kh[some].sum(0), KB[some].sum(0)
            likelihood += right @ S @ right - np.linalg.slogdet(precision)[1]
            mean[some] += K[some] @ (S @ right)
            covariance[some] += K[some] @ S @ Kt[some]
            slope[some] -= K[some] @ (S @ by_c)
            of_c -= by_c.T @ S @ by_c
            right_c -= by_c.T @ S @ right
        covariance_c = np.linalg.inv(of_c)
        mean_c, cross = covariance_c @ right_c, slope @ covariance_c
        likelihood += right_c @ mean_c - np.linalg.slogdet(of_c)[1] + np.linalg.slogdet(prior_c)[1]
        every = len(score)
        mean = np.concatenate([mean + slope @ mean_c, np.tile(mean_c, (every, 1))], axis=1)
        below = np.concatenate([cross.swapaxes(1, 2), np.tile(covariance_c, (every, 1, 1))], axis=2)
        covariance = np.concatenate([covariance + cross @ slope.swapaxes(1, 2), cross], axis=2)
        return likelihood / 2, mean, np.concatenate([covariance, below], axis=1)

    all_shares = [(1.0, 1.0)] if species is None else product(SHARES, SHARES)
    shares, width = max(product(all_shares, WIDTHS if offsets else [1.0]), key=lambda each: joint(*each)[0])
    if species is not None:
        text = "birds of one species differ by %.0f %% of the variance of the prior in bones, and by %.0f %% in shape"
        _logger.info(text, *(100 * share for share in shares))
    _, mean, covariance = joint(shares, width)
    whole = scipy.linalg.block_diag(unit, np.eye(len(prior) - len(unit)))
    covariance = whole.T @ covariance @ whole
    return list(zip(mean @ whole, (covariance + covariance.swapaxes(1, 2)) / 2, strict=True))


def _agree(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray], prior: Float[np.ndarray, "P P"]) -> bool:
    """Return whether two means of one body, each from data of its own, differ by no more than their errors explain.

    With m₁, m₂ the means, S₁, S₂ the covariances and P the precision of the prior, m₁ − m₂ has the covariance
    S₁ + S₂ − S₁PS₂ − S₂PS₁ for one body, since Cov(mᵢ) = P⁻¹ − Sᵢ and Cov(m₁, m₂) = (P⁻¹ − S₁)P(P⁻¹ − S₂).
    """
    (m1, S1), (m2, S2) = a, b
    both = S1 @ prior @ S2
    # in units of the prior, so that directions without data, which do not differ, are recognised
    root = np.linalg.cholesky(prior)
    values, vectors = np.linalg.eigh(root.T @ (S1 + S2 - both - both.T) @ root)
    known = values > MIN_VARIANCE
    squared = ((vectors.T @ root.T @ (m1 - m2))[known] ** 2 / values[known]).sum()
    return bool(scipy.special.chdtrc(max(int(known.sum()), 1), squared) >= DIFFERENT)


def _prior(priors: Priors, config: FitConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean and precision of the prior of the numbers of a body, and the part of the broad prior.

    The posterior of a window contains the broad prior (`posterior.broad_precision`), but the fit does not.
    """
    settings = config.stage_settings(config.stages[stages_of_pass(config, has_bodies=False)[-1]])
    whitener, shape_sd = (np.asarray(each, np.float64) for each in (priors.bone_whitener, priors.shape_sd))
    # a term w·‖W(b − μ)‖² in nats has the precision 2w·WᵀW
    of = {
        "bone_length": (priors.bone_mean, "bone_prior", whitener.T @ whitener, BROAD_BONE_SD),
        "betas": (np.zeros(len(shape_sd)), "shape_prior", np.diag(shape_sd**-2), BROAD_SHAPE_SD),
    }
    means, blocks, broad_blocks = [], [], []
    for name in _body_numbers(config):
        mean, term, precision, broad_sd = of[name]
        means.append(np.asarray(mean, np.float64))
        weight = settings.get(term, {}).get("weight", 0.0)
        broad_blocks.append(broad_sd**-2 * np.eye(len(precision)))
        blocks.append(2 * weight * precision + broad_blocks[-1])
    return (
        np.concatenate(means),
        np.asarray(scipy.linalg.block_diag(*blocks)),
        np.asarray(scipy.linalg.block_diag(*broad_blocks)),
    )


def _symmetric(precision: Float[np.ndarray, "P P"], bird: Bird) -> Float[np.ndarray, "P P"]:
    """Return the precision of a prior, bones first, with the small differences between left and right bones."""
    result = precision.copy()
    for pair in bird.bone_pairs:
        difference = np.zeros(len(precision))
        difference[list(pair)] = 1, -1
        result += np.outer(difference, difference) / ASYMMETRY_SD**2
    return result


def _split(
    numbers: Float[np.ndarray, "P"], names: Sequence[str], bone_length: np.ndarray, betas: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the bone lengths and the shape coefficients among the numbers of a body, float32.

    Args:
        numbers: the numbers of a body.
        names: the parameters that the body has.
        bone_length, betas: values in place of a parameter that the body does not have.
    """
    if "bone_length" in names:
        bone_length, numbers = numbers[: len(bone_length)], numbers[len(bone_length) :]
    return np.asarray(bone_length, np.float32), np.asarray(numbers if "betas" in names else betas, np.float32)


def _common_share(evidence: Sequence[BodyEvidence]) -> float:
    """Return 1/n_eff: the share of the squared errors of the keypoints that all frames of a track have in common."""
    errors = sum(each.errors for each in evidence)
    mean = sum(each.error_sum for each in evidence) / np.maximum(errors, 1)[:, None]
    total = sum(float(each.error_squares.sum()) for each in evidence)
    return float((errors * (mean**2).sum(-1)).sum()) / total if total > 0 else 1.0


def with_bodies(
    solution: Solution, bodies: Mapping[int, Body], bird: Bird, config: FitConfig, source: object
) -> Solution:
    """Return a solution with the bodies of its tracks, by their positions; report tracks whose halves disagree."""
    birds, failures = len(solution.track_id), dict(solution.failures)
    for n in (n for n, body in bodies.items() if not body.agree):
        track = int(solution.track_id[n])
        text = "the first and the second half have different bodies, as of two birds: look for a switch"
        failures[track] = (*failures.get(track, ()), text)
        _logger.warning("%s: track %d: %s", source, track, text)
    bones, shapes = bird.num_joints - 1, bird.num_shapes
    sizes = {"bone_length": bones, "bone_length_sd": bones, "betas": shapes, "betas_sd": shapes}
    arrays: dict[str, np.ndarray] = {name: np.full((birds, size), np.nan, np.float32) for name, size in sizes.items()}
    directions = offset_directions(bird)
    arrays["keypoint_offsets"] = np.full((birds, bird.num_keypoints, 3), np.nan, np.float32)
    of_track = "frames", "determined", "keypoint_scale", "outline_offset"
    arrays |= {name: np.full(birds, np.nan, np.float32) for name in of_track}
    for n, body in bodies.items():
        arrays["bone_length"][n], arrays["betas"][n, : len(body.betas)] = body.bone_length, body.betas
        arrays["betas"][n, len(body.betas) :] = 0  # for a fit without shape coefficients
        for name in ("frames", "determined", "keypoint_scale"):
            arrays[name][n] = getattr(body, name)
        outline, *along = body.offsets if len(body.offsets) else np.zeros(1 + len(directions))
        arrays["outline_offset"][n], arrays["keypoint_offsets"][n] = outline, np.tensordot(along, directions, axes=1)
        sd = np.sqrt(np.diagonal(body.covariance))[: len(body.covariance) - len(body.offsets)]
        sd = _split(sd, _body_numbers(config), np.zeros(bones), np.zeros(shapes))
        arrays["bone_length_sd"][n], arrays["betas_sd"][n] = sd
    return solution.with_arrays(**{f"body_{name}": array for name, array in arrays.items()}, failures=failures)


def bodies_of(solution: Solution, bird: Bird, config: FitConfig) -> dict[int, Body]:
    """Return track id → body of a result; empty for a result without bodies.

    The covariances of a result are diagonal: it holds standard deviations.
    """
    known, names, found = solution.bodies, _body_numbers(config), {}
    if known is None or not names:
        return {}
    directions = offset_directions(bird) if config.learns_offsets else np.zeros((0, bird.num_keypoints, 3))
    of_directions = directions.reshape(len(directions), 3 * bird.num_keypoints).T
    for n in np.flatnonzero(np.isfinite(known.frames)).tolist():
        along = np.linalg.lstsq(of_directions, known.keypoint_offsets[n].ravel())[0]
        offsets = np.array([known.outline_offset[n], *along]) if config.learns_offsets else np.zeros(0)
        sd = np.concatenate([getattr(known, f"{name}_sd")[n] for name in names] + [np.zeros(len(offsets))])
        found[int(solution.track_id[n])] = Body(
            known.bone_length[n],
            known.betas[n],
            offsets.astype(np.float32),
            np.diag(sd.astype(np.float64) ** 2),
            float(known.frames[n]),
            float(known.determined[n]),
            float(known.keypoint_scale[n]),
        )
    return found


def known_rows(bodies: Mapping[int, Body] | None, track_id: Int[np.ndarray, "N"]) -> dict[int, Body]:
    """Return position of a track → its known body, from track id → body; other ids do not matter."""
    ids = track_id.tolist()
    return {ids.index(track): body for track, body in (bodies or {}).items() if track in ids}
