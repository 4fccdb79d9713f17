"""Random landscapes, and random species: body, posture, plumage."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxfit.learning.networks.augment import draw_clutter
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose, fold_bird, window_transforms, window_vertices
from jaxfit.model.murre import POSTURES
from jaxfit.simulation.footage import GAMMA, Noise, smoothstep


class Landscape(NamedTuple):
    """A picture without birds."""

    picture: Float[np.ndarray, "H W 3"]
    """Linear light: blue, green, red."""
    water_from: int
    """First row of water, where birds swim; the height of the picture if there is no water."""


class _Ground(NamedTuple):
    """A kind of ground: two scales of noise select its colours."""

    colours: tuple[tuple[float, float, float], ...]
    """From dark to light, linear light."""
    period: tuple[float, float]
    """Range of the period of the coarse noise, in widths of the picture."""
    grain: float
    """Period of the fine noise, relative to the coarse noise."""
    highlights: tuple[float, float, float]
    """Colour of bright patches: foam, snow, guano, clouds."""
    strokes: tuple[int, int] = (0, 1)
    """Range of the number of blades or branches."""


_GROUNDS = {
    "water": _Ground(((0.10, 0.08, 0.05), (0.32, 0.26, 0.21), (0.55, 0.45, 0.38)), (0.15, 1.2), 0.3, (0.8, 0.8, 0.8)),
    "grass": _Ground(
        ((0.02, 0.07, 0.03), (0.05, 0.2, 0.09), (0.15, 0.38, 0.3)), (0.5, 3), 0.1, (0.2, 0.5, 0.5), (0, 900)
    ),
    "sand": _Ground(((0.18, 0.26, 0.33), (0.38, 0.5, 0.58)), (0.7, 3), 0.05, (0.92, 0.9, 0.88)),
    "rock": _Ground(((0.05, 0.055, 0.06), (0.2, 0.22, 0.25), (0.42, 0.45, 0.48)), (0.5, 2.5), 0.5, (0.75, 0.75, 0.75)),
    "leaves": _Ground(
        ((0.01, 0.025, 0.015), (0.04, 0.16, 0.07), (0.15, 0.42, 0.28)), (0.2, 1.5), 0.3, (0.3, 0.5, 0.4), (0, 90)
    ),
    "sky": _Ground(((0.75, 0.45, 0.22), (0.85, 0.75, 0.65)), (1, 4), 0.5, (0.9, 0.9, 0.9)),
}
"""Kinds of ground; the sky is only above a border."""


def draw_landscape(rng: np.random.Generator, width: int, height: int, pitch_deg: float) -> Landscape:
    """Draw a landscape: one kind of ground, or two kinds with an uneven border, and objects.

    Args:
        rng: source of randomness.
        width, height: size of the picture, pixels.
        pitch_deg: angle of the camera below the horizontal; textures are foreshortened accordingly.
    """
    flatness = max(np.sin(np.radians(pitch_deg)), 0.15)
    flat = [kind for kind in _GROUNDS if kind != "sky"]
    lower = str(rng.choice(flat))
    picture, water_from = _paint(rng, lower, (height, width), flatness), 0 if lower == "water" else height
    if rng.random() < (0.75 if pitch_deg < 35 else 0.3):
        upper = str(rng.choice(["sky", "sky", "leaves", "grass", "rock"] if pitch_deg < 35 else flat))
        row = rng.uniform(0.05, 0.6) * height
        rough = rng.uniform(0, 0.04) * height * Noise(rng, 6)(np.arange(width), np.zeros(width), 2.0 * width)
        above = (np.arange(height)[:, None] < row + rough[None])[..., None]
        picture = np.where(above, _paint(rng, upper, (height, width), flatness), picture)
        water_from = max(water_from, int(row + np.abs(rough).max())) if lower == "water" else height
    if rng.random() < 0.5:
        picture = draw_clutter(rng, picture)
    return Landscape(picture.astype(np.float32), water_from)


def _paint(rng: np.random.Generator, kind: str, shape: tuple[int, int], flatness: float) -> Float[np.ndarray, "H W 3"]:
    """Draw one kind of ground with a random tint; water has finer ripples towards the top of the picture."""
    ground, (height, width) = _GROUNDS[kind], shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    if kind == "water":
        depth = height * (0.3 + flatness) / (y + 0.3 * height + 1)
        x, y = (x - width / 2) * depth, 300 * depth
    if kind not in ("leaves", "sky"):
        y = y / flatness
    period = rng.uniform(*ground.period) * width
    coarse, fine = Noise(rng, 6)(x, y, period), Noise(rng, 6, 0.8)(x, y, max(ground.grain * period, 40))
    values = np.clip(0.5 + rng.uniform(0.1, 0.3) * coarse + rng.uniform(0, 0.25) * fine, 0, 1)
    colours = np.clip(np.array(ground.colours) * rng.uniform(0.75, 1.3, 3) * rng.uniform(0.6, 1.5), 0, 1)
    stops = np.linspace(0, 1, len(colours))
    picture = np.stack([np.interp(values, stops, colours[:, i]) for i in range(3)], -1)
    share = smoothstep(rng.uniform(0.6, 2), 2.4, coarse + 0.5 * fine)[..., None] * rng.uniform(0, 1)
    picture = (picture * (1 - share) + np.array(ground.highlights) * share).astype(np.float32)
    if kind == "leaves" and rng.random() < 0.6:  # out of focus
        picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(1, 8))
    draw_strokes(rng, picture, rng.uniform(0, [width, height], (int(rng.integers(*ground.strokes)), 2)), colours[-1])
    return picture


def draw_strokes(rng: np.random.Generator, picture: np.ndarray, roots_px: np.ndarray, colour: np.ndarray) -> None:
    """Draw blades of grass or twigs upwards from some points into a picture of 1 or 3 channels, in place."""
    for root in roots_px:
        tip = root + np.array([rng.normal(0, 30), -rng.uniform(4, 200)])
        shade = (colour * rng.uniform(0.2, 1.2)).tolist()
        cv2.line(
            picture, root.astype(int).tolist(), tip.astype(int).tolist(), shade, int(rng.integers(1, 4)), cv2.LINE_AA
        )


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


@dataclasses.dataclass(frozen=True, eq=False)
class Species:
    """A body and a plumage."""

    body: Bird
    colours: Float[np.ndarray, "V 3"]
    """Linear light: blue, green, red."""

    def pose(self, rng: np.random.Generator, count: int, manner: str) -> tuple[np.ndarray, np.ndarray]:
        """Draw postures and headings of some birds.

        Args:
            rng: source of randomness.
            count: number of birds.
            manner: `stand`, `swim` or `fly`.

        Returns:
            Vertices (count, V, 3) and keypoints (count, K, 3) in the world frame (z up), with the root at the origin.
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
        return vertices, np.einsum("kv,pvc->pkc", np.asarray(self.body.keypoint_weights, np.float64), vertices)


def draw_species(rng: np.random.Generator, bird: Bird) -> Species:
    """Draw a species from the murre: other proportions of neck, legs, wings, head, bill and body, other colours."""
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
    body = dataclasses.replace(
        bird,
        vertices=jnp.asarray(vertices * stretch, jnp.float32),
        joints=jnp.asarray(joints * stretch, jnp.float32),
        shape_basis=bird.shape_basis[:0],
        shape_variance=bird.shape_variance[:0],
        bone_mean=jnp.asarray(bone, jnp.float32),
    )
    return Species(body, _draw_plumage(rng, bird))


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
