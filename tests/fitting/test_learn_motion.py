"""A motion prior learnt from results: recovery of known settings, accelerations by scipy, and the command."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_t
from support.birds import random_pose, solution_of, toy_bird
from support.terms_by_hand import accelerations, term_value

from jaxfit.cli.main import main
from jaxfit.config.fit import load_config
from jaxfit.data.solution import save_solution
from jaxfit.foundation.errors import InputError
from jaxfit.learning.priors import (
    MotionPrior,
    accelerations_rad_s2,
    effective_birds,
    learn_motion,
    maximum_likelihood,
    mean_cost,
    motion_config,
    norm_histogram,
    shipped_motion,
)
from jaxfit.objective.likelihood import motion_likelihood

BIRD = toy_bird()
J = len(BIRD.joint_names)


def draw(count, sd, dof, seed=0):
    return multivariate_t(np.zeros(3), sd**2 * np.eye(3), dof, seed=seed).rvs(count)


def moving(birds=3, frames=80, sd_rad_s2=2.0, dof=3.0, fps=25.0, seed=0):
    """Return a result whose angular accelerations are independent draws from a Student t."""
    rng = np.random.default_rng(seed)
    base = random_pose(BIRD, 0, 0.2)
    still = dataclasses.replace(
        base,
        global_orient=np.zeros((frames, 3)),
        body_pose=np.zeros((frames, J - 1, 3)),
        transl=np.tile(np.asarray(base.transl), (frames, 1)),
        scale=np.tile(np.asarray(base.scale), frames),
    )
    solution = solution_of(BIRD, [still] * birds)
    rotvec = np.zeros((birds, frames, J, 3))
    for n in range(birds):
        a = draw((frames - 2) * J, sd_rad_s2, dof, rng).reshape(frames - 2, J, 3) / fps**2
        step = np.concatenate([0.02 * rng.normal(size=(1, J, 3)), a]).cumsum(axis=0)
        R = [Rotation.from_rotvec(0.3 * rng.normal(size=(J, 3)))]
        for own in step:
            R.append(R[-1] * Rotation.from_rotvec(own))
        rotvec[n] = [each.as_rotvec() for each in R]
    return solution.with_arrays(global_orient=rotvec[:, :, 0], body_pose=rotvec[:, :, 1:], fps=fps)


@pytest.mark.parametrize(("sd", "dof"), [(0.5, 0.8), (6.0, 2.0), (300.0, 8.0)])
def test_maximum_likelihood_is_that_of_scipy(sd, dof):
    a = draw(4000, sd, dof)
    learnt = maximum_likelihood(norm_histogram(np.linalg.norm(a, axis=1)))

    def cost(x):
        return -multivariate_t(np.zeros(3), np.exp(2 * x[0]) * np.eye(3), np.exp(x[1])).logpdf(a).mean()

    best = minimize(cost, np.log([sd, dof]), method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-9})
    np.testing.assert_allclose(learnt, np.exp(best.x), rtol=5e-3)
    assert learnt == pytest.approx((sd, dof), rel=0.1)
    assert mean_cost(norm_histogram(np.linalg.norm(a, axis=1)), learnt) == pytest.approx(best.fun, abs=1e-3)


def test_a_motion_is_recovered_at_any_frame_rate():
    for fps in (25.0, 100.0):
        learnt = learn_motion([("a", moving(fps=fps))])
        assert learnt.unshrunk == pytest.approx((2.0, 3.0), rel=0.15)
        assert learnt.rates_fps == (fps,)
        assert (learnt.birds, learnt.frames, learnt.unknown_rates) == (3, 3 * 78, 0)
        assert learnt.cost < learnt.shipped_cost


def test_accelerations_and_cost_are_those_of_the_term():
    solution = moving(1, 12)
    valid = solution.valid.copy()
    valid[0, 4] = False
    solution = dataclasses.replace(solution, valid=valid)
    a, runs = accelerations_rad_s2(solution, 0, 0.04)
    assert np.flatnonzero(runs).tolist() == [0, 1, 5, 6, 7, 8, 9]
    expected = np.concatenate(
        [accelerations(solution.poses.global_orient[0])[:, None], accelerations(solution.poses.body_pose[0])], 1
    )
    np.testing.assert_allclose(a, expected[runs] * 625, atol=1e-6)
    prior = MotionPrior(1.5, 2.0)
    pose = solution.poses.global_orient[0], solution.poses.body_pose[0], valid[0]
    term = float(term_value(motion_likelihood, *pose, 0.04, **prior._asdict()))
    at_zero = -multivariate_t(np.zeros(3), 1.5**2 * np.eye(3), 2.0).logpdf(np.zeros(3))
    cost = mean_cost(norm_histogram(np.linalg.norm(a, axis=-1)), prior)
    assert cost * runs.sum() * J == pytest.approx(term + at_zero * runs.sum() * J, rel=2e-3)


def test_runs_are_of_consecutive_frames_and_every_nth_frame_has_a_longer_interval():
    solution = moving(1, 9, fps=25.0)
    numbers = np.array([0, 2, 4, 6, 10, 12, 14, 16, 18])
    every_second = dataclasses.replace(solution, frame_index=numbers)
    _, runs = accelerations_rad_s2(every_second, 0, 0.08)
    assert runs.tolist() == [True, True, False, False, True, True, True]
    assert learn_motion([("a", every_second)]).rates_fps == (12.5,)
    unknown = learn_motion([("a", dataclasses.replace(solution, fps=None))])
    assert (unknown.unknown_rates, unknown.rates_fps) == (1, (25.0,))
    assert "unknown frame rate, taken as 25 frames/s: 1" in motion_config(unknown)
    assert unknown.unshrunk == learn_motion([("a", solution)]).unshrunk


def test_shrinkage_by_the_number_of_birds():
    assert effective_birds([50, 50, 50]) == pytest.approx(3)
    assert effective_birds([100, 1]) == pytest.approx(101**2 / 10001)
    one, many = (learn_motion([("a", moving(birds, 20))]) for birds in (1, 12))
    shipped = shipped_motion()
    assert (one.shrinkage, many.shrinkage) == (0.8, 0.25)
    for learnt in (one, many):
        for own, best, before in zip(learnt.prior, learnt.unshrunk, shipped, strict=True):
            assert own == pytest.approx(best ** (1 - learnt.shrinkage) * before**learnt.shrinkage)
    assert one.cost is None


def test_the_cost_is_that_of_birds_that_were_left_out():
    parts = [moving(1, 40, sd, 3.0, seed=seed) for seed, sd in enumerate((1.0, 2.0, 8.0))]
    together = learn_motion([(str(i), part) for i, part in enumerate(parts)])
    costs = []
    for i, part in enumerate(parts):
        others = learn_motion([(str(k), other) for k, other in enumerate(parts) if k != i])
        norms = np.linalg.norm(accelerations_rad_s2(part, 0, 0.04)[0], axis=-1)
        costs.append(mean_cost(norm_histogram(norms), others.prior))
    assert together.cost == pytest.approx(np.mean(costs), rel=1e-9)


def test_results_without_three_frames_are_rejected():
    with pytest.raises(InputError, match="short: holds no bird with three consecutive valid frames"):
        learn_motion([("short", _without_middle(moving(2, 3)))])
    diverged = dataclasses.replace(_without_middle(moving(1, 3)), status=np.array(["diverged"]))
    with pytest.raises(InputError, match="diverged birds: 1"):
        learn_motion([("a", diverged)])


def _without_middle(solution):
    valid = solution.valid.copy()
    valid[:, 1] = False
    return dataclasses.replace(solution, valid=valid)


def test_the_command(tmp_path, capsys):
    save_solution(moving(2, 30), BIRD, "", {}, tmp_path / "one")
    save_solution(moving(1, 30, fps=50.0, seed=5), BIRD, "", {}, tmp_path / "two")
    out = tmp_path / "motion.yaml"
    command = ["prior", "learn", "--motion", str(tmp_path / "one"), str(tmp_path / "two"), "--out"]
    assert main([*command, str(out)]) == 0
    output = capsys.readouterr().out
    for words in ("wings", "legs", "root", "shipped", "84 runs of three frames of 3 tracks", "share of the shipped"):
        assert words in output
    config, text = load_config(out), out.read_text()
    for words in ("birds: 3", "runs of three frames: 84", "frames per second: 25, 50", "Fits are smoothed"):
        assert words in text
    settings = config.stage_settings(config.stages[-1])["motion_likelihood"]
    learnt = learn_motion([("a", moving(2, 30)), ("b", moving(1, 30, fps=50.0, seed=5))]).prior
    assert settings["sd_rad_s2"] == pytest.approx(learnt.sd_rad_s2, rel=1e-3)
    assert settings["dof"] == pytest.approx(learnt.dof, rel=1e-3)
    assert config.stages == load_config("map").stages
