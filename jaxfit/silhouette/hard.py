"""Hard masks: the pixels whose centre a mesh covers."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxfit.silhouette.operator import silhouette
from jaxfit.silhouette.reference import Blur

SHARP = Blur(sigma=1e-6, radius=1e-3)  # far below a pixel: the soft silhouette is 0 or 1 at every pixel's centre
_covered = eqx.filter_jit(lambda vertices, faces, size: silhouette(vertices, faces, size, blur=SHARP) > 0.5)


def hard_mask(
    vertices_screen: Float[np.ndarray, "V 3"], faces, width: int, height: int
) -> Bool[np.ndarray, "{height} {width}"]:
    """The mask of a mesh in an image.

    Args:
        vertices_screen: x and y in image pixels, and the depth in the camera frame in any unit.
        faces: (F, 3) vertex indices.
        width: of the image, pixels.
        height: of the image, pixels.
    """
    full = np.zeros((height, width), bool)
    xy = np.clip(np.asarray(vertices_screen)[:, :2], -1, [width + 1, height + 1])
    low = np.maximum(np.floor(xy.min(0)).astype(int), 0)
    high = np.minimum(np.ceil(xy.max(0)).astype(int), [width, height])
    columns, rows = high - low
    if columns <= 0 or rows <= 0:
        return full
    size = int(64 * np.ceil(max(rows, columns) / 64))  # few sizes: each is a program of its own
    shifted = np.asarray(vertices_screen, np.float32) - np.array([*low, 0], np.float32)
    covered = np.asarray(_covered(shifted, faces, size))
    full[low[1] : high[1], low[0] : high[0]] = covered[:rows, :columns]
    return full
