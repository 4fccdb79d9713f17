"""Levenberg-Marquardt: its steps solve its equation, and few steps reach the loss of hundreds of Adam's steps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.stages import BIRD, CONFIG, FIRST, MODEL, B, T, case, problems, program, solve, total

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
from jaxfit.foundation.errors import InputError
from jaxfit.objective import registry
from jaxfit.objective.curvature import add_rows, frame_rows, shared_columns
from jaxfit.objective.objective import evaluate_curvature
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect

NEWTON = dataclasses.replace(
    FIRST, solver="levenberg_marquardt", terms=("keypoints", "pose_prior", "velocity", "acceleration")
)
PLACE = dataclasses.replace(NEWTON, optimised=("global_orient", "transl", "scale"))
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
    return jax.tree.map(lambda x: x[0], problems(*case(), stage))


compiled: dict = {}


def solver_of(stage):
    """Return the compiled `init` and `step` of a stage."""
    if id(stage) not in compiled:
        own = program(stage)

        def init(problem):
            return LEVENBERG_MARQUARDT.init(own, problem, None)

        def step(problem, pose, state):
            return LEVENBERG_MARQUARDT.step(own, problem, pose, state)

        compiled[id(stage)] = tuple(jax.jit(jax.vmap(f)) for f in (init, step))
    return compiled[id(stage)]


def take_steps(stage, problem, count=1, **changes):
    """Return the first state (with `changes`), and pose and state after each step with an accurate equation."""
    init, step = solver_of(stage)
    batch = jax.tree.map(lambda x: jnp.asarray(x)[None], problem)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxfit.fitting.levenberg_marquardt.CG_TOLERANCE", 1e-6)
        pose, first = step(batch, batch.anchor, init(batch))  # evaluates the anchor
        states = [(pose, first._replace(**{name: value[None] for name, value in changes.items()}))]
        for _ in range(count):
            states.append(step(batch, *states[-1]))
    (_, before), *after = jax.tree.map(lambda x: x[0], states)
    return before, after


def dense_step(stage, problem, damping):
    """Solve (H + μ·D)·d = −g with a dense H and its diagonal D, over the optimised parameters."""
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
    return (basis @ np.linalg.solve(reduced, -basis.T @ gradient.ravel())).reshape(zero.shape)


def total_of(stage, pose, problem):
    return total(pose, problem.anchor, problem.targets, stage)


@pytest.mark.parametrize("stage", [PLACE, SHAPE], ids=["place", "bones and shape"])
def test_a_step_solves_the_equation(stage):
    problem = first_problem(stage)
    before, [(pose, after)] = take_steps(stage, problem, damping=jnp.float32(DAMPING))
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
        state = {name: jnp.asarray(value, jnp.float32) for name, value in state.items()}
        _, [(pose, after)] = take_steps(stage, problem, **state)
        change = np.asarray(frame_rows(pose) - frame_rows(problem.anchor))
        expected = (relaxation + 0.2 * momentum) * newton
        np.testing.assert_allclose(change, expected, atol=2e-3 * np.abs(expected).max())
        np.testing.assert_allclose(after.change, change, atol=1e-6)


def test_the_curvature_ratio_compares_the_objective_with_its_quadratic():
    """κ = 2·(E(x + c) − E(x) − g·c) / c·H·c."""
    problem = first_problem(PLACE)
    _, [(pose, after)] = take_steps(PLACE, problem, damping=jnp.float32(DAMPING))
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
    _, [(pose, after)] = take_steps(PLACE, problem, loss=jnp.float32(0.0))
    for name in vars(pose):
        np.testing.assert_array_equal(getattr(pose, name), getattr(problem.anchor, name), err_msg=name)
    assert after.loss == 0
    assert after.damping == pytest.approx(FIRST_DAMPING * DAMPING_INCREASE)
    assert after.rejected == 0
    assert after.curvature_ratio == 1
    assert not np.any(after.change)


@pytest.mark.parametrize("loss", [np.inf, np.nan])
def test_a_loss_that_is_not_finite_stops_the_bird(loss):
    """All steps from then on are rejected, so that their number dates the failure."""
    problem = first_problem(PLACE)
    _, steps = take_steps(PLACE, problem, 3, loss=jnp.float32(loss))
    assert [int(state.rejected) for _, state in steps] == [1, 2, 3]
    for name in vars(problem.anchor):
        np.testing.assert_array_equal(getattr(steps[-1][0], name), getattr(problem.anchor, name), err_msg=name)


def test_few_steps_reach_a_lower_loss_than_many_steps_of_adam():
    start, targets = case()
    adam = dataclasses.replace(NEWTON, solver="adam")
    slow, fast = solve([adam], start, targets, (300,))[1], solve([NEWTON], start, targets, (15,))[1]
    before = solve([NEWTON], start, targets, (0,))[1]
    assert (fast <= slow).all()
    assert (slow < 0.1 * before).all()


def test_a_common_size_stays_common():
    start, targets = case()
    pose, _, _ = solve([NEWTON], start, targets, (10,))
    assert pose.scale.shape == (B, 1)
    assert (np.abs(pose.scale - start.scale) > 1e-3).all()
    own = dataclasses.replace(start, scale=jnp.ones((B, T)))
    pose, loss, _ = solve([NEWTON], own, targets, (10,))
    assert (np.ptp(pose.scale, axis=1) > 1e-5).all()
    assert np.isfinite(loss).all()


def test_a_term_without_residuals_is_rejected_before_the_fit(monkeypatch):
    monkeypatch.setattr(registry, "_terms", dict(registry._terms))
    registry.term(name="number")(lambda window: jnp.sum(window.pose.transl))
    stage = dataclasses.replace(NEWTON, terms=("keypoints", "number"))
    config = dataclasses.replace(CONFIG, stages=(stage,))
    with pytest.raises(InputError, match=r"'number': returns a number.*solver adam"):
        check_terms(config, MODEL)
    check_terms(dataclasses.replace(CONFIG, stages=(dataclasses.replace(stage, solver="adam"),)), MODEL)


def test_blocks_of_another_shape_are_rejected_before_the_fit(monkeypatch):
    monkeypatch.setattr(registry, "_terms", dict(registry._terms))

    def with_blocks(window):
        return jnp.sum(window.pose.transl), jnp.zeros((len(window.present), 3, 3))

    registry.term(name="place", with_blocks=with_blocks)(lambda window: jnp.sum(window.pose.transl))
    stage = dataclasses.replace(NEWTON, terms=("keypoints", "place"))
    with pytest.raises(InputError, match=r"'place': `with_blocks` returned blocks of shape"):
        check_terms(dataclasses.replace(CONFIG, stages=(stage,)), MODEL)


def test_fast_is_paper_with_another_solver():
    paper, fast = load_config("paper"), load_config("fast")
    stages = (dataclasses.replace(stage, solver="adam", steps=1) for stage in fast.stages)
    without_steps = (dataclasses.replace(stage, steps=1) for stage in paper.stages)
    assert tuple(stages) == tuple(without_steps)
    assert dataclasses.replace(fast, stages=paper.stages) == paper


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


def test_the_reported_loss_is_the_loss_of_the_poses():
    start, targets = case()
    pose, loss, _ = solve([NEWTON], start, targets, (7,))
    for n in range(B):
        one, at, seen = jax.tree.map(lambda x, n=n: x[n], (pose, start, targets))
        np.testing.assert_allclose(loss[n], total(one, at, seen, NEWTON), rtol=1e-5)


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
