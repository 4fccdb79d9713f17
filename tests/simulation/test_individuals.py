"""Individuals: drawn bodies have the stated spread, are mirrored, and do not change motion, cameras and noise."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.birds import tiny_bird

from jaxfit import load_murre
from jaxfit.simulation.individuals import draw_bones, draw_bones_of_prior, draw_offsets, draw_shape
from jaxfit.simulation.scene import stage_scene

MURRE = load_murre()
SMALL = {"birds": 2, "frames": 4, "size": (480, 280), "fps": 5, "seed": 3}


@pytest.fixture(scope="module")
def individual():
    return stage_scene(MURRE, **SMALL)


@pytest.fixture(scope="module")
def equal():
    return stage_scene(MURRE, **SMALL, bone_sd=0, keypoint_offset=0)


def test_bones_have_the_stated_spread_and_equal_sides():
    rng = np.random.default_rng(0)
    bones = np.array([draw_bones(MURRE, rng) for _ in range(2000)]) / np.asarray(MURRE.bone_mean)
    np.testing.assert_allclose(bones.mean(0), 1, atol=0.005)
    np.testing.assert_allclose(bones.std(0), 0.05, rtol=0.08)
    index = {name: i - 1 for i, name in enumerate(MURRE.joint_names)}
    for name in ("hip", "knee", "ankle", "foot", "wing_root", "shoulder", "elbow", "wrist"):
        np.testing.assert_array_equal(bones[:, index[f"left_{name}"]], bones[:, index[f"right_{name}"]])
    sides = np.corrcoef(bones[:, index["left_elbow"]], bones[:, index["left_knee"]])[0, 1]
    assert abs(sides) < 0.1
    np.testing.assert_array_equal(draw_bones(MURRE, rng, 0), np.asarray(MURRE.bone_mean))


def test_bodies_of_the_prior_have_its_covariance():
    bird, rng = tiny_bird(), np.random.default_rng(0)
    covariance = np.float32([[0.01, 0.005, 0], [0.005, 0.02, 0], [0, 0, 0.04]])  # head, left wing, right wing
    bird = dataclasses.replace(bird, bone_covariance=covariance, bone_mean=np.float32([1.2, 1, 0.9]))
    bones = np.array([draw_bones_of_prior(bird, rng, 0.5) for _ in range(4000)])
    np.testing.assert_allclose(np.cov(bones[:, :2].T), covariance[:2, :2] / 4, atol=3e-4)
    np.testing.assert_allclose(bones[:, 2], 0.9 * bones[:, 1], rtol=1e-5)
    bird = dataclasses.replace(bird, shape_variance=np.float32([4, 0.25]))
    betas = np.array([draw_shape(bird, rng, 0.5) for _ in range(4000)])
    np.testing.assert_allclose(betas.std(0), [1, 0.25], rtol=0.05)


def test_offsets_have_the_stated_distance_and_equal_sides():
    rest = np.asarray(MURRE.keypoints, np.float64)
    names = MURRE.keypoint_names
    length = np.linalg.norm(rest[names.index("bill_tip")] - rest[names.index("tail_tip")])
    offsets = np.array([draw_offsets(MURRE, np.random.default_rng(seed), 0.02) for seed in range(100)])
    share = np.linalg.norm(offsets, axis=-1) / length
    assert share.mean() == pytest.approx(0.02, rel=0.05)
    assert 0.0099 < share.min() < share.max() < 0.0301
    for left, right in MURRE.keypoint_pairs:
        np.testing.assert_allclose(offsets[:, left], offsets[:, right] * [-1, 1, 1])


def test_individuals_move_as_equal_birds_under_the_same_camera(individual, equal):
    np.testing.assert_array_equal(individual.view.R_cam_world, equal.view.R_cam_world)
    for own, mean in zip(individual.birds, equal.birds, strict=True):
        for name in ("global_orient", "body_pose", "scale", "betas"):
            np.testing.assert_array_equal(getattr(own.pose, name), getattr(mean.pose, name))
        np.testing.assert_array_equal(mean.pose.bone_length, MURRE.bone_mean)
    bones = np.stack([bird.pose.bone_length for bird in individual.birds])
    assert 0.02 < (bones / np.asarray(MURRE.bone_mean)).std(1).min() < 0.1
    assert (bones[0] != bones[1]).any()
    np.testing.assert_array_equal(individual.poses.poses.bone_length, np.repeat(bones[:, None], 4, 1))


def rigid_part(bird, joint, t=0):
    """Return the rotation of the part that moves with one joint alone, and the place of the joint in the world.

    The part is rigid, so its vertices give both, without forward kinematics.
    """
    j = MURRE.joint_names.index(joint)
    part = np.asarray(MURRE.skin_weights)[:, j] > 0.999
    shaped = np.asarray(MURRE.vertices, np.float64) + np.tensordot(
        bird.pose.betas, np.asarray(MURRE.shape_basis), axes=1
    )
    own, posed = float(bird.pose.scale[0]) * shaped[part], bird.vertices_world[t][part]
    turn, _ = Rotation.align_vectors(posed - posed.mean(0), own - own.mean(0))
    at_rest = bird.pose.scale[0] * np.asarray(MURRE.joints, np.float64)[j]
    return turn, turn.apply(at_rest - own.mean(0)) + posed.mean(0)


@pytest.mark.parametrize("joint", ["left_ankle", "left_foot", "right_foot", "neck", "head"])
def test_true_bones_are_the_distances_between_rigid_parts_of_the_mesh(joint, individual):
    j = MURRE.joint_names.index(joint)
    parent = MURRE.parents[j]
    at_rest = np.linalg.norm(np.subtract(MURRE.joints[j], MURRE.joints[parent]))
    for n, bird in enumerate(individual.birds):
        a, b = (rigid_part(bird, MURRE.joint_names[each])[1] for each in (parent, j))
        length = np.linalg.norm(b - a) / bird.pose.scale[0] / at_rest
        assert individual.poses.poses.bone_length[n, 0, j - 1] == pytest.approx(float(length), rel=1e-3)


def test_keypoints_of_the_detector_move_with_the_bird(individual):
    """The same noise without offsets: the difference is the offset, turned with the part of the bird."""
    same = stage_scene(MURRE, **SMALL, keypoint_offset=0)
    np.testing.assert_array_equal(same.truth.keypoints_px, individual.truth.keypoints_px)
    moved = individual.detections.keypoints_px - same.detections.keypoints_px
    both = (individual.detections.confidence > 0) & (same.detections.confidence > 0)
    offsets = draw_offsets(MURRE, np.random.default_rng((SMALL["seed"], 7)))
    found, expected = [], []
    parts = {"head": ("left_eye", "right_eye", "forehead", "crown", "throat", "bill_base"), "tail": ("tail_tip",)}
    for joint, names in parts.items():
        at = [MURRE.keypoint_names.index(name) for name in names]
        for n, bird in enumerate(individual.birds):
            for t in range(SMALL["frames"]):
                turn, _ = rigid_part(bird, joint, t)
                points = np.asarray(MURRE.keypoint_weights)[at] @ bird.vertices_world[t]
                beside = points + bird.pose.scale[0] * turn.apply(offsets[at])
                shift = individual.view.to_screen(beside)[:, :2] - individual.view.to_screen(points)[:, :2]
                found.append(moved[n, t, at][both[n, t, at]])
                expected.append(shift[both[n, t, at]])
    difference = np.linalg.norm(np.concatenate(found) - np.concatenate(expected), axis=1)
    # outliers and flips apart; the jitter differs a little, because the moved keypoints have other velocities
    assert np.quantile(difference, 0.8) < 0.05
    assert np.median(np.linalg.norm(np.concatenate(expected), axis=1)) > 0.5
