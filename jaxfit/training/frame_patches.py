"""Random patches of simulated frames, for the training samples of both networks."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfit.training.labelled_frames import LabelledFrames

__all__ = ["patch_around", "random_rotation"]


def random_rotation(
    rng: np.random.Generator, factor: float, max_degrees: float
) -> tuple[Float[np.ndarray, "2 2"], bool]:
    """Draw a rotation times `factor`, mirrored with probability 1/2; return the matrix and whether it mirrors."""
    angle = np.radians(rng.uniform(-max_degrees, max_degrees))
    matrix = factor * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    mirrored = bool(rng.random() < 0.5)
    if mirrored:
        matrix[:, 0] *= -1
    return matrix, mirrored


def patch_around(
    frames: LabelledFrames, s: int, centre_px: Float[np.ndarray, "2"], reach_px: float, factor: float
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"], Int[np.ndarray, "2"]]:
    """Cut a square patch out of a frame, clipped to the frame; the patch may be empty.

    If `factor` reduces the picture, a Gaussian blur first removes the detail that would alias.

    Args:
        frames: the frames.
        s: index of the frame.
        centre_px: centre of the patch, pixels of the frame.
        reach_px: half the side of the patch, pixels of the frame.
        factor: scale of the later resampling.

    Returns:
        Picture, bird of each pixel, and x, y of the upper left corner in the frame.
    """
    low = np.maximum(np.floor(centre_px - reach_px), 0).astype(int)
    high = np.maximum(np.ceil(centre_px + reach_px), 0).astype(int)
    part = slice(low[1], high[1]), slice(low[0], high[0])
    picture, owner = np.ascontiguousarray(frames.pictures[s][part]), np.ascontiguousarray(frames.owner[s][part])
    if factor < 1 and picture.size:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.45 * np.sqrt(1 / factor**2 - 0.75)), np.uint8)
    return picture, owner, low
