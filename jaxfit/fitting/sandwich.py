"""The covariance of a fit whose prior and noise model are wrong in time: H⁻¹ with two additions.

The error of a fit is e = H⁻¹(g + P·x) to first order, with the curvature H, the gradient g of the noise of the data,
the precision P of the assumed prior and the true deviation x of the pose from the mean of the prior. For noise with the
covariance B and deviations with the covariance S, the error has the covariance H⁻¹(B + P·S·P)H⁻¹ (the sandwich). If all
assumptions hold, B is the curvature of the data and S = P⁻¹, and the sandwich is H⁻¹. In windows, two do not hold.

Prior: the pose prior with the weight w and the covariance Σ₀ counts n frames as n independent draws, each with the
precision p = 2w·Σ₀⁻¹. But it was learnt from single poses, and the pose of a bird hardly changes within a window.
Motion terms are 0 for a constant pose v: P(1 ⊗ v) = 1 ⊗ p·v. So the assumed prior gives the mean pose of the window the
covariance p⁻¹/n, where that of a single pose, p⁻¹, is right. A constant deviation with the missing covariance
C = (1 − 1/n)·p⁻¹ makes up for this:

    S = P⁻¹ + (1 ⊗ I)·C·(1 ⊗ I)ᵀ,   H⁻¹P·S·P·H⁻¹ = H⁻¹P·H⁻¹ + V·Vᵀ,   V = H⁻¹(1 ⊗ p·C^½).

A single frame keeps H⁻¹. The motion of a pose about its mean over the window stays that of the assumed prior.

Noise: errors of keypoints that agree between frames average less. The fit of a frame averages the keypoints of some
frames. If its errors, for independent noise, have the correlation κ between consecutive frames, then noise with the
correlation ρₖ at lag k makes their variance greater by the factor f = 1 + 2·Σ ρₖκᵏ (for κ = 1 the integrated
autocorrelation time of the mean of a long window). The noise of the keypoints, with the curvature D, adds
(f − 1)·H⁻¹D·H⁻¹.

Source: White 1982, *Maximum likelihood estimation of misspecified models*; Sokal 1997, *Monte Carlo methods in
statistical mechanics* (integrated autocorrelation time); the constant deviation and κ: ours.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.fitting.posterior import Blocks, Posterior, invert_blocks, solve_blocks

STEP = 1e-4
"""Step of the difference of two inverses, which is its relative error for B = H."""
MIN_PAIRS = 100
"""Number of pairs of residuals that a correlation needs: its standard deviation is at most 0.1."""


def data_blocks(J: Float[np.ndarray, "T K 2 P"], precision: Float[np.ndarray, "T K"], own: int) -> Blocks:
    """Return the curvature D = Σ precision·JᵀJ of the keypoints.

    Args:
        J: derivatives of the projected keypoints by the parameters of the frame, followed by the shared parameters.
        precision: of x and y of every keypoint, 1/pixel²; 0 for keypoints that do not count.
        own: number of parameters of a frame.
    """
    # a keypoint depends on its own frame only: no block links two frames, and the band beside the diagonal is 0
    T, P = len(J), J.shape[-1]
    rows = (np.sqrt(precision)[..., None, None] * J).reshape(T, -1, P)
    full = rows.swapaxes(1, 2) @ rows
    band = np.zeros((3, T, own, own))
    band[0] = full[:, :own, :own]
    return Blocks(band, full[:, :own, own:], full[:, own:, own:].sum(axis=0))


def spread(H: Blocks, covariance: Float[np.ndarray, "T P P"], B: Blocks) -> Float[np.ndarray, "T P P"]:
    """Return H⁻¹B·H⁻¹ for the P = L + C parameters of each frame.

    H⁻¹B·H⁻¹ is minus the derivative of (H + ε·B)⁻¹ at ε = 0, so a second selected inverse gives its blocks.

    Args:
        H: a positive definite matrix.
        covariance: the blocks of H⁻¹, as `Blocks.of_frames`.
        B: a positive semi-definite matrix, not much greater than H.
    """
    # d/dε (H + εB)⁻¹ = −H⁻¹B·H⁻¹ at ε = 0; the difference quotient costs one more selected inverse and no dense product
    more = Blocks(*(h + STEP * b for h, b in zip(H, B, strict=True)))
    return (covariance - invert_blocks(more).of_frames()) / STEP


def constant_deviation(
    window: Posterior,
    whitener: Float[np.ndarray, "D D"],
    first: int,
    weight: float,
    present: Bool[np.ndarray, "T"],
) -> tuple[Float[np.ndarray, "T L D"], Float[np.ndarray, "C D"]]:
    """Return V, for the parameters of the frames and for the shared ones: a deviation from the prior in the whole
    window adds V·Vᵀ to the covariance.

    Args:
        window: the posterior.
        whitener: W of the pose prior, Σ₀⁻¹ = WᵀW.
        first: position of the first of the D parameters of the prior in the columns of a frame.
        weight: w of the pose prior.
        present: the frames that the prior counts.
    """
    (T, _, C), at = window.precision.border.shape, window.columns.own
    inside = (at >= first) & (at < first + len(whitener))
    missing = 1 - 1 / max(int(present.sum()), 1)  # C = (1 − 1/n)·p⁻¹: a single frame misses nothing
    pull = np.zeros((T, len(at), len(whitener)))
    if missing <= 0 or weight <= 0 or not inside.any():
        return pull, np.zeros((C, len(whitener)))
    # p·C^½ in every frame: p = 2w·WᵀW has the square root √(2w)·Wᵀ, and C = missing·p⁻¹, so p·C^½ = √(2w·missing)·Wᵀ
    pull[:, inside] = np.sqrt(2 * weight * missing) * whitener.T[at[inside] - first]
    pull *= present[:, None, None]
    # V = H⁻¹(1 ⊗ p·C^½): one right-hand side for each parameter of the prior
    return solve_blocks(window.factors, pull, np.zeros((C, len(whitener))))


def lag_correlations(residuals: Float[np.ndarray, "T K 2"], counted: Bool[np.ndarray, "T K"]) -> np.ndarray:
    """Return the correlations ρ₁, ρ₂, … of residuals in time, pooled over keypoints, before the first that is not > 0.

    They are those of Gaussians whose signs agree as often as those of the residuals, so outliers and the scale of a
    residual have no effect. Means are not subtracted: an offset that lasts for the whole window is an error, too.

    Source: Sheppard 1899, *On the application of the theory of error to cases of normal distribution* (signs).
    """
    sign, found = np.sign(residuals) * counted[..., None], []
    for lag in range(1, len(sign)):
        pairs = 2 * int((counted[lag:] & counted[:-lag]).sum())
        if pairs < MIN_PAIRS:
            break
        # Sheppard: the signs of Gaussians with correlation ρ have the mean product (2/π)·arcsin ρ
        correlation = np.sin(np.pi / 2 * (sign[lag:] * sign[:-lag]).sum() / pairs)
        if correlation <= 0:  # the sum of noisy correlations at long lags would have no limit
            break
        found.append(correlation)
    return np.array(found)


def fit_correlation(J: Float[np.ndarray, "T K 2 P"], covariance: Blocks, present: Bool[np.ndarray, "T"]) -> float:
    """Return κ: the correlation of the errors of the projected keypoints between consecutive frames; 0 without pairs.

    Args:
        J: as for `data_blocks`.
        covariance: the blocks of H⁻¹.
        present: the frames that count.
    """
    own, pairs = J[..., : covariance.band.shape[-1]], present[1:] & present[:-1]
    if not pairs.any():
        return 0.0
    T, _, _, L = own.shape
    rows = own.reshape(T, -1, L)
    # covariances of the projected keypoints: tr(J_t·Σ_tt·J_tᵀ) of one frame, tr(J_t·Σ_t,t+1·J_t+1ᵀ) of neighbours
    variance = np.sum((rows @ covariance.band[0]) * rows, axis=(1, 2))
    shared = np.sum((rows[:-1] @ covariance.band[1, :-1]) * rows[1:], axis=(1, 2))[pairs].sum()
    return float(np.clip(shared / np.sqrt(variance[1:][pairs].sum() * variance[:-1][pairs].sum()), 0, 1))


def time_factor(correlations: np.ndarray, kappa: float) -> float:
    """Return f = 1 + 2·Σ ρₖκᵏ."""
    return float(1 + 2 * np.sum(correlations * kappa ** np.arange(1, len(correlations) + 1)))
