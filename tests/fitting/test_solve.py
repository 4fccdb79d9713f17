"""The solvers: Adam is a plain loop of Adam; steps of Levenberg-Marquardt solve its equation, and few are enough."""

import dataclasses
import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.birds import pose_window
from support.stages import (
    BIRD,
    CAMERA,
    CONFIG,
    FIRST,
    MODEL,
    SECOND,
    STEPS,
    B,
    T,
    case,
    problems,
    program,
    row,
    solve,
    total,
)

from jaxfit.config.fit import load_config
from jaxfit.fitting.diagnose import check_terms
from jaxfit.fitting.fit import fit
from jaxfit.fitting.levenberg_marquardt import (
    DAMPING_DECREASE,
    DAMPING_INCREASE,
    FIRST_DAMPING,
    LEVENBERG_MARQUARDT,
    MAX_RELAXATION,
    MOMENTUM,
)
from jaxfit.fitting.problem import problem_window
from jaxfit.fitting.solve import advance, begin, report
from jaxfit.foundation.errors import InputError
from jaxfit.model.camera import project
from jaxfit.model.kinematics import Pose
from jaxfit.objective import registry
from jaxfit.objective.curvature import add_rows, frame_rows, shared_columns
from jaxfit.objective.objective import evaluate_curvature
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect

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
    pose, loss, _ = solve([first], start, targets)
    if solver != "adam":  # Adam has the loss before its last step
        for n in range(B):
            np.testing.assert_allclose(loss[n], total(*row((pose, start, targets), n)), rtol=1e-5)
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
    points = np.array(targets.keypoints_px)
    points[:, :, nape] += 40
    moved = dataclasses.replace(targets, keypoints_px=points)
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
    keypoints, _ = pose_window(BIRD, row(start))
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
        shorter = jax.device_put(row((start, targets), slice(1)))
        solve([FIRST], *shorter)
        assert len(compiled(caplog, "advance")) == 1  # another batch size compiles: the count works


def compiled(caplog, name):
    messages = [record.getMessage() for record in caplog.records]
    return [m for m in messages if m.startswith("Compiling") and name in m.split("with")[0]]


NEWTON = dataclasses.replace(FIRST, solver="levenberg_marquardt")
PLACE = dataclasses.replace(
    NEWTON, optimised=("global_orient", "transl", "scale"), terms=(*NEWTON.terms, "acceleration")
)
"""Few enough parameters for conjugate gradients to converge. Most tests share its compiled program."""
SHAPE = dataclasses.replace(
    NEWTON,
    optimised=("global_orient", "transl", "scale", "bone_length", "betas"),
    terms=("keypoints", "bone_prior", "shape_prior"),
)

DAMPING = 1.0
"""With less damping, the first step of this case would increase the loss."""


def first_problem(stage):
    """Return the problem of the first bird."""
    return row(problems(*case(), stage))


compiled_steps: dict = {}


def solver_of(stage):
    """Return the compiled `init` and `step` of a stage."""
    if id(stage) not in compiled_steps:
        own = program(stage)

        def init(problem):
            return LEVENBERG_MARQUARDT.init(own, problem, None)

        def step(problem, pose, state):
            return LEVENBERG_MARQUARDT.step(own, problem, pose, state)

        compiled_steps[id(stage)] = tuple(jax.jit(jax.vmap(f)) for f in (init, step))
    return compiled_steps[id(stage)]


def take_steps(stage, problem, count=1, **changes):
    """Return the first state (with `changes`), and pose and state after each step with an accurate equation."""
    init, step = solver_of(stage)
    batch = jax.device_put(jax.tree.map(lambda x: np.asarray(x)[None], problem))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxfit.fitting.levenberg_marquardt.CG_TOLERANCE", 1e-6)
        pose, first = step(batch, batch.anchor, init(batch))  # evaluates the anchor
        states = [(pose, first._replace(**{name: np.float32(value)[None] for name, value in changes.items()}))]
        for _ in range(count):
            states.append(step(batch, *states[-1]))
    (_, before), *after = row(states)
    return before, after


def dense_step(stage, problem, damping):
    """Solve (H + μ·D)·d = −g with a dense H and its diagonal D, over the optimised parameters."""
    if ("dense", id(stage)) in compiled_steps:
        return compiled_steps["dense", id(stage)]
    own, anchor = program(stage), problem.anchor
    zero = jnp.zeros_like(frame_rows(anchor, own.shared))
    size = jax.tree.map(lambda x, step: jnp.broadcast_to(step, x.shape), anchor, problem.hyperparameters.step_size)
    optimised = np.asarray(frame_rows(size, own.shared)) > 0
    is_shared = shared_columns(anchor, own.shared)

    @jax.jit
    def derivatives():
        H = evaluate_curvature(problem_window(own, problem, anchor), own.terms, problem.hyperparameters.settings)
        units = jnp.eye(zero.size).reshape(-1, *zero.shape)
        gradient = jax.grad(lambda rows: total_of(stage, add_rows(anchor, rows, own.shared), problem))(zero)
        return jax.vmap(H.product)(units), H.diagonal, gradient

    product, diagonal, gradient = (np.asarray(x, np.float64) for x in derivatives())
    units = np.eye(zero.size).reshape(*zero.shape, -1)
    basis = np.column_stack([units[optimised & ~is_shared].T, units[:, optimised[0] & is_shared].sum(axis=0).T])
    H, D = product.reshape(zero.size, -1), np.diag(diagonal.ravel())
    reduced = basis.T @ (H + damping * D) @ basis
    step = (basis @ np.linalg.solve(reduced, -basis.T @ gradient.ravel())).reshape(zero.shape)
    return compiled_steps.setdefault(("dense", id(stage)), step)


def total_of(stage, pose, problem):
    return total(pose, problem.anchor, problem.targets, stage)


@pytest.mark.parametrize("stage", [PLACE, SHAPE], ids=["place", "bones and shape"])
def test_a_step_solves_the_equation(stage):
    problem = first_problem(stage)
    before, [(pose, after)] = take_steps(stage, problem, damping=DAMPING)
    expected = dense_step(stage, problem, DAMPING)
    shared = program(stage).shared
    change = np.asarray(frame_rows(pose, shared) - frame_rows(problem.anchor, shared))
    assert (np.abs(expected).max(axis=0) > 1e-3)[-1], "the last parameter changes"
    np.testing.assert_allclose(change, expected, atol=2e-3 * np.abs(expected).max())
    assert after.loss < before.loss
    assert after.damping == pytest.approx(DAMPING * DAMPING_DECREASE)
    np.testing.assert_allclose(after.loss, total_of(stage, pose, problem), rtol=1e-5)


def test_a_step_is_longer_where_the_curvature_was_too_large():
    """c = ω·d + β·c_last with ω = 1/κ."""
    stage = PLACE
    problem = first_problem(stage)
    newton = dense_step(stage, problem, DAMPING)
    for ratio, relaxation, momentum in ((0.8, 1.25, MOMENTUM), (0.1, MAX_RELAXATION, MOMENTUM), (0.95, 1.0, 0.0)):
        state = {"damping": DAMPING, "curvature_ratio": ratio, "change": 0.2 * newton}
        _, [(pose, after)] = take_steps(stage, problem, **state)
        change = np.asarray(frame_rows(pose) - frame_rows(problem.anchor))
        expected = (relaxation + 0.2 * momentum) * newton
        np.testing.assert_allclose(change, expected, atol=2e-3 * np.abs(expected).max())
        np.testing.assert_allclose(after.change, change, atol=1e-6)


def test_the_curvature_ratio_compares_the_objective_with_its_quadratic():
    """κ = 2·(E(x + c) − E(x) − g·c) / c·H·c."""
    problem = first_problem(PLACE)
    _, [(pose, after)] = take_steps(PLACE, problem, damping=DAMPING)
    own, anchor, c = program(PLACE), problem.anchor, after.change

    @jax.jit
    def parts(pose, c):
        H = evaluate_curvature(problem_window(own, problem, anchor), own.terms, problem.hyperparameters.settings)
        loss, g = jax.value_and_grad(lambda rows: total_of(PLACE, add_rows(anchor, rows), problem))(jnp.zeros_like(c))
        return total_of(PLACE, pose, problem) - loss - jnp.vdot(g, c), jnp.vdot(c, H.product(c))

    difference, bend = parts(pose, c)
    assert after.curvature_ratio == pytest.approx(float(2 * difference / bend), rel=2e-2)


def test_a_step_that_increases_the_loss_is_not_taken():
    """The loss in the state is 0, so that every step increases the loss."""
    problem = first_problem(PLACE)
    _, [(pose, after)] = take_steps(PLACE, problem, loss=0.0)
    for name in vars(pose):
        np.testing.assert_array_equal(getattr(pose, name), getattr(problem.anchor, name), err_msg=name)
    assert after.loss == 0
    assert after.damping == pytest.approx(FIRST_DAMPING * DAMPING_INCREASE)
    assert after.rejected == 0
    assert after.curvature_ratio == 1
    assert not np.any(after.change)


def test_a_step_to_a_size_below_0_is_not_taken():
    """Momentum leads the size below 0; the loss in the state is so large that the step lowers it."""
    problem = first_problem(PLACE)
    before, [(_, after)] = take_steps(PLACE, problem, loss=1e30)
    assert after.loss < before.loss
    momentum = np.zeros_like(before.change)
    momentum[:, problem.anchor.body_pose.shape[1] * 3 + 6] = -10
    _, [(pose, after)] = take_steps(PLACE, problem, loss=1e30, curvature_ratio=0.5, change=momentum)
    np.testing.assert_array_equal(pose.scale, problem.anchor.scale)
    assert after.damping == pytest.approx(FIRST_DAMPING * DAMPING_INCREASE)


@pytest.mark.parametrize("loss", [np.inf, np.nan])
def test_a_loss_that_is_not_finite_stops_the_bird(loss):
    """All steps from then on are rejected, so that their number dates the failure."""
    problem = first_problem(PLACE)
    _, steps = take_steps(PLACE, problem, 3, loss=loss)
    assert [int(state.rejected) for _, state in steps] == [1, 2, 3]
    for name in vars(problem.anchor):
        np.testing.assert_array_equal(getattr(steps[-1][0], name), getattr(problem.anchor, name), err_msg=name)


def test_few_steps_reach_a_lower_loss_than_many_steps_of_adam():
    start, targets = case()
    slow, fast = solve([FIRST], start, targets, (300,))[1], solve([NEWTON], start, targets, (15,))[1]
    before = np.array([total(*row((start, start, targets), n)) for n in range(B)])
    assert (fast <= slow).all()
    assert (slow < 0.1 * before).all()


def test_every_frame_may_have_its_own_size():
    start, targets = case()
    own = dataclasses.replace(start, scale=np.ones((B, T), np.float32))
    pose, loss, _ = solve([NEWTON], own, targets, (10,))
    assert (np.ptp(pose.scale, axis=1) > 1e-5).all()
    assert np.isfinite(loss).all()


def test_terms_without_a_curvature_are_rejected_before_the_fit(monkeypatch):
    monkeypatch.setattr(registry, "_terms", dict(registry._terms))

    def number(window):
        return jnp.sum(window.pose.transl)

    registry.term(name="number")(number)
    registry.term(name="place", with_blocks=lambda w: (number(w), jnp.zeros((len(w.present), 3, 3))))(number)
    for name, problem in (("number", "returns a number.*solver adam"), ("place", "`with_blocks` returned blocks")):
        stage = dataclasses.replace(NEWTON, terms=("keypoints", name))
        with pytest.raises(InputError, match=f"'{name}': {problem}"):
            check_terms(dataclasses.replace(CONFIG, stages=(stage,)), MODEL)
        check_terms(dataclasses.replace(CONFIG, stages=(dataclasses.replace(stage, solver="adam"),)), MODEL)


def test_fast_is_paper_with_another_solver():
    paper, fast = load_config("paper"), load_config("fast")
    stages = (dataclasses.replace(stage, solver="adam", steps=1) for stage in fast.stages)
    without_steps = (dataclasses.replace(stage, steps=1) for stage in paper.stages)
    assert tuple(stages) == tuple(without_steps)
    # and it searches all orientations where birds are not seen from above
    assert fast.initialise == dataclasses.replace(paper.initialise, method="auto")
    assert dataclasses.replace(fast, stages=paper.stages, initialise=paper.initialise) == paper


@pytest.mark.extended
def test_both_stages_reach_the_loss_of_adam():
    """With masks, for birds that miss a mask or a frame. 30 steps converge also where the 16 steps of `fast` do not."""
    observed = detect(BIRD, [smooth_motion(BIRD, 4, seed) for seed in (3, 4)], 1.0, 0.0)
    masks = {key: mask for key, mask in observed.masks.items() if key != (0, 1)}
    confidence = np.where(np.arange(4)[:, None] == 2, 0, observed.confidence)
    observed = dataclasses.replace(observed.with_keypoints(observed.keypoints_px, confidence), masks=masks)
    loss = {}
    for name, steps in (("paper", (600, 400)), ("fast", (12, 30))):
        config = load_config(name)
        stages = tuple(dataclasses.replace(stage, steps=n) for stage, n in zip(config.stages, steps, strict=True))
        crop = dataclasses.replace(config.crop, size_px=96)
        result = fit(observed, BIRD, dataclasses.replace(config, stages=stages, window=4, crop=crop))
        assert result.status.tolist() == ["ok", "ok"]
        loss[name] = sum(result.loss.values())
    assert (loss["fast"] <= 1.001 * loss["paper"]).all(), loss


@pytest.mark.extended
def test_bones_and_shape_are_optimised_like_by_adam():
    start, targets = case()
    stage = dataclasses.replace(
        NEWTON,
        optimised=(*NEWTON.optimised, "bone_length", "betas"),
        terms=(*NEWTON.terms, "bone_prior", "shape_norm"),
    )
    adam = dataclasses.replace(stage, solver="adam")
    _, slow, _ = solve([adam], start, targets, (300,))
    pose, fast, _ = solve([stage], start, targets, (20,))
    assert (fast <= 1.001 * slow).all()
    assert (np.abs(pose.bone_length - start.bone_length).max(axis=1) > 1e-2).all()


@pytest.mark.extended
def test_a_fit_of_single_frames():
    """With few parameters, conjugate gradients converge before their largest number of steps."""
    paper, loss = load_config("paper"), {}
    observed = detect(BIRD, [smooth_motion(BIRD, 3, 3)], 1.0, 0.05)
    for solver, steps in (("adam", 600), ("levenberg_marquardt", 12)):
        stages = (dataclasses.replace(paper.stages[0], solver=solver, steps=steps),)
        result = fit(observed, BIRD, dataclasses.replace(paper, stages=stages, window=1))
        assert result.status.tolist() == ["ok"]
        loss[solver] = sum(x.sum() for x in result.loss.values())
    assert loss["levenberg_marquardt"] < 1.001 * loss["adam"]
