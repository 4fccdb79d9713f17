"""Frames that take over the pose of a near frame, on toy birds with exact keypoints."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.stages import BIRD, CAMERA, MODEL, B, T, case, problems, program, stacked

from jaxfit.fitting.batch import take_near_poses
from jaxfit.model.camera import project
from jaxfit.model.kinematics import window_keypoints, window_transforms
from jaxfit.simulation.flock import smooth_motion

FIELDS = "global_orient", "body_pose", "transl"


def truth():
    return stacked([smooth_motion(BIRD, T, seed) for seed in range(B)])


def reversed_at(pose, n, t):
    """Return the poses with one bird turned by 180° in one frame."""
    orient = np.array(pose.global_orient)
    turn = Rotation.from_rotvec([0, 0, np.pi]) * Rotation.from_rotvec(orient[n, t])
    orient[n, t] = turn.as_rotvec()
    return dataclasses.replace(pose, global_orient=orient)


def taken(pose, targets):
    return take_near_poses(program(), problems(pose, targets), pose)


def keypoint_error(pose, targets, n, source, t):
    """Mean distance of the keypoints of frame `t` from those of the pose of frame `source`, crop pixels."""
    own = type(pose)(**{name: np.asarray(value)[n] for name, value in vars(pose).items()})
    points = np.asarray(project(window_keypoints(MODEL.rig, window_transforms(MODEL.rig, own), own), CAMERA))
    return np.linalg.norm(points[source] - np.asarray(targets.keypoints_px)[n, t], axis=-1).mean()


@pytest.mark.parametrize("t", range(T))
def test_a_reversed_frame_takes_the_nearest_pose(t):
    _, targets = case()
    correct = truth()
    found = taken(reversed_at(correct, 0, t), targets)
    near = [s for s in (t - 2, t - 1, t + 1, t + 2) if 0 <= s < T]
    best = min(near, key=lambda source: keypoint_error(correct, targets, 0, source, t))
    for name in FIELDS:
        expected = np.array(getattr(correct, name))
        expected[0, t] = expected[0, best]
        np.testing.assert_array_equal(getattr(found, name), expected, err_msg=name)
    for name in ("scale", "bone_length", "betas"):
        np.testing.assert_array_equal(getattr(found, name), getattr(correct, name), err_msg=name)


def test_frames_without_the_bird_give_and_take_no_pose():
    _, targets = case()
    wrong = reversed_at(truth(), 0, 1)
    present = np.ones((B, T), bool)
    present[0] = [False, True, False, True]
    found = taken(wrong, dataclasses.replace(targets, present=present))
    np.testing.assert_array_equal(found.body_pose[0, 1], wrong.body_pose[0, 3])
    present[0, 1] = False
    assert taken(wrong, dataclasses.replace(targets, present=present)) is wrong


def test_small_errors_and_poses_that_are_not_better_change_nothing():
    _, targets = case()
    correct = truth()
    near = dataclasses.replace(correct, transl=correct.transl + np.float32([0.02, 0, 0]))
    assert 0 < keypoint_error(near, targets, 0, 0, 0) < 6
    assert taken(near, targets) is near
    everywhere = correct
    for t in range(T):
        everywhere = reversed_at(everywhere, 0, t)
    assert keypoint_error(everywhere, targets, 0, 0, 0) > 6
    assert taken(everywhere, targets) is everywhere


def test_keypoints_without_confidence_do_not_count():
    _, targets = case()
    correct = truth()
    points, confidence = np.array(targets.keypoints_px), np.array(targets.confidence)
    points[0, 2], confidence[0, 2] = points[0, 2] + 500, 0
    assert taken(correct, dataclasses.replace(targets, keypoints_px=points, confidence=confidence)) is correct
