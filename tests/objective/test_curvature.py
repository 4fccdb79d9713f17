"""The quadratic of a curvature bounds its term, and its derivatives agree with automatic differentiation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import terms_by_hand

from jaxfit.foundation.errors import InputError
from jaxfit.model.rotation import axis_angle_to_matrix, right_jacobian
from jaxfit.objective.curvature import SHARED_PARAMETERS, add_rows, frame_rows, pentadiagonal_solver, shared_columns
from jaxfit.objective.objective import evaluate_curvature, residual_sum
from jaxfit.objective.registry import Term, find_term, find_terms
from jaxfit.objective.residuals import NORM, as_list, geman_mcclure, huber, student_t

T = terms_by_hand.T
TERMS = terms_by_hand.TERMS
MASKS = ["mask", "mask_smooth_l1"]
KEYPOINTS = ["keypoints", "keypoint_likelihood"]
CHAINS = ["velocity", "acceleration", "geodesic_velocity", "huber_velocity", "motion_likelihood", "place_likelihood"]
RESIDUALS = [name for name in TERMS if name not in MASKS]
LINEAR = [
    "pose_prior",
    "bone_prior",
    "shape_prior",
    "shape_norm",
    "velocity",
    "acceleration",
    "low_pass",
    "stage_anchor",
]
"""Terms whose residuals are linear in the pose: their quadratic is a bound everywhere."""
POSE, ANCHOR = terms_by_hand.window_pose(), terms_by_hand.window_pose(seed=5)
IS_SHARED = shared_columns(POSE, SHARED_PARAMETERS)
D = len(IS_SHARED)


def settings(name):
    return {name: {"weight": 3.0, **find_term(name).settings}}


def window_of(pose, targets):
    return terms_by_hand.posed_window(pose, targets, ANCHOR, SHARED_PARAMETERS)


def moved(pose, rows):
    return add_rows(pose, rows, SHARED_PARAMETERS)


def along(rows, pose, targets):
    """Each linear term after a change of the pose by `rows`, times 3 for its weight."""
    window = window_of(moved(pose, rows), targets)
    return {name: 3.0 * residual_sum(find_term(name).function(window, **find_term(name).settings)) for name in LINEAR}


def basis():
    """All changes of one parameter, (n, T, D): of one frame, or of all frames for a shared parameter."""
    units = np.eye(T * D).reshape(T, D, T, D)
    framewise = units[:, ~IS_SHARED].reshape(-1, T, D)
    return jnp.asarray(np.concatenate([framewise, units[:, IS_SHARED].sum(axis=0)]), jnp.float32)


@jax.jit
def curvatures(pose, targets):
    """For each term: H over the changes of `basis`, and the diagonal and the bands of the curvature."""
    window, results = window_of(pose, targets), {}
    for name in TERMS:
        H = evaluate_curvature(window, find_terms([name]), settings(name))
        product = jax.vmap(H.product)(basis())
        diagonal = jnp.concatenate([H.diagonal[:, ~IS_SHARED].ravel(), H.diagonal[:, IS_SHARED].sum(axis=0)])
        results[name] = jnp.einsum("itd,jtd->ij", basis(), product), diagonal, H.bands
    return results


DIRECTIONS = 6


@jax.jit
def squares_by_autodiff(x, pose, targets):
    """For each term: Σ 2λwρ′·(J·x)² for changes x (DIRECTIONS, n) over `basis`; J·x from forward differentiation."""

    def residuals(rows):
        window = window_of(moved(pose, rows), targets)
        return {name: as_list(find_term(name).function(window, **find_term(name).settings)) for name in RESIDUALS}

    def values(rows):
        return {name: [each.values for each in own] for name, own in residuals(rows).items()}

    def weight(each):
        return jnp.asarray(6.0 * each.weight * each.kernel.slope(jnp.sum(each.values**2, axis=-1)))[..., None]

    zero = jnp.zeros((T, D))
    weights = {name: [weight(each) for each in own] for name, own in residuals(zero).items()}

    def squares(x):
        rows = jnp.einsum("i,itd->td", x, basis())
        changes = jax.jvp(values, (zero,), (rows,))[1]
        return {
            name: sum(jnp.sum(w * change**2) for w, change in zip(weights[name], changes[name], strict=True))
            for name in RESIDUALS
        }

    return jax.lax.map(squares, x)


def test_right_jacobian():
    matrix, slope, jacobian = (
        jax.jit(each) for each in (axis_angle_to_matrix, jax.jacfwd(axis_angle_to_matrix), right_jacobian)
    )
    for theta in (0.0, 1e-4, 9e-3, 1.1e-2, 1.0, 3.0):
        r = jnp.asarray(theta * np.array([0.6, -0.64, 0.48]), jnp.float32)
        R, dR = np.asarray(matrix(r), np.float64), np.asarray(slope(r), np.float64)
        for k in range(3):
            spin = R.T @ dR[..., k]  # skew-symmetric
            expected = [spin[2, 1], spin[0, 2], spin[1, 0]]
            np.testing.assert_allclose(np.asarray(jacobian(r))[:, k], expected, atol=2e-5, err_msg=str(theta))


def test_keypoint_jacobian():
    pose, targets = terms_by_hand.window_pose(), terms_by_hand.random_targets()
    assert np.abs(pose.betas).max() > 0.1, "the test needs a shape other than the mean"

    def points(rows):
        # every frame has its own bones and shape here
        def one(frame, own):
            pose = jax.tree.map(lambda x: x[None], frame)
            pose = moved(dataclasses.replace(pose, bone_length=bones, betas=betas), own[None])
            window = terms_by_hand.posed_window(pose, first)
            return window.keypoints_px.ravel()

        frames = dataclasses.replace(pose, bone_length=None, betas=None)
        return jax.vmap(one)(frames, rows)

    bones, betas, first = pose.bone_length, pose.betas, jax.tree.map(lambda x: x[:1] if x.ndim else x, targets)
    expected = jax.jit(jax.jacfwd(points))(jnp.zeros((T, D)))
    actual = jnp.concatenate(jax.jit(lambda: window_of(pose, targets).keypoint_jacobian_px)(), axis=-1)
    for t in range(T):
        np.testing.assert_allclose(actual[t], expected[t, :, t], rtol=1e-3, atol=1e-3 * np.abs(expected).max())


def test_frame_rows():
    pose, rows = POSE, np.float32(np.random.default_rng(0).normal(size=(T, D)))
    rows = np.where(IS_SHARED, rows[:1], rows)
    before, after = jax.jit(lambda *x: [frame_rows(each, SHARED_PARAMETERS) for each in (x[0], moved(*x))])(pose, rows)
    np.testing.assert_allclose(after - before, rows, atol=3e-5)
    common = dataclasses.replace(pose, scale=jnp.array([1.5]))
    scale = frame_rows(common).shape[1] - 1
    assert frame_rows(common)[:, scale].tolist() == [1.5] * T
    assert np.flatnonzero(shared_columns(common)).tolist() == [scale]
    rows = np.zeros((T, D), np.float32)
    rows[:, scale] = np.arange(3)
    np.testing.assert_allclose(moved(common, rows).scale, [2.5])


def test_curvature_is_the_weighted_square_of_the_jacobian():
    """x·H·x for random x; H is symmetric, so that these values determine H."""
    pose, targets = case()
    x = np.random.default_rng(0).normal(size=(DIRECTIONS, len(basis())))
    H, expected = curvatures(pose, targets), squares_by_autodiff(jnp.asarray(x, jnp.float32), pose, targets)
    for name in RESIDUALS:
        actual = np.einsum("ni,ij,nj->n", x, np.asarray(H[name][0], np.float64), x)
        np.testing.assert_allclose(actual, expected[name], rtol=2e-3, err_msg=name)
        assert (np.asarray(expected[name]) > 0).all(), name


def test_product_and_diagonal_belong_to_one_positive_semidefinite_matrix():
    for name, each in curvatures(*case()).items():
        H, diagonal, bands = (np.asarray(x, np.float64) for x in each)
        scale = np.abs(H).max()
        np.testing.assert_allclose(H, H.T, atol=1e-5 * scale, err_msg=name)
        assert np.linalg.eigvalsh(H).min() > -1e-4 * scale, name
        used = np.diagonal(H) > 1e-6 * scale
        assert (diagonal[used] > 0).all(), name
        if name in CHAINS:
            framewise = int((~IS_SHARED).sum())
            for ahead in (1, 2):
                expected = np.diagonal(H, ahead * framewise)[: (T - ahead) * framewise].reshape(-1, framewise)
                np.testing.assert_allclose(bands[ahead - 1][:-ahead, ~IS_SHARED], expected, atol=1e-5 * scale)
                assert not bands[ahead - 1][-ahead:].any(), name
                assert expected.any() or "velocity" in name, name
        else:
            assert not bands.any(), name
        if name in [*MASKS, *KEYPOINTS, *CHAINS]:
            np.testing.assert_allclose(diagonal, np.diagonal(H), atol=1e-5 * scale, err_msg=name)
        else:  # an estimate from random signs, with a relative standard deviation of at most √(2/16)
            ratio = diagonal[used] / np.diagonal(H)[used]
            assert 0.7 < ratio.mean() < 1.3, name
            assert ratio.max() < 4, name


def test_the_pentadiagonal_part_is_inverted():
    """Also where it has no inverse, as for a term of acceleration alone: the result is then finite."""
    rng = np.random.default_rng(0)
    differences = np.diff(np.eye(9), 2, axis=0)
    weights = 10.0 ** rng.uniform(-1, 3, (4, 7))  # of birds that rest and move
    P = np.einsum("kti,dk,ktj->dij", differences[:, None], weights, differences[:, None]) + 0.3 * np.eye(9)
    rows = rng.normal(size=(9, 4)).astype(np.float32)
    expected = np.linalg.solve(P, rows.T[..., None])[..., 0].T

    @jax.jit
    def solved(P):
        diagonals = (jnp.pad(jnp.diagonal(P, ahead, 1, 2), [(0, 0), (0, ahead)]).T for ahead in range(3))
        diagonal, *bands = diagonals
        return pentadiagonal_solver(diagonal, jnp.stack(bands))(jnp.asarray(rows))

    np.testing.assert_allclose(solved(jnp.asarray(P, jnp.float32)), expected, rtol=2e-3, atol=1e-3)
    assert np.isfinite(solved(jnp.asarray(P - 0.3 * np.eye(9), jnp.float32))).all()


def case():
    return terms_by_hand.window_pose(), terms_by_hand.random_targets()


def test_the_quadratic_is_above_the_term():
    pose, targets = case()
    still, H, units = jnp.zeros((T, D)), curvatures(pose, targets), np.asarray(basis())
    compiled = jax.jit(lambda *of: (along(*of), jax.jacrev(along)(*of)))
    values, slopes = compiled(still, pose, targets)
    for seed, size in enumerate((0.01, 0.1, 0.5, 2.0)):
        x = size * np.random.default_rng(seed).normal(size=len(units))
        rows = np.einsum("i,itd->td", x, units).astype(np.float32)
        after = compiled(rows, pose, targets)[0]
        for name in LINEAR:
            bound = float(values[name]) + np.sum(np.asarray(slopes[name]) * rows) + 0.5 * x @ np.asarray(H[name][0]) @ x
            assert float(after[name]) <= bound * (1 + 1e-5), name
            if name in ("pose_prior", "bone_prior", "shape_prior", "low_pass"):
                assert float(after[name]) == pytest.approx(bound, rel=1e-4), name


@pytest.mark.parametrize("kernel", [geman_mcclure(2.0), huber(0.7), NORM, student_t(3.0, 2)])
def test_a_kernel_lies_below_its_tangent(kernel):
    """So the weighted squares are an upper bound. At 0, the slope of the norm is replaced by a finite number."""
    at = jnp.asarray([0.01, 0.3, 1.0, 9.0, 0.0, 0.1, 2.0, 100.0])
    evaluated = jax.jit(lambda s: (kernel.value(s), jax.vmap(jax.grad(kernel.value))(s), kernel.slope(s)))(at)
    s, value, slope, own_slope = map(np.asarray, (at, *evaluated))
    np.testing.assert_allclose(own_slope[:4], slope[:4], rtol=1e-5)
    for i in range(4, 8):
        assert (value[i] <= value[:4] + slope[:4] * (s[i] - s[:4]) + 1e-6).all()
    assert value[4] == 0
    assert np.isfinite(slope[4])
    assert 0 < own_slope[4] < 1e3


def test_keypoint_terms_do_not_couple_frames():
    framewise = int((~IS_SHARED).sum())
    for name in KEYPOINTS:
        H = np.array(curvatures(*case())[name][0])
        H = H[: T * framewise, : T * framewise].reshape(T, framewise, T, framewise)
        for t in range(T):
            assert np.any(H[t, :, t])
            H[t, :, t] = 0
        assert not np.any(H), name


def test_a_term_that_returns_a_number_has_no_curvature():
    term = Term("number", lambda window: jnp.zeros(()), {}, frozenset(), False)
    with pytest.raises(
        InputError, match="'number': returns a number, but the solver levenberg_marquardt and error bars need its"
    ):
        evaluate_curvature(window_of(*case()), {"number": term}, {"number": {"weight": 1.0}})


def test_missing_frames_have_no_curvature():
    framewise = int((~IS_SHARED).sum())
    for missing in range(T):
        targets = terms_by_hand.without_frame(terms_by_hand.random_targets(), missing)
        own = slice(missing * framewise, (missing + 1) * framewise)
        for name, each in curvatures(terms_by_hand.window_pose(), targets).items():
            if name == "low_pass":  # the term fills missing frames
                continue
            H, diagonal, _ = map(np.asarray, each)
            assert not np.any(H[own]), (name, missing)
            assert not np.any(H[:, own]), (name, missing)
            assert not np.any(diagonal[own]), (name, missing)


def test_equal_frames_have_finite_curvature():
    pose = terms_by_hand.window_pose()
    equal = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x)[:1], x.shape), pose)
    equal = dataclasses.replace(equal, bone_length=pose.bone_length, betas=0 * np.asarray(pose.betas))
    for name, (H, diagonal, bands) in curvatures(equal, terms_by_hand.random_targets()).items():
        assert np.isfinite(H).all(), name
        assert np.isfinite(diagonal).all(), name
        assert np.isfinite(bands).all(), name
        assert np.abs(H).max() > 0 or name == "joint_limits", name
