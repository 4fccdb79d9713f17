"""Terms for smooth and plausible motion: against scipy, at non-differentiable points, and with missing frames."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.fft import dct
from scipy.spatial.transform import Rotation
from support.birds import tiny_bird
from support.terms_by_hand import CAMERA, RASTER, motion_by_hand, random_motion, random_targets, term_value, window_pose

from jaxfit.foundation.errors import InputError
from jaxfit.model.kinematics import fold_bird
from jaxfit.objective.likelihood import motion_likelihood
from jaxfit.objective.posed_window import PosedWindow, priors_of
from jaxfit.objective.residuals import residual_sum
from jaxfit.objective.temporal import acceleration, geodesic_velocity, huber_velocity, low_pass, velocity
from jaxfit.objective.terms import feet_on_ground, joint_limits

BONES, L = 4, 8


def angle(a, b):
    return (Rotation.from_rotvec(a).inv() * Rotation.from_rotvec(b)).magnitude()


def huber_by_hand(x, delta):
    return np.where(x <= delta, x**2 / 2, delta * (x - delta / 2))


def by_hand(term, orient, body, present, beta_global=10.0, beta_pose=1.0, **settings):
    if term is motion_likelihood:
        return motion_by_hand(orient, body, present, **settings)
    if term is low_pass:
        flat = body.reshape(len(body), -1)
        return beta_global * fast_energy(orient, present, **settings) + beta_pose * fast_energy(
            flat, present, **settings
        )
    if term in (velocity, acceleration):
        order, total = 1 if term is velocity else 2, 0.0
        for i in range(len(orient) - order):
            if all(present[i : i + order + 1]):
                for theta, beta in ((orient, beta_global), (body, beta_pose)):
                    total += beta * np.linalg.norm(np.diff(theta[i : i + order + 1], order, axis=0))
        return total
    total = 0.0
    for i in range(len(orient) - 1):
        if present[i] and present[i + 1]:
            root, joints = angle(orient[i], orient[i + 1]), angle(body[i], body[i + 1])
            if term is geodesic_velocity:
                total += beta_global * root + beta_pose * np.sqrt((joints**2).sum())
            else:
                delta = settings["delta_rad"]
                total += beta_global * huber_by_hand(root, delta) + beta_pose * huber_by_hand(joints, delta).sum()
    return total


def fast_energy(x, present, cutoff_cycles_per_frame):
    """Energy above the cut-off frequency, with missing frames interpolated by NumPy."""
    at = np.flatnonzero(present)
    if not len(at):
        return 0.0
    filled = np.stack([np.interp(np.arange(len(x)), at, column[at]) for column in x.T], axis=1)
    c, f = dct(filled, axis=0, norm="ortho")[1:], np.arange(1, len(x)) / (2 * len(x))
    return ((c**2).sum(axis=1) / (1 + (cutoff_cycles_per_frame / f) ** 8)).sum()


CASES = [
    pytest.param(velocity, {}, id="velocity"),
    pytest.param(acceleration, {}, id="acceleration"),
    pytest.param(geodesic_velocity, {}, id="geodesic"),
    pytest.param(huber_velocity, {"delta_rad": 1.2}, id="huber"),
    pytest.param(low_pass, {"cutoff_cycles_per_frame": 0.2}, id="low_pass"),
    pytest.param(motion_likelihood, {"sd_rad_s2": 700.0, "dof": 2.5}, id="motion"),
]


CORNERS = {
    "equal frames": np.broadcast_to([0.3, -1.0, 0.5], (L, 3)),
    "zero rotation": np.zeros((L, 3)),
    "half turns": np.arange(L)[:, None] * [0, 0, np.pi],
    "half turns about a slanted axis": np.arange(L)[:, None] % 2 * np.pi * np.array([0.6, 0, 0.8]),
    "tiny steps": np.arange(L)[:, None] * [1e-7, 0, 0],
}


@pytest.mark.parametrize(("term", "own"), CASES)
def test_values_by_hand_and_finite_gradients_at_corners(term, own):
    own = own if term is motion_likelihood else own | {"beta_global": 3.0, "beta_pose": 0.5}
    value_and_slope = jax.jit(jax.value_and_grad(lambda *motion: term_value(term, *motion, **own), (0, 1)))
    for missing in [(), (0,), (3,), (2, 3, 7), range(L), range(1, L)]:
        motion = random_motion(L, missing=missing)
        value, _ = value_and_slope(*map(np.float32, motion[:2]), motion[2])
        assert float(value) == pytest.approx(by_hand(term, *motion, **own), rel=2e-5, abs=1e-6), missing
    for corner, orient in CORNERS.items():
        body = np.broadcast_to(orient[:, None], (L, BONES, 3))
        for gradient in value_and_slope(np.float32(orient), np.float32(body), np.ones(L, bool))[1]:
            assert np.isfinite(gradient).all(), corner
            if corner in ("equal frames", "zero rotation"):
                np.testing.assert_allclose(gradient, 0, atol=1e-4, err_msg=corner)
    assert float(term_value(term, *random_motion(1), **own)) == 0


def test_velocity_on_rotations_ignores_full_turns_of_the_axis_angle():
    """Axis-angles that differ by a full turn are the same rotation; `velocity` would count a jump of 2π."""
    orient, body, present = random_motion(L, spread=0.3)
    again = orient.copy()
    again[4:] += 2 * np.pi * orient[4:] / np.linalg.norm(orient[4:], axis=1, keepdims=True)
    for term, own in ((geodesic_velocity, {}), (huber_velocity, {}), (motion_likelihood, {"sd_rad_s2": 700.0})):
        before, after = (float(term_value(term, o, body, present, **own)) for o in (orient, again))
        assert after == pytest.approx(before, rel=1e-4)


def test_steady_motion_has_no_acceleration():
    steady = np.arange(L)[:, None] * [0.25, -0.5, 0.125]
    body = np.broadcast_to(steady[:, None], (L, BONES, 3))
    assert float(term_value(acceleration, steady, body, np.ones(L, bool))) == 0
    assert float(term_value(velocity, steady, body, np.ones(L, bool))) > 1


def test_huber_limits_the_gradient_of_fast_joints():
    """The gradient of one joint grows with its speed up to δ, independently of the other joints."""

    slope = jax.jit(
        jax.grad(lambda body: term_value(huber_velocity, np.zeros((2, 3)), body, np.ones(2, bool), delta_rad=0.1))
    )

    def gradient(speed, others):
        body = np.zeros((2, BONES, 3))
        body[1, 0, 0], body[1, 1:, 1] = speed, others
        return float(np.asarray(slope(jnp.asarray(body, jnp.float32)))[1, 0, 0])

    for others in (0.0, 0.5):
        assert gradient(0.02, others) == pytest.approx(0.02, rel=1e-3)
        assert gradient(0.4, others) == pytest.approx(0.1, rel=1e-3)
        assert gradient(1.5, others) == pytest.approx(0.1, rel=1e-3)


def test_low_pass_separates_slow_from_fast_motion():
    t = np.arange(60) + 0.5
    body = np.zeros((60, BONES, 3))

    def energy(cycles_per_frame):
        orient = np.cos(2 * np.pi * cycles_per_frame * t)[:, None] * [0.1, 0, 0]
        return float(term_value(low_pass, orient, body, np.ones(60, bool), cutoff_cycles_per_frame=0.15))

    whole = 60 * 0.1**2 / 2
    assert energy(0.05) < 1e-3 * whole
    assert energy(0.15) == pytest.approx(whole / 2, rel=1e-3)
    assert energy(0.4) == pytest.approx(whole, rel=1e-2)
    still = np.full((60, 3), 2.0)
    assert float(term_value(low_pass, still, body, np.ones(60, bool))) < 1e-9


LIMITED = tiny_bird()
LIMITED = replace(LIMITED, joint_limits=jnp.broadcast_to(jnp.array([-0.2, 0.5]), (3, 3, 2)))


def make_window(bird, pose, targets):
    """A posed window with the priors of `bird`, whose anchor is the pose itself."""
    return PosedWindow(pose, pose, targets, fold_bird(bird), priors_of(bird), CAMERA, RASTER)


def test_joint_limits():
    pose, targets = window_pose(), random_targets()
    inside = np.zeros(pose.body_pose.shape, np.float32)
    inside[0, 0, 0], inside[1, 1, 2] = 0.5, -0.2
    outside = inside.copy()
    outside[0, 0, 0], outside[1, 1, 2], outside[2, 2, 1] = 0.8, -0.4, 2.5

    @jax.jit
    @jax.value_and_grad
    def limits(body, present):
        window = make_window(LIMITED, replace(pose, body_pose=body), replace(targets, present=present))
        return residual_sum(joint_limits(window))

    all_present = np.ones(3, bool)
    assert float(limits(inside, all_present)[0]) == 0
    value, slope = limits(outside, all_present)
    assert float(value) == pytest.approx(0.3**2 + 0.2**2 + 2.0**2, rel=1e-5)
    assert float(slope[2, 2, 1]) == pytest.approx(4.0, rel=1e-5)
    assert np.count_nonzero(slope) == 3
    absent = np.array([True, True, False])
    assert float(limits(outside, absent)[0]) == pytest.approx(0.3**2 + 0.2**2, rel=1e-5)
    with pytest.raises(InputError, match="no joint limits"):
        joint_limits(make_window(tiny_bird(), pose, targets))


def test_feet_on_ground():
    """A constant pose in a moving crop slides in the world; a constant pose in a static crop stands."""
    bird = tiny_bird()
    one = jax.tree.map(np.asarray, window_pose())
    still = jax.tree.map(lambda x: np.broadcast_to(x[:1], x.shape), one)
    still = replace(still, bone_length=one.bone_length, betas=one.betas)
    targets = replace(random_targets(), corner_px=np.float32([[0, 0], [3, -1], [6, 0]]))
    feet = list(make_window(bird, still, targets).keypoint_indices("left_foot", "right_foot"))
    z = np.asarray(jax.jit(lambda: make_window(bird, still, targets).keypoints_cam)()[0, feet, 2])

    @jax.jit
    @jax.value_and_grad
    def slip(pose, targets):
        return residual_sum(feet_on_ground(make_window(bird, pose, targets)))

    # displacement in the world of a bird at rest in the crop, if the crop moves by these pixels
    d = np.hypot([3.0, 3.0], [1.0, 1.0])[:, None] * z / CAMERA.focal_px
    expected = (0.25 * d**2 / (0.25 + d**2)).sum()
    assert float(slip(still, targets)[0]) == pytest.approx(expected, rel=1e-3)
    fixed = replace(targets, corner_px=np.full((3, 2), 7.0, np.float32))
    assert float(slip(still, fixed)[0]) == 0
    far = replace(still, transl=still.transl + np.float32([[0, 0, 0], [40, 0, 0], [80, 0, 0]]))
    slope = slip(far, fixed)[1].transl
    assert np.abs(slope).max() < 1e-4, "long steps must have hardly any gradient"
    names = tuple("foot" if "foot" in name else name for name in bird.keypoint_names)
    footless = replace(bird, keypoint_names=names)
    with pytest.raises(InputError, match=r"no keypoint 'left_foot'.*bill_tip"):
        feet_on_ground(make_window(footless, still, fixed))
