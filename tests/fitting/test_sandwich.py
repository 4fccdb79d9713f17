"""The sandwich covariance against dense matrices, and against the errors of many simulated linear fits."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from support.precisions import blocks, dense, random_precision

from jaxfit.fitting.posterior import Columns, factorise, invert_blocks, posterior_of, solve_blocks
from jaxfit.fitting.sandwich import (
    constant_deviation,
    data_blocks,
    fit_correlation,
    lag_correlations,
    spread,
    time_factor,
)


@pytest.mark.parametrize(("frames", "L", "C"), [(1, 3, 0), (2, 3, 1), (6, 3, 2), (7, 2, 0)])
def test_solutions_and_spread_are_those_of_dense_matrices(frames, L, C):
    H, B = random_precision(frames, L, C), random_precision(frames, L, C, seed=1)
    right = np.random.default_rng(2).normal(size=(frames * L + C, 4))
    own, shared = solve_blocks(factorise(H), right[: frames * L].reshape(frames, L, 4), right[frames * L :])
    found = np.concatenate([own.reshape(-1, 4), shared])
    np.testing.assert_allclose(found, np.linalg.solve(dense(H), right), atol=1e-9)
    inverse = np.linalg.inv(dense(H))
    expected = inverse @ dense(B) @ inverse
    for t, own_frame in enumerate(spread(H, invert_blocks(H).of_frames(), B)):
        at = [*range(t * L, (t + 1) * L), *range(frames * L, frames * L + C)]
        np.testing.assert_allclose(own_frame, expected[np.ix_(at, at)], rtol=0.01, atol=0.01 * np.abs(expected).max())


def test_curvature_of_the_data():
    rng, own = np.random.default_rng(0), 3
    J, precision = rng.normal(size=(4, 5, 2, own + 2)), rng.uniform(size=(4, 5))
    expected = np.zeros((4 * own + 2,) * 2)
    for t in range(4):
        rows = np.zeros((10, len(expected)))
        rows[:, t * own : (t + 1) * own] = J[t, ..., :own].reshape(10, own)
        rows[:, 4 * own :] = J[t, ..., own:].reshape(10, 2)
        expected += rows.T @ (np.repeat(precision[t], 2)[:, None] * rows)
    np.testing.assert_allclose(dense(data_blocks(J, precision, own)), expected)


class Line:
    """Poses of two parameters: one keypoint shows the first, x, and the pose prior links the second, z, to x.

    Like the depth of a joint, z is not in the image. Accelerations are penalised.
    """

    frames, weight, noise_precision, motion = 40, 1.4, 4.0, 30.0
    covariance = np.array([[1.0, 0.6], [0.6, 1.0]])

    def __init__(self):
        self.whitener = np.linalg.inv(np.linalg.cholesky(self.covariance))
        p = 2 * self.weight * self.whitener.T @ self.whitener
        second = np.diff(np.eye(self.frames), 2, axis=0)
        self.prior = np.kron(np.eye(self.frames), p)
        self.motion_part = np.kron(self.motion * second.T @ second, np.eye(2))
        self.shown = np.kron(np.eye(self.frames), [[1.0, 0.0]])
        self.H = self.prior + self.motion_part + self.noise_precision * self.shown.T @ self.shown
        found = posterior_of(
            blocks(self.H, self.frames, 2), Columns(np.arange(2), np.zeros(0, int)), np.full((self.frames, 2), 1e-9)
        )
        assert not isinstance(found, str)
        self.window = found

    def errors(self, poses, noise):
        """Return the errors of the fits to noisy keypoints of some poses, (draws, frames, 2)."""
        data = self.noise_precision * (poses @ self.shown.T + noise)
        fitted = np.linalg.solve(self.H, self.shown.T @ data.T).T
        return (fitted - poses).reshape(-1, self.frames, 2)


def test_error_bars_of_a_constant_pose_are_those_of_many_fits():
    """Poses that stay as they are for the whole window: H⁻¹ is too narrow, the sandwich is right."""
    line, rng, draws = Line(), np.random.default_rng(0), 4000
    deviations = rng.multivariate_normal(np.zeros(2), line.covariance / (2 * line.weight), draws)
    poses = np.tile(deviations, (1, line.frames))
    noise = rng.normal(size=(draws, line.frames)) / np.sqrt(line.noise_precision)
    measured = line.errors(poses, noise).var(axis=0)
    plain = line.window.covariance().of_frames()
    present = np.ones(line.frames, bool)
    V, _ = constant_deviation(line.window, line.whitener, 0, line.weight, present)
    wide = plain + V @ V.swapaxes(1, 2)
    middle = slice(5, -5)
    sd, plain_sd, true_sd = (
        np.sqrt(np.mean(each[middle, 1])) for each in (*(np.einsum("tii->ti", c) for c in (wide, plain)), measured)
    )
    assert plain_sd < 0.6 * true_sd
    assert 0.95 * true_sd < sd < 1.25 * true_sd  # the assumed motion about the mean pose comes on top


def test_a_single_frame_keeps_its_posterior():
    line = Line()
    one = posterior_of(blocks(line.H[:2, :2], 1, 2), Columns(np.arange(2), np.zeros(0, int)), np.full((1, 2), 1e-9))
    assert not isinstance(one, str)
    assert not constant_deviation(one, line.whitener, 0, line.weight, np.ones(1, bool))[0].any()
    assert time_factor(lag_correlations(np.ones((1, 9, 2)), np.ones((1, 9), bool)), 1.0) == 1
    # so does a window with one frame with the bird
    only = np.arange(line.frames) == 3
    assert not constant_deviation(line.window, line.whitener, 0, line.weight, only)[0].any()


def test_noise_that_agrees_between_frames():
    """The variance that correlated noise adds is that of many fits, within the accuracy of a single κ."""
    line, rng, rho, draws = Line(), np.random.default_rng(0), 0.8, 4000
    R = np.linalg.cholesky(toeplitz(rho ** np.arange(line.frames)))
    white = rng.normal(size=(draws, line.frames)) / np.sqrt(line.noise_precision)
    zero = np.zeros((draws, 2 * line.frames))
    measured = line.errors(zero, white @ R.T)[:, 5:-5].var(axis=0).mean(axis=0)
    independent = line.errors(zero, white)[:, 5:-5].var(axis=0).mean(axis=0)
    J = np.broadcast_to([[1.0, 0.0], [0.0, 0.0]], (line.frames, 1, 2, 2))
    present = np.ones(line.frames, bool)
    kappa = fit_correlation(J, line.window.covariance(), present)
    factor = time_factor(rho ** np.arange(1, line.frames), kappa)
    data = data_blocks(J, np.full((line.frames, 1), line.noise_precision), 2)
    found = factor * np.einsum("tii->ti", spread(line.window.precision, line.window.covariance().of_frames(), data))[
        5:-5
    ].mean(axis=0)
    assert (measured > 2 * independent).all()
    np.testing.assert_allclose(found, measured, rtol=0.25)


@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_correlations_of_residuals(rho):
    """Neither outliers, nor scales that differ between residuals, nor missing keypoints change the correlations."""
    rng, frames, keypoints = np.random.default_rng(0), 200, 18
    R = np.linalg.cholesky(toeplitz(rho ** np.arange(frames)))
    normal = np.einsum("tu,uki->tki", R, rng.normal(size=(frames, keypoints, 2)))
    counted = rng.random((frames, keypoints)) < 0.8
    found = lag_correlations(normal * rng.standard_cauchy((frames, keypoints, 1)) ** 2, counted)
    if rho:
        np.testing.assert_allclose(found[:4], rho ** np.arange(1, 5), atol=0.05)
    assert time_factor(found, 1.0) == pytest.approx((1 + rho) / (1 - rho), rel=0.2)
    assert time_factor(found, 0.0) == 1


def test_few_residuals_have_no_correlation():
    assert not len(lag_correlations(np.ones((5, 3, 2)), np.ones((5, 3), bool)))
