"""Fractal noise for textures: periodic tiles that are sampled at any scale."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

__all__ = ["Noise", "smoothstep"]

TILE = 1024


def smoothstep(low: float, high: float, values: np.ndarray) -> np.ndarray:
    """Map values to 0 below `low`, 1 above `high`, and smoothly in between; `low` may exceed `high`."""
    x = np.clip((values - low) / (high - low), 0, 1)
    return x * x * (3 - 2 * x)


class Noise:
    """A periodic tile of fractal noise, with mean 0 and standard deviation 1.

    Args:
        rng: source of randomness.
        octaves: number of octaves; each has twice as many cells as the previous octave.
        gain: amplitude of an octave relative to the previous octave.
        coarsest: number of cells of the first octave along a side, a power of two.
    """

    def __init__(self, rng: np.random.Generator, octaves: int = 8, gain: float = 0.55, coarsest: int = 4):
        tile = np.zeros((TILE, TILE), np.float32)
        for octave in range(octaves):
            cells = coarsest * 2**octave
            knots = rng.normal(size=(cells, cells)).astype(np.float32)
            padded = np.pad(knots, 4, mode="wrap")
            zoom = TILE // cells
            fine = cv2.resize(padded, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
            tile += gain**octave * fine[4 * zoom : 4 * zoom + TILE, 4 * zoom : 4 * zoom + TILE]
        self.tile = (tile - tile.mean()) / tile.std()

    def __call__(self, u: np.ndarray, v: np.ndarray, period: float) -> Float[np.ndarray, "*B"]:
        """Sample the noise at coordinates (u, v); the tile has the side `period`."""
        rows = -(-u.size // TILE)  # cv2.remap needs a two-dimensional picture
        x, y = (np.resize(np.asarray(c, np.float32) * np.float32(TILE / period) % TILE, (rows, TILE)) for c in (u, v))
        values = cv2.remap(self.tile, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return values.reshape(-1)[: u.size].reshape(u.shape)
