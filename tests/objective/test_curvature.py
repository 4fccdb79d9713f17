"""The quadratic of a curvature bounds its term, and its derivatives agree with automatic differentiation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import terms_by_hand

from jaxfit.model.rotation import axis_angle_to_matrix, right_jacobian
from jaxfit.objective.curvature import frame_rows
from jaxfit.objective.objective import evaluate_curvature
from jaxfit.objective.registry import find_term, find_terms, known_terms

CURVED = [name for name in known_terms() if find_term(name).curvature]
D = 3 * len(terms_by_hand.BIRD.joints) + 4


def settings(name):
    return {name: {"weight": 3.0, **find_term(name).settings}}


def moved(pose, rows):
    return dataclasses.replace(
        pose,
        global_orient=pose.global_orient + rows[:, :3],
        body_pose=pose.body_pose + rows[:, 3:-4].reshape(pose.body_pose.shape),
        transl=pose.transl + rows[:, -4:-1],
        scale=pose.scale + rows[:, -1],
    )


@jax.jit
def along(rows, pose, targets):
    """Each term with curvature after a change of the pose by `rows`, times 3 for its weight."""
    window = terms_by_hand.posed_window(moved(pose, rows), targets)
    return {name: 3.0 * find_term(name).function(window, **find_term(name).settings) for name in CURVED}


@jax.jit
def curvatures(rows, pose, targets):
    """For each term: H·rows, the matrix H, and the diagonal that the curvature returns."""
    window = terms_by_hand.posed_window(pose, targets)
    units = jnp.eye(terms_by_hand.T * D).reshape(-1, terms_by_hand.T, D)
    results = {}
    for name in CURVED:
        H = evaluate_curvature(window, find_terms([name]), settings(name))
        results[name] = H.product(rows), jax.vmap(H.product)(units).reshape(terms_by_hand.T * D, -1), H.diagonal
    return results


def change(seed, size):
    return jnp.asarray(size * np.random.default_rng(seed).normal(size=(terms_by_hand.T, D)), jnp.float32)


def test_the_terms_of_the_paper_without_masks_have_curvature():
    assert {"keypoints", "pose_prior", "velocity", "acceleration"} <= set(CURVED)


@pytest.mark.parametrize("theta", [0.0, 1e-4, 9e-3, 1.1e-2, 1.0, 3.0])
def test_right_jacobian(theta):
    r = theta * np.array([0.6, -0.64, 0.48])
    R = np.asarray(axis_angle_to_matrix(jnp.asarray(r)), np.float64)
    dR = np.asarray(jax.jacfwd(axis_angle_to_matrix)(jnp.asarray(r)), np.float64)
    for k in range(3):
        spin = R.T @ dR[..., k]  # skew-symmetric
        actual = [spin[2, 1], spin[0, 2], spin[1, 0]]
        np.testing.assert_allclose(right_jacobian(jnp.asarray(r))[:, k], actual, atol=2e-5)


def test_keypoint_jacobian():
    pose, targets = terms_by_hand.window_pose(), terms_by_hand.random_targets()
    assert np.abs(pose.betas).max() > 0.1, "the test needs a shape other than the mean"

    def points(rows):
        return terms_by_hand.posed_window(moved(pose, rows), targets).keypoints_px.reshape(terms_by_hand.T, -1)

    expected = jax.jit(jax.jacfwd(points))(jnp.zeros((terms_by_hand.T, D)))
    by_angles, by_place = jax.jit(lambda: terms_by_hand.posed_window(pose, targets).keypoint_jacobian_px)()
    actual = jnp.concatenate([by_angles, by_place], axis=-1)
    for t in range(terms_by_hand.T):
        np.testing.assert_allclose(actual[t], expected[t, :, t], rtol=1e-3, atol=1e-3 * np.abs(expected).max())


def test_frame_rows():
    pose, rows = terms_by_hand.window_pose(), change(0, 1.0)
    np.testing.assert_allclose(frame_rows(moved(pose, rows)) - frame_rows(pose), rows, atol=3e-5)
    common = dataclasses.replace(pose, scale=jnp.array([1.5]))
    assert frame_rows(common)[:, -1].tolist() == [1.5] * terms_by_hand.T


@pytest.mark.parametrize("name", CURVED)
def test_product_and_diagonal_belong_to_one_positive_semidefinite_matrix(name):
    rows = change(1, 1.0)
    product, H, diagonal = curvatures(rows, terms_by_hand.window_pose(), terms_by_hand.random_targets())[name]
    scale = np.abs(H).max()
    np.testing.assert_allclose(product.ravel(), H @ rows.ravel(), atol=1e-4 * scale)
    np.testing.assert_allclose(diagonal.ravel(), np.diagonal(H), atol=1e-5 * scale)
    np.testing.assert_allclose(H, H.T, atol=1e-5 * scale)
    assert np.linalg.eigvalsh(np.asarray(H, np.float64)).min() > -1e-4 * scale


@pytest.mark.parametrize("name", ["pose_prior", "velocity", "acceleration"])
def test_the_quadratic_is_above_the_term(name):
    pose, targets = terms_by_hand.window_pose(), terms_by_hand.random_targets()
    still = jnp.zeros((terms_by_hand.T, D))
    value = along(still, pose, targets)[name]
    gradient = jax.grad(lambda rows: along(rows, pose, targets)[name])(still)
    for seed, size in enumerate((0.01, 0.1, 0.5, 2.0)):
        rows = change(seed, size)
        product = curvatures(rows, pose, targets)[name][0]
        bound = value + jnp.sum(gradient * rows) + 0.5 * jnp.sum(rows * product)
        after = along(rows, pose, targets)[name]
        assert after <= bound * (1 + 1e-5)
        if name == "pose_prior":
            assert after == pytest.approx(float(bound), rel=1e-4)


def test_keypoint_curvature_is_reweighted_least_squares():
    """H = JᵀWJ, and the weighted squares are an upper bound of Geman-McClure."""
    pose, targets = terms_by_hand.window_pose(), terms_by_hand.random_targets()
    window, sigma = terms_by_hand.posed_window(pose, targets), 50.0
    J = np.concatenate(window.keypoint_jacobian_px, axis=-1)
    e = np.asarray(window.keypoints_px - targets.keypoints_px, np.float64)
    c = np.asarray(targets.confidence, np.float64)[..., None]

    def robust(e):
        return c * sigma**2 * e**2 / (sigma**2 + e**2)

    weight = c * 2 * sigma**4 / (sigma**2 + e**2) ** 2
    rng = np.random.default_rng(0)
    for size in (0.1, 5.0, 100.0):
        other = e + size * rng.normal(size=e.shape)
        assert (robust(other) <= robust(e) + 0.5 * weight * (other**2 - e**2) + 1e-9).all()
    H = curvatures(change(0, 1.0), pose, targets)["keypoints"][1].reshape(terms_by_hand.T, D, terms_by_hand.T, D)
    for t in range(terms_by_hand.T):
        expected = 3.0 * J[t].T @ (weight[t].reshape(-1, 1) * J[t])
        np.testing.assert_allclose(H[t, :, t], expected, atol=1e-4 * np.abs(expected).max())
        H = H.at[t, :, t].set(0)
    assert not np.any(H), "the keypoint term does not couple frames"


@pytest.mark.parametrize("name", CURVED)
@pytest.mark.parametrize("missing", range(terms_by_hand.T))
def test_missing_frames_have_no_curvature(name, missing):
    targets = terms_by_hand.without_frame(terms_by_hand.random_targets(), missing)
    _, H, diagonal = curvatures(change(0, 1.0), terms_by_hand.window_pose(), targets)[name]
    H = H.reshape(terms_by_hand.T, D, terms_by_hand.T, D)
    assert not np.any(H[missing])
    assert not np.any(H[:, :, missing])
    assert not np.any(diagonal[missing])


def test_equal_frames_have_finite_curvature():
    pose = jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), terms_by_hand.window_pose())
    pose = dataclasses.replace(
        pose, bone_length=terms_by_hand.window_pose().bone_length, betas=terms_by_hand.window_pose().betas
    )
    for name, (_, H, _) in curvatures(change(0, 1.0), pose, terms_by_hand.random_targets()).items():
        assert np.isfinite(H).all(), name
        assert np.abs(H).max() > 0
