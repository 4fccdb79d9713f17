"""Measure the time of the soft silhouette, of the renderer and of a fit."""

from __future__ import annotations

import dataclasses
import math
import resource
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfit.config.fit import FitConfig
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.metrics import distances, mean_error, procrustes_align
from jaxfit.fitting.fit import fit
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import fold_bird, window_keypoints, window_transforms
from jaxfit.raster import silhouette as raster
from jaxfit.raster import zbuffer
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect

NOISE_PX, OUTLIERS = 2.0, 0.05
"""Standard deviation of the detected keypoints in pixels, and fraction of outliers."""
REPEATS = 15
CROP_PX, FRAME_PX, BIRD_PX = 256, (2592, 1520), 350
"""Side of a crop, width and height of a full frame, and length of a bird in a full frame, in pixels."""


def bird_like_mesh() -> tuple[np.ndarray, np.ndarray]:
    """Return a body and two wings, each with four overlapping layers of feathers: 5,712 faces, as in the AVES bird.

    Returns:
        Vertices (V, 3) without a unit, with z = 1, and faces (F, 3).
    """
    around, along, layers, span, chord = 24, 26, 4, 31, 9
    angle = np.linspace(0, 2 * math.pi, around, endpoint=False)
    axis = np.linspace(-1, 1, along + 1)
    radius = 0.085 * np.sqrt(np.clip(1 - axis**2, 1e-3, None))
    body = np.stack([0.5 + radius[:, None] * np.cos(angle), 0.5 + 0.32 * axis[:, None] + 0.03 * np.sin(angle)], -1)
    parts, faces, count = [body.reshape(-1, 2)], [_grid_faces(along, around, wrap=True)], body.size // 2
    s, c = np.meshgrid(np.linspace(0, 1, span + 1), np.linspace(-0.5, 0.5, chord + 1), indexing="ij")
    for side in (-1, 1):
        for layer in range(layers):
            x = 0.5 + side * (0.05 + 0.27 * s)
            y = 0.45 + 0.16 * s**2 + c * 0.2 * (1 - 0.75 * s**2) + 0.008 * layer + 0.004 * np.sin(7 * s + layer)
            parts.append(np.stack([x, y], -1).reshape(-1, 2))
            faces.append(_grid_faces(span, chord, wrap=False) + count)
            count += x.size
    xy = np.concatenate(parts)
    return np.concatenate([xy, np.ones((len(xy), 1))], 1).astype(np.float32), np.concatenate(faces).astype(np.int32)


def _grid_faces(rows: int, columns: int, wrap: bool) -> np.ndarray:
    """Return two triangles for each of rows × columns quads. With `wrap` the last column joins the first column."""
    width = columns if wrap else columns + 1
    r, c = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a, b = r * width + c, r * width + (c + 1) % width
    return np.stack([a, b, a + width, a + width, b, b + width], -1).reshape(-1, 3)


def _view(vertices: Float[np.ndarray, "V 3"], longest_px: float, depth: float) -> np.ndarray:
    """Return the mesh seen along its shortest side, in pixels: x and y around 0, and a depth."""
    low, high = vertices.min(0), vertices.max(0)
    order = np.argsort(low - high, kind="stable")[[1, 0, 2]]
    centred = (vertices - (low + high) / 2)[:, order] * (longest_px / (high - low).max())
    return (centred + np.array([0, 0, depth])).astype(np.float32)


def _jittered(vertices: Float[np.ndarray, "V 3"], frames: int) -> Float[np.ndarray, "T V 3"]:
    """Return crops of a mesh with small random rotations, scales and shifts about their centre."""
    rng = np.random.default_rng(0)
    angle, scale = rng.normal(0, 0.1, frames), 1 + rng.normal(0, 0.03, frames)
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], -1).reshape(-1, 2, 2)
    xy = vertices[:, :2] @ (turn * scale[:, None, None]) + CROP_PX / 2 + rng.normal(0, 2, (frames, 1, 2))
    return np.concatenate([xy, np.broadcast_to(vertices[:, 2:], (frames, len(vertices), 1))], -1).astype(np.float32)


def median_seconds(run: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the median time of one run in seconds. A first run, which may compile, is not counted."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def bench_silhouette(frames: int = 100) -> dict[str, float]:
    """Measure mask loss and vertex gradient of a batch of crops, and the error of the gradient of the first crop.

    The matrix product is measured directly after the crops, on the same cores. The plain JAX reference takes about ten
    seconds.
    """
    vertices, faces = bird_like_mesh()
    screen = _view(vertices, 0.7 * CROP_PX, 1.0)
    batch, faces = jnp.asarray(_jittered(screen, frames)), jnp.asarray(faces)
    centred = jnp.asarray(screen + np.array([CROP_PX / 2, CROP_PX / 2, 0], np.float32))
    target = raster.silhouette(centred, faces, CROP_PX) > 0.5

    def loss(v, f, backend: raster.Backend = "auto"):
        return raster.mask_loss(v, f, target, backend=backend)

    with_gradient = jax.jit(jax.vmap(jax.value_and_grad(loss), in_axes=(0, None)))
    ms = 1e3 * median_seconds(lambda: with_gradient(batch, faces)) / frames
    matmul, a = jax.jit(lambda a: a @ a), jax.random.normal(jax.random.key(0), (1024, 1024))
    matmul_ms = 1e3 * median_seconds(lambda: matmul(a))
    gradient, expected = (jax.jit(jax.grad(lambda v, b=b: loss(v, faces, b)))(batch[0]) for b in ("auto", "reference"))
    error = float(jnp.linalg.norm(gradient - expected) / jnp.linalg.norm(expected))
    return {"ms_per_frame": ms, "matmul_ratio": ms / matmul_ms, "gradient_error": error}


def bench_render(crops: int = 100, birds: int = 9) -> dict[str, float]:
    """Measure the renderer in milliseconds: a crop, also anti-aliased, and birds in a full frame and the mask of one.

    The bird is about 180 pixels long in a crop; in a full frame each bird is 350 pixels long and has half the faces.
    """
    vertices, faces = bird_like_mesh()
    colours = np.random.default_rng(0).random((len(vertices), 3)).astype(np.float32)
    batch = _jittered(_view(vertices, 0.7 * CROP_PX, 1e4), crops)
    zbuffer_s = median_seconds(lambda: zbuffer.zbuffer(batch, faces, CROP_PX, CROP_PX))
    interpolate_s = median_seconds(lambda: zbuffer.interpolate(batch, faces, colours, CROP_PX, CROP_PX))
    width, height = FRAME_PX
    columns = int(np.ceil(np.sqrt(birds)))
    x, y = (np.arange(birds) % columns + 0.5) / columns, (np.arange(birds) // columns + 0.5) / columns
    places = np.stack([width * x, height * y, np.zeros(birds)], 1)[:, None].astype(np.float32)
    flock = (_view(vertices, BIRD_PX, 1e4) + places).reshape(-1, 3)
    flock_faces = np.concatenate([faces[::2] + i * len(vertices) for i in range(birds)])
    flock_colours, frame = np.tile(colours, (birds, 1)), np.full((height, width, 3), 128, np.uint8)
    frame_s = median_seconds(lambda: zbuffer.draw(frame, flock, flock_faces, flock_colours))
    mask_s = median_seconds(lambda: zbuffer.hard_mask(flock[: len(vertices)], faces, width, height))
    return {
        "crop_ms": 1e3 * zbuffer_s / crops,
        "interpolated_crop_ms": 1e3 * interpolate_s / crops,
        "full_frame_ms": 1e3 * frame_s,
        "mask_ms": 1e3 * mask_s,
    }


def bench_fit(
    bird: Bird, config: FitConfig, birds: int, frames: int = 100, seed: int = 0, progress: ProgressTask = silent
) -> dict[str, Any]:
    """Measure the time and the errors of a fit of a simulated scene.

    The scene has smooth random motion, keypoints with 2 px of noise and 5 % outliers, and complete masks. A first fit
    with one step per stage compiles the programs (or loads them from the cache of an earlier run). The second fit is
    measured.

    Returns:
        `minutes` (duration of the second fit), `compile_s` (duration of the first fit), `peak_memory_gb` of the
        process, and the errors against the truth: `me_p`, `me_v`, `pa_mpjpe` (keypoints, model units).
    """
    poses = [smooth_motion(bird, frames, seed + n) for n in range(birds)]
    observations = detect(bird, poses, NOISE_PX, OUTLIERS, seed)
    short = dataclasses.replace(config, stages=tuple(dataclasses.replace(stage, steps=1) for stage in config.stages))
    start = time.perf_counter()
    fit(observations, bird, short)
    compiled = time.perf_counter()
    solution = fit(observations, bird, config, progress=progress)
    seconds = time.perf_counter() - compiled
    quality = evaluate(solution, bird, detect(bird, poses)).overall
    rig, points_cam = fold_bird(bird), solution.keypoints.cam
    true_cam = np.stack([window_keypoints(rig, window_transforms(rig, pose), pose) for pose in poses])
    unit = 1e9 if sys.platform == "darwin" else 1e6  # ru_maxrss is in bytes on macOS, and in kilobytes on Linux
    return {
        "minutes": seconds / 60,
        "compile_s": compiled - start,
        "peak_memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit,
        "me_p": quality["me_p"],
        "me_v": quality["me_v"],
        "pa_mpjpe": mean_error(distances(procrustes_align(points_cam, true_cam), true_cam)),
    }
