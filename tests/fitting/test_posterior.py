"""The posterior of a window against dense matrices, and against a linear-Gaussian case with a known posterior."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.precisions import blocks, dense, random_precision
from support.stages import CONFIG, MODEL, POSTERIOR, SHARED, B, T, case, problems, row

from jaxfit.fitting.posterior import (
    Blocks,
    blocks_of,
    curvature_products,
    invert_blocks,
    multiply,
    window_posteriors,
)
from jaxfit.fitting.problem import problem_window
from jaxfit.fitting.solve import stage_program
from jaxfit.objective.curvature import frame_rows, shared_columns
from jaxfit.objective.objective import evaluate_curvature
from jaxfit.objective.registry import Term, find_terms
from jaxfit.objective.residuals import Residuals, residual_curvature, student_t


@pytest.mark.parametrize(("frames", "L", "C"), [(1, 3, 0), (1, 2, 2), (2, 3, 1), (3, 2, 0), (6, 3, 2), (7, 2, 3)])
def test_the_selected_inverse_is_that_of_the_dense_matrix(frames, L, C):
    H = random_precision(frames, L, C)
    posterior, full = invert_blocks(H), dense(H)
    inverse = np.linalg.inv(full)
    for own, expected in zip(posterior, blocks(inverse, frames, L), strict=True):
        np.testing.assert_allclose(own, expected, atol=1e-9)
    at = [*range(L), *range(frames * L, len(full))]
    np.testing.assert_allclose(posterior.of_frames()[0], inverse[np.ix_(at, at)], atol=1e-9)
    x, shared = np.arange(frames * L, dtype=float).reshape(frames, L), np.arange(C, dtype=float)
    product = np.concatenate([each.ravel() for each in multiply(H, x, shared)])
    np.testing.assert_allclose(product, full @ np.concatenate([x.ravel(), shared]))


def test_kalman_smoother():
    """A random walk that is observed with noise: the posterior is that of the Rauch-Tung-Striebel smoother."""
    frames, q, r = 9, 0.3, 2.0
    band = np.zeros((3, frames, 1, 1))
    band[0] += 1 / r
    band[0, :-1] += 1 / q
    band[0, 1:] += 1 / q
    band[1, :-1] = -1 / q
    band[0, 0] += 1 / 4.0  # the prior of the first frame
    filtered, predicted = [], [4.0]
    for _ in range(frames):
        filtered.append(predicted[-1] * r / (predicted[-1] + r))
        predicted.append(filtered[-1] + q)
    smoothed = [filtered[-1]]
    for t in reversed(range(frames - 1)):
        gain = filtered[t] / predicted[t + 1]
        smoothed.append(filtered[t] + gain**2 * (smoothed[-1] - predicted[t + 1]))
    empty = np.zeros((frames, 1, 0)), np.zeros((0, 0))
    own = invert_blocks(Blocks(band, *empty)).band[0, :, 0, 0]
    np.testing.assert_allclose(own, smoothed[::-1], rtol=1e-12)


def fitted(confidence=1.0, stage=POSTERIOR, terms=None):
    """Return the program of a stage with all shared parameters, its problems, and poses."""
    program = stage_program(CONFIG, stage, MODEL)._replace(shared=SHARED)
    program = program if terms is None else program._replace(terms=terms)
    anchor, targets = case()
    targets = dataclasses.replace(targets, confidence=targets.confidence * confidence)
    return program, problems(anchor, targets, stage), anchor


@pytest.fixture(scope="module")
def products():
    return curvature_products(*fitted())


def test_blocks_are_those_of_the_dense_curvature(products):
    program, several, poses = fitted()
    is_shared = shared_columns(row(poses), SHARED)
    D = len(is_shared)

    @jax.jit
    def whole(problem, pose):
        H = evaluate_curvature(
            problem_window(program, problem, pose), program.terms, problem.hyperparameters.settings, second_order=True
        )
        units = np.eye(T * D).reshape(T, D, T, D)
        basis = np.concatenate([units[:, ~is_shared].reshape(-1, T, D), units[:, is_shared].sum(axis=0)])
        basis = jnp.asarray(basis, jnp.float32)
        return jnp.einsum("itd,jtd->ij", basis, jax.vmap(H.product)(basis))

    for b in range(B):
        one = row((several, poses), b)
        expected = np.asarray(whole(*one))
        own = blocks_of(row(products, b), is_shared)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(dense(own) / scale, expected / scale, atol=2e-5)


def test_posterior_of_a_window():
    """Fixed depth and settings; frames without data have the broad prior and do not count in the volume."""
    program, several, poses = fitted()
    for each in window_posteriors(program, several, poses):
        assert not isinstance(each, str)
        J, D = len(MODEL.rig.parents), frame_rows(row(poses), SHARED).shape[1]
        assert 3 * J + 2 not in each.columns.own  # depth
        assert len(each.columns.own) == 3 * J + 2
        assert len(each.columns.shared) == D - 3 * J - 3
        sd = np.sqrt(np.einsum("tii->ti", each.covariance().of_frames()))
        assert np.isfinite(sd).all()
        assert sd[:, : 3 * J].max() < np.pi / np.sqrt(3)


@pytest.mark.parametrize("keypoints", [0, 2])
def test_a_bird_with_few_keypoints_has_finite_error_bars(keypoints):
    few = np.zeros((B, T, MODEL.bird.num_keypoints), np.float32)
    few[..., :keypoints] = 1
    orient_sd = []
    for confidence in (few, 1.0):
        own = window_posteriors(*fitted(confidence))[0]
        assert not isinstance(own, str)
        covariance = own.covariance().of_frames()
        assert np.isfinite(covariance).all()
        assert (np.linalg.eigvalsh(covariance) > 0).all()
        orient_sd.append(np.sqrt(np.diagonal(covariance[0])[:3]))
    assert (orient_sd[0] > 3 * orient_sd[1]).all()


def test_missing_frames_do_not_count():
    program, several, poses = fitted()
    present = np.ones((B, T), bool)
    present[:, -1] = False
    targets = several.targets
    targets = dataclasses.replace(targets, present=present, confidence=targets.confidence * present[..., None])
    own = window_posteriors(program, several._replace(targets=targets), poses)[0]
    assert not isinstance(own, str)
    angle_sd = np.sqrt(np.diagonal(own.covariance().band[0, -1]))[:3]
    np.testing.assert_allclose(angle_sd, np.pi / np.sqrt(3), rtol=1e-4)


def test_a_term_that_links_distant_frames_is_reported():
    def ends(window):
        return Residuals(window.pose.global_orient[-1] - window.pose.global_orient[0])

    terms = {**find_terms(("keypoints", "pose_prior")), "ends": Term("ends", ends, {}, frozenset(), False)}
    program = fitted()[0]._replace(terms=terms)
    several = fitted(stage=dataclasses.replace(POSTERIOR, terms=("keypoints", "pose_prior")))[1]
    settings = several.hyperparameters.settings | {"ends": {"weight": np.full(B, 100.0, np.float32)}}
    several = several._replace(hyperparameters=several.hyperparameters._replace(settings=settings))
    own = window_posteriors(program, several, fitted()[2])
    assert all(isinstance(each, str) and "frames apart" in each for each in own)


def test_second_order_curvature_of_student_t_is_its_fisher_information():
    """The mean over the density is (ν + n)/(ν + n + 2) per scale²; the bound has the mean 1."""
    dof, size, count = 4.0, 2, 40_000
    rng = np.random.default_rng(0)
    r = rng.normal(size=(count, size)) / np.sqrt(rng.chisquare(dof, (count, 1)) / dof)
    r = jnp.asarray(r, jnp.float32)

    class Line:
        """A window with one parameter per residual: the residuals are r + rows."""

        pose = dataclasses.replace(fitted()[2], global_orient=np.zeros((count, 3), np.float32))
        shared = ()

    kernel = student_t(dof, size)
    own = Residuals(r, kernel=kernel, jacobian=lambda: [jnp.broadcast_to(jnp.eye(size)[:, :1], (count, size, 1))])
    for second_order, expected in ((True, (dof + size) / (dof + size + 2)), (False, 1.0)):
        H = residual_curvature(Line(), [lambda _: own], second_order)  # pyright: ignore[reportArgumentType]
        assert float(H.diagonal.mean()) == pytest.approx(expected, rel=0.02)
