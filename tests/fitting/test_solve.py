"""Stages of a fit: Adam against a plain loop, fixed parameters, diverged birds, reports and compiled programs."""

import dataclasses
import logging

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.stages import (
    BIRD,
    CAMERA,
    CONFIG,
    FIRST,
    MODEL,
    SECOND,
    STEPS,
    B,
    case,
    problems,
    program,
    solve,
    total,
)

from jaxfit.fitting.solve import advance, begin, report
from jaxfit.model.camera import project
from jaxfit.model.kinematics import Pose, window_keypoints, window_transforms

STEP = {"global_orient": 0.02, "body_pose": 0.02, "transl": np.array([0.02, 0.01, 0]), "scale": 0.005}
"""Step size of each optimised parameter in the stage `FIRST`."""

SOLVERS = pytest.mark.parametrize("solver", ["adam", "levenberg_marquardt"])


@jax.jit
def loss_and_gradient(pose, targets):
    return jax.vmap(jax.value_and_grad(lambda p, e: total(p, p, e)))(pose, targets)


def adam(start, targets, rates, carry):
    """Algorithm 1 of Kingma and Ba as a plain loop. `rates` has a factor on the step size of each stage."""
    pose = {name: np.asarray(getattr(start, name), np.float64) for name in vars(start)}
    losses = []
    for stage, rate in enumerate(rates):
        if stage == 0 or not carry:
            m, v, t = {name: 0.0 for name in STEP}, {name: 0.0 for name in STEP}, 0
        for _ in range(STEPS):
            value, gradient = loss_and_gradient(
                Pose(**{name: jnp.asarray(x, jnp.float32) for name, x in pose.items()}), targets
            )
            t += 1
            for name, step in STEP.items():
                g = np.asarray(getattr(gradient, name), np.float64)
                m[name] = 0.9 * m[name] + 0.1 * g
                v[name] = 0.999 * v[name] + 0.001 * g**2
                direction = (m[name] / (1 - 0.9**t)) / (np.sqrt(v[name] / (1 - 0.999**t)) + 1e-8)
                pose[name] = pose[name] - rate * step * direction
            losses.append(np.asarray(value))
    return pose, np.array(losses)


def test_a_stage_equals_a_plain_loop_of_adam():
    start, targets = case()
    pose, loss, rejected = solve([FIRST], start, targets)
    expected, losses = adam(start, targets, [1.0], carry=False)
    np.testing.assert_allclose(loss, losses[-1], rtol=1e-5)
    assert (losses[-1] < 0.5 * losses[0]).all()
    for name in STEP:
        np.testing.assert_allclose(getattr(pose, name), expected[name], atol=2e-5, err_msg=name)
    assert not rejected.any()


@pytest.mark.parametrize("carry", [True, False])
def test_moments_are_carried_or_reset(carry):
    start, targets = case()
    second = dataclasses.replace(SECOND, carry_moments=carry)
    pose, loss, _ = solve([FIRST, second], start, targets)
    runs = {c: adam(start, targets, [1.0, 0.5], carry=c) for c in (True, False)}
    np.testing.assert_allclose(loss, runs[carry][1][-1], rtol=1e-5)
    for name in STEP:
        np.testing.assert_allclose(getattr(pose, name), runs[carry][0][name], atol=2e-5, err_msg=name)
    difference = np.abs(runs[True][0]["body_pose"] - runs[False][0]["body_pose"]).max()
    assert difference > 1e-3, "the test needs a case in which the moments matter"


@SOLVERS
def test_the_number_of_steps_per_call_does_not_change_the_result(solver):
    start, targets = case()
    stage = dataclasses.replace(FIRST, solver=solver)
    whole, loss, _ = solve([stage], start, targets)
    parts, loss_of_parts, _ = solve([stage], start, targets, (1, 2, 9, STEPS - 12))
    np.testing.assert_array_equal(loss, loss_of_parts)
    for name in vars(whole):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name), err_msg=name)


@SOLVERS
def test_fixed_parameters_do_not_change(solver):
    start, targets = case()
    first = dataclasses.replace(FIRST, solver=solver)
    pose, _, _ = solve([first], start, targets)
    for name in ("bone_length", "betas"):
        np.testing.assert_array_equal(getattr(pose, name), getattr(start, name))
    np.testing.assert_array_equal(pose.transl[..., 2], start.transl[..., 2])
    for after, before in (
        (pose.transl[..., :2], start.transl[..., :2]),
        (pose.scale, start.scale),
        (pose.global_orient, start.global_orient),
        (pose.body_pose, start.body_pose),
    ):
        assert (np.abs(after - before) > 1e-4).mean() > 0.9
    assert pose.scale.shape == (B, 1)  # one size for the window
    only = dataclasses.replace(first, optimised=("global_orient",))
    pose, _, _ = solve([only], start, targets)
    for name in ("body_pose", "transl", "scale"):
        np.testing.assert_array_equal(getattr(pose, name), getattr(start, name))


@SOLVERS
def test_a_diverged_bird_does_not_move_and_does_not_change_the_other_bird(solver):
    start, healthy = case()
    stages = [dataclasses.replace(s, solver=solver, carry_moments=solver == "adam") for s in (FIRST, SECOND)]
    pose, _, rejected = solve(stages, start, case(diverging=1)[1])
    expected, _, _ = solve(stages, start, healthy)
    assert rejected.tolist() == [0, STEPS]
    for name in vars(pose):
        np.testing.assert_array_equal(getattr(pose, name)[0], getattr(expected, name)[0], err_msg=name)
        np.testing.assert_array_equal(getattr(pose, name)[1], getattr(start, name)[1], err_msg=name)


def test_keypoints_off_are_ignored():
    start, targets = case()
    stage = dataclasses.replace(FIRST, keypoints_off=("nape", "no such keypoint"))
    nape = BIRD.keypoint_names.index("nape")
    moved = eqx.tree_at(lambda e: e.keypoints_px, targets, targets.keypoints_px.at[:, :, nape].add(40.0))
    results = [solve([s], start, e)[0] for s in (stage, FIRST) for e in (targets, moved)]
    np.testing.assert_array_equal(results[0].body_pose, results[1].body_pose)
    assert np.abs(results[2].body_pose - results[3].body_pose).max() > 1e-3


def test_the_report_has_the_weighted_terms_and_the_keypoints_of_the_poses():
    start, targets = case()
    result = report(program(), problems(start, targets), start)
    assert set(result.loss) == set(FIRST.terms)
    np.testing.assert_allclose(sum(result.loss.values()), loss_and_gradient(start, targets)[0], rtol=1e-5)
    prior = (np.asarray(start.body_pose).reshape(B, -1) ** 2).sum(1) / 0.1  # the variance of the toy bird's prior
    np.testing.assert_allclose(result.loss["pose_prior"], 10 * prior, rtol=1e-5, atol=1e-5)
    first = jax.tree.map(lambda x: x[0], start)
    keypoints = window_keypoints(MODEL.rig, window_transforms(MODEL.rig, first), first)
    np.testing.assert_allclose(result.keypoints_cam[0], keypoints, atol=1e-4)
    np.testing.assert_allclose(result.keypoints_px[0], project(keypoints, CAMERA), atol=1e-2)


def test_steps_weights_learning_rates_and_frame_rates_share_one_program(caplog):
    start, targets = case()
    solve([FIRST], start, targets)
    others = [
        (dataclasses.replace(FIRST, learning_rate=0.1, step_scale={"transl": (1.0, 1.0, 1.0), "scale": 1.0}), CONFIG),
        (FIRST, dataclasses.replace(CONFIG, terms={"keypoints": {"sigma_px": 9}, "velocity": 3})),
        (dataclasses.replace(FIRST, keypoints_off=("nape",)), CONFIG),
    ]
    with caplog.at_level(logging.WARNING), jax.log_compiles():
        for stage, config in others:
            faster = dataclasses.replace(targets, frame_s=targets.frame_s / 4)
            own = program(stage, config), problems(start, faster, stage, config)
            advance((*own, jnp.int32(3)), begin(*own, None))
        assert not compiled(caplog, "advance")
        assert not compiled(caplog, "begin")
        shorter = jax.tree.map(lambda x: x[:1], (start, targets))
        solve([FIRST], *shorter)
        assert len(compiled(caplog, "advance")) == 1  # another batch size compiles: the count works


def compiled(caplog, name):
    messages = [record.getMessage() for record in caplog.records]
    return [m for m in messages if m.startswith("Compiling") and name in m.split("with")[0]]
