"""Errors of the outline of masks: how many are independent, and how large they are.

Errors of an outline are not independent from pixel to pixel. If the outline is displaced by an error with a Gaussian
correlation of length τ, the filtered mask error ẽ (σ: the width of the filter) has

    N = L/√(2π(τ² + 2σ²)),   r = Σ(ẽ filtered to the width 2σ)²/Σẽ² = ½·√((τ² + 2σ²)/(τ² + 8σ²)),

with the length L of the outline. r gives τ, as a median over masks. The variance Σẽ²/N is a mean over masks: it
contains the outlines that the fit does not reach, so that the weight does not count all outlines as known.

The precision N/Σẽ² makes the mask term know the mean displacement of a piece of the outline as well as the data do: for
a standard deviation s of the displacement, it is √2·σ/(τ·s²).

Source: ours.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter

from jaxfit.fitting.problem import Program
from jaxfit.raster.silhouette_reference import UNKNOWN

MASKS_PER_WINDOW = 25
"""Number of masks of a window whose errors are filtered."""
LARGEST_RATIO = 0.49
"""Largest r, for which τ is 12σ. For a displacement of the whole outline, r is ½."""


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
        known = gaussian_filter(unknown.astype(np.float32), sigma, mode="constant") < 0.01
    error = np.where(known, shown - gaussian_filter(mask.astype(np.float32), sigma, mode="constant"), 0)
    wider = gaussian_filter(error, np.sqrt(3) * sigma, mode="constant")
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
