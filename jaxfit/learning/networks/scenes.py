"""Simulated frames with labels: murres on ledges, and many kinds of birds in many landscapes."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from jaxfit.data.formats.fields import read_json
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import new_folder, write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks.labelled_frames import MARKER, LabelledFrames, save_labels
from jaxfit.learning.networks.varied import Landscape, Species, draw_landscape, draw_species, draw_strokes
from jaxfit.model.bird import Bird
from jaxfit.model.files import load_murre
from jaxfit.raster.zbuffer import hard_mask, interpolate, vertex_normals, zbuffer
from jaxfit.simulation.flock import simulate_flock
from jaxfit.simulation.footage import GAMMA, Footage, Light, Noise, lit_plumage, random_light
from jaxfit.simulation.scene import LEDGE_DEPTH, SURFACE_TOLERANCE, mesh_keypoints, render_visibility
from jaxfit.simulation.viewpoint import Viewpoint, camera_axes

MAX_VARIED_BIRDS = 40
LENGTH_UNITS = 20.0
"""Length of the murre in model units; the sizes of birds refer to this length."""
LENGTH_SHARE = 0.03, 0.44
"""Range of the length of birds, as a share of the width of the picture."""
FLIGHT_SHARE, WINGS_FLIGHT_SHARE = 0.15, 0.7
"""Share of the frames in which all birds fly: usually, and in scenes with wings."""
DEPTH_STEP = 1000.0
"""Depth between birds in model units: a nearer bird hides a farther bird completely."""


class _Placed(NamedTuple):
    """One bird in the picture."""

    vertices_world: Float[np.ndarray, "V 3"]
    vertices_screen: Float[np.ndarray, "V 3"]
    keypoints_screen: Float[np.ndarray, "K 3"]
    species: Species
    waterline: float | None
    """Height below which water hides the bird, model units; None on the ground and in the air."""
    flies: bool


def draw_frames(
    rng: np.random.Generator, bird: Bird, count: int, width: int, height: int, flight: float = FLIGHT_SHARE
) -> LabelledFrames:
    """Draw a scene, which is one or two species, one landscape, one light and one camera, and some of its frames.

    Birds have other places and postures in every frame.

    Args:
        rng: source of randomness.
        bird: the murre.
        count: number of frames.
        width, height: size of the frames, pixels.
        flight: share of the frames in which all birds fly.
    """
    pitch = float(rng.uniform(0, 90))
    R_cam_world = camera_axes(pitch, 0, rng.uniform(-8, 8))
    species = [draw_species(rng, bird) for _ in range(int(rng.integers(1, 3)))]
    scale = float(np.exp(rng.uniform(*np.log(LENGTH_SHARE)))) * width / LENGTH_UNITS
    landscape, light = draw_landscape(rng, width, height, pitch), random_light(rng)
    expected = min(rng.uniform(0.05, 0.6) * width * height / (LENGTH_UNITS * scale) ** 2, MAX_VARIED_BIRDS)
    feathers = Noise(rng, octaves=5, coarsest=16)
    K = bird.num_keypoints
    points = np.zeros((count, MAX_VARIED_BIRDS, K, 2), np.float32)
    visibility = np.zeros((count, MAX_VARIED_BIRDS, K), np.uint8)
    pictures, owner = np.zeros((count, height, width, 3), np.uint8), np.zeros((count, height, width), np.uint8)
    for s in range(count):
        N = int(np.clip(rng.poisson(expected), 1, MAX_VARIED_BIRDS))
        birds = _place(rng, species, N, scale, R_cam_world, landscape, (width, height), rng.random() < flight)
        pictures[s], owner[s], points[s, :N], visibility[s, :N] = _render(rng, birds, landscape, light, feathers)
    return LabelledFrames(pictures, owner, points, visibility, np.full(count, scale, np.float32))


def _place(
    rng: np.random.Generator,
    species: list[Species],
    N: int,
    scale: float,
    R_cam_world: np.ndarray,
    landscape: Landscape,
    size_px: tuple[int, int],
    flies: bool,
) -> list[_Placed]:
    """Place birds at random points of the picture; birds that stand lower in the picture are nearer."""
    centres = rng.uniform([0, 0], size_px, (N, 2))
    for n in range(1, N):  # some birds stand close to another bird
        if rng.random() < 0.35:
            centres[n] = centres[rng.integers(n)] + rng.normal(0, 0.6 * LENGTH_UNITS * scale, 2)
    centres = np.clip(centres, 0, size_px)[np.argsort(centres[:, 1])]
    kinds = rng.integers(len(species), size=N)
    swims = np.zeros(N, bool) if flies else centres[:, 1] >= landscape.water_from
    # most birds on water swim, the others stand on something that the picture does not show
    swims &= rng.random(N) < 0.95
    manners = ("fly",) if flies else ("stand", "swim")
    posed = {manner: [kind_of_bird.pose(rng, N, manner) for kind_of_bird in species] for manner in manners}
    placed = []
    for n, (centre, kind) in enumerate(zip(centres, kinds, strict=True)):
        bird_scale = scale * float(np.exp(rng.normal(0, 0.12)))
        vertices, keypoints = (points[n] for points in posed["fly" if flies else "swim" if swims[n] else "stand"][kind])
        screen, points = (
            _on_screen(world, R_cam_world, bird_scale, centre, N - n + 1) for world in (vertices, keypoints)
        )
        low, high = vertices[:, 2].min(), vertices[:, 2].max()
        waterline = low + rng.uniform(0.25, 0.5) * (high - low) if swims[n] else None
        placed.append(_Placed(vertices, screen, points, species[kind], waterline, flies))
    return placed


def _on_screen(
    points_world: Float[np.ndarray, "P 3"], R_cam_world: np.ndarray, scale: float, centre_px: np.ndarray, rank: int
) -> Float[np.ndarray, "P 3"]:
    """Project points in parallel to x, y in pixels and depth in model units; birds of a higher rank are farther."""
    cam = points_world @ R_cam_world.T
    return np.column_stack([centre_px + scale * cam[:, :2], DEPTH_STEP * rank + cam[:, 2]])


def _render(
    rng: np.random.Generator, birds: list[_Placed], landscape: Landscape, light: Light, feathers: Noise
) -> tuple[Any, ...]:
    picture = landscape.picture * light.tint.astype(np.float32)
    height, width = picture.shape[:2]
    owner = np.zeros((height, width), np.uint8)
    depths = np.full((height, width), np.inf, np.float32)
    faces = np.asarray(birds[0].species.body.faces)
    strength = rng.uniform(0, 0.6)
    for bird in birds:
        if not bird.flies and bird.waterline is None:
            picture = _add_shadow(picture, bird, faces, light, strength)
    reflection = rng.uniform(0, 0.5)
    for n, bird in enumerate(birds, start=1):
        _draw(picture, owner, depths, n, bird, faces, light, feathers, reflection)
    if rng.random() < 0.2:
        _add_foreground(rng, picture, owner)
    exposed = np.clip(picture * rng.uniform(0.9, 1.6), 0, 1) ** (1 / GAMMA)
    points = np.stack([bird.keypoints_screen for bird in birds])
    return (
        np.clip(255 * exposed + 0.5, 0, 255).astype(np.uint8),
        owner,
        points[..., :2].astype(np.float32),
        _visibility(points, owner, depths),
    )


def _box(points: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    low = np.clip(np.floor(points[:, :2].min(0)).astype(int) - 1, 0, [width, height])
    return low, np.clip(np.ceil(points[:, :2].max(0)).astype(int) + 1, 0, [width, height])


def _draw(
    picture: np.ndarray,
    owner: np.ndarray,
    depths: np.ndarray,
    n: int,
    bird: _Placed,
    faces: np.ndarray,
    light: Light,
    feathers: Noise,
    reflection: float,
) -> None:
    """Draw one bird, and its reflection if the bird swims."""
    height, width = owner.shape
    low, high = _box(bird.vertices_screen, width, height)
    columns, rows = (high - low).tolist()
    if columns <= 0 or rows <= 0:
        return
    screen = (bird.vertices_screen - [*low, 0]).astype(np.float32)
    normals = vertex_normals(bird.vertices_world, faces)
    up = bird.vertices_world[:, 2:] - bird.vertices_world[:, 2].min()
    rest = np.asarray(bird.species.body.vertices)
    attributes = np.concatenate([bird.species.colours, normals, rest, up, bird.vertices_world[:, 2:]], axis=1)
    values, coverage, _ = interpolate(screen, faces, attributes.astype(np.float32), columns, rows)
    inside = coverage > 0
    mean = values[inside] / coverage[inside][:, None]
    colours = np.zeros((rows, columns, 3))
    colours[inside] = lit_plumage(mean[:, :10], light, feathers)
    alpha = coverage.copy()
    if bird.waterline is not None:
        alpha[inside] *= mean[:, 10] > bird.waterline
    box = (slice(low[1], high[1]), slice(low[0], high[0]))
    if bird.waterline is not None and alpha.any():
        _reflect(picture, colours, alpha, low, reflection)
    picture[box] = picture[box] * (1 - alpha[..., None]) + colours * alpha[..., None]
    shown = alpha > 0.5
    owner[box][shown] = n
    depths[box][shown] = zbuffer(screen, faces, columns, rows).depth[shown]


def _reflect(picture: np.ndarray, colours: np.ndarray, alpha: np.ndarray, low: np.ndarray, strength: float) -> None:
    """Draw the mirror image of a swimming bird below the lowest row of the bird."""
    bottom = int(np.flatnonzero(alpha.any(1))[-1]) + 1
    top = low[1] + bottom
    rows = min(bottom, picture.shape[0] - top)
    if rows <= 0:
        return
    share = cv2.GaussianBlur(alpha[bottom - rows : bottom][::-1], (0, 0), 2.0)[..., None] * strength
    box = (slice(top, top + rows), slice(low[0], low[0] + alpha.shape[1]))
    picture[box] = picture[box] * (1 - share) + 0.7 * colours[bottom - rows : bottom][::-1] * share


def _add_shadow(picture: np.ndarray, bird: _Placed, faces: np.ndarray, light: Light, strength: float) -> np.ndarray:
    """Darken the ground where the body hides sun and sky."""
    height, width = picture.shape[:2]
    world, screen = bird.vertices_world, bird.vertices_screen
    # the affine map from the world to the screen, from the vertices themselves
    system = np.column_stack([world, np.ones(len(world))])
    to_screen, *_ = np.linalg.lstsq(system, screen, rcond=None)
    above = world[:, 2:] - world[:, 2].min()
    fallen = world - above * (light.to_sun_world / light.to_sun_world[2])
    shadow = np.column_stack([fallen, np.ones(len(world))]) @ to_screen
    mask = hard_mask((shadow / [4, 4, 1]).astype(np.float32), faces, width // 4, height // 4).astype(np.float32)
    soft = cv2.resize(cv2.GaussianBlur(mask, (0, 0), 1.5), (width, height), interpolation=cv2.INTER_LINEAR)
    return picture * (1 - strength * soft[..., None])


def _add_foreground(rng: np.random.Generator, picture: np.ndarray, owner: np.ndarray) -> None:
    """Draw blades of grass or twigs in front of the birds."""
    height, width = owner.shape
    drawn, count = np.zeros((height, width), np.float32), int(rng.integers(5, 60))
    columns = rng.uniform(0, width) + rng.normal(0, 0.15 * width, count)
    draw_strokes(rng, drawn, np.stack([columns, height * rng.uniform(0.4, 1.1, count)], 1), np.ones(1))
    colour = np.array([0.05, 0.2, 0.1]) * rng.uniform(0.3, 2.5) * rng.uniform(0.7, 1.3, 3)
    picture[:] = picture * (1 - drawn[..., None]) + colour * drawn[..., None]
    owner[drawn > 0.5] = 0


def _visibility(points: Float[np.ndarray, "N K 3"], owner: np.ndarray, depths: np.ndarray) -> Float[np.ndarray, "N K"]:
    """Return 2 for visible keypoints, 1 for hidden keypoints and 0 for keypoints outside the picture."""
    height, width = owner.shape
    inside: Bool[np.ndarray, "N K"] = np.all((points[..., :2] >= 0) & (points[..., :2] < [width, height]), axis=-1)
    column, row = (np.clip(points[..., i].astype(int), 0, side - 1) for i, side in enumerate((width, height)))
    is_bird = owner[row, column] == np.arange(1, len(points) + 1)[:, None]
    visible = inside & is_bird & (points[..., 2] <= depths[row, column] + SURFACE_TOLERANCE)
    return inside.astype(np.uint8) + visible


WIDTH, HEIGHT = 960, 640
MAX_BIRDS = 14
FRAMES_PER_SCENE = 10
WORKERS = 2
"""Number of processes that film."""
SHARES = "shares.json"
"""The shares of varied scenes and of scenes with wings in a folder of scenes."""
FPS, EVERY = 12.0, 4
"""Every fourth frame at 12 frames/s: the frames of a scene are 1/3 s apart, so that postures differ."""


def film_scenes(
    folder: str | Path,
    count: int,
    varied: float | None = None,
    wings: float | None = None,
    progress: ProgressTask = silent,
) -> tuple[Path, ...]:
    """Film the scenes that a folder lacks, each into a folder of its own; the same seeds give the same frames.

    Args:
        folder: folder of the scenes, with about 32 MB per scene.
        count: number of scenes, with seeds from 0.
        varied: share of the scenes with other birds in other landscapes (`varied.py`).
        wings: share of the scenes in which the birds flap or fly. None: the shares of the scenes in the folder.
        progress: reports every scene.

    Returns:
        The folders of the first `count` scenes.

    Raises:
        InputError: the folder holds other files or scenes of other shares, or cannot be written; or the system ended a
            process.
    """
    folder = Path(folder)
    folders = _scene_folders(folder, count)
    path = folder / SHARES
    stored = read_json(path).value if path.is_file() else {"varied": 0.0, "wings": 0.0}
    shares = stored if varied is None else {"varied": varied, "wings": wings}
    if shares != stored:
        if folder.exists() and any(folder.iterdir()):
            remedy = "give another folder, or remove this one"
            raise InputError(folder, f"holds scenes of {stored}, not of {shares}", remedy)
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps(shares).encode())
    missing = _missing(folders)
    if not missing:
        return folders
    pool = ProcessPoolExecutor(min(WORKERS, len(missing)), get_context("spawn"))  # a fork breaks compiled code
    with progress("Filming simulated scenes for the training", len(missing)) as report_progress, pool:
        film = partial(film_scene, **shares)
        try:
            for _ in pool.map(film, [folders[seed] for seed in missing], missing):
                report_progress(1, "")
        except BrokenProcessPool as error:
            problem = "is incomplete, because the system ended a process that films scenes"
            raise InputError(folder, problem, "free memory and repeat the command, or give fewer --scenes") from error
    return folders


def missing_scenes(folder: Path, count: int) -> int:
    """Return how many of the first `count` scenes must be filmed; errors as `film_scenes`."""
    return len(_missing(_scene_folders(folder, count)))


def _missing(folders: Sequence[Path]) -> list[int]:
    return [seed for seed, folder in enumerate(folders) if not (folder / MARKER).exists()]


def _scene_folders(folder: Path, count: int) -> tuple[Path, ...]:
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    others = sorted(name for name in names if not name.startswith((".", "scene_")) and name != SHARES)
    if others:
        problem = f"holds other files than simulated scenes: {others[0]}"
        raise InputError(folder, problem, "give another folder by --frames")
    return tuple(folder / f"scene_{seed:04d}" for seed in range(count))


def film_scene(folder: Path, seed: int, varied: float = 0.0, wings: float = 0.0) -> None:
    """Simulate one scene and write its frames to a new folder."""
    frames = draw_scene(seed, varied, wings)
    try:
        with new_folder(folder, marker=MARKER) as part:
            np.save(part / "pictures.npy", frames.pictures)
            np.save(part / "owner.npy", frames.owner)
            save_labels(part, frames.keypoints_px, frames.visibility, frames.pixels_per_unit)
    except InputError:
        if not (folder / MARKER).exists():  # another command has filmed the same scene in the meantime
            raise


def draw_scene(seed: int, varied: float = 0.0, wings: float = 0.0) -> LabelledFrames:
    """Simulate the frames of one scene: with probability `varied`, other birds in another landscape."""
    bird = load_murre()
    has_wings = bool(np.random.default_rng((seed, 13)).random() < wings)
    if np.random.default_rng((seed, 11)).random() < varied:
        rng = np.random.default_rng((seed, 12))
        flight = WINGS_FLIGHT_SHARE if has_wings else FLIGHT_SHARE
        return draw_frames(rng, bird, FRAMES_PER_SCENE, WIDTH, HEIGHT, flight)
    scene = simulate_ledge(seed, bird, has_wings)
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


def simulate_ledge(seed: int, bird: Bird, wings: bool = False) -> Ledge:
    """Simulate the birds of a scene without rendering the pictures; `wings` as in `simulate_flock`."""
    rng = np.random.default_rng((seed, 10))
    view, pixels_per_unit = _random_view(rng)
    # the expected number of birds grows with the visible area
    expected_birds = (view.width / pixels_per_unit) * (view.height / pixels_per_unit) / 170
    N = int(np.clip(rng.poisson(min(expected_birds, 9)) + 1, 1, MAX_BIRDS))
    T = FRAMES_PER_SCENE * EVERY
    birds = simulate_flock(bird, N, T, FPS, LEDGE_DEPTH, view, seed, wings)
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
