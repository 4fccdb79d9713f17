"""The birds of a scene: who stands where, what each does, and their exact poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import fold_bird, window_joints, window_transforms, window_vertices
from jaxfit.model.murre import POSTURES
from jaxfit.model.pose import Pose
from jaxfit.model.rotation import unwrap_axis_angle
from jaxfit.simulation.behaviour import REACH, Key, Motion, Performer, motion_of
from jaxfit.simulation.motion import smooth_noise
from jaxfit.simulation.viewpoint import Viewpoint

__all__ = ["Actor", "act"]

SPACING = 9.0
"""Least distance between standing places, model units (18 cm): shoulder to shoulder."""
FROM_EDGE, FROM_WALL = 7.0, 9.0
"""How near to edge and wall feet stand, model units."""
KNOT_S = 0.8
"""Time in which a bird's small movements change."""
YIELD_S = 0.6
"""Time in which a bird makes room."""
SWAY = 0.035
"""Standard deviation of each joint angle's own movement, radians."""
BODY = (("lower_body", "chest", 2.9), ("chest", "neck", 2.3), ("neck", "head", 1.9))
"""Capsules between joints that stand for the body where birds must not run into each other: radii in model units."""


@dataclass(frozen=True)
class Actor:
    """One bird over T frames."""

    pose: Pose
    """Camera frame; scale (1,), bone lengths and betas constant."""
    vertices_world: Float[np.ndarray, "T V 3"]
    behaviour: np.ndarray
    """(T,) index into BEHAVIOURS."""


def act(bird: Bird, birds: int, frames: int, fps: float, ledge_depth: float, view: Viewpoint, seed: int) -> list[Actor]:
    """Let birds live on a ledge for a while.

    Each of the first birds shows another behaviour, so that a scene of seven has them all; afterwards chance decides.

    Args:
        bird: the murre.
        birds: how many.
        frames, fps: length and frames a second.
        ledge_depth: from edge to wall, model units.
        view: the camera.
        seed: the same seed gives the same scene.
    """
    rng = np.random.default_rng((seed, 1))
    places = _places(rng, birds, ledge_depth, view)
    performers = _perform(rng, places, ledge_depth, frames / fps)
    motions = [motion_of(performer, frames, fps) for performer in performers]
    bodies = [_Body(bird, motion, rng, KNOT_S * fps) for motion in motions]
    _separate(bodies, YIELD_S * fps)
    return [body.actor(view) for body in bodies]


def _places(rng: np.random.Generator, birds: int, depth: float, view: Viewpoint) -> list[tuple[float, float]]:
    """Standing places in view, every other one next to an earlier one, so that neighbours hide each other."""
    half = 0.36 * view.width / view.focal_px * float(np.linalg.norm(view.position_world - [0, depth / 2, 0]))
    spacing, places = SPACING, []
    while len(places) < birds:
        for _ in range(200):
            if places and rng.random() < 0.75:
                angle, reach = rng.uniform(0, 2 * np.pi), rng.uniform(spacing, 1.3 * spacing)
                spot = np.add(places[rng.integers(len(places))], reach * np.array([np.cos(angle), np.sin(angle)]))
            else:
                spot = np.array([rng.uniform(-half, half), rng.uniform(FROM_EDGE, depth - FROM_WALL)])
            inside = abs(spot[0]) <= half and FROM_EDGE <= spot[1] <= depth - FROM_WALL
            if inside and all(np.hypot(*np.subtract(spot, other)) >= spacing for other in places):
                places.append((float(spot[0]), float(spot[1])))
                break
        else:
            spacing *= 0.9  # a crowded ledge
    return places


def _perform(
    rng: np.random.Generator, places: Sequence[tuple[float, float]], depth: float, seconds: float
) -> list[Performer]:
    leading = ["preen", "walk", "approach", "flap", "incubate", "fly_off", "stand"]
    usual, weights = ["stand", "preen", "walk", "flap", "approach", "incubate"], [0.4, 0.22, 0.12, 0.06, 0.1, 0.1]
    performers = []
    for n, place in enumerate(places):
        heading = rng.normal(0, 0.9) if rng.random() < 0.6 else rng.uniform(-np.pi, np.pi)  # most face the wall
        bird = Performer(rng, [Key(-1.0, POSTURES["standing"], place, float(heading))])
        first = leading[n] if n < len(leading) else str(rng.choice(usual, p=weights))
        if first != "incubate":
            bird.perform("stand", rng.uniform(0.0, 0.6))
        while bird.now.time_s < seconds and first is not None:
            target = _target(rng, n, places, depth, first)
            last = bird.now.time_s + rng.uniform(1.0, 2.5) >= seconds
            bird.perform(first, seconds if last else bird.now.time_s + rng.uniform(1.5, 3.5), target)
            if first == "fly_off":
                break
            first = "incubate" if first == "incubate" else str(rng.choice(usual[:-1], p=np.array(weights[:-1]) / 0.9))
        performers.append(bird)
    return performers


def _target(rng: np.random.Generator, n: int, places: Sequence[tuple[float, float]], depth: float, behaviour: str):
    """Where the behaviour leads: to a neighbour, or to a free spot near by."""
    own = np.array(places[n])
    others = np.array([place for i, place in enumerate(places) if i != n]).reshape(-1, 2)
    if behaviour == "approach" and len(others):
        distance = np.linalg.norm(others - own, axis=1)
        far_enough = np.where(distance > REACH + 4, distance, distance + 100)  # one to walk to, if there is one
        return tuple(others[np.argmin(far_enough)])
    if behaviour == "walk":
        # of some random spots the one that is farthest from everybody
        spots = own + rng.uniform(9, 22) * np.array(
            [[np.cos(a), 0.5 * np.sin(a)] for a in rng.uniform(0, 2 * np.pi, 12)]
        )
        spots[:, 1] = np.clip(spots[:, 1], FROM_EDGE, depth - FROM_WALL)
        room = [np.min(np.linalg.norm(others - spot, axis=1), initial=99.0) for spot in spots]
        return tuple(spots[int(np.argmax(room))])
    return None


class _Body:
    """One bird's curves, turned into poses that stand on the ledge."""

    def __init__(self, bird: Bird, motion: Motion, rng: np.random.Generator, frames_a_knot: float):
        frames = len(motion.pitch)
        self.motion, self.shift = motion, np.zeros((frames, 2))
        low, high = np.moveaxis(np.asarray(bird.joint_limits, np.float64), -1, 0)
        sway = SWAY * smooth_noise(rng, frames, motion.body_pose.shape[1:], frames_a_knot)
        self.body_pose = np.clip(motion.body_pose + sway, low, high)
        lean = 0.04 * smooth_noise(rng, frames, (3,), frames_a_knot)
        self.R_world_root = (
            Rotation.from_rotvec(motion.heading[:, None] * [0, 0, 1] + lean * [0, 0, 1])
            * Rotation.from_rotvec((motion.pitch + lean[:, 0])[:, None] * [1, 0, 0])
            * Rotation.from_rotvec(lean[:, 1:2] * [0, 1, 0])
        )
        variance = np.asarray(bird.shape_variance, np.float64)
        pose = Pose(
            global_orient=jnp.asarray(self.R_world_root.as_rotvec(), jnp.float32),
            body_pose=jnp.asarray(self.body_pose, jnp.float32),
            transl=jnp.zeros((frames, 3)),
            scale=jnp.full(1, rng.normal(1, 0.03), jnp.float32),
            bone_length=jnp.asarray(bird.bone_mean),
            betas=jnp.asarray(0.7 * np.sqrt(variance) * rng.normal(size=len(variance)), jnp.float32),
        )
        self.pose = pose
        rig = fold_bird(bird)
        A = window_transforms(rig, pose)
        self.vertices = np.asarray(window_vertices(rig, A, pose), np.float64)  # about the root
        joints = np.asarray(window_joints(rig, A, pose), np.float64)
        names = bird.joint_names
        feet = joints[:, [names.index("left_foot"), names.index("right_foot")]].mean(1)
        airborne = np.clip(motion.altitude / 3.0, 0, 1)[:, None]
        self.root = np.column_stack(
            [motion.feet - (1 - airborne) * feet[:, :2], motion.altitude - self.vertices[..., 2].min(1)]
        )
        self.capsules = [(joints[:, names.index(a)], joints[:, names.index(b)], r) for a, b, r in BODY]

    def place(self) -> Float[np.ndarray, "T 3"]:
        return self.root + np.column_stack([self.shift, np.zeros(len(self.shift))])

    def actor(self, view: Viewpoint) -> Actor:
        place = self.place()
        orient = (Rotation.from_matrix(view.R_cam_world) * self.R_world_root).as_rotvec()
        pose = Pose(
            global_orient=unwrap_axis_angle(jnp.asarray(orient, jnp.float32)),
            body_pose=self.pose.body_pose,
            transl=jnp.asarray(view.to_camera(place), jnp.float32),
            scale=self.pose.scale,
            bone_length=self.pose.bone_length,
            betas=self.pose.betas,
        )
        return Actor(pose, self.vertices + place[:, None], self.motion.behaviour)


def _separate(bodies: Sequence[_Body], frames: float, rounds: int = 12) -> None:
    """Push birds apart along the ledge where their bodies would overlap, smoothly over time."""
    for _ in range(rounds):
        pushes = [np.zeros_like(body.shift) for body in bodies]
        for i, a in enumerate(bodies):
            for j in range(i):
                b = bodies[j]
                away = _overlap(a, b)
                pushes[i] += away / 2
                pushes[j] -= away / 2
        if max(np.abs(push).max() for push in pushes) < 0.02:
            break
        for body, push in zip(bodies, pushes, strict=True):
            body.shift += _smooth_envelope(push, frames)


def _overlap(a: _Body, b: _Body) -> Float[np.ndarray, "T 2"]:
    """How far bird a must move along the ledge to be clear of b, per frame; zero where they do not meet."""
    place_a, place_b = a.place(), b.place()
    worst, direction = np.zeros(len(place_a)), np.zeros((len(place_a), 2))
    for start_a, end_a, radius_a in a.capsules:
        for start_b, end_b, radius_b in b.capsules:
            gap = np.full(len(place_a), np.inf)
            between = np.zeros((len(place_a), 3))
            for s in np.linspace(0, 1, 5):  # samples along both axes are close enough for pushing
                for u in np.linspace(0, 1, 5):
                    offset = (start_a + s * (end_a - start_a) + place_a) - (start_b + u * (end_b - start_b) + place_b)
                    distance = np.linalg.norm(offset, axis=1)
                    nearer = distance < gap
                    gap, between[nearer] = np.where(nearer, distance, gap), offset[nearer]
            depth = radius_a + radius_b - gap
            deeper = depth > worst
            worst[deeper], direction[deeper] = depth[deeper], between[deeper, :2]
    apart = (place_a - place_b)[:, :2]
    direction = np.where(np.linalg.norm(direction, axis=1, keepdims=True) > 0.3, direction, apart)
    return worst[:, None] * direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-6)


def _smooth_envelope(push: Float[np.ndarray, "T 2"], frames: float) -> Float[np.ndarray, "T 2"]:
    """A smooth curve that is nowhere much below the push, so that birds yield before they are touched."""
    window = max(1, round(frames))
    up = maximum_filter1d(np.maximum(push, 0), window, axis=0)
    down = maximum_filter1d(np.maximum(-push, 0), window, axis=0)
    return gaussian_filter1d(up - down, frames / 4, axis=0)
