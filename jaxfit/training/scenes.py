"""Simulated frames to learn from: the ledge of `jaxfit.simulation` seen by cameras of every kind, with exact labels."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from numpy.lib.format import open_memmap

from jaxfit.model.files import load_murre
from jaxfit.progress import ProgressTask, silent
from jaxfit.simulation.flock import act
from jaxfit.simulation.footage import Footage
from jaxfit.simulation.ledge import random_light
from jaxfit.simulation.scene import LEDGE_DEPTH
from jaxfit.simulation.viewpoint import Viewpoint, camera_axes
from jaxfit.simulation.visibility import keypoints_of, see
from jaxfit.storage.files import new_folder

__all__ = ["FRAMES_A_SCENE", "LabelledFrames", "film_scenes", "load_frames"]

WIDTH, HEIGHT = 960, 640
MOST_BIRDS = 14
FRAMES_A_SCENE = 10
FPS, EVERY = 12.0, 4
"""Frames of a scene lie a third of a second apart, so that postures differ."""
_MARKER = "frames.npz"


class LabelledFrames(NamedTuple):
    """S frames of simulated scenes; the large arrays stay on disk."""

    pictures: UInt8[np.ndarray, "S H W 3"]
    """Blue, green, red."""
    owner: UInt8[np.ndarray, "S H W"]
    """Which bird a pixel shows, counted from 1; 0 for none."""
    keypoints_px: Float[np.ndarray, "S N K 2"]
    """x, y of every keypoint, also where it is hidden or outside."""
    seen: UInt8[np.ndarray, "S N K"]
    """2 where the camera sees it, 1 where something hides it, 0 where it is outside or there is no such bird."""
    pixels_a_unit: Float[np.ndarray, "S"]
    """Pixels across one model unit (2 cm) at the ledge: the scale of the picture."""


def film_scenes(
    folder: str | Path, seeds: range, workers: int = 2, overwrite: bool = False, progress: ProgressTask = silent
) -> LabelledFrames:
    """Film scenes into a folder; the same seeds give the same frames.

    Args:
        folder: to make; about 32 MB a scene.
        seeds: one a scene.
        workers: processes side by side.
        overwrite: replace frames filmed before.
        progress: told of every scene.

    Raises:
        InputError: the folder holds something else, or cannot be written.
    """
    bird = load_murre()
    S, K = len(seeds) * FRAMES_A_SCENE, bird.num_keypoints
    with new_folder(folder, overwrite, marker=_MARKER) as part:
        pictures = open_memmap(part / "pictures.npy", "w+", np.uint8, (S, HEIGHT, WIDTH, 3))
        owner = open_memmap(part / "owner.npy", "w+", np.uint8, (S, HEIGHT, WIDTH))
        points, seen = np.zeros((S, MOST_BIRDS, K, 2), np.float32), np.zeros((S, MOST_BIRDS, K), np.uint8)
        scale = np.zeros(S, np.float32)
        pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))  # compiled code does not survive a fork
        with progress("Filming scenes", len(seeds)) as report_progress, pool:
            for i, frames in enumerate(pool.map(_film, seeds)):
                at = slice(i * FRAMES_A_SCENE, (i + 1) * FRAMES_A_SCENE)
                N = frames.seen.shape[1]
                pictures[at], owner[at], scale[at] = frames.pictures, frames.owner, frames.pixels_a_unit
                points[at, :N], seen[at, :N] = frames.keypoints_px, frames.seen
                report_progress(1, "")
        pictures.flush()
        owner.flush()
        np.savez(part / _MARKER, keypoints_px=points, seen=seen, pixels_a_unit=scale)
    return load_frames(folder)


def load_frames(folder: str | Path) -> LabelledFrames:
    """Frames that `film_scenes` left in a folder."""
    folder = Path(folder)
    with closing(np.load(folder / _MARKER, allow_pickle=False)) as labels:
        points, seen, scale = (labels[name] for name in ("keypoints_px", "seen", "pixels_a_unit"))
    large = (np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in ("pictures", "owner"))
    pictures, owner = large
    return LabelledFrames(pictures, owner, points, seen, scale)


def _film(seed: int) -> LabelledFrames:
    """One scene with a camera, a light and a number of birds of its own."""
    bird = load_murre()
    rng = np.random.default_rng((seed, 10))
    view, pixels_a_unit = _random_view(rng)
    # as many as find room in what the camera sees
    room = (view.width / pixels_a_unit) * (view.height / pixels_a_unit) / 170
    N = int(np.clip(rng.poisson(min(room, 9)) + 1, 1, MOST_BIRDS))
    T = FRAMES_A_SCENE * EVERY
    actors = act(bird, N, T, FPS, LEDGE_DEPTH, view, seed)
    footage = Footage(bird, actors, view, LEDGE_DEPTH, random_light(rng), seed)
    shown = range(int(rng.integers(EVERY)), T, EVERY)
    vertices = np.stack([actor.vertices_world for actor in actors], axis=1)
    keypoints = keypoints_of(bird, vertices)
    faces = np.asarray(bird.faces)
    frames = list(_look(footage, shown, vertices, keypoints, faces, view))
    pictures, owner, points, seen = (np.stack(values) for values in zip(*frames, strict=True))
    return LabelledFrames(pictures, owner, points, seen, np.full(len(shown), pixels_a_unit, np.float32))


def _look(footage: Footage, shown: range, vertices, keypoints, faces, view: Viewpoint) -> Iterator[tuple[Any, ...]]:
    for t in shown:
        at = see(vertices[t], keypoints[t], faces, view)
        owner = np.zeros((view.height, view.width), np.uint8)
        for n, mask in enumerate(at.visible, start=1):
            owner[mask] = n
        seen = at.inside.astype(np.uint8) + at.seen
        yield footage.frame(t), owner, at.keypoints_px.astype(np.float32), seen


def _random_view(rng: np.random.Generator) -> tuple[Viewpoint, float]:
    """A camera anywhere between steeply above and obliquely in front, near or far, at any zoom."""
    R_cam_world = camera_axes(rng.uniform(42, 82), rng.uniform(-25, 25), rng.uniform(-6, 6))
    distance = rng.uniform(130, 400)
    across = float(np.exp(rng.uniform(np.log(48), np.log(130))))
    aim = np.array([rng.uniform(-6, 6), rng.uniform(0.35, 0.55) * LEDGE_DEPTH, 6])
    focal_px = WIDTH * distance / across
    view = Viewpoint(R_cam_world, aim - distance * R_cam_world[2], focal_px, WIDTH, HEIGHT)
    return view, WIDTH / across
