"""Terms as likelihoods: the density by scipy, outliers, and motion that does not depend on the frame rate."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.stats import multivariate_t
from support.terms_by_hand import motion_by_hand, posed_window, random_targets, term_value, window_pose

from jaxfit.objective.likelihood import keypoint_likelihood, keypoint_sd_px, motion_likelihood, place_likelihood
from jaxfit.objective.residuals import residual_sum, student_t


@pytest.mark.parametrize(("dof", "size"), [(0.7, 3), (1.0, 3), (4.0, 2), (30.0, 2)])
def test_student_t_is_the_negative_log_density_up_to_a_constant(dof, size):
    x = np.random.default_rng(0).normal(size=(50, size)) * 3
    density = multivariate_t(np.zeros(size), np.eye(size), dof)
    expected = density.logpdf(np.zeros(size)) - density.logpdf(x)
    np.testing.assert_allclose(student_t(dof, size).value(jnp.asarray((x**2).sum(1))), expected, rtol=1e-5, atol=1e-6)


def test_scale_of_keypoints_by_confidence():
    scale = keypoint_sd_px(jnp.array([0.0, 0.5, 1.0]), 2.0, 8.0)
    np.testing.assert_allclose(scale, [8, 4, 2], rtol=1e-6)


def curve(fps, seconds=2.0):
    """A smooth motion of the root and of two joints, sampled at a frame rate."""
    t = np.arange(round(seconds * fps) + 1)[:, None] / fps
    orient = np.concatenate([0.8 * np.sin(2 * t), 0.5 * np.cos(3 * t), 0.4 * t], axis=1)
    body = np.stack([orient * [0.5, 1.0, -1.0], np.sin(4 * t) * [0.1, 0.2, 0.3]], axis=1)
    return orient, body, np.ones(len(t), bool)


def test_the_cost_of_a_frame_does_not_depend_on_the_frame_rate():
    settings, per_run = {"sd_rad_s2": 0.8, "dof": 3.0}, {}
    for fps in (25, 50):
        motion = curve(fps)
        value = float(term_value(motion_likelihood, *motion, 1 / fps, **settings))
        assert value == pytest.approx(motion_by_hand(*motion, 1 / fps, **settings), rel=1e-3)
        per_run[fps] = value / (len(motion[0]) - 2)
    assert per_run[50] == pytest.approx(per_run[25], rel=0.03)
    # the wrong frame rate gives another value
    wrong = float(term_value(motion_likelihood, *curve(50), 1 / 25, **settings)) / (len(curve(50)[0]) - 2)
    assert wrong < 0.6 * per_run[25]


def test_the_window_holds_the_frame_interval():
    """The scale is sd_rad_s2 · Δ²: half the interval has the effect of a quarter of the scale."""
    pose, targets = window_pose(), random_targets()
    assert float(posed_window(pose, targets).frame_s) == pytest.approx(1 / 30)

    @jax.jit
    def cost(targets, sd_rad_s2):
        return residual_sum(motion_likelihood(posed_window(pose, targets), sd_rad_s2=sd_rad_s2))

    def value(factor, sd_rad_s2):
        scaled = dataclasses.replace(targets, frame_s=factor * targets.frame_s)
        return float(cost(scaled, sd_rad_s2))

    assert value(0.5, 40.0) == pytest.approx(value(1.0, 10.0), rel=1e-5)
    assert value(0.5, 40.0) > 1.1 * value(1.0, 40.0)


def test_the_place_is_that_in_the_image_and_not_that_in_the_crop():
    """A bird that rests in its crop, while the crop moves with a constant velocity, costs nothing."""
    pose, targets = window_pose(), random_targets()
    still = dataclasses.replace(pose, transl=jnp.broadcast_to(pose.transl[0], pose.transl.shape))
    at = np.arange(len(pose.transl))[:, None]

    def value(corner_px):
        moved = dataclasses.replace(targets, corner_px=np.float32(corner_px), present=np.ones(len(at), bool))
        return float(residual_sum(place_likelihood(posed_window(still, moved))))

    assert value(at * [3.0, -2.0]) == pytest.approx(0, abs=1e-6)
    assert value(at**2 * [3.0, -2.0]) > 1


def test_gradients_of_the_keypoint_term_with_respect_to_its_settings():
    targets = random_targets()
    pose = window_pose()

    @jax.jit
    def total(sd_sure_px, sd_unsure_px, dof):
        settings = {"sd_sure_px": sd_sure_px, "sd_unsure_px": sd_unsure_px, "dof": dof}
        return residual_sum(keypoint_likelihood(posed_window(pose, targets), **settings)) / 100

    at = (jnp.float32(1.5), jnp.float32(5.0), jnp.float32(3.0))
    check_grads(total, at, order=1, modes=["rev"], eps=1e-2, atol=0.01, rtol=0.01)
