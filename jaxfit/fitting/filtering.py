"""Smoothing of detected keypoints along time, before the fit sees them."""

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
    """Weighted median of each keypoint over the frames around it, x and y apart.

    With the values of the window sorted, x_1 ≤ x_2 ≤ …, and their confidences c_1, c_2, …, frame t becomes
    x_k with the smallest k for which c_1 + … + c_k ≥ ½ Σ c.

    The window is centred on the frame and cut off at the ends; its frames are neighbours in the array. What
    is missing has confidence 0 and contributes nothing, so a missing keypoint receives its neighbours' median
    while its confidence, which the caller keeps, stays 0: it does not become a detection. Where the whole
    window is missing, the input is returned.

    Args:
        keypoints_px: x, y in image pixels; where the confidence is 0, anything.
        confidence: weight of each keypoint, 0 or more.
        window: number of frames, odd.

    Returns:
        Filtered x, y in image pixels.

    Raises:
        ValueError: ``window`` is not odd and positive.

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
    # a sum that is exactly half must pass whatever the rounding of the sums
    half = total * (0.5 - 4 * jnp.finfo(total.dtype).eps)
    first = jnp.argmax(cumulative >= half, axis=1, keepdims=True)
    median = jnp.take_along_axis(values, first, axis=1)[:, 0]
    return jnp.where(total[:, 0] > 0, median, keypoints_px)
