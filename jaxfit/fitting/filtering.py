"""Smoothing of detected keypoints over time, before the fit."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

__all__ = ["weighted_median_filter"]


def weighted_median_filter(
    keypoints_px: Float[Array | np.ndarray, "T K 2"],
    confidence: Float[Array | np.ndarray, "T K"],
    window: int = 5,
) -> Float[Array, "T K 2"]:
    """Return the weighted median of each keypoint over a window of frames, separately for x and y.

    Let x_1 ≤ x_2 ≤ … be the sorted values of the window, and c_1, c_2, … their confidences. The filtered value is x_k
    with the smallest k for which c_1 + … + c_k ≥ ½ Σ c.

    The window is centred on the frame and is shorter at both ends of the array. A missing keypoint has confidence 0
    and does not contribute. Its filtered value is the median of its neighbours, but the caller keeps its confidence
    of 0, so the keypoint does not become a detection. If a keypoint is missing in all frames of the window, its input
    is returned.

    Args:
        keypoints_px: x, y in image pixels; any value where the confidence is 0.
        confidence: weight of each keypoint, 0 or more.
        window: number of consecutive frames, odd.

    Returns:
        Filtered x, y in image pixels.

    Raises:
        ValueError: `window` is not odd and positive.

    Source: Hägerlind et al. 2024, the filter over detected keypoints.
    """
    if window < 1 or window % 2 == 0:
        raise ValueError(f"window must be odd and positive, not {window}")
    keypoints_px, confidence = jnp.asarray(keypoints_px), jnp.asarray(confidence)
    T = keypoints_px.shape[0]
    neighbours = jnp.arange(T)[:, None] + jnp.arange(window) - window // 2
    inside = (neighbours >= 0) & (neighbours < T)
    neighbours = jnp.clip(neighbours, 0, T - 1)
    values = keypoints_px[neighbours]  # (T, window, K, 2)
    weights = jnp.where(inside[:, :, None], confidence[neighbours], 0)[..., None]

    order = jnp.argsort(values, axis=1)
    values = jnp.take_along_axis(values, order, axis=1)
    weights = jnp.take_along_axis(jnp.broadcast_to(weights, values.shape), order, axis=1)
    cumulative = jnp.cumsum(weights, axis=1)
    total = cumulative[:, -1:]
    # a sum of exactly half must pass in spite of rounding errors
    half = total * (0.5 - 4 * jnp.finfo(total.dtype).eps)
    first = jnp.argmax(cumulative >= half, axis=1, keepdims=True)
    median = jnp.take_along_axis(values, first, axis=1)[:, 0]
    return jnp.where(total[:, 0] > 0, median, keypoints_px)
