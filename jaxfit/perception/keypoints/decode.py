"""Positions and confidences out of heatmaps and coordinate classes."""

from __future__ import annotations

import numpy as np
import scipy.special
from jaxtyping import Bool, Float, Int

__all__ = ["activated", "heatmap_peaks", "simcc_peaks", "subcell_offsets"]

_FLOOR = 1e-6  # what a logarithm takes for nothing


def activated(
    values: Float[np.ndarray, "N K *B"], activation: str
) -> tuple[Float[np.ndarray, "N K *B"], Bool[np.ndarray, "N K"]]:
    """The network's output as confidences, and where it holds only numbers; where not, all of it becomes 0.

    Args:
        values: one map, or one row, for each keypoint.
        activation: one of `ACTIVATIONS`; a softmax runs over a whole map.
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
    """Cells (x, y) with the largest values, and these."""
    flat = heatmaps.reshape(*heatmaps.shape[:2], -1)
    best = flat.argmax(axis=-1)
    y, x = np.divmod(best, heatmaps.shape[-1])
    return np.stack([x, y], -1), np.take_along_axis(flat, best[..., None], -1)[..., 0]


def subcell_offsets(
    heatmaps: Float[np.ndarray, "N K h w"], cells: Int[np.ndarray, "N K 2"]
) -> Float[np.ndarray, "N K 2"]:
    """How far (x, y), in cells, a heatmap's peak lies from the centre of its largest cell.

    The peak of the quadric that the central differences of ln(heatmap) about the cell describe: −H⁻¹ ∇, exact for
    a Gaussian of any width and direction. 0 where they describe no peak, and across the border in a cell at it;
    at most one cell.

    Source: Zhang et al. 2020 (DARK), equations 7 and 8, without their smoothing.
    """
    N, K, h, w = heatmaps.shape
    rows = _mirrored(cells[..., 1, None] + np.arange(-1, 2), h)[..., :, None]
    columns = _mirrored(cells[..., 0, None] + np.arange(-1, 2), w)[..., None, :]
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
    """Bins (x, y) with the largest values, and the smaller of the two values.

    Source: `get_simcc_maximum` of MMPose 1.
    """
    bins = np.stack([simcc_x.argmax(axis=-1), simcc_y.argmax(axis=-1)], -1)
    return bins, np.minimum(simcc_x.max(axis=-1), simcc_y.max(axis=-1))


def _mirrored(index: Int[np.ndarray, "*B"], length: int) -> Int[np.ndarray, "*B"]:
    """−1 → 1 and length → length − 2: what lies across the border has no slope."""
    return np.clip((length - 1) - np.abs((length - 1) - np.abs(index)), 0, length - 1)
