"""A prior learnt from results: statistics by hand, shrinkage for few data, and the command."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.birds import random_pose, solution_of, tiny_bird

from jaxfit.cli.main import main
from jaxfit.data.solution import save_solution
from jaxfit.foundation.errors import InputError
from jaxfit.learning.priors import MIN_SD_RAD, MIN_WIDTH, effective_count, learn_prior, oas_shrinkage
from jaxfit.model.bird import check_bird
from jaxfit.model.files import load_bird

BIRD, T = tiny_bird(), 12


def posed(seeds, spread=0.3):
    """Return a result with one bird per seed. All frames are independent random poses."""
    windows = []
    for seed in seeds:
        frames = [random_pose(BIRD, 100 * seed + t, spread) for t in range(T)]
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *frames)
        windows.append(dataclasses.replace(stacked, bone_length=jnp.ones(3), betas=jnp.zeros(2)))
    return solution_of(BIRD, windows)


def test_the_width_is_a_factor_on_the_covariance_of_the_model():
    poses = np.random.default_rng(0).multivariate_normal(BIRD.pose_mean, 3.0 * BIRD.pose_covariance, 600)
    result = posed(range(50))
    drawn = poses.reshape(50, T, -1, 3).astype(np.float32)
    learnt = learn_prior([("a", result.with_arrays(body_pose=drawn), BIRD)])
    assert learnt.width == pytest.approx(3, rel=0.1)
    assert learnt.pose_prior_weight == pytest.approx(1 / 6, rel=0.1)
    still = np.broadcast_to(np.asarray(BIRD.pose_mean, np.float32).reshape(-1, 3), drawn.shape)
    assert learn_prior([("a", result.with_arrays(body_pose=still), BIRD)]).width == MIN_WIDTH


def test_oas_by_hand():
    # S = diag(3, 1), n = 4, D = 2: tr S² = 10, tr² S = 16; (0·10 + 16) / ((4 + 1 − 1)(10 − 8)) = 2 → 1
    assert oas_shrinkage(np.diag([3.0, 1.0]), 4) == 1
    # n = 20: 16 / (20 · 2)
    assert oas_shrinkage(np.diag([3.0, 1.0]), 20) == pytest.approx(0.4)
    # D = 3, S = diag(4, 1, 1): tr S² = 18, tr² S = 36; (18/3 + 36) / ((n + 1/3)(18 − 12))
    assert oas_shrinkage(np.diag([4.0, 1.0, 1.0]), 9) == pytest.approx(42 / (28 / 3 * 6))
    assert oas_shrinkage(np.eye(3), 100) == 1  # the target of the shrinkage


def test_effective_count_of_autoregressive_poses():
    rng, r, n = np.random.default_rng(0), 0.8, 4000
    x = np.zeros((n, 3))
    for t in range(1, n):
        x[t] = r * x[t - 1] + rng.normal(size=3)
    everywhere, every_pair = np.ones(n, bool), np.ones(n - 1, bool)
    assert effective_count([(x, everywhere, every_pair)]) == pytest.approx(n * 0.2 / 1.8, rel=0.1)
    assert effective_count([(rng.normal(size=(n, 3)), everywhere, every_pair)]) == pytest.approx(n, rel=0.1)
    # a bird that never moves counts as one pose
    still = [(np.broadcast_to(rng.normal(size=3), (50, 3)), np.ones(50, bool), np.ones(49, bool)) for _ in range(4)]
    assert effective_count(still) == pytest.approx(4)
    holes = everywhere & (np.arange(n) % 2 == 0)  # no two valid frames follow each other
    assert effective_count([(x, holes, every_pair)]) == n / 2
    # neighbours that are not consecutive frames are independent
    assert effective_count([(x, everywhere, ~every_pair)]) == n


def test_mean_and_covariance():
    solution = posed([1, 2])
    valid = solution.valid.copy()
    valid[0, 3:5] = False
    body = solution.poses.body_pose.copy()
    body[0, 3:5] = np.nan
    solution = solution.with_arrays(valid=valid, body_pose=body)
    learnt = learn_prior([("a", solution, BIRD)])
    poses = body[valid].reshape(-1, 9).astype(np.float64)
    assert (learnt.poses, learnt.birds, learnt.diverged, learnt.bones_learnt) == (2 * T - 2, 2, 0, False)
    np.testing.assert_allclose(learnt.bird.pose_mean, poses.mean(0), atol=1e-6)
    sample = np.cov(poses.T, bias=True)
    covariance = np.asarray(learnt.bird.pose_covariance, np.float64)
    np.testing.assert_allclose(np.diag(covariance), np.diag(sample) + MIN_SD_RAD**2, rtol=1e-5)
    off = ~np.eye(9, dtype=bool)
    np.testing.assert_allclose(covariance[off], (1 - learnt.shrinkage) * sample[off], atol=1e-6)
    np.testing.assert_allclose(learnt.mean_change_rad, np.linalg.norm(poses.mean(0).reshape(3, 3), axis=1), rtol=1e-5)
    assert 0 < learnt.shrinkage <= 1
    np.testing.assert_array_equal(learnt.bird.bone_mean, BIRD.bone_mean)
    np.testing.assert_array_equal(learnt.bird.bone_covariance, BIRD.bone_covariance)
    assert learn_prior([("a", solution, BIRD), ("b", posed([3]), BIRD)]).poses == 3 * T - 2


def test_the_prior_of_one_motionless_bird_is_positive_definite():
    solution = posed([1])
    still = solution.with_arrays(
        body_pose=np.broadcast_to(solution.poses.body_pose[:, :1], solution.poses.body_pose.shape)
    )
    learnt = learn_prior([("a", still, BIRD)])
    assert learnt.effective_poses == 1
    assert learnt.shrinkage == 1
    assert np.linalg.eigvalsh(np.asarray(learnt.bird.pose_covariance)).min() > 0.9 * MIN_SD_RAD**2
    check_bird(learnt.bird, "learnt")


def test_bone_lengths_are_learnt_if_they_differ():
    solution = posed([1, 2, 3])
    lengths = np.broadcast_to(np.array([0.9, 1.0, 1.2])[:, None, None], (3, T, 3))
    learnt = learn_prior([("a", solution.with_arrays(bone_length=lengths), BIRD)])
    assert learnt.bones_learnt
    np.testing.assert_allclose(learnt.bird.bone_mean, np.full(3, 3.1 / 3), rtol=1e-6)
    np.testing.assert_allclose(np.diag(learnt.bird.bone_covariance), np.var([0.9, 1.0, 1.2]) + 1e-4, rtol=1e-5)
    check_bird(learnt.bird, "learnt")


def test_diverged_birds_are_skipped_and_unsuitable_results_are_rejected():
    solution = posed([1, 2])
    first = np.array([True, False])[:, None] & solution.valid
    half = dataclasses.replace(solution, status=np.array(["ok", "diverged"]), valid=first)
    assert (learn_prior([("a", half, BIRD)]).birds, learn_prior([("a", half, BIRD)]).diverged) == (1, 1)
    none = dataclasses.replace(half, status=np.array(["diverged", "diverged"]), valid=np.zeros_like(first))
    with pytest.raises(InputError, match=r"a: holds no valid pose; diverged birds: 2 "):
        learn_prior([("a", none, BIRD)])
    other = dataclasses.replace(BIRD, joint_names=(*BIRD.joint_names[:-1], "hoof"))
    with pytest.raises(InputError, match="b: has the model"):
        learn_prior([("a", solution, BIRD), ("b", solution, other)])


def test_the_command(tmp_path, capsys):
    save_solution(posed([1, 2]), BIRD, "", {}, tmp_path / "one")
    save_solution(posed([3]), BIRD, "", {}, tmp_path / "two")
    out = tmp_path / "learnt.npz"
    assert main(["prior", "learn", str(tmp_path / "one"), str(tmp_path / "two"), "--out", str(out)]) == 0
    output = capsys.readouterr().out
    for words in ("36 poses of 3 tracks", "left_wing", "independent", f"--model {out}"):
        assert words in output.replace("\n", "") or words in output
    learnt = load_bird(out)
    assert not np.allclose(learnt.pose_mean, BIRD.pose_mean)
    with np.load(out) as stored:
        assert (int(stored["prior_poses"]), int(stored["prior_birds"])) == (36, 3)
        assert 0 < float(stored["prior_shrinkage"]) <= 1
        assert stored["pose_covariance"].shape == (9, 9)
    capsys.readouterr()
    assert main(["prior", "learn", str(tmp_path / "absent"), "--out", str(out)]) == 2
    assert "absent" in capsys.readouterr().err
    assert main(["prior", "learn", "--motion", str(tmp_path / "one"), "--out", str(tmp_path / "motion.yaml")]) == 2
    assert "terms.motion_likelihood" in capsys.readouterr().err
