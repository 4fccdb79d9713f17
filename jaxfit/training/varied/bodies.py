"""Random species: the body, posture and plumage of the murre, changed far beyond the variation of murres."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import fold_bird, window_transforms, window_vertices
from jaxfit.model.murre import POSTURES
from jaxfit.model.pose import Pose
from jaxfit.simulation.footage import GAMMA
from jaxfit.simulation.texture import Noise
from jaxfit.training.varied.landscapes import log_uniform

__all__ = ["PosedBirds", "Species", "draw_species"]

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
    own = np.asarray(bird.vertex_colours, np.float64)[:, ::-1] ** GAMMA
    if kind < 0.25:
        return np.clip(own * rng.uniform(0.5, 2, 3), 0.01, 0.95)
    vertices, names = np.asarray(bird.vertices, np.float64), bird.joint_names
    weights = np.asarray(bird.skin_weights, np.float64)
    parts = [
        weights[:, [i for i, name in enumerate(names) if any(word in name for word in words)]].sum(1)
        for words in (("neck", "head", "jaw"), ("shoulder", "elbow", "wrist", "wing"), ("foot", "ankle"), ("tail",))
    ]
    low, high = np.quantile(vertices[:, 2], [0.2, 0.6])
    belly = 1 - np.clip((vertices[:, 2] - low) / (high - low), 0, 1)
    bill = np.clip((vertices[:, 1] - 9.2) / 0.6, 0, 1)  # the head ends 9.2 units in front of the root
    colours = np.broadcast_to(_colour(rng), own.shape)
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
