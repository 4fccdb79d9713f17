"""Parts of simulated frames, as both networks learn from them: turned, mirrored, at another scale."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfit.training.scenes import LabelledFrames

__all__ = ["random_turn", "surroundings"]


def random_turn(rng: np.random.Generator, factor: float, most_degrees: float) -> tuple[Float[np.ndarray, "2 2"], bool]:
    """A random rotation times `factor`, every other time mirrored, and whether it is."""
    angle = np.radians(rng.uniform(-most_degrees, most_degrees))
    turn = factor * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    mirrored = bool(rng.random() < 0.5)
    if mirrored:
        turn[:, 0] *= -1
    return turn, mirrored


def surroundings(
    frames: LabelledFrames, s: int, middle: Float[np.ndarray, "2"], reach: float, factor: float
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"], Int[np.ndarray, "2"]]:
    """A frame's pixels within `reach` of a point: picture and owner, perhaps empty, and where they begin.

    Where `factor` will shrink it, the picture is smoothed to what the smaller one can hold.
    """
    low = np.maximum(np.floor(middle - reach), 0).astype(int)
    high = np.maximum(np.ceil(middle + reach), 0).astype(int)
    part = slice(low[1], high[1]), slice(low[0], high[0])
    picture, owner = np.ascontiguousarray(frames.pictures[s][part]), np.ascontiguousarray(frames.owner[s][part])
    if factor < 1 and picture.size:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.45 * np.sqrt(1 / factor**2 - 0.75)), np.uint8)
    return picture, owner, low
