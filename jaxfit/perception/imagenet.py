"""Mean and standard deviation of ImageNet's colours, with which many networks normalise their input."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = ["IMAGENET_MEAN", "IMAGENET_STD", "normalise"]

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
"""Red, green, blue within [0, 1]."""


def normalise(rgb: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Subtract ImageNet's mean from a red-green-blue picture within [0, 1], and divide by the standard deviation."""
    return (rgb - np.array(IMAGENET_MEAN, np.float32)) / np.array(IMAGENET_STD, np.float32)
