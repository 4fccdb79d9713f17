"""Positions and poses of all birds, with random motion from the pose prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose, fold_bird, window_joints, window_transforms, window_vertices
from jaxfit.model.murre import POSTURES
from jaxfit.model.rotation import unwrap_axis_angle
from jaxfit.simulation.behaviour import JAB_DISTANCE, Key, Keyframes, Motion, interpolate_keyframes
from jaxfit.simulation.individuals import draw_bones, draw_shape
from jaxfit.simulation.viewpoint import Viewpoint

FRAMES_PER_KNOT = 20.0
"""A random knot every 20 frames: at 25 frames/s, movements last about a second."""


def smooth_noise(
    rng: np.random.Generator, frames: int, shape: tuple[int, ...] = (), frames_per_knot: float = FRAMES_PER_KNOT
) -> Float[np.ndarray, "T *shape"]:
    """Draw smooth random curves of about unit standard deviation: standard normal knots, joined by cosine ramps.

    Args:
        rng: source of randomness.
        frames: length T.
        shape: shape of the array of independent curves.
        frames_per_knot: number of frames between knots.
    """
    knots = rng.normal(size=(int(frames / frames_per_knot) + 2, *shape))
    at = np.arange(frames) / frames_per_knot
    low = at.astype(int)
    ramp = ((1 - np.cos(np.pi * (at - low))) / 2).reshape(-1, *[1] * len(shape))
    return (1 - ramp) * knots[low] + ramp * knots[low + 1]


def smooth_motion(bird: Bird, frames: int, seed: int, depth: float = 200.0, spread: float = 0.7) -> Pose:
    """Draw smooth poses of a bird seen from above that turns, leans, bends and drifts.

    Args:
        bird: the model; body poses vary about the mean of its prior.
        frames: length T of the window.
        seed: seed of the motion.
        depth: distance from the camera in model units.
        spread: amplitude of the body pose, in standard deviations of the prior.

    Returns:
        The pose of a window, with one scale between 0.9 and 1.1, mean bone lengths and mean shape.
    """
    rng = np.random.default_rng(seed)
    from_above = Rotation.from_rotvec([np.pi, 0, 0])  # rotates z up to z towards the camera
    heading = rng.uniform(-np.pi, np.pi) + 0.6 * smooth_noise(rng, frames)
    turned = Rotation.from_rotvec(heading[:, None] * [0, 0, 1])
    orient = turned * Rotation.from_rotvec(0.25 * smooth_noise(rng, frames, (3,))) * from_above
    cholesky = np.linalg.cholesky(np.asarray(bird.pose_covariance, np.float64))
    body = np.asarray(bird.pose_mean) + spread * smooth_noise(rng, frames, (len(cholesky),)) @ cholesky.T
    place = rng.normal(size=2) + np.cumsum(0.05 * smooth_noise(rng, frames, (2,)), axis=0)
    return Pose(
        global_orient=unwrap_axis_angle(jnp.asarray(orient.as_rotvec(), jnp.float32)),
        body_pose=jnp.asarray(body.reshape(frames, -1, 3), jnp.float32),
        transl=jnp.asarray(np.column_stack([place, np.full(frames, depth)]), jnp.float32),
        scale=jnp.full(1, rng.uniform(0.9, 1.1), jnp.float32),
        bone_length=jnp.asarray(bird.bone_mean),
        betas=jnp.zeros(bird.num_shapes),
    )


SPACING = 9.0
"""Least distance between positions, model units (18 cm): birds stand shoulder to shoulder."""
EDGE_MARGIN, WALL_MARGIN = 7.0, 9.0
"""Least distance of the feet from edge and wall, model units."""
KNOT_S = 0.8
"""Time between the knots of a bird's sway, seconds."""
AVOIDANCE_S = 0.6
"""Time in which a bird moves away from another bird, seconds."""
SWAY = 0.035
"""Standard deviation of the sway of each joint angle, radians."""
BODY_CAPSULES = (("lower_body", "chest", 2.9), ("chest", "neck", 2.3), ("neck", "head", 1.9))
"""Capsules of the body for the avoidance of collisions: two joints and the radius in model units."""


@dataclass(frozen=True)
class SimulatedBird:
    """One bird over T frames."""

    pose: Pose
    """Camera frame; scale (1,), bone lengths and betas constant."""
    vertices_world: Float[np.ndarray, "T V 3"]
    behaviour: np.ndarray
    """(T,), index into BEHAVIOURS."""


def simulate_flock(
    bird: Bird,
    birds: int,
    frames: int,
    fps: float,
    ledge_depth: float,
    view: Viewpoint,
    seed: int,
    wings: bool = False,
    bone_sd: float = 0.0,
) -> list[SimulatedBird]:
    """Simulate the motion of several birds on a ledge.

    The first seven birds begin with different behaviours, so that a scene of seven birds shows all behaviours. All
    other behaviours are random.

    Args:
        bird: the murre model.
        birds: number of birds.
        frames, fps: number of frames, and frames per second.
        ledge_depth: distance from the edge of the ledge to the wall, model units.
        view: the camera.
        seed: seed of the motion.
        wings: every bird flaps again and again, or flies off.
        bone_sd: standard deviation of the length of each bone between birds, as a share; it does not change the
            behaviours.
    """
    rng, bones = np.random.default_rng((seed, 1)), np.random.default_rng((seed, 6))
    positions = _draw_positions(rng, birds, ledge_depth, view)
    draw = _draw_wingbeats if wings else _draw_keyframes
    keyframes = draw(rng, positions, ledge_depth, frames / fps)
    motions = [interpolate_keyframes(keys, frames, fps) for keys in keyframes]
    bodies = [_Body(bird, motion, rng, KNOT_S * fps, draw_bones(bird, bones, bone_sd)) for motion in motions]
    _separate(bodies, AVOIDANCE_S * fps)
    return [body.in_camera(view) for body in bodies]


def _draw_positions(rng: np.random.Generator, birds: int, depth: float, view: Viewpoint) -> list[tuple[float, float]]:
    """Draw positions in view, three in four next to an earlier position, so that birds occlude each other."""
    half = 0.36 * view.width / view.focal_px * float(np.linalg.norm(view.position_world - [0, depth / 2, 0]))
    spacing, positions = SPACING, []
    while len(positions) < birds:
        for _ in range(200):
            if positions and rng.random() < 0.75:
                angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(spacing, 1.3 * spacing)
                offset = distance * np.array([np.cos(angle), np.sin(angle)])
                spot = np.add(positions[rng.integers(len(positions))], offset)
            else:
                spot = np.array([rng.uniform(-half, half), rng.uniform(EDGE_MARGIN, depth - WALL_MARGIN)])
            inside = abs(spot[0]) <= half and EDGE_MARGIN <= spot[1] <= depth - WALL_MARGIN
            if inside and all(np.hypot(*np.subtract(spot, other)) >= spacing for other in positions):
                positions.append((float(spot[0]), float(spot[1])))
                break
        else:
            spacing *= 0.9  # too little space: allow smaller distances
    return positions


def _draw_keyframes(
    rng: np.random.Generator, positions: Sequence[tuple[float, float]], depth: float, seconds: float
) -> list[Keyframes]:
    """Draw the behaviours of all birds."""
    first_behaviours = ["preen", "walk", "approach", "flap", "incubate", "fly_off", "stand"]
    behaviours, weights = ["stand", "preen", "walk", "flap", "approach", "incubate"], [0.4, 0.22, 0.12, 0.06, 0.1, 0.1]
    keyframes = []
    for n, position in enumerate(positions):
        heading = rng.normal(0, 0.9) if rng.random() < 0.6 else rng.uniform(-np.pi, np.pi)  # most face the wall
        bird = Keyframes(rng, [Key(-1.0, POSTURES["standing"], position, float(heading))])
        behaviour = first_behaviours[n] if n < len(first_behaviours) else str(rng.choice(behaviours, p=weights))
        if behaviour != "incubate":
            bird.add_behaviour("stand", rng.uniform(0.0, 0.6))
        while bird.last.time_s < seconds:
            target = _choose_target(rng, n, positions, depth, behaviour)
            is_last = bird.last.time_s + rng.uniform(1.0, 2.5) >= seconds
            bird.add_behaviour(behaviour, seconds if is_last else bird.last.time_s + rng.uniform(1.5, 3.5), target)
            if behaviour == "fly_off":
                break
            if behaviour != "incubate":
                behaviour = str(rng.choice(behaviours[:-1], p=np.array(weights[:-1]) / 0.9))
        keyframes.append(bird)
    return keyframes


def _draw_wingbeats(
    rng: np.random.Generator, positions: Sequence[tuple[float, float]], _depth: float, seconds: float
) -> list[Keyframes]:
    """Draw birds of which 30 % fly off at a random time; all birds flap again and again before."""
    keyframes = []
    for position in positions:
        bird = Keyframes(rng, [Key(-1.0, POSTURES["standing"], position, float(rng.uniform(-np.pi, np.pi)))])
        leaves_s = rng.uniform(0, seconds) if rng.random() < 0.3 else np.inf
        bird.add_behaviour("stand", rng.uniform(0.0, 0.4))
        while bird.last.time_s < min(seconds, leaves_s):
            bird.add_behaviour("flap", bird.last.time_s + rng.uniform(0.5, 2.0))
        if bird.last.time_s < seconds:
            bird.add_behaviour("fly_off", seconds)
        keyframes.append(bird)
    return keyframes


def _choose_target(
    rng: np.random.Generator, n: int, positions: Sequence[tuple[float, float]], depth: float, behaviour: str
) -> tuple[float, float] | None:
    """Choose the target of a behaviour: a neighbour, or free space nearby."""
    own = np.array(positions[n])
    others = np.array([position for i, position in enumerate(positions) if i != n]).reshape(-1, 2)
    if behaviour == "approach" and len(others):
        distance = np.linalg.norm(others - own, axis=1)
        # a neighbour at some distance is preferred
        far_enough = np.where(distance > JAB_DISTANCE + 4, distance, distance + 100)
        return tuple(others[np.argmin(far_enough)])
    if behaviour == "walk":
        # of twelve random positions, the position with the largest distance to the nearest bird
        spots = own + rng.uniform(9, 22) * np.array(
            [[np.cos(a), 0.5 * np.sin(a)] for a in rng.uniform(0, 2 * np.pi, 12)]
        )
        spots[:, 1] = np.clip(spots[:, 1], EDGE_MARGIN, depth - WALL_MARGIN)
        room = [np.min(np.linalg.norm(others - spot, axis=1), initial=99.0) for spot in spots]
        return tuple(spots[int(np.argmax(room))])
    return None


class _Body:
    """Poses of one bird on the ledge, world frame."""

    def __init__(
        self,
        bird: Bird,
        motion: Motion,
        rng: np.random.Generator,
        frames_per_knot: float,
        bone_length: Float[np.ndarray, "bones"],
    ):
        frames = len(motion.pitch)
        self.motion, self.shift = motion, np.zeros((frames, 2))
        low, high = np.moveaxis(np.asarray(bird.joint_limits, np.float64), -1, 0)
        sway = SWAY * smooth_noise(rng, frames, motion.body_pose.shape[1:], frames_per_knot)
        self.body_pose = np.clip(motion.body_pose + sway, low, high)
        lean = 0.04 * smooth_noise(rng, frames, (3,), frames_per_knot)
        self.R_world_root = (
            Rotation.from_rotvec(motion.heading[:, None] * [0, 0, 1] + lean * [0, 0, 1])
            * Rotation.from_rotvec((motion.pitch + lean[:, 0])[:, None] * [1, 0, 0])
            * Rotation.from_rotvec(lean[:, 1:2] * [0, 1, 0])
        )
        pose = Pose(
            global_orient=jnp.asarray(self.R_world_root.as_rotvec(), jnp.float32),
            body_pose=jnp.asarray(self.body_pose, jnp.float32),
            transl=jnp.zeros((frames, 3)),
            scale=jnp.full(1, rng.normal(1, 0.03), jnp.float32),
            bone_length=jnp.asarray(bone_length),
            betas=jnp.asarray(draw_shape(bird, rng)),
        )
        self.pose = pose
        rig = fold_bird(bird)
        A = window_transforms(rig, pose)
        self.vertices = np.asarray(window_vertices(rig, A, pose), np.float64)  # relative to the root
        joints = np.asarray(window_joints(rig, A, pose), np.float64)
        names = bird.joint_names
        feet = joints[:, [names.index("left_foot"), names.index("right_foot")]].mean(1)
        airborne = np.clip(motion.altitude / 3.0, 0, 1)[:, None]
        self.root = np.column_stack(
            [motion.feet - (1 - airborne) * feet[:, :2], motion.altitude - self.vertices[..., 2].min(1)]
        )
        self.capsules = [(joints[:, names.index(a)], joints[:, names.index(b)], r) for a, b, r in BODY_CAPSULES]

    def position(self) -> Float[np.ndarray, "T 3"]:
        """Position of the root, world frame."""
        return self.root + np.column_stack([self.shift, np.zeros(len(self.shift))])

    def in_camera(self, view: Viewpoint) -> SimulatedBird:
        """Transform the poses to the camera frame."""
        position = self.position()
        orient = (Rotation.from_matrix(view.R_cam_world) * self.R_world_root).as_rotvec()
        pose = Pose(
            global_orient=unwrap_axis_angle(jnp.asarray(orient, jnp.float32)),
            body_pose=self.pose.body_pose,
            transl=jnp.asarray(view.to_camera(position), jnp.float32),
            scale=self.pose.scale,
            bone_length=self.pose.bone_length,
            betas=self.pose.betas,
        )
        return SimulatedBird(pose, self.vertices + position[:, None], self.motion.behaviour)


def _separate(bodies: Sequence[_Body], frames: float, rounds: int = 12) -> None:
    """Shift birds along the ledge, smoothly over time, until their bodies do not overlap."""
    for _ in range(rounds):
        pushes = [np.zeros_like(body.shift) for body in bodies]
        for i, a in enumerate(bodies):
            for j in range(i):
                b = bodies[j]
                away = _separation(a, b)
                pushes[i] += away / 2
                pushes[j] -= away / 2
        if max(np.abs(push).max() for push in pushes) < 0.02:
            break
        for body, push in zip(bodies, pushes, strict=True):
            body.shift += _smooth_envelope(push, frames)


def _separation(a: _Body, b: _Body) -> Float[np.ndarray, "T 2"]:
    """Compute the shift of bird a along the ledge that separates it from b, per frame; zero without overlap."""
    position_a, position_b = a.position(), b.position()
    worst, direction = np.zeros(len(position_a)), np.zeros((len(position_a), 2))
    share, frames = np.linspace(0, 1, 5), np.arange(len(position_a))  # five points along each axis are precise enough
    s, u = np.repeat(share, 5)[:, None, None], np.tile(share, 5)[:, None, None]
    for start_a, end_a, radius_a in a.capsules:
        for start_b, end_b, radius_b in b.capsules:
            offset = start_a + s * (end_a - start_a) + position_a - (start_b + u * (end_b - start_b) + position_b)
            distance = np.linalg.norm(offset, axis=-1)
            nearest = distance.argmin(0)
            depth = radius_a + radius_b - distance[nearest, frames]
            deeper = depth > worst
            worst[deeper], direction[deeper] = depth[deeper], offset[nearest, frames][deeper, :2]
    apart = (position_a - position_b)[:, :2]
    direction = np.where(np.linalg.norm(direction, axis=1, keepdims=True) > 0.3, direction, apart)
    return worst[:, None] * direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-6)


def _smooth_envelope(push: Float[np.ndarray, "T 2"], frames: float) -> Float[np.ndarray, "T 2"]:
    """Compute a smooth envelope of the shifts, so that birds move before they touch."""
    window = max(1, round(frames))
    up = maximum_filter1d(np.maximum(push, 0), window, axis=0)
    down = maximum_filter1d(np.maximum(-push, 0), window, axis=0)
    return gaussian_filter1d(up - down, frames / 4, axis=0)
