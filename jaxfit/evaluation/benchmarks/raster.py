"""Benchmarks of the soft silhouette and of the z-buffer renderer."""

import math
import os
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfit.model.bird import Bird
from jaxfit.raster import kernels, zbuffer
from jaxfit.raster import silhouette as raster


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


def fitted_to_image(vertices: Float[np.ndarray, "V 3"], size: int) -> np.ndarray:
    """Return the mesh seen along its shortest side, with its longest side scaled to 0.7 of the image's width.

    Returns:
        Vertices (V, 3): x and y in pixels, depth 1.
    """
    low, high = vertices.min(0), vertices.max(0)
    longest, second = np.argsort(low - high, kind="stable")[:2]
    xy = (vertices - (low + high) / 2)[:, [second, longest]] * (0.7 * size / (high - low)[longest]) + size / 2
    return np.concatenate([xy, np.ones((len(xy), 1))], 1).astype(np.float32)


def jittered_frames(vertices: Float[np.ndarray, "V 3"], frames: int, size: int, seed: int = 0) -> np.ndarray:
    """Return frames with small random rotations, scales and shifts about the image's centre: (frames, V, 3)."""
    rng = np.random.default_rng(seed)
    angle, scale = rng.normal(0, 0.1, frames), 1 + rng.normal(0, 0.03, frames)
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], -1).reshape(-1, 2, 2)
    xy = (vertices[:, :2] - size / 2) @ (turn * scale[:, None, None]) + size / 2 + rng.normal(0, 2, (frames, 1, 2))
    return np.concatenate([xy, np.broadcast_to(vertices[:, 2:], (frames, len(vertices), 1))], -1).astype(np.float32)


def median_seconds(run: Callable[[], object], repeats: int) -> float:
    """Return the median time of one run in seconds. A first run, which may compile, is not counted."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def bench_silhouette(
    frames: int = 100,
    repeats: int = 15,
    size: int = 256,
    vertices: Float[Array | np.ndarray, "V 3"] | None = None,
    faces: Int[Array | np.ndarray, "F 3"] | None = None,
    reference_frames: int = 1,
) -> dict:
    """Measure the time of mask loss and vertex gradient over a batch of frames, and the error of the gradient.

    The default mesh is a generated bird of 5,712 faces. With the AVX-512 kernels it takes 0.9 to 1.0 of the time of the
    AVES bird. The matrix product is measured directly after the frames, on the same cores.

    Args:
        frames: number of images in a batch.
        repeats: number of runs. The results are medians.
        size: width and height of the images in pixels.
        vertices: a mesh in any unit. The frames are jittered views along its shortest side.
        faces: the faces of the mesh.
        reference_frames: number of frames in which the gradient is compared with the plain JAX reference. A frame takes
            about ten seconds. With 0, `gradient_error` is None.

    Returns:
        `ms_per_frame`, `loss_ms_per_frame` (without gradient), `frames`, `faces`, `size`, `threads`, `isa` (None if the
        reference ran), `gradient_error` (norm of the difference over the norm), `matmul_ms` (a 1024³ float32 product),
        `matmul_ratio` (`ms_per_frame` over `matmul_ms`), and `scaling`: rows of `frames`, `faces`, `ms_per_frame`.

    Raises:
        ValueError: only one of vertices and faces is given, or a count is not positive.
    """
    if (vertices is None) != (faces is None):
        raise ValueError("vertices, faces: expected both or neither")
    for name, value in (("frames", frames), ("repeats", repeats), ("size", size)):
        if value < 1:
            raise ValueError(f"{name}: expected at least 1, got {value}")
    if vertices is None:
        vertices, faces = bird_like_mesh()
    screen = fitted_to_image(np.asarray(vertices), size)
    batch = jnp.asarray(jittered_frames(screen, frames, size))
    faces = jnp.asarray(faces)
    target = raster.silhouette(jnp.asarray(screen), faces, size) > 0.5

    def loss(v, f, backend: raster.Backend = "auto"):
        return raster.mask_loss(v, f, target, backend=backend)

    loss_only = jax.jit(jax.vmap(loss, in_axes=(0, None)))
    with_gradient = jax.jit(jax.vmap(jax.value_and_grad(loss), in_axes=(0, None)))

    def time_of(count: int, some_faces) -> dict:
        seconds = median_seconds(lambda: with_gradient(batch[:count], some_faces), repeats)
        return {"frames": count, "faces": len(some_faces), "ms_per_frame": 1e3 * seconds / count}

    whole = time_of(frames, faces)
    a = jax.random.normal(jax.random.key(0), (1024, 1024))
    matmul = jax.jit(lambda a: a @ a)
    matmul_ms = 1e3 * median_seconds(lambda: matmul(a), repeats)

    counts = sorted({max(1, frames // 4), max(1, frames // 2)})
    # Every second or fourth face covers the same area, so that only the number of faces changes.
    scaling = [time_of(count, faces) for count in counts]
    scaling += [time_of(frames, faces[::step]) for step in (4, 2)] + [whole]

    return {
        **whole,
        "loss_ms_per_frame": 1e3 * median_seconds(lambda: loss_only(batch, faces), repeats) / frames,
        "size": size,
        "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "isa": kernels.current_isa(),
        "gradient_error": _gradient_error(loss, batch[:reference_frames], faces) if reference_frames else None,
        "matmul_ms": matmul_ms,
        "matmul_ratio": whole["ms_per_frame"] / matmul_ms,
        "scaling": scaling,
    }


def _gradient_error(loss, batch, faces) -> float:
    """Return the largest relative error of a frame's vertex gradient against the plain JAX reference."""
    fast, slow = (jax.jit(jax.grad(lambda v, b=b: loss(v, faces, b))) for b in ("auto", "reference"))
    errors = []
    for vertices in batch:
        expected = slow(vertices)
        errors.append(float(jnp.linalg.norm(fast(vertices) - expected) / jnp.linalg.norm(expected)))
    return max(errors)


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
