"""Decoding of heatmaps and SimCC vectors into positions and confidences."""

from __future__ import annotations

import numpy as np
import scipy.special
from jaxtyping import Bool, Float, Int

__all__ = ["apply_activation", "heatmap_peaks", "simcc_peaks", "subcell_offsets"]

_FLOOR = 1e-6  # lower bound before the logarithm


def apply_activation(
    values: Float[np.ndarray, "N K *B"], activation: str
) -> tuple[Float[np.ndarray, "N K *B"], Bool[np.ndarray, "N K"]]:
    """Apply the activation that turns the network's output into confidences.

    Args:
        values: one map or one vector for each keypoint.
        activation: one of `ACTIVATIONS`; the softmax runs over a whole map.

    Returns:
        The confidences, and whether all values of a keypoint are finite. If not, its confidences are those of zeros.
    """
    axes = tuple(range(2, values.ndim))
    finite = np.asarray(np.isfinite(values).all(axis=axes))
    values = np.where(np.expand_dims(finite, axes), values, 0)
    if activation == "sigmoid":
        values = scipy.special.expit(values)
    elif activation == "softmax":
        values = scipy.special.softmax(values, axis=axes)
    return values, finite


def heatmap_peaks(heatmaps: Float[np.ndarray, "N K h w"]) -> tuple[Int[np.ndarray, "N K 2"], Float[np.ndarray, "N K"]]:
    """Return the cells (x, y) of the largest values, and the largest values."""
    flat = heatmaps.reshape(*heatmaps.shape[:2], -1)
    best = flat.argmax(axis=-1)
    y, x = np.divmod(best, heatmaps.shape[-1])
    return np.stack([x, y], -1), np.take_along_axis(flat, best[..., None], -1)[..., 0]


def subcell_offsets(
    heatmaps: Float[np.ndarray, "N K h w"], cells: Int[np.ndarray, "N K 2"]
) -> Float[np.ndarray, "N K 2"]:
    """Estimate the offset (x, y), in cells, from the centre of the largest cell to the peak of the heatmap.

    The offset is −H⁻¹ ∇, with the gradient ∇ and the Hessian H of ln(heatmap) from central differences at the cell. It
    is exact for a Gaussian of any width and direction. It is 0 where H is not that of a peak, is 0 across the border
    for a cell at the border, and is at most one cell.

    Source: Zhang et al. 2020 (DARK), equations 7 and 8, without the smoothing.
    """
    N, K, h, w = heatmaps.shape
    rows = _mirror(cells[..., 1, None] + np.arange(-1, 2), h)[..., :, None]
    columns = _mirror(cells[..., 0, None] + np.arange(-1, 2), w)[..., None, :]
    n, k = np.arange(N)[:, None, None, None], np.arange(K)[:, None, None]
    around = heatmaps[n, k, rows, columns].astype(np.float64)  # (N, K, 3, 3)
    log = np.log(np.maximum(around, _FLOOR))
    x = (log[..., 1, 2] - log[..., 1, 0]) / 2
    y = (log[..., 2, 1] - log[..., 0, 1]) / 2
    xx = log[..., 1, 2] - 2 * log[..., 1, 1] + log[..., 1, 0]
    yy = log[..., 2, 1] - 2 * log[..., 1, 1] + log[..., 0, 1]
    xy = (log[..., 2, 2] - log[..., 2, 0] - log[..., 0, 2] + log[..., 0, 0]) / 4
    determinant = xx * yy - xy**2
    is_peak = (xx < 0) & (determinant > 1e-9)
    scale = np.where(is_peak, -1 / np.where(is_peak, determinant, 1), 0)
    offsets = np.stack([yy * x - xy * y, xx * y - xy * x], -1) * scale[..., None]
    return np.clip(offsets, -1, 1)


def simcc_peaks(
    simcc_x: Float[np.ndarray, "N K X"], simcc_y: Float[np.ndarray, "N K Y"]
) -> tuple[Int[np.ndarray, "N K 2"], Float[np.ndarray, "N K"]]:
    """Return the bins (x, y) of the largest values, and the smaller of the two values.

    Source: `get_simcc_maximum` of MMPose 1.
    """
    bins = np.stack([simcc_x.argmax(axis=-1), simcc_y.argmax(axis=-1)], -1)
    return bins, np.minimum(simcc_x.max(axis=-1), simcc_y.max(axis=-1))


def _mirror(index: Int[np.ndarray, "*B"], length: int) -> Int[np.ndarray, "*B"]:
    """Mirror indices at the border (−1 → 1, length → length − 2), so that the slope across the border is 0."""
    return np.clip((length - 1) - np.abs((length - 1) - np.abs(index)), 0, length - 1)
