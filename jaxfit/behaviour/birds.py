"""`Birds`: what the definitions of features receive, and `Flock`: the birds of a result, some frames at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from jaxfit.cameras.camera import Camera
from jaxfit.data.projection import in_image
from jaxfit.data.solution import Solution, select_solution
from jaxfit.fitting.ledge import on_ledge
from jaxfit.fitting.ledge_plane import estimate_ledge
from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import Bird, rest_length
from jaxfit.model.kinematics import Pose, Rig, fold_bird, joint_transforms, posed_joints, posed_keypoints

MAX_TILT_SD_DEG = 15.0
"""Standard deviation of an estimated vertical above which the vertical is unknown, degrees.

Postures on a ledge differ by some 15° of pitch: a vertical that is wrong by more takes one posture for another.
"""
STEPS = 21
"""Steps from frame to frame of which the median is the usual step: fewer follow gaps, more hide a new frame rate."""
POSES = 4096
"""Poses that are computed at once, so that results of any length share one compiled program."""
Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class Birds:
    """N birds over T frames in one world. All arrays are float64 and read-only; values without a pose are NaN.

    The frames are a part of the film: up to 1,000 frames, and those of 2 s before and after them. A value may depend on
    these frames only, never on the whole film. A function that compares frames states `needs=("time",)`.

    Lengths are in `unit`: metres, or lengths of the model at rest from bill tip to tail tip (body lengths, `bl`).
    """

    track_id: Int[np.ndarray, "N"]
    time_s: Float[np.ndarray, "T"]
    """NaN where unknown."""
    R_world_body: Float[np.ndarray, "N T 3 3"]
    """Rotation from the body to the world. Axes of the body: x to its right, y forwards, z to its back."""
    joints: Float[np.ndarray, "N T J 3"]
    """Positions in the world."""
    keypoints: Float[np.ndarray, "N T K 3"]
    """Positions in the world."""
    joint_names: tuple[str, ...]
    keypoint_names: tuple[str, ...]
    body_length: Float[np.ndarray, "N T"]
    """Length of each bird in the rest pose, from bill tip to tail tip."""
    bone_length: Float[np.ndarray, "N T J"]
    """Distance of each joint from its parent; 0 for the root."""
    contact: Float[np.ndarray, "N T"]
    """Probability that the bird stands on the ledge z = 0; NaN if no ledge is known."""
    unit: str
    """`m`, or `bl`: body lengths."""
    level: bool
    """Whether z points up."""
    together: bool
    """Whether the birds are in one world at the same time; birds of photographs are not."""
    interval_s: float
    """Usual time between frames of the whole video; NaN where unknown."""
    step_s: Float[np.ndarray, "T"]
    """Usual time between frames around each frame (`usual_steps`); NaN where unknown."""
    first: int
    """Position of the first of these frames in the video."""
    _stored: dict[Any, Any] = field(default_factory=dict)

    @property
    def valid(self) -> Bool[np.ndarray, "N T"]:
        """Where a bird has a pose."""
        return np.isfinite(self.joints[:, :, 0, 0])

    @property
    def place(self) -> Float[np.ndarray, "N T 3"]:
        """Position of the root joint, which is in the middle of the body."""
        return self.joints[:, :, 0]

    @property
    def forward(self) -> Float[np.ndarray, "N T 3"]:
        """Direction of the long axis of the body, towards the head."""
        return self.R_world_body[..., 1]

    def joint(self, name: str) -> Float[np.ndarray, "N T 3"]:
        """Return the positions of a joint."""
        return self.joints[:, :, self.joint_names.index(name)]

    def keypoint(self, name: str) -> Float[np.ndarray, "N T 3"]:
        """Return the positions of a keypoint."""
        return self.keypoints[:, :, self.keypoint_names.index(name)]

    def bone(self, name: str) -> Float[np.ndarray, "N T"]:
        """Return the distance of a joint from its parent."""
        return self.bone_length[:, :, self.joint_names.index(name)]

    def in_body(self, direction: Float[np.ndarray, "N T 3"]) -> Float[np.ndarray, "N T 3"]:
        """Return directions of the world in the axes of the body."""
        return np.einsum("ntji,ntj->nti", self.R_world_body, direction)

    def once(self, function: Callable[[Birds], Value]) -> Value:
        """Return the value of a function of the birds, which is computed once. Arrays become read-only."""
        if function not in self._stored:
            value = function(self)
            _make_read_only(*(value if isinstance(value, tuple) else (value,)))
            self._stored[function] = value
        return self._stored[function]


def _make_read_only(*values: Any) -> None:
    for value in values:
        if isinstance(value, np.ndarray):
            value.flags.writeable = False


def times_known(time_s: Float[np.ndarray, "T"]) -> bool:
    """Return whether movements can be measured: all times are known, of more than one frame."""
    return len(time_s) > 1 and bool(np.isfinite(time_s).all())


def usual_steps(time_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """Return the usual time between frames around each frame: the median of `STEPS` steps; NaN for unknown times.

    A gap of the video does not change it, and a new frame rate changes it within a frame.
    """
    if not times_known(time_s):
        return np.full(len(time_s), np.nan)
    steps = np.diff(time_s)
    if len(steps) <= STEPS:
        return np.full(len(time_s), np.median(steps))
    half = STEPS // 2
    # at the ends of the video, the first and the last steps
    middle = np.clip(np.arange(len(time_s)), half, len(steps) - 1 - half)
    return median_filter(steps, STEPS)[middle]


def whole_frames(seconds: float, step_s: Float[np.ndarray, "*T"]) -> Int[np.ndarray, "*T"]:
    """Return the whole number of frames that is nearest to a time, at least 1; halves are rounded up.

    Args:
        seconds: the time.
        step_s: time between frames. Rounding errors of it do not change the result.
    """
    return np.maximum(np.floor(seconds / np.asarray(step_s) + 0.5 + 1e-6), 1).astype(int)


@dataclass(frozen=True, eq=False)
class Flock:
    """The birds of a result in one world."""

    solution: Solution
    """The poses of N birds in T frames; without a ledge of its own, on the estimated ledge."""
    bird: Bird
    """The model."""
    time_s: Float[np.ndarray, "T"]
    """Time of each frame; NaN where unknown."""
    R_world_body: Float[np.ndarray, "N T 3 3"]
    """Rotation from the body to the world; any rotation without a pose."""
    place: Float[np.ndarray, "N T 3"]
    """Position of the root joint in `unit`."""
    per_unit: float
    """Length of a model unit in `unit`."""
    size: Float[np.ndarray, "N T"]
    """Size of each bird relative to the model."""
    contact: Float[np.ndarray, "N T"]
    """Probability that the bird stands on the ledge; NaN if no ledge is known."""
    unit: str
    """Unit of lengths: `m`, or `bl`, body lengths."""
    level: bool
    """Whether z points up."""
    together: bool
    """Whether the birds are in one world at the same time; birds of photographs are not."""
    notes: tuple[str, ...]
    """Sentences about what is not known, for people."""

    @cached_property
    def _rig(self) -> Rig:
        return fold_bird(self.bird)

    @cached_property
    def interval_s(self) -> float:
        """Usual time between frames, seconds; NaN where unknown."""
        return float(np.median(np.diff(self.time_s))) if len(self.time_s) > 1 else float("nan")

    @cached_property
    def step_s(self) -> Float[np.ndarray, "T"]:
        """Usual time between frames around each frame, seconds; NaN where unknown."""
        return usual_steps(self.time_s)

    @property
    def model_length(self) -> float:
        """Length of the model at rest, from bill tip to tail tip, in `unit`."""
        return self.per_unit * body_length(self.bird)

    def select(self, rows: Int[np.ndarray, "M"], columns: Int[np.ndarray, "L"]) -> Flock:
        """Return M of the birds in L of the frames, chosen by their positions."""
        arrays = ("R_world_body", "place", "size", "contact")
        return replace(
            self,
            solution=select_solution(self.solution, rows, columns),
            time_s=self.time_s[columns],
            **{name: getattr(self, name)[rows][:, columns] for name in arrays},
        )

    def birds(self, frames: slice, rng: np.random.Generator | None = None) -> Birds:
        """Return the birds in some frames.

        Args:
            frames: positions of the frames.
            rng: draws poses from the error bars of the result; None: the poses of the result.
        """
        s, rig = self.solution, self._rig
        valid, shape = s.valid[:, frames], s.valid[:, frames].shape
        pose = jax.tree.map(lambda values: values[:, frames], s.poses)
        R = self.R_world_body[:, frames]
        if rng is not None:
            pose, R = self._drawn(pose, R, frames, rng)
        still = replace(pose, global_orient=np.zeros_like(pose.global_orient), transl=np.zeros_like(pose.transl))
        still = replace(still, scale=self.size[:, frames].astype(np.float32))
        flat = jax.tree.map(lambda values: np.asarray(values).reshape(valid.size, *values.shape[2:]), still)
        joints, keypoints = _posed(rig, flat)
        root = joints[:, :1]

        def in_world(points: np.ndarray) -> np.ndarray:
            local = ((points - root) * self.per_unit).reshape(*shape, points.shape[1], 3)
            placed = np.einsum("ntij,ntpj->ntpi", R, local) + self.place[:, frames, None]
            return np.where(valid[..., None, None], placed, np.nan)

        parents = np.maximum(np.asarray(self.bird.parents), 0)
        world = in_world(joints)
        size = np.where(valid, self.size[:, frames], np.nan)
        birds = Birds(
            track_id=s.track_id.view(),
            time_s=self.time_s[frames],
            R_world_body=np.where(valid[..., None, None], R, np.nan),
            joints=world,
            keypoints=in_world(keypoints),
            joint_names=self.bird.joint_names,
            keypoint_names=self.bird.keypoint_names,
            body_length=self.model_length * size,
            bone_length=np.linalg.norm(world - world[:, :, parents], axis=-1),
            contact=np.where(valid, self.contact[:, frames], np.nan),
            unit=self.unit,
            level=self.level,
            together=self.together,
            interval_s=self.interval_s,
            step_s=self.step_s[frames],
            first=frames.start or 0,
        )
        _make_read_only(*vars(birds).values())
        return birds

    def _drawn(self, pose: Pose, R: np.ndarray, frames: slice, rng: np.random.Generator) -> tuple[Pose, np.ndarray]:
        """Return poses drawn from the error bars, as if the errors of all angles were independent.

        Unknown error bars count as 0: `describe` leaves out the standard deviations of these frames.
        """
        bars = self.solution.error_bars
        assert bars is not None  # `describe` asks for deviations of results with error bars only

        def error(sd: np.ndarray) -> Rotation:
            deviation = np.nan_to_num(sd[:, frames])
            return Rotation.from_rotvec((deviation * rng.standard_normal(deviation.shape)).reshape(-1, 3))

        body = Rotation.from_rotvec(np.nan_to_num(pose.body_pose).reshape(-1, 3)) * error(bars.body_pose_sd)
        drawn = body.as_rotvec().reshape(pose.body_pose.shape).astype(np.float32)
        return replace(pose, body_pose=drawn), R @ error(bars.global_orient_sd).as_matrix().reshape(R.shape)


def body_length(bird: Bird) -> float:
    """Return the length of a model at rest, model units: from bill tip to tail tip, else from end to end."""
    length = rest_length(bird)
    return length if np.isfinite(length) else float(np.ptp(np.asarray(bird.vertices), axis=0).max())


def _posed(rig: Rig, pose: Pose) -> tuple[Float[np.ndarray, "M J 3"], Float[np.ndarray, "M K 3"]]:
    """Return joints and keypoints of M poses, model units."""
    M, parts = len(pose.scale), []
    if not M:
        return np.zeros((0, len(rig.joint_names), 3)), np.zeros((0, len(rig.keypoint_names), 3))
    for first in range(0, M, POSES):
        chosen = np.minimum(np.arange(first, first + POSES), M - 1)
        parts.append(jax.tree.map(np.asarray, _posed_block(rig, jax.tree.map(lambda values: values[chosen], pose))))  # noqa: B023
    joints, keypoints = (np.concatenate([part[i] for part in parts])[:M].astype(np.float64) for i in (0, 1))
    return joints, keypoints


@jax.jit
def _posed_block(rig: Rig, pose: Pose) -> tuple[Float[Array, "M J 3"], Float[Array, "M K 3"]]:
    def one(frame: Pose) -> tuple[Float[Array, "J 3"], Float[Array, "K 3"]]:
        A = joint_transforms(rig, frame)
        return posed_joints(rig, A, frame), posed_keypoints(rig, A, frame)

    return jax.vmap(one)(pose)


def flock_of(
    solution: Solution,
    bird: Bird,
    time_s: Float[np.ndarray, "T"],
    cameras: int = 0,
    camera: Camera | None = None,
    photographs: bool = False,
    source: object = "the result",
) -> Flock:
    """Return the birds of a result in one world whose z axis points up, if this direction is known.

    A result on a ledge has this world. Of other results, the ledge is estimated (`fitting.ledge_plane`): in metres with
    calibrated cameras, else in lengths of the model, because one camera alone measures no size. A vertical that is
    less certain than `MAX_TILT_SD_DEG` counts as unknown.

    Args:
        solution: the poses; those in a world, in the frame of `camera` (`data.world.as_filmed`).
        bird: the model.
        time_s: time of each frame; NaN where unknown.
        cameras: number of cameras that the poses were fitted to; more than one camera knows sizes.
        camera: the first camera of a result in a world.
        photographs: whether the frames are photographs of different birds, which share no world.
        source: name of the result in messages.
    """
    s, notes = solution, []
    if s.contact is None and not photographs:
        model = bird if s.world is not None and bird.metres_per_unit else replace(bird, metres_per_unit=1.0)
        try:
            found = estimate_ledge(s, model, None if camera is None else camera.pinhole(), source=source)
            count, tilt_sd = found.facts["birds"], found.facts["tilt_sd_deg"]
            birds = "1 bird" if count == 1 else f"{count} birds"
            if tilt_sd <= MAX_TILT_SD_DEG:
                s = on_ledge(s, model, found.camera, known_sizes=cameras > 1)
                notes.append(f"the vertical is estimated from {birds} (± {tilt_sd:.1f}°)")
            else:
                limit = f"at most {MAX_TILT_SD_DEG:.0f}° is needed"
                problem = f"estimated from {birds}, its error is ± {tilt_sd:.0f}°, and {limit}"
                notes.append(f"the ledge and the vertical are unknown: {problem}")
        except InputError as error:
            notes.append(f"the ledge and the vertical are unknown: {error.problem}")
    if solution.world is not None and bird.metres_per_unit:
        unit, per_unit = "m", bird.metres_per_unit
    else:
        unit, per_unit = "bl", 1 / body_length(bird)
    standing = s.contact is not None and not photographs
    contact = np.asarray(s.contact, np.float64) if standing else np.full(s.valid.shape, np.nan)
    if s.world is not None:
        R = np.where(s.valid[..., None, None], np.asarray(s.world.R_world_root, np.float64), np.eye(3))
        place = s.world.transl_world_m * (1.0 if unit == "m" else per_unit)
        size = np.where(s.valid, s.poses.scale, 1.0).astype(np.float64)
    else:
        at = in_image(s, bird)
        R = Rotation.from_rotvec(np.nan_to_num(at.orientation).reshape(-1, 3)).as_matrix().reshape(*s.valid.shape, 3, 3)
        place, size = at.root * per_unit, np.where(s.valid, at.size, 1.0)
    return Flock(s, bird, time_s, R, place, per_unit, size, contact, unit, standing, not photographs, tuple(notes))
