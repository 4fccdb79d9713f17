"""Velocity and acceleration: sums of norms over neighbours that are really there."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit.objective.temporal import acceleration, velocity

BONES = 4


def window(frames, seed=0, missing=()):
    rng = np.random.default_rng(seed)
    present = np.ones(frames, bool)
    present[list(missing)] = False
    return rng.normal(size=(frames, 3)), rng.normal(size=(frames, BONES, 3)), present


def value(term, orient, body, present, **settings):
    window = SimpleNamespace(
        pose=SimpleNamespace(global_orient=jnp.asarray(orient), body_pose=jnp.asarray(body)),
        targets=SimpleNamespace(present=jnp.asarray(present)),
    )
    return term(window, **settings)


def by_hand(order, orient, body, present, beta_global=10.0, beta_pose=1.0):
    """The paper's sums, frame by frame."""
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
@pytest.mark.parametrize("missing", [(), (0,), (3,), (2, 3), (1, 4, 6), range(7), (0, 2, 4, 6)])
def test_by_hand(term, order, missing):
    case = window(7, missing=missing)
    assert float(value(term, *case)) == pytest.approx(by_hand(order, *case), rel=1e-5, abs=1e-6)


@pytest.mark.parametrize(("term", "order"), TERMS)
def test_betas_weigh_the_two_parts(term, order):
    case = window(5)
    for betas in ({"beta_global": 0.0}, {"beta_pose": 0.0}, {"beta_global": 3.0, "beta_pose": 7.0}):
        assert float(value(term, *case, **betas)) == pytest.approx(by_hand(order, *case, **betas), rel=1e-5)
    assert float(value(term, *case, beta_global=0.0, beta_pose=0.0)) == 0


def test_too_short_to_move():
    assert float(value(velocity, *window(1))) == 0
    assert float(value(acceleration, *window(1))) == 0
    assert float(value(acceleration, *window(2))) == 0
    assert float(value(velocity, *window(2))) > 0


def test_steady_motion_has_no_acceleration():
    steady = np.arange(6.0)[:, None] * [0.25, -0.5, 0.125]
    body = np.broadcast_to(steady[:, None], (6, BONES, 3))
    assert float(value(acceleration, steady, body, np.ones(6, bool))) == 0
    assert float(value(velocity, steady, body, np.ones(6, bool))) > 1


@pytest.mark.parametrize(("term", "order"), TERMS)
def test_gradients_at_equal_and_missing_frames(term, order):
    orient, body, present = window(7, missing=(3,))
    orient[4:], body[4:] = orient[4], body[4]  # three equal frames: the norms' corner

    def total(orient, body):
        return value(term, orient, body, present)

    for gradient in jax.grad(total, (0, 1))(jnp.asarray(orient), jnp.asarray(body)):
        assert np.isfinite(gradient).all()
        np.testing.assert_array_equal(gradient[3], 0)  # the missing frame
        np.testing.assert_array_equal(gradient[5], 0)  # stands where both its neighbours stand
        assert np.abs(gradient[:3]).max() > 0


@pytest.mark.parametrize(("term", "order"), TERMS)
def test_a_missing_frame_may_hold_anything(term, order):
    orient, body, present = window(7, missing=(3,))
    expected = float(value(term, orient, body, present))
    orient[3], body[3] = 1e6, -1e6
    assert float(value(term, orient, body, present)) == expected
