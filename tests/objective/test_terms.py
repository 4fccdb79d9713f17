"""Every term agrees with its equation in NumPy; settings are traced; missing observations have no effect."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.birds import pose_window
from support.terms_by_hand import (
    BIRD,
    CAMERA,
    PRIORS,
    RASTER,
    RIG,
    TERMS,
    T,
    all_settings,
    every_gradient,
    every_term,
    oracle,
    posed_window,
    random_targets,
    soft_silhouettes,
    window_pose,
    without_frame,
)

from jaxfit.objective.objective import evaluate_terms, weighted_sum
from jaxfit.objective.posed_window import PosedWindow, priors_of
from jaxfit.objective.registry import find_term, find_terms
from jaxfit.objective.residuals import geman_mcclure, residual_sum
from jaxfit.objective.terms import pose_prior


@pytest.mark.parametrize("seed", [0, 10])
def test_every_term_agrees_with_its_equation(seed):
    pose, start, targets = window_pose(seed), window_pose(seed + 50), random_targets(seed)
    values = every_term(pose, start, targets, all_settings())
    assert set(values) == set(TERMS)
    for name, value in values.items():
        expected = oracle(name, pose, start, targets, seed)
        assert expected > 0, name
        assert float(value) == pytest.approx(expected, rel=2e-4), name


def test_stored_geman_mcclure_and_mahalanobis(reference_dir):
    with np.load(reference_dir / "reference" / "lbs.npz") as stored:
        value = geman_mcclure(50.0).value(jnp.asarray(stored["geman_mcclure/residual"]) ** 2)
        np.testing.assert_allclose(value, stored["geman_mcclure/value"], rtol=1e-6)
        poses, expected = stored["pose_prior/body_pose"], stored["pose_prior/squared_mahalanobis"]
    from jaxfit.model.published import import_model

    priors = priors_of(import_model("avian-mesh", [reference_dir / "models" / "avian_mesh"]))
    for body_pose, distance in zip(poses, expected, strict=True):
        pose = dataclasses.replace(window_pose(), body_pose=jnp.asarray(body_pose.reshape(1, -1, 3)))
        targets = dataclasses.replace(random_targets(), present=jnp.ones(1, bool))
        value = residual_sum(pose_prior(PosedWindow(pose, pose, targets, RIG, priors, CAMERA, RASTER)))
        assert float(value) == pytest.approx(distance, rel=1e-4)


def test_missing_observations_have_no_effect():
    pose, start = window_pose(), window_pose(50)
    targets = without_frame(random_targets(), 1)
    results = every_gradient(pose, start, targets, all_settings())
    # the pose of the missing frame has no effect
    pose = jax.tree.map(np.array, pose)
    moved = jax.tree.map(np.copy, pose)
    moved.global_orient[1], moved.scale[1] = 2.0, 3.0
    moved.body_pose[1] += 1.0
    moved.transl[1] += 9.0
    again = every_term(moved, start, targets, all_settings())
    for name, (value, gradient) in results.items():
        assert float(again[name]) == pytest.approx(float(value), rel=1e-6), name
        for field in ("global_orient", "body_pose", "transl", "scale"):
            np.testing.assert_array_equal(getattr(gradient, field)[1], 0, err_msg=f"{name}: {field}")
    # the position of a keypoint with confidence 0 has no effect
    faint = jax.tree.map(np.array, random_targets())
    faint.confidence[0, 2] = 0
    astray = jax.tree.map(np.copy, faint)
    astray.keypoints_px[0, 2] = 1e4
    both = [every_term(pose, start, e, all_settings()) for e in (faint, astray)]
    for name in ("keypoints", "keypoint_likelihood"):
        assert float(both[0][name]) == float(both[1][name])
        assert float(both[0][name]) < float(every_term(pose, start, random_targets(), all_settings())[name])


def test_mask_terms_skip_frames_without_mask():
    pose, targets = window_pose(), random_targets()
    bare = dataclasses.replace(targets, has_mask=np.array([True, False, True]))
    value = float(every_term(pose, pose, bare, all_settings())["mask"])
    e = np.abs(soft_silhouettes(0) - np.asarray(targets.mask))
    assert value == pytest.approx(e[[0, 2]].sum(), rel=2e-4)


def edges():
    pose, targets = (jax.tree.map(np.asarray, each) for each in (window_pose(), random_targets()))
    still = jax.tree.map(lambda x: np.broadcast_to(x[:1], x.shape), pose)
    still = dataclasses.replace(still, bone_length=pose.bone_length, betas=np.zeros(2, np.float32))
    rest = dataclasses.replace(
        still,
        global_orient=np.zeros((T, 3), np.float32),
        body_pose=np.zeros((T, 3, 3), np.float32),
        bone_length=PRIORS.bone_mean,
    )
    mean = np.broadcast_to(np.reshape(BIRD.pose_mean, (3, 3)), (T, 3, 3))
    none_present = functools.reduce(without_frame, range(T), targets)
    return {
        "equal frames": (still, targets),
        "zero rotation": (rest, targets),
        "at the prior's mean": (dataclasses.replace(rest, body_pose=mean), targets),
        "empty mask": (pose, dataclasses.replace(targets, mask=np.zeros_like(targets.mask))),
        "out of the frame": (dataclasses.replace(pose, transl=pose.transl + np.float32([900, 0, 0])), targets),
        "behind the camera": (dataclasses.replace(pose, transl=pose.transl * np.float32([1, 1, -1])), targets),
        "at the camera": (dataclasses.replace(pose, transl=0 * pose.transl), targets),
        "scale 0": (dataclasses.replace(pose, scale=0 * pose.scale), targets),
        "no observations": (pose, none_present),
        "confidence 0": (pose, dataclasses.replace(targets, confidence=0 * targets.confidence)),
    }


def test_finite_at_the_edges():
    for edge, (pose, targets) in edges().items():
        for name, (value, gradient) in every_gradient(pose, pose, targets, all_settings()).items():
            assert np.isfinite(value), (edge, name)
            for leaf in jax.tree.leaves(gradient):
                assert np.isfinite(leaf).all(), (edge, name)


SMOOTH = [n for n in TERMS if n not in ("mask", "mask_smooth_l1")]  # tests/raster checks the gradients of masks


def test_gradients_are_right():
    """Finite differences of each term in random directions."""
    pose, start, targets = (jax.tree.map(np.asarray, e) for e in (window_pose(), window_pose(50), random_targets()))
    found, rng, step = every_gradient(pose, start, targets, all_settings()), np.random.default_rng(0), 2e-3
    for _ in range(3):
        direction = jax.tree.map(lambda x: np.float32(rng.normal(size=x.shape)), pose)
        after, before = (
            every_term(
                jax.tree.map(lambda x, d, h=h: np.float32(x + h * d), pose, direction), start, targets, all_settings()
            )
            for h in (step, -step)
        )
        for name in SMOOTH:
            value, gradient = found[name]
            slope = sum(float((g * d).sum()) for g, d in zip(*map(jax.tree.leaves, (gradient, direction)), strict=True))
            # finite differences are wrong where an absolute value has its corner
            error = 0.005 * float(value) * (10 if name == "stage_anchor" else 1)
            assert float(after[name] - before[name]) / (2 * step) == pytest.approx(slope, rel=0.02, abs=error), name


def test_settings_are_traced():
    """The sum is weighted. Another weight or σ needs no new program, and a sweep over weights and σ is one vmap."""
    pose, targets, traces = window_pose(), random_targets(), []
    names = ("keypoints", "pose_prior", "velocity")

    def total(settings):
        traces.append(None)
        return weighted_sum(posed_window(pose, targets), find_terms(settings), settings)

    def settings(weight, sigma, beta):
        own = {"keypoints": {"sigma_px": sigma}, "velocity": {"beta_global": beta, "beta_pose": 1.0}}
        return {name: {"weight": weight, **own.get(name, {})} for name in names}

    compiled = jax.jit(total)
    sweep = [(1.0, 50.0, 10.0), (2.0, 50.0, 10.0), (1.0, 5.0, 10.0), (1.0, 50.0, 0.0)]
    one_by_one = [float(compiled(settings(*np.float32(values)))) for values in sweep]
    terms = every_term(pose, pose, targets, all_settings())
    assert one_by_one[1] == pytest.approx(2 * sum(float(terms[name]) for name in names), rel=1e-5)
    assert float(weighted_sum(posed_window(pose, targets), {}, {})) == 0
    assert len(traces) == 1
    assert len(set(one_by_one)) == len(sweep)
    together = jax.jit(jax.vmap(lambda v: total(settings(*v))))(jnp.array(sweep))
    np.testing.assert_allclose(together, one_by_one, rtol=1e-5)
    gradient = jax.jit(jax.grad(lambda v: total(settings(*v))))(jnp.array(sweep[0]))
    assert np.isfinite(gradient).all()
    assert (np.abs(gradient) > 0).all()


def test_common_size():
    """A common scale has the effect of the same scale in every frame."""
    pose, targets = window_pose(), random_targets()
    common = dataclasses.replace(pose, scale=pose.scale[:1])
    spread = dataclasses.replace(pose, scale=jnp.broadcast_to(pose.scale[:1], (T,)))

    @jax.jit
    def points(pose):
        window = posed_window(pose, targets)
        return window.keypoints_px, window.keypoints_cam

    (common_px, common_cam), (spread_px, _) = points(common), points(spread)
    np.testing.assert_allclose(common_px, spread_px)
    keypoints, _ = pose_window(BIRD, spread)
    np.testing.assert_allclose(common_cam, keypoints, atol=1e-5)


def test_compares_masks_is_set_for_terms_that_draw_silhouettes():
    """A term without the mark receives empty masks; an unnecessary mark makes a stage slow."""
    drawn = {}

    def evaluate(pose, name):
        one = posed_window(pose, random_targets())
        evaluate_terms(one, find_terms([name]), {name: {"weight": 1.0, **find_term(name).settings}})
        drawn[name] = "vertices_screen" in vars(one)

    for name in TERMS:
        jax.eval_shape(functools.partial(evaluate, name=name), window_pose())
    assert drawn == {name: find_term(name).compares_masks for name in TERMS}
