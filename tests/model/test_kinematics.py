"""Kinematics agrees with the authors' numbers and with a loop over 4×4 matrices, and moves as a rigid body."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from support.birds import PUBLISHED_CASES, exp_map, published_poses, random_pose, skin_by_hand, toy_bird

from jaxfit.model.kinematics import (
    fold_bird,
    joint_transforms,
    posed_joints,
    posed_keypoints,
    posed_vertices,
    rest_pose,
    with_detector,
)
from jaxfit.model.published import import_model

# the root is not at the origin, so that rotations about the root and about the origin differ
ROOT = np.float32([0.5, -1.0, 2.0])
BIRD = dataclasses.replace(toy_bird(), vertices=toy_bird().vertices + ROOT, joints=toy_bird().joints + ROOT)
RIG = fold_bird(BIRD)


@jax.jit
def posed(rig, pose):
    A = joint_transforms(rig, pose)
    return posed_vertices(rig, A, pose), posed_keypoints(rig, A, pose), posed_joints(rig, A, pose)


@pytest.mark.parametrize(("model", "scale"), PUBLISHED_CASES)
def test_agrees_with_the_authors_numbers(reference_dir, model, scale):
    bird = import_model(model.replace("_", "-"), [reference_dir / "models" / model])
    rig, size = fold_bird(bird), np.ptp(np.asarray(bird.vertices), axis=0).max()
    for pose, expected_vertices, expected_keypoints in published_poses(reference_dir, model, scale):
        vertices, keypoints, _ = posed(rig, pose)
        assert np.abs(vertices - expected_vertices).max() < 1e-4 * size
        assert np.abs(keypoints - expected_keypoints).max() < 1e-4 * size


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_a_loop_of_matrices(seed):
    pose = random_pose(BIRD, seed)
    vertices, keypoints, joints = posed(RIG, pose)
    expected, expected_joints = skin_by_hand(BIRD, pose)
    np.testing.assert_allclose(vertices, expected, atol=1e-4)
    np.testing.assert_allclose(joints, expected_joints, atol=1e-4)
    np.testing.assert_allclose(keypoints, np.asarray(BIRD.keypoint_weights) @ expected, atol=1e-4)


def test_keypoints_of_several_vertices():
    """The keypoints of a rig are the weighted means of the posed vertices, also with non-zero shape coefficients."""
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.full(len(BIRD.vertices), 0.01), size=BIRD.num_keypoints)
    bird = dataclasses.replace(BIRD, keypoint_weights=jnp.asarray(weights, jnp.float32))
    pose = random_pose(bird, 7)
    _, keypoints, _ = posed(fold_bird(bird), pose)
    np.testing.assert_allclose(keypoints, weights @ skin_by_hand(bird, pose)[0], atol=1e-4)


def test_every_shape_direction_changes_the_mesh():
    pose = random_pose(BIRD, 3)
    flat = dataclasses.replace(pose, betas=jnp.zeros(2))
    for i in range(2):
        one = dataclasses.replace(pose, betas=jnp.eye(2)[i])
        for moved, still in zip(posed(RIG, one)[:2], posed(RIG, flat)[:2], strict=True):
            assert np.abs(moved - still).max() > 0.1


def test_a_detector_moves_the_outline_or_the_keypoints():
    rng = np.random.default_rng(2)
    normals, direction = rng.standard_normal(BIRD.vertices.shape), rng.standard_normal((1, BIRD.num_keypoints, 3))
    rig, pose = with_detector(RIG, normals, direction), rest_pose(BIRD)
    assert (rig.of_detector, rig.num_shapes) == (2, BIRD.num_shapes)
    vertices, keypoints, joints = posed(rig, dataclasses.replace(pose, betas=jnp.array([0.0, 0.0, 0.3, 0.2])))
    np.testing.assert_allclose(vertices, BIRD.vertices + 0.3 * normals, atol=1e-5)
    np.testing.assert_allclose(keypoints, BIRD.keypoints + 0.2 * direction[0], atol=1e-5)
    np.testing.assert_allclose(joints, BIRD.joints, atol=1e-6)


def test_rest_pose_gives_the_rest_mesh():
    vertices, keypoints, joints = posed(RIG, rest_pose(BIRD))
    np.testing.assert_allclose(vertices, BIRD.vertices, atol=1e-6)
    np.testing.assert_allclose(keypoints, BIRD.keypoints, atol=1e-6)
    np.testing.assert_allclose(joints, BIRD.joints, atol=1e-6)


def test_rest_pose_of_a_window():
    mean = jnp.arange(21.0)
    bird = dataclasses.replace(BIRD, pose_mean=mean)
    assert rest_pose(bird).scale.shape == ()
    for common, shape in ((False, (5,)), (True, (1,))):
        window = rest_pose(bird, 5, common)
        assert window.scale.shape == shape
        np.testing.assert_array_equal(window.body_pose, np.broadcast_to(mean.reshape(7, 3), (5, 7, 3)))
        assert window.bone_length.shape == (7,)


angles = st.tuples(*[st.floats(-3, 3, width=32)] * 3)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), angles, angles, st.floats(0.25, 4, width=32))
def test_moves_as_a_rigid_body(seed, turn, shift, factor):
    """Rotation about the root, translation and scale move all points alike: p ↦ s·R·(p − root) + root′."""
    from scipy.spatial.transform import Rotation

    pose, root = random_pose(BIRD, seed), np.asarray(BIRD.joints)[0]
    R = exp_map(np.array(turn, np.float64))
    orient = Rotation.from_matrix(R @ exp_map(np.asarray(pose.global_orient, np.float64))).as_rotvec()
    moved = dataclasses.replace(
        pose,
        global_orient=jnp.asarray(orient, jnp.float32),
        transl=pose.transl + jnp.array(shift),
        scale=pose.scale * factor,
    )
    for before, after in zip(posed(RIG, pose), posed(RIG, moved), strict=True):
        at_root = np.asarray(before) - np.asarray(pose.transl) - float(pose.scale) * root
        expected = factor * at_root @ R.T + np.asarray(moved.transl) + float(moved.scale) * root
        np.testing.assert_allclose(after, expected, atol=1e-3)


def test_bone_length_moves_its_bone_and_the_descendants():
    pose = rest_pose(BIRD)
    neck = BIRD.joint_names.index("neck")
    longer = dataclasses.replace(pose, bone_length=pose.bone_length.at[neck - 1].set(2.0))
    joints = np.asarray(posed(RIG, longer)[2])
    moved = np.asarray(BIRD.joints)[neck] - np.asarray(BIRD.joints)[0]
    expected = np.asarray(BIRD.joints).copy()
    expected[[neck, BIRD.joint_names.index("head")]] += moved  # the head is a child of the neck
    np.testing.assert_allclose(joints, expected, atol=1e-6)


@pytest.mark.parametrize("rest", [True, False], ids=["rest", "posed"])
def test_gradients(rest):
    start = rest_pose(BIRD) if rest else random_pose(BIRD, 1, 0.3)
    # a small translation, because large coordinates hide the small steps of finite differences
    start = dataclasses.replace(start, transl=jnp.array([0.1, 0.2, 0.3]))
    keypoint_weights = jnp.asarray(np.random.default_rng(0).normal(size=(BIRD.num_keypoints, 3)), jnp.float32)
    vertex_weights = jnp.asarray(np.random.default_rng(1).normal(size=BIRD.vertices.shape) / 50, jnp.float32)

    @jax.jit
    def value(pose):
        vertices, keypoints, _ = posed(RIG, pose)
        return jnp.sum(keypoint_weights * keypoints) + jnp.sum(vertex_weights * vertices)

    check_grads(value, (start,), order=1, modes=["rev"], eps=1e-2, atol=0.02, rtol=0.02)
    gradient = jax.grad(value)(start)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
