"""Velocity and acceleration are sums of norms over consecutive present frames."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.terms_by_hand import random_motion, term_value

from jaxfit.objective.temporal import acceleration, velocity


def by_hand(order, orient, body, present, beta_global=10.0, beta_pose=1.0):
    """The sums of Hägerlind et al. 2024, frame by frame."""
    total = 0.0
    for i in range(len(orient) - order):
        if not all(present[i : i + order + 1]):
            continue
        for theta, beta in ((orient, beta_global), (body, beta_pose)):
            if order == 1:
                difference = theta[i + 1] - theta[i]
            else:
                difference = (theta[i + 2] - theta[i + 1]) - (theta[i + 1] - theta[i])
            total += beta * np.sqrt((difference**2).sum())
    return total


TERMS = [pytest.param(velocity, 1, id="velocity"), pytest.param(acceleration, 2, id="acceleration")]


@pytest.mark.parametrize(("term", "order"), TERMS)
def test_by_hand(term, order):
    for missing in [(), (0,), (3,), (2, 3), (1, 4, 6), range(7), (0, 2, 4, 6)]:
        case = random_motion(7, missing=missing)
        assert float(term_value(term, *case)) == pytest.approx(by_hand(order, *case), rel=1e-5, abs=1e-6), missing


@pytest.mark.parametrize(("term", "order"), TERMS)
def test_betas_weight_orientation_and_body(term, order):
    case = random_motion(7)
    for betas in ({"beta_global": 0.0}, {"beta_pose": 0.0}, {"beta_global": 3.0, "beta_pose": 7.0}):
        assert float(term_value(term, *case, **betas)) == pytest.approx(by_hand(order, *case, **betas), rel=1e-5)
    assert float(term_value(term, *case, beta_global=0.0, beta_pose=0.0)) == 0


def test_short_windows_have_no_velocity_or_acceleration():
    assert float(term_value(velocity, *random_motion(1))) == 0
    assert float(term_value(acceleration, *random_motion(1))) == 0
    assert float(term_value(acceleration, *random_motion(2))) == 0
    assert float(term_value(velocity, *random_motion(2))) > 0


def test_steady_motion_has_no_acceleration():
    steady = np.arange(7.0)[:, None] * [0.25, -0.5, 0.125]
    body = np.broadcast_to(steady[:, None], (7, 4, 3))
    assert float(term_value(acceleration, steady, body, np.ones(7, bool))) == 0
    assert float(term_value(velocity, steady, body, np.ones(7, bool))) > 1


@pytest.mark.parametrize(("term", "order"), TERMS)
def test_gradients_at_equal_and_missing_frames(term, order):
    orient, body, present = random_motion(7, missing=(3,))
    orient[4:], body[4:] = orient[4], body[4]  # three equal frames: the norms are not differentiable there

    def total(orient, body):
        return term_value(term, orient, body, present)

    for gradient in map(np.asarray, jax.jit(jax.grad(total, (0, 1)))(jnp.asarray(orient), jnp.asarray(body))):
        assert np.isfinite(gradient).all()
        np.testing.assert_array_equal(gradient[3], 0)  # the missing frame
        np.testing.assert_array_equal(gradient[5], 0)  # equal to both neighbours
        assert np.abs(gradient[:3]).max() > 0


@pytest.mark.parametrize(("term", "order"), TERMS)
def test_the_pose_of_a_missing_frame_has_no_effect(term, order):
    orient, body, present = random_motion(7, missing=(3,))
    expected = float(term_value(term, orient, body, present))
    orient[3], body[3] = 1e6, -1e6
    assert float(term_value(term, orient, body, present)) == expected
