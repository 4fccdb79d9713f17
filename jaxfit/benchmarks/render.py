"""Benchmark of the renderer: crops of one bird, and full frames with several birds."""

import os

import numpy as np

from jaxfit.benchmarks.silhouette import bird_like_mesh, jittered_frames, median_seconds
from jaxfit.model.bird import Bird
from jaxfit.raster import kernels, zbuffer

CROP_PX, FRAME_PX, BIRD_PX = 256, (2592, 1520), 350
"""Side of a crop, width and height of a full frame, and length of a bird in a full frame, in pixels."""


def _view(vertices: np.ndarray, longest_px: float) -> np.ndarray:
    """Return the mesh seen along its shortest side, in pixels: x and y around 0, depth around 10⁴."""
    low, high = vertices.min(0), vertices.max(0)
    order = np.argsort(low - high, kind="stable")[[1, 0, 2]]
    centred = (vertices - (low + high) / 2)[:, order] * (longest_px / (high - low).max())
    return (centred + np.array([0, 0, 1e4])).astype(np.float32)


def bench_render(bird: Bird | None = None, crops: int = 100, birds: int = 9, repeats: int = 15) -> dict:
    """Measure the time of the renderer on crops (face, barycentrics, depth) and full frames (anti-aliased colours).

    Args:
        bird: a model, rendered at rest along its shortest side. The default is a generated mesh of 5,712 faces.
        crops: number of 256-pixel crops in a batch. The bird is about 180 pixels long and moves slightly.
        birds: number of birds in a frame of 2592×1520 pixels. Each bird is 350 pixels long and has half the faces.
        repeats: number of runs. The results are medians.

    Returns:
        `crops_per_s`, `interpolated_crops_per_s` (three channels, 4 samples per pixel), `mask_ms` (hard mask of a bird
        in a full frame), `full_frames_per_s` and `full_frame_ms` (`draw`, 4 samples per pixel), `faces` of a crop,
        `frame_faces`, `crops`, `birds`, `threads`, `isa` (None if the NumPy reference ran).

    Raises:
        ValueError: a count is not positive.
    """
    for name, value in (("crops", crops), ("birds", birds), ("repeats", repeats)):
        if value < 1:
            raise ValueError(f"{name}: expected at least 1, got {value}")
    if bird is None:
        vertices, faces = bird_like_mesh()
    else:
        vertices, faces = np.asarray(bird.vertices), np.asarray(bird.faces)
    colours = np.random.default_rng(0).random((len(vertices), 3)).astype(np.float32)

    middle = np.array([CROP_PX / 2, CROP_PX / 2, 0], np.float32)
    batch = jittered_frames(_view(vertices, 0.7 * CROP_PX) + middle, crops, CROP_PX)
    zbuffer_s = median_seconds(lambda: zbuffer.zbuffer(batch, faces, CROP_PX, CROP_PX), repeats)
    interpolate_s = median_seconds(lambda: zbuffer.interpolate(batch, faces, colours, CROP_PX, CROP_PX), repeats)

    width, height = FRAME_PX
    columns = int(np.ceil(np.sqrt(birds)))
    x, y = (np.arange(birds) % columns + 0.5) / columns, (np.arange(birds) // columns + 0.5) / columns
    places = np.stack([width * x, height * y, np.zeros(birds)], 1)[:, None].astype(np.float32)
    flock = (_view(vertices, BIRD_PX) + places).reshape(-1, 3)
    flock_faces = np.concatenate([faces[::2] + i * len(vertices) for i in range(birds)])
    flock_colours, frame = np.tile(colours, (birds, 1)), np.full((height, width, 3), 128, np.uint8)
    frame_s = median_seconds(lambda: zbuffer.draw(frame, flock, flock_faces, flock_colours), repeats)
    one = flock[: len(vertices)]
    return {
        "crops_per_s": crops / zbuffer_s,
        "interpolated_crops_per_s": crops / interpolate_s,
        "mask_ms": 1e3 * median_seconds(lambda: zbuffer.hard_mask(one, faces, width, height), repeats),
        "full_frames_per_s": 1 / frame_s,
        "full_frame_ms": 1e3 * frame_s,
        "faces": len(faces),
        "frame_faces": len(flock_faces),
        "crops": crops,
        "birds": birds,
        "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "isa": kernels.current_isa(),
    }
