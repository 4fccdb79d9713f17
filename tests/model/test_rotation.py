"""Rotations agree with scipy, gradients are finite, and the view grid covers SO(3)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxfit.model.rotation import (
    axis_angle_to_matrix,
    geodesic_distance,
    matrix_to_axis_angle,
    rotation_change,
    unwrap_axis_angle,
    view_grid,
    viewing_axis_rotations,
)

to_matrix, to_axis_angle = jax.jit(axis_angle_to_matrix), jax.jit(matrix_to_axis_angle)
coordinate = st.floats(-4, 4, width=32)
vector = st.tuples(coordinate, coordinate, coordinate).map(lambda v: np.array(v, np.float32))
direction = vector.filter(lambda v: np.linalg.norm(v) > 0.1).map(lambda v: v / np.linalg.norm(v))


def angle_between(Ra, Rb):
    return (Rotation.from_matrix(Ra).inv() * Rotation.from_matrix(Rb)).magnitude()


@settings(max_examples=50, deadline=None)
@given(vector)
@example(np.zeros(3, np.float32))
@example(np.array([1e-3, 0, 0], np.float32))
@example(np.array([0.00999, 0, 0], np.float32))
@example(np.array([0, 0.01001, 0], np.float32))
@example(np.array([0, 0, np.pi], np.float32))
def test_matrices_agree_with_scipy(axis_angle):
    R = np.asarray(to_matrix(axis_angle), np.float64)
    np.testing.assert_allclose(R, Rotation.from_rotvec(axis_angle).as_matrix(), atol=2e-6)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=3e-6)
    assert np.linalg.det(R) == pytest.approx(1, abs=5e-6)


def test_gradients_are_finite_and_right():
    jacobian = jax.jit(jax.jacrev(axis_angle_to_matrix))
    for theta in [0.0, 1e-8, 1e-3, 0.00999, 0.01001, 1.0, np.pi, 2 * np.pi]:
        axis = np.array([0.6, -0.48, 0.64])
        J = jacobian(jnp.asarray(theta * axis, jnp.float32))
        step = 1e-5
        moved = theta * axis + step * np.concatenate([np.eye(3), -np.eye(3)])
        ahead, behind = np.split(Rotation.from_rotvec(moved).as_matrix(), 2)
        expected = np.moveaxis((ahead - behind) / (2 * step), 0, -1)
        np.testing.assert_allclose(J, expected, atol=1e-4)


@settings(max_examples=50, deadline=None)
@given(direction, st.floats(0, np.pi))
@example(np.array([1, 0, 0], np.float32), np.pi)
@example(np.array([0, 1, 0], np.float32), np.pi)
@example(np.array([0, 0, 1], np.float32), np.pi)
@example(np.array([0.6, 0, -0.8], np.float32), np.pi - 1e-4)
@example(np.array([0.6, 0, -0.8], np.float32), 1e-7)
@example(np.array([0, 0, 1], np.float32), 0.0)
def test_axis_angle_of_a_matrix(axis, theta):
    R = Rotation.from_rotvec(theta * axis.astype(np.float64)).as_matrix()
    result = np.asarray(to_axis_angle(jnp.asarray(R, jnp.float32)))
    assert np.isfinite(result).all()
    assert np.linalg.norm(result) <= np.pi + 1e-6
    assert Rotation.from_rotvec(result).inv().as_matrix() @ R == pytest.approx(np.eye(3), abs=2e-6)
    if theta < 3:  # near π both signs of the axis are the same rotation
        np.testing.assert_allclose(result, theta * axis, atol=5e-6)


@settings(max_examples=50, deadline=None)
@given(vector, direction, st.floats(0, 3.1))
@example(np.zeros(3, np.float32), np.array([1, 0, 0], np.float32), 1e-4)
def test_geodesic_distance(base, axis, theta):
    Ra = Rotation.from_rotvec(base).as_matrix()
    Rb = Ra @ Rotation.from_rotvec(theta * axis.astype(np.float64)).as_matrix()
    distance = geodesic_distance(jnp.asarray(Ra, jnp.float32), jnp.asarray(Rb, jnp.float32))
    # near π the distance is insensitive to the angle: only half of the digits of float32 remain
    assert float(distance) == pytest.approx(theta, abs=1e-6 + (2e-5 if theta > 2.5 else 2e-6))


def spins():
    turn = np.linspace(0, 1.98 * np.pi, 50)
    wobble = 0.1 * np.stack([np.sin(3 * turn), np.cos(2 * turn), np.sin(turn)], -1)
    spun = Rotation.from_rotvec(turn[:, None] * [0.6, 0, 0.8])
    above = Rotation.from_matrix(viewing_axis_rotations(50)) * Rotation.from_rotvec([np.pi, 0, 0])
    past_pi = Rotation.from_rotvec(np.linspace(2, 4.3, 50)[:, None] * [0, 0, 1])
    whole_turn = Rotation.from_rotvec(np.linspace(0, 2 * np.pi, 49)[:, None] * [0, 0, 1])
    whole_turn = Rotation.concatenate([whole_turn, Rotation.identity(1)])  # the identity has no axis
    return {
        "about a fixed axis": spun,
        "a whole turn": whole_turn,
        "seen from above": above,  # all rotations are half turns, with an axis of either sign
        "seen from above, leaning": Rotation.from_rotvec(wobble) * above,
        "through π, leaning": past_pi * Rotation.from_rotvec(wobble),
    }


@pytest.mark.parametrize("name", spins())
def test_unwrapped_rotations_do_not_jump(name):
    R = spins()[name].as_matrix()
    wrapped = np.asarray(to_axis_angle(jnp.asarray(R, jnp.float32)))
    unwrapped = np.asarray(jax.jit(unwrap_axis_angle)(wrapped))
    np.testing.assert_allclose(Rotation.from_rotvec(unwrapped).as_matrix(), R, atol=5e-6)
    jumps = np.linalg.norm(np.diff(unwrapped, axis=0), axis=1)
    assert jumps.max() < 1, "a smooth spin turned by about 0.13 rad a frame"
    np.testing.assert_array_equal(unwrapped[0], wrapped[0])


def test_unwrapping_is_needed():
    """Before unwrapping, the rotation past π jumps by almost 2π: the previous test can fail."""
    R = spins()["through π, leaning"].as_matrix()
    wrapped = np.asarray(to_axis_angle(jnp.asarray(R, jnp.float32)))
    assert np.linalg.norm(np.diff(wrapped, axis=0), axis=1).max() > 5


def test_rotations_about_the_viewing_axis():
    R = viewing_axis_rotations(30)
    assert R.shape == (30, 3, 3)
    np.testing.assert_allclose(R[0], np.eye(3))
    np.testing.assert_allclose(angle_between(R, np.roll(R, -1, axis=0)), np.deg2rad(12), atol=1e-12)
    expected = Rotation.from_euler("z", 12 * np.arange(30)[:, None], degrees=True).as_matrix()
    np.testing.assert_allclose(R, expected, atol=1e-12)


@pytest.mark.parametrize(("directions", "turns"), [(100, 24), (40, 12)])
def test_the_view_grid_covers_so3(directions, turns):
    """The nearest grid point of any rotation is at most the radius of a direction's cell plus half a turn away.

    For cells of area 4π/directions, the covering radius of a square lattice is √(cell/2); the covering radius of the
    spiral is at most 1.5 times as large.
    """
    grid = view_grid(directions, turns)
    assert grid.shape == (directions * turns, 3, 3)
    np.testing.assert_allclose(grid @ grid.transpose(0, 2, 1), np.broadcast_to(np.eye(3), grid.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(grid), 1)
    bound = 1.5 * np.sqrt(4 * np.pi / directions / 2) + np.pi / turns
    anywhere = Rotation.random(500, rng=np.random.default_rng(0)).as_matrix()
    cosine = (np.einsum("aij,gij->ag", anywhere, grid) - 1) / 2
    nearest = np.arccos(np.clip(cosine.max(1), -1, 1))
    assert nearest.max() < bound
    between = np.arccos(np.clip((np.einsum("aij,gij->ag", grid, grid) - 1) / 2, -1, 1))
    np.fill_diagonal(between, np.inf)
    assert between.min() > 0.5 * np.pi / turns, "two views are nearly equal"


def test_changes_of_rotations_and_their_derivatives_agree_with_scipy():
    change_of = jax.jit(rotation_change)
    derivatives = [jax.jit(each(rotation_change, (0, 1))) for each in (jax.jacfwd, jax.jacrev)]
    for theta in [0.0, 0.7, 4.0]:
        for angle in [0.0, 1e-4, 0.24, 0.25, 1.0, 3.0]:
            before = theta * np.array([0.6, -0.48, 0.64])
            start = Rotation.from_rotvec(before)
            after = (start * Rotation.from_rotvec(angle * np.array([0.48, 0.6, 0.64]))).as_rotvec()

            def change(both):
                return (Rotation.from_rotvec(both[:, :3]).inv() * Rotation.from_rotvec(both[:, 3:])).as_rotvec()

            step, both = 1e-5, np.concatenate([before, after])
            ahead, behind = (change(both + sign * step * np.eye(6)) for sign in (1, -1))
            given = jnp.asarray(before, jnp.float32), jnp.asarray(after, jnp.float32)
            np.testing.assert_allclose(change_of(*given), change(both[None])[0], atol=3e-6)
            for derivative in derivatives:
                J = np.concatenate(derivative(*given), axis=-1)
                np.testing.assert_allclose(J, ((ahead - behind) / (2 * step)).T, atol=3e-4)
