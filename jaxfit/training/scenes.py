"""Simulated frames for training: murres on ledges with random cameras, or other birds in other landscapes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit.errors import InputError
from jaxfit.model.bird import Bird
from jaxfit.model.files import load_murre
from jaxfit.progress import ProgressTask, silent
from jaxfit.simulation.flock import simulate_flock
from jaxfit.simulation.footage import Footage
from jaxfit.simulation.ledge import random_light
from jaxfit.simulation.scene import LEDGE_DEPTH
from jaxfit.simulation.viewpoint import Viewpoint, camera_axes
from jaxfit.simulation.visibility import mesh_keypoints, render_visibility
from jaxfit.storage.files import new_folder
from jaxfit.training.labelled_frames import MARKER, LabelledFrames, create_pictures, load_frames, save_labels
from jaxfit.training.varied import frames as varied_frames

__all__ = ["FRAMES_PER_SCENE", "Ledge", "film_scene", "film_scenes", "simulate_ledge"]

WIDTH, HEIGHT = 960, 640
MAX_BIRDS = 14
FRAMES_PER_SCENE = 10
FPS, EVERY = 12.0, 4
"""Every fourth frame at 12 frames/s: the frames of a scene are 1/3 s apart, so that postures differ."""


def film_scenes(
    folder: str | Path,
    seeds: range,
    workers: int = 2,
    overwrite: bool = False,
    progress: ProgressTask = silent,
    varied: float = 0.0,
) -> LabelledFrames:
    """Simulate scenes and write their frames to a folder; the same seeds give the same frames.

    Args:
        folder: folder to create, with about 32 MB per scene.
        seeds: one seed per scene.
        workers: number of parallel processes.
        overwrite: replace the frames of an earlier run.
        progress: reports every scene.
        varied: share of the scenes with other birds in other landscapes (`jaxfit.training.varied`).

    Raises:
        InputError: the folder contains other files, or cannot be written.
    """
    most = varied_frames.MAX_BIRDS if varied else MAX_BIRDS
    with new_folder(folder, overwrite, marker=MARKER) as part:
        pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))  # a fork breaks compiled code
        with progress("Filming simulated scenes for the training", len(seeds)) as report_progress, pool:
            scenes = pool.map(partial(_film_scene, varied=varied), seeds)
            _write_scenes(part, scenes, len(seeds), most, lambda: report_progress(1, ""))
    return load_frames(folder)


def film_scene(folder: Path, seed: int) -> None:
    """Simulate one scene and write its frames to a folder; a folder that exists is not changed.

    Raises:
        InputError: the folder cannot be written.
    """
    if (folder / MARKER).exists():
        return
    try:
        with new_folder(folder, marker=MARKER) as part:
            _write_scenes(part, [_film_scene(seed)], 1, MAX_BIRDS)
    except InputError:
        if not (folder / MARKER).exists():  # another command has filmed the same scene in the meantime
            raise


def _write_scenes(
    part: Path, scenes: Iterable[LabelledFrames], count: int, most: int, written: Callable[[], None] = lambda: None
) -> None:
    """Write the frames of `count` scenes with at most `most` birds to a folder, one scene after the other."""
    S, K = count * FRAMES_PER_SCENE, load_murre().num_keypoints
    pictures, owner = create_pictures(part, S, HEIGHT, WIDTH)
    points, visibility = np.zeros((S, most, K, 2), np.float32), np.zeros((S, most, K), np.uint8)
    scale = np.zeros(S, np.float32)
    for i, frames in enumerate(scenes):
        at = slice(i * FRAMES_PER_SCENE, (i + 1) * FRAMES_PER_SCENE)
        N = frames.visibility.shape[1]
        pictures[at], owner[at], scale[at] = frames.pictures, frames.owner, frames.pixels_per_unit
        points[at, :N], visibility[at, :N] = frames.keypoints_px, frames.visibility
        written()
    del pictures, owner  # writes the memory-mapped files
    save_labels(part, points, visibility, scale)


def _film_scene(seed: int, varied: float = 0.0) -> LabelledFrames:
    """Simulate the frames of one scene: with probability `varied`, other birds in another landscape."""
    bird = load_murre()
    if np.random.default_rng((seed, 11)).random() < varied:
        rng = np.random.default_rng((seed, 12))
        return varied_frames.draw_frames(rng, bird, FRAMES_PER_SCENE, WIDTH, HEIGHT)
    return _film_ledge(seed, bird)


def _film_ledge(seed: int, bird: Bird) -> LabelledFrames:
    """Simulate murres on a ledge with a random camera, light and number of birds."""
    scene = simulate_ledge(seed, bird)
    frames = list(_render_frames(scene, np.asarray(bird.faces)))
    pictures, owner, points, visibility = (np.stack(values) for values in zip(*frames, strict=True))
    scale = np.full(len(scene.kept), scene.pixels_per_unit, np.float32)
    return LabelledFrames(pictures, owner, points, visibility, scale)


class Ledge(NamedTuple):
    """Murres on a ledge, before the pictures are rendered."""

    footage: Footage
    kept: range
    """The frames of the training."""
    vertices: Float[np.ndarray, "T N V 3"]
    """Vertices of the birds, world frame."""
    keypoints: Float[np.ndarray, "T N K 3"]
    """Keypoints of the birds, world frame."""
    pixels_per_unit: float


def simulate_ledge(seed: int, bird: Bird) -> Ledge:
    """Simulate the birds of a scene without rendering the pictures."""
    rng = np.random.default_rng((seed, 10))
    view, pixels_per_unit = _random_view(rng)
    # the expected number of birds grows with the visible area
    expected_birds = (view.width / pixels_per_unit) * (view.height / pixels_per_unit) / 170
    N = int(np.clip(rng.poisson(min(expected_birds, 9)) + 1, 1, MAX_BIRDS))
    T = FRAMES_PER_SCENE * EVERY
    birds = simulate_flock(bird, N, T, FPS, LEDGE_DEPTH, view, seed)
    footage = Footage(bird, birds, view, LEDGE_DEPTH, random_light(rng), seed)
    kept = range(int(rng.integers(EVERY)), T, EVERY)
    vertices = np.stack([simulated.vertices_world for simulated in birds], axis=1)
    return Ledge(footage, kept, vertices, mesh_keypoints(bird, vertices), pixels_per_unit)


def _render_frames(scene: Ledge, faces: np.ndarray) -> Iterator[tuple[Any, ...]]:
    view = scene.footage.view
    for t in scene.kept:
        visible = render_visibility(scene.vertices[t], scene.keypoints[t], faces, view)
        owner = np.zeros((view.height, view.width), np.uint8)
        for n, mask in enumerate(visible.visible_masks, start=1):
            owner[mask] = n
        visibility = visible.inside.astype(np.uint8) + visible.keypoint_visible
        yield scene.footage.frame(t), owner, visible.keypoints_px.astype(np.float32), visibility


def _random_view(rng: np.random.Generator) -> tuple[Viewpoint, float]:
    """Draw a camera with random direction (steeply above to obliquely in front), distance and zoom."""
    R_cam_world = camera_axes(rng.uniform(42, 82), rng.uniform(-25, 25), rng.uniform(-6, 6))
    distance = rng.uniform(130, 400)
    width_units = float(np.exp(rng.uniform(np.log(48), np.log(130))))
    aim = np.array([rng.uniform(-6, 6), rng.uniform(0.35, 0.55) * LEDGE_DEPTH, 6])
    focal_px = WIDTH * distance / width_units
    view = Viewpoint(R_cam_world, aim - distance * R_cam_world[2], focal_px, WIDTH, HEIGHT)
    return view, WIDTH / width_units
