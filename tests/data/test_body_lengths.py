"""Lengths of bodies against posed keypoints, and their standard deviations against draws."""

import dataclasses

import numpy as np
from support.birds import toy_bird

from jaxfit.data.body_lengths import body_lengths
from jaxfit.data.solution import Bodies
from jaxfit.model.kinematics import fold_bird, joint_transforms, posed_keypoints, rest_pose

BIRD = toy_bird(subdivisions=0)  # its head follows two bones
BONES, SHAPES = BIRD.num_joints - 1, BIRD.num_shapes


def bodies_of(bones, betas, bones_sd=0.0, betas_sd=0.0):
    count = len(bones)
    sds = np.full((count, BONES), bones_sd), np.full((count, SHAPES), betas_sd)
    one = np.ones(count)
    return Bodies(bones, sds[0], betas, sds[1], one, one, one, np.zeros((count, BIRD.num_keypoints, 3)), one)


def posed_length(bones, betas):
    """Return the distance from bill tip to tail tip of the straight bird by the kinematics."""
    rig, pose = fold_bird(BIRD), rest_pose(BIRD)
    pose = dataclasses.replace(pose, body_pose=0 * pose.body_pose, bone_length=bones, betas=betas)
    points = np.asarray(posed_keypoints(rig, joint_transforms(rig, pose), pose))
    bill, tail = (BIRD.keypoint_names.index(name) for name in ("bill_tip", "tail_tip"))
    return np.linalg.norm(points[bill] - points[tail])


def test_lengths_are_those_of_the_posed_bird():
    rng = np.random.default_rng(0)
    bones = np.float32(1 + 0.2 * rng.standard_normal((3, BONES)))
    betas = np.float32(rng.standard_normal((3, SHAPES)))
    found = body_lengths(BIRD, bodies_of(bones, betas))
    of_model = posed_length(np.asarray(BIRD.bone_mean), np.zeros(SHAPES, np.float32))
    expected = [posed_length(*body) / of_model for body in zip(bones, betas, strict=True)]
    np.testing.assert_allclose(found["length"].share, expected, rtol=1e-5)
    assert "wing" not in found  # this bird has no shoulder


def test_standard_deviations_are_those_of_draws():
    rng = np.random.default_rng(1)
    one = np.ones((1, BONES), np.float32), np.zeros((1, SHAPES), np.float32)
    sd = body_lengths(BIRD, bodies_of(*one, 0.01, 0.1))["length"].sd
    bones = np.float32(1 + 0.01 * rng.standard_normal((4000, BONES)))
    betas = np.float32(0.1 * rng.standard_normal((4000, SHAPES)))
    drawn = body_lengths(BIRD, bodies_of(bones, betas))["length"].share
    np.testing.assert_allclose(sd, drawn.std(), rtol=0.05)
