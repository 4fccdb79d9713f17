"""The z-buffer in NumPy, one face at a time. The compiled kernel computes the same bits.

A face covers a sample p if its three edge functions s·((a − p) × (b − p)) are at least 0, where s is the sign of the
area of the face. Two faces that share an edge compute the same number with opposite signs, so every sample on a shared
edge is covered. In float64 these products are exact for all float32 pixel coordinates below a few thousand.
"""

import numpy as np
from jaxtyping import Float, Float32, Int, Int32, UInt8

NEAR_DEPTH = 1e-3  # a face with a vertex at this depth or less is skipped


def raster(
    vertices: Float32[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], width: int, height: int, samples: int
) -> tuple[Int32[np.ndarray, "R C"], Float[np.ndarray, "R C 3"], Float[np.ndarray, "R C"]]:
    """Return the nearest face of every sample, with samples² samples per pixel.

    Returns:
        Index of the face, its barycentrics, and 1/depth. Without a face they are −1, 0 and −1.
    """
    rows, columns = height * samples, width * samples
    face = np.full((rows, columns), -1, np.int32)
    barycentric = np.zeros((rows, columns, 3))
    nearness = np.full((rows, columns), -1.0)
    finite = np.isfinite(vertices).all(-1)
    drawn = (finite & (vertices[:, 2] > NEAR_DEPTH))[faces].all(-1)
    for index in np.flatnonzero(drawn):
        corners = vertices[faces[index]].astype(np.float64)
        x, y, inverse_depth = corners[:, 0] * samples, corners[:, 1] * samples, 1 / corners[:, 2]
        area = (x[1] - x[0]) * (y[2] - y[0]) - (y[1] - y[0]) * (x[2] - x[0])
        left, right = max(np.ceil(x.min() - 0.5), 0), min(np.floor(x.max() - 0.5), columns - 1)
        top, bottom = max(np.ceil(y.min() - 0.5), 0), min(np.floor(y.max() - 0.5), rows - 1)
        if area == 0 or left > right or top > bottom:
            continue
        box = slice(int(top), int(bottom) + 1), slice(int(left), int(right) + 1)
        dx = x[:, None, None] - (np.arange(left, right + 1) + 0.5)
        dy = (y[:, None, None] - (np.arange(top, bottom + 1) + 0.5)[:, None]) * np.sign(area)
        edge = np.stack([dx[(i + 1) % 3] * dy[(i + 2) % 3] - dy[(i + 1) % 3] * dx[(i + 2) % 3] for i in range(3)])
        weight = edge * (inverse_depth / abs(area))[:, None, None]
        total = (weight[0] + weight[1]) + weight[2]
        near = np.clip(total, inverse_depth.min(), inverse_depth.max())
        # Rounding makes the depths equal where faces meet or coincide. Then the first face keeps the sample.
        better = (edge >= 0).all(0) & (near.astype(np.float32) > nearness[box].astype(np.float32))
        weight[0, total == 0], total[total == 0] = 1, 1  # rounded to 0: a corner is far outside
        face[box][better] = index
        nearness[box][better] = near[better]
        barycentric[box][better] = np.moveaxis(weight * (1 / total), 0, -1)[better]
    return face, barycentric, nearness


def fragments(vertices: Float32[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], width: int, height: int):
    """Return face, barycentrics and depth of one image. See `jaxfit.raster.zbuffer.zbuffer`."""
    face, barycentric, nearness = raster(vertices, faces, width, height, 1)
    depth = np.where(face >= 0, 1 / nearness, np.inf)
    return face, barycentric.astype(np.float32), depth.astype(np.float32)


def mask_overlap(
    vertices: Float32[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    width: int,
    height: int,
    runs: Int[np.ndarray, "R 2"],
) -> tuple[Int[np.ndarray, "4"], int, Int[np.ndarray, "R"]]:
    """Return box, area and overlap of the mask of one image. See `jaxfit.raster.zbuffer.mask_overlap`."""
    mask = raster(vertices, faces, width, height, 1)[0] >= 0
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    before = np.append(0, np.cumsum(mask.T))  # the number of covered pixels before each pixel
    box = [columns[0], rows[0], np.ptp(columns) + 1, np.ptp(rows) + 1] if len(rows) else [0] * 4
    return np.array(box), before[-1], before[runs[:, 1]] - before[runs[:, 0]]


def interpolate(
    vertices: Float32[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    attributes: Float32[np.ndarray, "V C"],
    width: int,
    height: int,
    samples: int,
) -> tuple[Float[np.ndarray, "H W C"], Float[np.ndarray, "H W"], Int32[np.ndarray, "H W"]]:
    """Return values, coverage and face of one image. See `jaxfit.raster.zbuffer.interpolate`."""
    face, barycentric, nearness = raster(vertices, faces, width, height, samples)
    seen = face >= 0
    values = np.zeros((*face.shape, attributes.shape[-1]))
    values[seen] = np.einsum("nk,nkc->nc", barycentric[seen], attributes[faces[face[seen]]].astype(np.float64))
    values, seen, face, nearness = (_by_pixel(a, samples) for a in (values, seen, face, nearness))
    nearest = nearness.astype(np.float32).argmax(-1)[..., None]
    return values.mean(2), seen.mean(2), np.take_along_axis(face, nearest, -1)[..., 0]


def draw(
    image: UInt8[np.ndarray, "H W 3"],
    vertices: Float32[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    colours: Float32[np.ndarray, "V 3"],
    samples: int,
) -> None:
    """Draw over the image in place. See `jaxfit.raster.zbuffer.draw`."""
    values, coverage, _ = interpolate(vertices, faces, colours, image.shape[1], image.shape[0], samples)
    touched = coverage > 0
    mixed = (1 - coverage[touched, None]) * image[touched] + 255 * values[touched]
    # Rounding to float32 first removes the rounding errors of the sums, so that exact halves always round up.
    image[touched] = np.clip(mixed.astype(np.float32) + np.float32(0.5), 0, 255).astype(np.uint8)


def _by_pixel(samples_of: np.ndarray, samples: int) -> np.ndarray:
    """Reshape (H·s, W·s, …) to (H, W, s², …)."""
    rows, columns = samples_of.shape[:2]
    split = samples_of.reshape(rows // samples, samples, columns // samples, samples, *samples_of.shape[2:])
    return np.moveaxis(split, 2, 1).reshape(rows // samples, columns // samples, samples**2, *samples_of.shape[2:])
