"""Statistics of the errors of detected keypoints: the parameters of `keypoint_likelihood`, and further properties."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from jaxfit.data.keypoint_names import opposite_keypoints
from jaxfit.evaluation.labelled_pairs import LabelledPairs
from jaxfit.objective.likelihood import keypoint_sd_px

__all__ = [
    "OUTLIER_SCALES",
    "KeypointNoise",
    "exchanged_pairs",
    "fit_student_t",
    "frame_correlation",
    "keypoint_factors",
    "outlier_share",
    "scaled_errors",
]

LEAST_SD_PX, MOST_SD_PX = 0.1, 128.0
"""Limits of the scales, in crop pixels."""
LEAST_DOF, MOST_DOF = 1.0, 30.0
"""Limits of the degrees of freedom; above 30 the density hardly differs from a normal density."""
PRIOR_SD = 2.0
"""Standard deviation of the weak prior on the logarithm of every parameter, about the values of the config."""
OUTLIER_SCALES = 4.0
"""An error of more than this number of scales is an outlier."""
EXCHANGE_RATIO = 2.0
"""A pair is exchanged if the RMS error of the exchanged assignment is smaller by more than this factor."""
LEAST_CORRELATION_PAIRS = 30
"""Fewest pairs of errors for a correlation."""


class KeypointNoise(NamedTuple):
    """Parameters of the Student t density of keypoint errors, in crop pixels."""

    sd_sure_px: float
    """Scale at confidence 1."""
    sd_unsure_px: float
    """Scale at confidence 0."""
    dof: float
    """Degrees of freedom."""


def fit_student_t(
    error_px: Float[np.ndarray, "M 2"],
    confidence: Float[np.ndarray, "M"],
    prior: KeypointNoise,
    weight: Float[np.ndarray, "M"] | None = None,
    start: KeypointNoise | None = None,
) -> KeypointNoise:
    """Maximise the likelihood of errors e at confidences c under the density of `keypoint_likelihood`.

    Σ −log(2π s²) − (ν + 2)/2 · log(1 + ‖e‖²/(ν s²)),  s = s₁^c · s₀^(1−c)

    A normal prior on the logarithms of s₁, s₀ and ν, with the standard deviation `PRIOR_SD` about `prior`, decides
    only what the data leave open, for example s₀ where all confidences are near 1.

    Args:
        error_px: detected minus labelled position, crop pixels.
        confidence: of the detections, in (0, 1].
        prior: centre of the prior.
        weight: number of times that each error counts; None for 1.
        start: initial values; None for the centre of the prior.

    Source: Lange, Little and Taylor 1989, *Robust Statistical Modeling Using the t Distribution*.
    """
    squared = (error_px**2).sum(-1)
    weight = np.ones(len(squared)) if weight is None else weight
    limits = np.array([(LEAST_SD_PX, MOST_SD_PX)] * 2 + [(LEAST_DOF, MOST_DOF)])
    centre, first = (np.log(np.clip(values, *limits.T)) for values in (prior, start or prior))

    def loss(logs: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the negative log-density of errors and prior, and its gradient."""
        sure, unsure, dof = np.exp(logs)
        scale = keypoint_sd_px(confidence, sure, unsure)
        ratio = squared / (dof * scale**2)
        value = weight @ (2 * np.log(scale) + (dof + 2) / 2 * np.log1p(ratio))
        by_log_scale = weight * (2 - (dof + 2) * ratio / (1 + ratio))
        by_log_dof = weight @ (dof / 2 * np.log1p(ratio) - (dof + 2) / 2 * ratio / (1 + ratio))
        gradient = np.array([by_log_scale @ confidence, by_log_scale @ (1 - confidence), by_log_dof])
        off = (logs - centre) / PRIOR_SD
        return value + off @ off / 2, gradient + off / PRIOR_SD

    found = minimize(loss, first, jac=True, method="L-BFGS-B", bounds=np.log(limits))
    return KeypointNoise(*np.exp(found.x).tolist())


def scaled_errors(pairs: LabelledPairs, noise: KeypointNoise) -> Float[np.ndarray, "P K 2"]:
    """Return the errors divided by their scale; NaN where there is no error."""
    scale = keypoint_sd_px(pairs.confidence, noise.sd_sure_px, noise.sd_unsure_px)
    return (pairs.detected_px - pairs.labelled_px) / scale[..., None]


def outlier_share(scaled: Float[np.ndarray, "P K 2"]) -> float:
    """Return the share of errors of more than `OUTLIER_SCALES` scales."""
    size = np.linalg.norm(scaled, axis=-1)
    return float((size[np.isfinite(size)] > OUTLIER_SCALES).mean())


def keypoint_factors(scaled: Float[np.ndarray, "P K 2"], dof: float, names: tuple[str, ...]) -> Mapping[str, float]:
    """Return, for every keypoint with an error, the factor by which its scale differs from the scale of all keypoints.

    The factor maximises the likelihood at the same degrees of freedom, by the iteration of Lange et al. 1989:
    f² ← mean(w ‖e/s‖²)/2 with w = (ν + 2)/(ν + ‖e/s‖²/f²).
    """
    squared = (scaled**2).sum(-1)
    known = np.isfinite(squared).any(0)
    squared = squared[:, known]
    factor2 = np.nanmedian(squared, 0) + 1e-12
    for _ in range(100):
        factor2 = np.nanmean((dof + 2) / (dof + squared / factor2) * squared, 0) / 2 + 1e-12
    return dict(zip(np.array(names, object)[known].tolist(), np.sqrt(factor2).tolist(), strict=True))


def frame_correlation(pairs: LabelledPairs, scaled: Float[np.ndarray, "P K 2"], lag: int) -> float | None:
    """Return the correlation of the errors of one keypoint of one bird in two frames; None where it is not measured.

    Outliers do not count: few large errors would decide alone.

    Args:
        pairs: the pairs of birds.
        scaled: the result of `scaled_errors`.
        lag: difference of the frame numbers.

    Returns:
        Σ e(t)·e(t + lag) / √(Σ ‖e(t)‖² Σ ‖e(t + lag)‖²), or None for fewer than `LEAST_CORRELATION_PAIRS` errors.
    """
    place = {(bird, frame): p for p, (bird, frame) in enumerate(zip(*_keys(pairs), strict=True))}
    both = [(p, place[bird, frame + lag]) for (bird, frame), p in place.items() if (bird, frame + lag) in place]
    if not both:
        return None
    inside = np.linalg.norm(scaled, axis=-1) <= OUTLIER_SCALES  # False for NaN
    first, second = np.array(both).T
    kept = inside[first] & inside[second]
    if kept.sum() < LEAST_CORRELATION_PAIRS:
        return None
    a, b = scaled[first][kept], scaled[second][kept]
    return float((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum()))


def exchanged_pairs(pairs: LabelledPairs) -> tuple[int, int]:
    """Return the number of exchanged left and right keypoints, and of all pairs with both keypoints.

    A pair is exchanged if its RMS error is more than `EXCHANGE_RATIO` times the RMS error after an exchange.
    """
    opposite = opposite_keypoints(pairs.keypoint_names)
    sides = np.array([(k, other) for k, other in enumerate(opposite) if other > k], int).reshape(-1, 2)
    detected, labelled = pairs.detected_px[:, sides], pairs.labelled_px[:, sides]
    own, exchanged = (((detected - points) ** 2).sum((-1, -2)) for points in (labelled, labelled[:, :, ::-1]))
    known = np.isfinite(own)
    return int((exchanged[known] * EXCHANGE_RATIO**2 < own[known]).sum()), int(known.sum())


def _keys(pairs: LabelledPairs) -> tuple[Any, Any]:
    return pairs.bird.tolist(), pairs.frame_index.tolist()
