"""Results in a world whose poses a test chooses, the flock of such a result, and points of birds computed by hand."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxfit.behaviour.birds import Flock, flock_of
from jaxfit.behaviour.rules import BehaviourConfig, BehaviourRule
from jaxfit.data.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.model.files import load_murre
from jaxfit.model.kinematics import Pose
from jaxfit.model.murre import POSTURES
from support.birds import error_bars, skin_by_hand

BIRD = load_murre()
UNIT_M = BIRD.metres_per_unit
"""Length of a model unit in metres."""
LENGTH_M = float(np.hypot(11.85 + 7.65, 5.47 - 0.78)) * UNIT_M
"""Length of the murre from bill tip to tail tip, from the coordinates of both keypoints in the rest pose."""
REST = np.zeros((BIRD.num_joints - 1, 3))
STANDING = POSTURES["standing"].body_pose


def turned(heading=90.0, pitch=0.0, roll=0.0):
    """Return the rotation from the body to the world; degrees, broadcast against each other.

    The body of a bird in the rest pose looks along y, which is the heading 90. A pitch lifts the bill, and a roll
    lowers the right side. The bird is rolled first, then pitched, then turned.
    """
    heading, pitch, roll = np.broadcast_arrays(*(np.asarray(angle, float) for angle in (heading, pitch, roll)))
    z, x, y = ((a, np.radians(v).reshape(-1, 1)) for a, v in (("z", heading - 90), ("x", pitch), ("y", roll)))
    turns = [Rotation.from_rotvec(angle * np.eye(3)["xyz".index(axis)]) for axis, angle in (z, x, y)]
    return (turns[0] * turns[1] * turns[2]).as_matrix().reshape(*heading.shape, 3, 3)


def bent(body_pose=REST, **turns):
    """Return a body pose with other axis-angles of some joints, degrees."""
    changed = np.array(body_pose, float)
    for name, angles in turns.items():
        changed[BIRD.joint_names.index(name) - 1] = np.radians(angles)
    return changed


def result(body_pose=STANDING, turn=None, place_m=(0.0, 0.0, 0.2), shape=None, bird=BIRD, **changes) -> Solution:
    """Return a result on a ledge with the given poses of N birds in T frames.

    Args:
        body_pose: (…, J−1, 3), axis-angles in radians.
        turn: (…, 3, 3), rotation from the body to the world; None: the bird is level and looks along y.
        place_m: (…, 3), position of the root joint in the world.
        shape: (N, T); None: that of the arguments together.
        bird: the model.
        changes: other fields of the result; single numbers and arrays (…,) are those of all frames.
    """
    turn = np.eye(3) if turn is None else np.asarray(turn)
    lead = [np.shape(body_pose)[:-2], turn.shape[:-2], np.shape(place_m)[:-1]]
    N, T = np.broadcast_shapes((1, 1), *lead) if shape is None else shape
    J, K = bird.num_joints, bird.num_keypoints

    def all_frames(values, *axes):
        return np.array(np.broadcast_to(values, (N, T, *axes)))

    for name, axes in {"valid": (), "scale": (), "contact": (), "bone_length": (J - 1,)}.items():
        if changes.get(name) is not None:
            changes[name] = all_frames(changes[name], *axes)
    fields = {
        "track_id": np.arange(1, N + 1),
        "frame_index": np.arange(T),
        "valid": np.ones((N, T), bool),
        "global_orient": np.zeros((N, T, 3)),
        "body_pose": all_frames(body_pose, J - 1, 3),
        "transl": all_frames([0, 0, 100.0], 3),
        "scale": np.ones((N, T)),
        "bone_length": np.ones((N, T, J - 1)),
        "betas": np.zeros((N, T, bird.num_shapes)),
        "keypoints_cam": np.zeros((N, T, K, 3)),
        "keypoints_px": np.zeros((N, T, K, 2)),
        "crop": all_frames([0, 0, 256.0], 3),
        "image_size_px": np.full((N, T, 2), 256),
        "focal_px": 2167.0,
        "keypoint_names": bird.keypoint_names,
        "joint_names": bird.joint_names,
        "crop_px": 256,
        "loss": {},
        "status": np.full(N, "ok"),
        "R_world_root": all_frames(turn, 3, 3),
        "transl_world_m": all_frames(place_m, 3),
        "keypoints_world_m": np.zeros((N, T, K, 3)),
        "contact": np.ones((N, T)),
    }
    return Solution.from_arrays(**(fields | changes))


PAIR_M = [[[0, 0, 0.2]], [[0.6, 0, 0.2]]]


def pair(T=4, **changes) -> Solution:
    """Return two standing birds that look along x, the second bird 0.6 m before the first."""
    return result(STANDING, turned(np.zeros((2, T)), 50), np.array(PAIR_M), **changes)


def flock(solution: Solution, fps: float | None = 25.0, time_s=None, bird=BIRD, **known) -> Flock:
    """Return the flock of a result with a frame rate, with times, or with neither."""
    if time_s is None:
        time_s = np.full(len(solution.frame_index), np.nan) if fps is None else solution.frame_index / fps
    return flock_of(solution, bird, np.asarray(time_s, float), **known)


def renamed(**names) -> Bird:
    """Return the murre with other names of some keypoints or joints."""
    return replace(
        BIRD,
        keypoint_names=tuple(names.get(name, name) for name in BIRD.keypoint_names),
        joint_names=tuple(names.get(name, name) for name in BIRD.joint_names),
    )


def in_lengths(flock: Flock) -> Flock:
    """Return the same birds with the length of the model as the unit of length."""
    return replace(flock, unit="bl", per_unit=UNIT_M / LENGTH_M, place=flock.place / LENGTH_M)


def with_error_bars(solution: Solution, orient_sd=0.0, body_sd=0.0) -> Solution:
    """Return a result with error bars of angles, radians, broadcast to (N, T, 3) and (N, T, J−1, 3)."""
    return solution.with_arrays(
        **error_bars(solution, global_orient_sd=orient_sd, body_pose_sd=body_sd, misfit=1.0),
    )


def points_by_hand(body_pose, turn, place_m, scale=1.0, bird=BIRD):
    """Return joints and keypoints of one bird in the world by name, metres; no code of the package poses the bird."""
    pose = Pose(
        global_orient=Rotation.from_matrix(turn).as_rotvec(),
        body_pose=body_pose,
        transl=np.asarray(place_m) / bird.metres_per_unit - scale * np.asarray(bird.joints[0], float),
        scale=np.asarray(scale),
        bone_length=np.ones(bird.num_joints - 1),
        betas=np.zeros(bird.num_shapes),
    )
    vertices, joints = (points * bird.metres_per_unit for points in skin_by_hand(bird, pose))
    keypoints = np.asarray(bird.keypoint_weights, float) @ vertices
    return dict(zip(bird.joint_names, joints, strict=True)), dict(zip(bird.keypoint_names, keypoints, strict=True))


def rules(**behaviours):
    """Return a config; a rule is a mapping, whose missing keys have the simplest values."""
    simple = {"definition": "The bird does this.", "bridge_s": 0.0}
    return BehaviourConfig({name: BehaviourRule(**(simple | rule)) for name, rule in behaviours.items()})


def _rigid_hands():
    """Return the murre with wingtips that only the wrists move, so that straight wings are straight up to the tips."""
    weights, tips = np.array(BIRD.skin_weights), np.asarray(BIRD.keypoint_weights)
    for side in ("left", "right"):
        tip = tips[BIRD.keypoint_names.index(f"{side}_wingtip")] > 0
        weights[tip] = np.eye(BIRD.num_joints)[BIRD.joint_names.index(f"{side}_wrist")]
    return replace(BIRD, skin_weights=jnp.asarray(weights))


STRAIGHT = _rigid_hands()
"""The model of `straight_wings`."""
WING_BONES = ("shoulder", "elbow", "wrist")


def wing_lengths():
    """Return the distance between the shoulders, and the length of a wing along its three bones, model units."""
    joints, keypoints = (np.asarray(points, float) for points in (STRAIGHT.joints, STRAIGHT.keypoints))
    ends = [joints[STRAIGHT.joint_names.index(f"left_{name}")] for name in WING_BONES]
    ends.append(keypoints[STRAIGHT.keypoint_names.index("left_wingtip")])
    return 2 * abs(ends[0][0]), float(np.linalg.norm(np.diff(ends, axis=0), axis=1).sum())


def straight_wings(elevation=0.0, body_pose=STANDING):
    """Return the body pose of the model `STRAIGHT` with both wings straight to the sides.

    Args:
        elevation: (…), angle between the wings and the frontal plane of the body, degrees.
        body_pose: the pose of all other joints.
    """
    elevation = np.asarray(elevation, float)
    changed = np.array(np.broadcast_to(body_pose, (*elevation.shape, *np.shape(body_pose))))
    joints, keypoints = (np.asarray(points, float) for points in (STRAIGHT.joints, STRAIGHT.keypoints))
    for side, sign in (("left", -1), ("right", 1)):
        ends = [joints[STRAIGHT.joint_names.index(f"{side}_{name}")] for name in WING_BONES]
        ends.append(keypoints[STRAIGHT.keypoint_names.index(f"{side}_wingtip")])
        above = Rotation.identity()
        for name, start, end in zip(WING_BONES, ends[:-1], ends[1:], strict=True):
            straight, _ = Rotation.align_vectors([[sign, 0, 0]], [(end - start) / np.linalg.norm(end - start)])
            turn = above.inv() * straight
            if name == "shoulder":
                angle = np.radians(-sign * elevation).reshape(-1, 1)  # about y, which lifts the left wing
                turn = Rotation.from_rotvec(angle * [0, 1, 0]) * turn
            at = STRAIGHT.joint_names.index(f"{side}_{name}") - 1
            changed[..., at, :] = turn.as_rotvec().reshape(*((*elevation.shape, 3) if name == "shoulder" else (3,)))
            above = straight
    return changed
