"""Random landscapes, and random species: body, posture, plumage."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose, fold_bird, window_transforms, window_vertices
from jaxfit.model.murre import POSTURES
from jaxfit.simulation.footage import GAMMA, Noise, smoothstep

_Shape = tuple[int, int]


class Landscape(NamedTuple):
    """A picture without birds."""

    picture: Float[np.ndarray, "H W 3"]
    """Linear light: blue, green, red."""
    water_from: int
    """First row of water, where birds swim; the height of the picture if there is no water."""


def draw_landscape(rng: np.random.Generator, width: int, height: int, pitch_deg: float) -> Landscape:
    """Draw a landscape: one kind of ground, or two kinds with an uneven border, and objects.

    Args:
        rng: source of randomness.
        width, height: size of the picture, pixels.
        pitch_deg: angle of the camera below the horizontal; textures are foreshortened accordingly.
    """
    shape = height, width
    flatness = max(np.sin(np.radians(pitch_deg)), 0.15)
    kinds = list(_KINDS)
    lower = str(rng.choice(kinds[:-1]))
    picture, water_from = _KINDS[lower](rng, shape, flatness), 0 if lower == "water" else height
    if rng.random() < (0.75 if pitch_deg < 35 else 0.3):
        upper = str(rng.choice(["sky", "sky", "leaves", "grass", "rock"] if pitch_deg < 35 else kinds[:-1]))
        row = rng.uniform(0.05, 0.6) * height
        rough = rng.uniform(0, 0.04) * height * _noise(rng)(np.arange(width), np.zeros(width), 2.0 * width)
        above = (np.arange(height)[:, None] < row + rough[None])[..., None]
        picture = np.where(above, _KINDS[upper](rng, shape, flatness), picture)
        water_from = max(water_from, int(row + np.abs(rough).max())) if lower == "water" else height
    if rng.random() < 0.5:
        picture = _add_objects(rng, picture)
    return Landscape(picture.astype(np.float32), water_from)


def _noise(rng: np.random.Generator, octaves: int = 6, gain: float = 0.6) -> Noise:
    return Noise(rng, octaves=octaves, gain=gain)


def _grid(shape: _Shape) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    return x, y


def _mixed(values: np.ndarray, *colours: object) -> Float[np.ndarray, "H W 3"]:
    """Return colours in linear light that change with values from 0 to 1."""
    stops = np.linspace(0, 1, len(colours))
    table = np.array(colours, np.float64)
    return np.stack([np.interp(values, stops, table[:, i]) for i in range(3)], axis=-1)


def _jitter(rng: np.random.Generator, *colours: tuple[float, float, float]) -> list[np.ndarray]:
    tint = rng.uniform(0.75, 1.3, 3) * rng.uniform(0.6, 1.5)
    return [np.clip(np.array(colour) * tint, 0, 1) for colour in colours]


def _water(rng: np.random.Generator, shape: _Shape, flatness: float) -> np.ndarray:
    """Draw ripples that are finer towards the top of the picture, with reflections of the sky."""
    x, y = _grid(shape)
    depth = shape[0] * (0.3 + flatness) / (y + 0.3 * shape[0] + 1)
    scale = rng.uniform(0.15, 1.2) * shape[1]
    ripples = _noise(rng, 7, rng.uniform(0.5, 0.85))((x - shape[1] / 2) * depth, 300 * depth / flatness, scale)
    swell = _noise(rng, 3)(x, y / flatness, 4.0 * shape[1])
    values = np.clip(0.45 + rng.uniform(0.08, 0.35) * ripples + 0.15 * swell, 0, 1)
    deep, light = _jitter(rng, (0.10, 0.08, 0.05), (0.55, 0.45, 0.38))
    if rng.random() < 0.35:  # green or brown water
        deep = deep * rng.uniform([0.3, 0.8, 0.6], [0.8, 1.3, 1.6])
    picture = _mixed(values, deep, (deep + light) / 2, light)
    glint = smoothstep(1.6, 2.4, ripples)[..., None] * rng.uniform(0, 0.8) * (rng.random() < 0.4)
    return picture + glint


def _grass(rng: np.random.Generator, shape: _Shape, flatness: float) -> np.ndarray:
    """Draw patches of green or dry grass, with blades where the camera is near."""
    x, y = _grid(shape)
    patches = _noise(rng)(x, y / flatness, rng.uniform(0.5, 3) * shape[1])
    fine = _noise(rng, 5, 0.9)(x * rng.uniform(2, 5), y, 0.25 * shape[1])
    colours = _jitter(rng, (0.02, 0.07, 0.03), (0.05, 0.20, 0.09), (0.15, 0.38, 0.30))
    picture = _mixed(np.clip(0.5 + 0.18 * patches + 0.17 * fine, 0, 1), *colours).astype(np.float32)
    if rng.random() < 0.6:
        for _ in range(int(rng.integers(200, 900))):
            root = rng.uniform(0, [shape[1], shape[0]])
            tip = root + np.array([rng.normal(0, 6), -rng.uniform(4, 40)])
            shade = (colours[1] * rng.uniform(0.4, 2.2)).tolist()
            cv2.line(picture, root.astype(int).tolist(), tip.astype(int).tolist(), shade, 1, cv2.LINE_AA)
    return picture


def _sand(rng: np.random.Generator, shape: _Shape, flatness: float) -> np.ndarray:
    """Draw sand, mud or snow with dunes, grains and pebbles."""
    x, y = _grid(shape)
    dunes = _noise(rng, 4)(x, y / flatness, rng.uniform(0.7, 3) * shape[1])
    grain = _noise(rng, 4, 0.9)(x * 6, y * 6, 0.5 * shape[1])
    dark, light = _jitter(rng, (0.18, 0.26, 0.33), (0.38, 0.50, 0.58))
    if rng.random() < 0.25:
        dark, light = np.array([0.6, 0.55, 0.5]), np.array([0.92, 0.9, 0.88])  # snow
    picture = _mixed(np.clip(0.5 + 0.15 * dunes + rng.uniform(0, 0.12) * grain, 0, 1), dark, light).astype(np.float32)
    for _ in range(int(rng.integers(0, 60))):
        centre, axes = rng.uniform(0, [shape[1], shape[0]]), rng.uniform(1, 9, 2) * [1, max(flatness, 0.4)]
        shade = (light * rng.uniform(0.2, 1.2)).tolist()
        cv2.ellipse(picture, centre.astype(int).tolist(), axes.astype(int).tolist(), 0, 0, 360, shade, -1, cv2.LINE_AA)
    return picture


def _rock(rng: np.random.Generator, shape: _Shape, flatness: float) -> np.ndarray:
    """Draw rock with cracks, and white patches of guano or lichen."""
    x, y = _grid(shape)
    period = rng.uniform(0.5, 2.5) * shape[1]
    coarse, fine = _noise(rng)(x, y / flatness, period), _noise(rng, 7, 0.75)(x, y / flatness, 0.5 * period)
    colours = _jitter(rng, (0.05, 0.055, 0.06), (0.2, 0.22, 0.25), (0.42, 0.45, 0.48))
    picture = _mixed(np.clip(0.45 + 0.16 * coarse + 0.16 * fine, 0, 1), *colours)
    cracks = smoothstep(0.06, 0.0, np.abs(_noise(rng, 5)(x, y / flatness, 1.5 * period)))[..., None]
    picture = picture * (1 - rng.uniform(0, 0.7) * cracks)
    white = smoothstep(rng.uniform(0.6, 2), 2.2, coarse + 0.5 * fine)[..., None]
    return picture * (1 - white) + 0.75 * white


def _leaves(rng: np.random.Generator, shape: _Shape, flatness: float) -> np.ndarray:
    """Draw leaves of trees or bushes, often out of focus, with branches in front."""
    x, y = _grid(shape)
    period = rng.uniform(0.2, 1.5) * shape[1]
    values = 0.45 + 0.2 * _noise(rng, 6, 0.7)(x, y, period) + 0.15 * _noise(rng, 3)(x, y, 3 * period)
    colours = _jitter(rng, (0.01, 0.025, 0.015), (0.04, 0.16, 0.07), (0.15, 0.42, 0.28))
    picture = _mixed(np.clip(values, 0, 1), *colours).astype(np.float32)
    if rng.random() < 0.6:
        picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(1, 8))
    return _add_branches(rng, picture) if rng.random() < 0.6 else picture


def _sky(rng: np.random.Generator, shape: _Shape, flatness: float) -> np.ndarray:
    """Draw a sky from blue to overcast, with clouds."""
    x, y = _grid(shape)
    top, bottom = _jitter(rng, (0.75, 0.45, 0.22), (0.85, 0.75, 0.65))
    if rng.random() < 0.4:
        top = bottom = np.full(3, rng.uniform(0.3, 0.9)) * rng.uniform(0.95, 1.05, 3)
    clouds = _noise(rng)(x, 2 * y, rng.uniform(1, 4) * shape[1])
    share = smoothstep(rng.uniform(-0.5, 1.5), rng.uniform(1.6, 2.5), clouds)[..., None]
    return _mixed(y / shape[0], top, bottom) * (1 - share) + rng.uniform(0.6, 0.95) * share


_KINDS: dict[str, Callable[[np.random.Generator, _Shape, float], np.ndarray]] = {
    "water": _water,
    "grass": _grass,
    "sand": _sand,
    "rock": _rock,
    "leaves": _leaves,
    "sky": _sky,
}
"""Kinds of ground; the last is only above a border."""


def _add_branches(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    drawn = np.ascontiguousarray(picture, np.float32)
    height, width = drawn.shape[:2]
    for _ in range(int(rng.integers(1, 7))):
        points = [rng.uniform(0, [width, height])]
        heading = rng.uniform(0, 2 * np.pi)
        for _ in range(int(rng.integers(3, 12))):
            heading += rng.normal(0, 0.3)
            points.append(points[-1] + rng.uniform(20, 90) * np.array([np.cos(heading), np.sin(heading)]))
        colour = (np.array([0.06, 0.08, 0.11]) * rng.uniform(0.3, 3)).tolist()
        corners = np.array(points).astype(np.int32)[None]
        cv2.polylines(drawn, list(corners), False, colour, int(rng.integers(2, 16)), cv2.LINE_AA)
    return drawn


def _add_objects(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """Draw objects that are not birds: stones, posts, buoys, branches, with light from above."""
    drawn = np.ascontiguousarray(picture, np.float32)
    height, width = drawn.shape[:2]
    if rng.random() < 0.3:
        drawn = _add_branches(rng, drawn)
    for _ in range(int(rng.integers(1, 9))):
        centre = rng.uniform(0, [width, height])
        count, radius = int(rng.integers(5, 12)), log_uniform(rng, 6, 110)
        angles = np.sort(rng.uniform(0, 2 * np.pi, count))
        reach = radius * rng.uniform(0.6, 1.1, count) * rng.uniform(0.3, 1)
        corners = centre + np.stack([radius * np.cos(angles), reach * np.sin(angles)], 1)
        mask = np.zeros((height, width), np.float32)
        cv2.fillPoly(mask, [corners.astype(np.int32)], 1.0, cv2.LINE_AA)
        mask = cv2.GaussianBlur(mask, (0, 0), 0.8)[..., None]
        base = rng.uniform(0.02, 0.7) * rng.uniform(0.8, 1.2, 3)
        shade = 1.3 - 0.8 * (np.arange(height)[:, None] - corners[:, 1].min()) / max(np.ptp(corners[:, 1]), 1)
        texture = (
            _noise(rng, 5, 0.8)(*_grid((height, width)), 300.0) if rng.random() < 0.5 else np.zeros((height, width))
        )
        body = np.clip(base * np.clip(shade, 0.3, 1.3)[..., None] * (1 + 0.2 * texture[..., None]), 0, 1)
        drawn = (drawn * (1 - mask) + body * mask).astype(np.float32)
    return drawn


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number that is uniform in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


_FOLDED = tuple(name for name in POSTURES if not name.startswith(("wings", "flapping")))
_POSTURES = {
    "stand": _FOLDED * 2 + ("wings_half", "flapping_up", "flapping_down"),
    "swim": _FOLDED,
    "fly": ("wings_up", "wings_down"),
}
_PITCHES_DEG = {"stand": (0, 10, 25, 45, 55), "swim": (0, 8), "fly": (0, 15)}
_POSE_SPREAD = 0.5
"""Amplitude of the variation about a posture, in standard deviations of the pose prior."""
_NECK = "neck_root", "neck", "head"
_LEGS = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle", "foot"))
_WINGS = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder", "elbow", "wrist"))
_NATURAL = np.array(
    [
        *([0.03, 0.03, 0.03], [0.8, 0.8, 0.78], [0.35, 0.35, 0.36], [0.6, 0.6, 0.62]),
        *([0.12, 0.2, 0.3], [0.2, 0.3, 0.42], [0.3, 0.4, 0.5], [0.05, 0.08, 0.12], [0.5, 0.62, 0.7]),
        *([0.08, 0.2, 0.05], [0.3, 0.15, 0.05], [0.05, 0.3, 0.7]),
    ]
)
"""Colours of plumage in linear light (blue, green, red): black, white, greys; browns; dark green, blue, orange."""


class PosedBirds(NamedTuple):
    """P birds of one species in the world frame (z up), with the root at the origin."""

    vertices_world: Float[np.ndarray, "P V 3"]
    keypoints_world: Float[np.ndarray, "P K 3"]


@dataclasses.dataclass(frozen=True, eq=False)
class Species:
    """A body and a plumage."""

    body: Bird
    colours: Float[np.ndarray, "V 3"]
    """Linear light: blue, green, red."""

    def pose(self, rng: np.random.Generator, count: int, manner: str) -> PosedBirds:
        """Draw postures and headings of some birds.

        Args:
            rng: source of randomness.
            count: number of birds.
            manner: `stand`, `swim` or `fly`.
        """
        flies = manner == "fly"
        names = _POSTURES[manner]
        first, second = (np.array([POSTURES[str(rng.choice(names))].body_pose for _ in range(count)]) for _ in range(2))
        share = rng.uniform(0, 1, (count, 1, 1)) * (rng.random((count, 1, 1)) < 0.7)
        cholesky = np.linalg.cholesky(np.asarray(self.body.pose_covariance, np.float64))
        noise = _POSE_SPREAD * rng.normal(size=(count, len(cholesky))) @ cholesky.T
        low, high = np.moveaxis(np.asarray(self.body.joint_limits, np.float64), -1, 0)
        body_pose = np.clip((1 - share) * first + share * second + noise.reshape(first.shape), low, high)
        pitch = rng.choice(_PITCHES_DEG[manner], count) + rng.normal(0, 15 if flies else 6, count)
        orient = (
            Rotation.from_rotvec(np.radians(rng.uniform(0, 360, count))[:, None] * [0, 0, 1])
            * Rotation.from_rotvec(np.radians(rng.normal(0, 20 if flies else 5, count))[:, None] * [0, 1, 0])
            * Rotation.from_rotvec(np.radians(pitch)[:, None] * [1, 0, 0])
        )
        pose = Pose(
            global_orient=jnp.asarray(orient.as_rotvec(), jnp.float32),
            body_pose=jnp.asarray(body_pose, jnp.float32),
            transl=jnp.zeros((count, 3)),
            scale=jnp.asarray(rng.normal(1, 0.05, count), jnp.float32),
            bone_length=self.body.bone_mean,
            betas=jnp.zeros(self.body.num_shapes),
        )
        rig = fold_bird(self.body)
        vertices = np.asarray(window_vertices(rig, window_transforms(rig, pose), pose), np.float64)
        keypoints = np.einsum("kv,pvc->pkc", np.asarray(self.body.keypoint_weights, np.float64), vertices)
        return PosedBirds(vertices, keypoints)


def draw_species(rng: np.random.Generator, bird: Bird) -> Species:
    """Draw a species from the murre: other proportions of neck, legs, wings, head, bill and body, other colours."""
    body = _draw_body(rng, bird)
    return Species(body, _draw_plumage(rng, bird))


def _draw_body(rng: np.random.Generator, bird: Bird) -> Bird:
    names = bird.joint_names
    vertices, joints = np.asarray(bird.vertices, np.float64), np.asarray(bird.joints, np.float64)
    weights = np.asarray(bird.skin_weights, np.float64)
    variance = np.asarray(bird.shape_variance, np.float64)
    vertices = vertices + np.einsum(
        "s,svc->vc", 1.5 * np.sqrt(variance) * rng.normal(size=len(variance)), np.asarray(bird.shape_basis, np.float64)
    )
    head = weights[:, [names.index("head"), names.index("jaw")]].sum(1, keepdims=True)
    at = joints[names.index("head")]
    size = log_uniform(rng, 0.7, 1.35)
    vertices = vertices + head * (size - 1) * (vertices - at)
    ahead = np.maximum(vertices[:, 1:2] - at[1] - 1.2 * size, 0)  # the bill begins in front of the head
    vertices = vertices + head * ahead * [0, log_uniform(rng, 0.4, 2.2) - 1, rng.uniform(-0.4, 0.1)]
    stretch = np.array([log_uniform(rng, 0.75, 1.35), log_uniform(rng, 0.85, 1.2), log_uniform(rng, 0.75, 1.3)])
    bone = np.asarray(bird.bone_mean, np.float64) * np.exp(0.05 * rng.normal(size=len(names) - 1))
    for group, low, high in ((_NECK, 0.7, 2.2), (_LEGS, 0.6, 1.8), (_WINGS, 0.8, 1.35), (("tail",), 0.7, 1.6)):
        factor = log_uniform(rng, low, high)
        for name in group:
            bone[names.index(name) - 1] *= factor
    return dataclasses.replace(
        bird,
        vertices=jnp.asarray(vertices * stretch, jnp.float32),
        joints=jnp.asarray(joints * stretch, jnp.float32),
        shape_basis=bird.shape_basis[:0],
        shape_variance=bird.shape_variance[:0],
        bone_mean=jnp.asarray(bone, jnp.float32),
    )


def _draw_plumage(rng: np.random.Generator, bird: Bird) -> Float[np.ndarray, "V 3"]:
    """Draw colours of the vertices: the murre's, one colour for each part of the body, or a random pattern."""
    kind = rng.random()
    murre = np.asarray(bird.vertex_colours, np.float64)[:, ::-1] ** GAMMA
    if kind < 0.25:
        return np.clip(murre * rng.uniform(0.5, 2, 3), 0.01, 0.95)
    vertices, names = np.asarray(bird.vertices, np.float64), bird.joint_names
    weights = np.asarray(bird.skin_weights, np.float64)
    parts = [
        weights[:, [i for i, name in enumerate(names) if any(word in name for word in words)]].sum(1)
        for words in (("neck", "head", "jaw"), ("shoulder", "elbow", "wrist", "wing"), ("foot", "ankle"), ("tail",))
    ]
    low, high = np.quantile(vertices[:, 2], [0.2, 0.6])
    belly = 1 - np.clip((vertices[:, 2] - low) / (high - low), 0, 1)
    bill = np.clip((vertices[:, 1] - 9.2) / 0.6, 0, 1)  # the head ends 9.2 units in front of the root
    colours = np.broadcast_to(_colour(rng), murre.shape)
    for share in (belly, *parts, bill):
        if rng.random() < 0.6:
            colours = colours + share[:, None] * (_colour(rng) - colours)
    if rng.random() < 0.5:
        noise = Noise(rng, octaves=3, coarsest=8)
        spots = noise(vertices[:, 0] + vertices[:, 2], vertices[:, 1], rng.uniform(10, 50)) > rng.uniform(0, 1.5)
        colours = np.where(spots[:, None], _colour(rng), colours)
    return np.clip(colours, 0.01, 0.95)


def _colour(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    colour = _NATURAL[rng.integers(len(_NATURAL))] * rng.uniform(0.7, 1.4) + rng.uniform(-0.02, 0.05, 3)
    return np.clip(colour, 0.01, 0.95)
