"""One body for each track: the estimate against dense algebra, its use in a fit, and its way through files."""

import argparse
import dataclasses
from itertools import product

import jax
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal
from support.birds import tiny_bird, toy_bird
from support.fits import CAMERA, T, config

from jaxfit.cli.fitting import _known_bodies
from jaxfit.config.build import with_values
from jaxfit.config.fit import StageConfig, load_config
from jaxfit.data.solution import load_solution, save_solution
from jaxfit.fitting import bodies
from jaxfit.fitting.bodies import (
    ASYMMETRY_SD,
    SHARES,
    BodyEvidence,
    _prior,
    _symmetric,
    bodies_of,
    estimate_bodies,
    stages_of_pass,
    windows_of_bodies,
)
from jaxfit.fitting.error_bars import _with_body, window_error_bars
from jaxfit.fitting.fit import fit, fit_runs, learn_weights, model_of_fit
from jaxfit.fitting.initial_poses import load_initial_poses
from jaxfit.fitting.keypoint_offsets import offset_directions
from jaxfit.fitting.posterior import BodySensitivity
from jaxfit.fitting.solve import fit_model, without_mask_stages
from jaxfit.fitting.stored_windows import StoredWindows
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.unfinished import Parts
from jaxfit.model.camera import project
from jaxfit.model.kinematics import fold_bird, move_keypoints, window_keypoints, window_transforms
from jaxfit.objective.posed_window import priors_of
from jaxfit.review.correct import refit
from jaxfit.review.edits import Edit, apply_edits
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect

BIRD = tiny_bird(shapes=0)
BONES = BIRD.num_joints - 1
POSE = ("global_orient", "body_pose", "transl", "scale")
TERMS = ("keypoint_likelihood", "pose_prior", "motion_likelihood", "place_likelihood")


def stages(body_steps=6, last_steps=4):
    common = {"solver": "levenberg_marquardt", "step_scale": {"transl": (1.0, 1.0, 0.0)}}
    return (
        StageConfig("keypoints", 10, TERMS, POSE, **common),
        StageConfig("body", body_steps, (*TERMS, "bone_prior"), (*POSE, "bone_length"), share_body=True, **common),
        StageConfig("poses", last_steps, TERMS, POSE, **common),
    )


TERM_SETTINGS = {
    "keypoint_likelihood": {"sd_sure_px": 0.5, "dof": 30},
    "pose_prior": 0.5,
    "bone_prior": 0.5,
    "motion_likelihood": {"sd_rad_s2": 60.0},
    "place_likelihood": {"sd_px_s2": 3000.0},
}
CONFIG = dataclasses.replace(config(memory_gb=1.0), terms=TERM_SETTINGS, stages=stages())
SHAPED = tiny_bird(shapes=2)
OFFSETS = dataclasses.replace(
    CONFIG,
    terms=TERM_SETTINGS | {"shape_prior": 0.5},
    stages=tuple(
        dataclasses.replace(stage, terms=(*stage.terms, "shape_prior"), optimised=(*stage.optimised, "betas"))
        if stage.share_body
        else stage
        for stage in stages()
    ),
)


MODEL = fit_model(BIRD, CONFIG)

LENGTHS = np.float32([[1.25, 0.85, 0.85], [0.8, 1.2, 1.2]])
"""Bone lengths of two birds: head, left wing, right wing."""


def individuals(frames):
    """Return smooth motion of birds whose bones differ from the model's."""
    poses = (jax.tree.map(np.asarray, smooth_motion(BIRD, frames, n)) for n in range(len(LENGTHS)))
    return [dataclasses.replace(pose, bone_length=bones) for pose, bones in zip(poses, LENGTHS, strict=True)]


@pytest.fixture(scope="module")
def fitted():
    poses = individuals(2 * T)
    observed = detect(BIRD, poses, 0.1, 0.0, 0, camera=CAMERA)
    return observed, fit(observed, BIRD, dataclasses.replace(CONFIG, error_bars=True))


def with_species(body, terms):
    """Return the config whose shared stage optimises some numbers of a body, for birds of species."""
    first, shared, last = stages()
    shared = dataclasses.replace(
        shared,
        optimised=(*POSE, *body),
        share_body="species",
        terms=(*shared.terms, *(("shape_prior",) if "betas" in body else ())),
    )
    return dataclasses.replace(CONFIG, terms=terms, stages=(first, shared, last))


def evidence(window_means, precision, errors):
    """Return the evidence of a window: errors (T, K, 2) of keypoints."""
    sums, squares = errors.sum(0), (errors**2).sum((0, 2))
    nothing = np.zeros((len(precision), 3 * BONES))
    counts = np.full(errors.shape[1], float(len(errors)))
    return BodyEvidence(window_means, precision, nothing, sums, squares, counts, np.ones(()))


def prior_precision():
    prior = np.linalg.inv(np.asarray(BIRD.bone_covariance, np.float64)) + np.eye(BONES)
    symmetric = prior.copy()
    for left, right in BIRD.joint_pairs:
        rows = [left - 1, right - 1]
        symmetric[np.ix_(rows, rows)] += np.array([[1, -1], [-1, 1]]) / ASYMMETRY_SD**2
    return prior, symmetric


def test_body_is_the_posterior_of_all_windows():
    """The oracle stacks the data of all windows and the prior in one least-squares problem."""
    rng, mean = np.random.default_rng(0), np.asarray(BIRD.bone_mean, np.float64)
    prior, symmetric = prior_precision()
    white = rng.standard_normal((50, 8, 2))
    white -= white.mean(0)  # no common part: all frames count
    rows, right, windows = [np.linalg.cholesky(symmetric).T], [np.linalg.cholesky(symmetric).T @ mean], []
    for _ in range(3):
        J, y = rng.standard_normal((20, BONES)), rng.standard_normal(20)
        A, broad = J.T @ J + prior, np.eye(BONES)  # the posterior has a broad prior, the fit has none
        windows.append(evidence(np.linalg.solve(A - broad, J.T @ y + (prior - broad) @ mean), A, white))
        rows.append(J)
        right.append(y)
    expected = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    (body,) = estimate_bodies(np.zeros(3, int), windows, MODEL, CONFIG).values()
    np.testing.assert_allclose(body.bone_length, expected, rtol=1e-5)
    stacked = np.concatenate(rows)
    np.testing.assert_allclose(
        body.covariance, np.linalg.inv(stacked.T @ stacked), rtol=1e-6
    )  # the prior is in float32
    assert body.frames == 150


def test_a_posture_that_lasts_is_noise_of_the_score():
    """The oracle: s = I·b + n as generalised least squares, with n ~ N(0, I/κ + M)."""
    rng, mean = np.random.default_rng(5), np.asarray(BIRD.bone_mean, np.float64)
    prior, symmetric = prior_precision()
    errors = rng.standard_normal((50, 8, 2)) + 1  # a part of the errors is common
    J, y, M = rng.standard_normal((20, BONES)), rng.standard_normal(BONES), rng.standard_normal((BONES, 3 * BONES))
    of_data = J.T @ J
    window = evidence(np.linalg.solve(of_data + prior, y + prior @ mean), of_data + prior, errors)
    (body,) = estimate_bodies(np.zeros(1, int), [window._replace(posture=M)], MODEL, CONFIG).values()
    noise = of_data * 50 / body.frames + M @ M.T
    weighted = of_data @ np.linalg.inv(noise)
    # the posterior of a window contains the broad prior of precision 1, and its optimum does not
    broad = weighted @ (np.linalg.solve(of_data + prior, y + prior @ mean) - mean)
    expected = np.linalg.solve(symmetric + weighted @ of_data, weighted @ (y - of_data @ mean) - broad)
    np.testing.assert_allclose(body.bone_length, mean + expected, rtol=1e-4)
    assert body.frames < 20


def test_errors_that_all_frames_share_count_once():
    mean = np.asarray(BIRD.bone_mean, np.float64)
    prior, _ = prior_precision()
    A = 50 * prior
    errors = np.random.default_rng(1).standard_normal((400, 40, 2))
    frames = {}
    for name, values in {
        "independent": errors,
        "half": errors + np.random.default_rng(2).standard_normal((1, 40, 2)),
        "constant": np.ones((400, 40, 2)),
    }.items():
        (body,) = estimate_bodies(np.zeros(1, int), [evidence(mean + 0.1, A, values)], MODEL, CONFIG).values()
        frames[name] = body.frames
        assert (np.abs(body.bone_length - mean) <= 0.1 + 1e-6).all()
    assert frames["independent"] > 300
    assert frames["half"] == pytest.approx(2, rel=0.3)  # half of the squares are common
    assert frames["constant"] == pytest.approx(1)


@pytest.mark.parametrize(("difference", "agree"), [(0.0, True), (0.3, False)])
def test_two_birds_under_one_track(difference, agree):
    """The data of each half have errors of their own; a bird differs from the other by 0.3 in all bones."""
    rng, prior = np.random.default_rng(4), prior_precision()[0]
    mean, wrong = np.asarray(BIRD.bone_mean, np.float64), 0
    for _ in range(20):
        own = mean + rng.multivariate_normal(np.zeros(BONES), np.linalg.inv(prior_precision()[1]))
        windows = []
        for half in (0, 1):
            for _ in range(2):
                precise = np.eye(BONES) * 2000.0
                seen = own + half * difference + rng.standard_normal(BONES) / np.sqrt(2000.0)
                A = precise + prior
                errors = rng.standard_normal((50, 40, 2))
                errors -= errors.mean(0)  # all frames count
                windows.append(evidence(np.linalg.solve(A, precise @ seen + prior @ mean), A, errors))
        (body,) = estimate_bodies(np.zeros(4, int), windows, MODEL, CONFIG).values()
        wrong += body.agree != agree
    assert wrong == 0


@pytest.mark.parametrize("true_share", [0.1, 1.0])
def test_bodies_of_species_are_the_joint_posterior(true_share):
    """The oracle: all bodies and all data as one Gaussian, for every pair of shares on the grid."""
    rng, bird = np.random.default_rng(6), tiny_bird(shapes=2)
    settings = with_species(("bone_length", "betas"), {**TERM_SETTINGS, "shape_prior": 0.5})
    mean, precision, broad = _prior(priors_of(bird), settings)
    C, species = np.linalg.inv(_symmetric(precision, bird)), np.array([7, 3, 7, 5, 7, 3, 3, 7])
    (P, N), same = (len(mean), len(species)), species[:, None] == species

    def covariance(of_bones, of_shape):
        root = np.sqrt(np.where(np.arange(P) < BONES, of_bones, of_shape))
        within, between = C * np.outer(root, root), C * np.outer(np.sqrt(1 - root**2), np.sqrt(1 - root**2))
        return np.kron(np.eye(N), within) + np.kron(same, between)

    x = rng.multivariate_normal(np.zeros(N * P), covariance(true_share, true_share))
    J = 30 * rng.standard_normal((N, 8, P))
    J[-2] = 0  # nothing is seen of this bird
    y = np.einsum("nyp,np->ny", J, x.reshape(N, P)) + rng.standard_normal((N, 8))
    dense = block_diag(*J)
    grid, best = {}, {}
    for shares in product(SHARES, SHARES):
        S = covariance(*shares)
        of_data = dense @ S @ dense.T + np.eye(len(dense))
        grid[shares] = multivariate_normal(np.zeros(len(dense)), of_data).logpdf(y.ravel())
        gain = np.linalg.solve(of_data, dense @ S).T
        best[shares] = gain @ y.ravel(), S - gain @ dense @ S
    shares = max(grid, key=grid.get)
    assert np.allclose(shares, true_share, atol=0.3)
    white = rng.standard_normal((50, 8, 2))
    white -= white.mean(0)  # no common part: all frames count
    windows = []
    for n in range(N):
        A = J[n].T @ J[n] + precision
        windows.append(evidence(mean + np.linalg.solve(A - broad, J[n].T @ y[n]), A, white))
    found_bodies = estimate_bodies(np.arange(N), windows, fit_model(bird, settings), settings, species)
    expected, spread = best[shares]
    for n, body in found_bodies.items():
        own = slice(n * P, (n + 1) * P)
        found = np.concatenate([body.bone_length, body.betas])
        np.testing.assert_allclose(found, mean + expected[own], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(body.covariance, spread[own, own], rtol=1e-4, atol=1e-7)


def test_a_bird_alone_in_its_species_has_its_own_body(fitted):
    observed, solution = fitted
    own = dataclasses.replace(with_species(("bone_length",), TERM_SETTINGS), error_bars=True)
    alone = fit(dataclasses.replace(observed, species={0: "murre", 1: "gull"}), BIRD, own)
    np.testing.assert_allclose(alone.bodies.bone_length, solution.bodies.bone_length, atol=1e-5)
    # these two birds differ as much as any birds, so the data of one say nothing about the other
    np.testing.assert_allclose(fit(observed, BIRD, own).bodies.bone_length, solution.bodies.bone_length, atol=1e-5)
    second = dataclasses.replace(individuals(2 * T)[1], bone_length=LENGTHS[0])
    equal = detect(BIRD, [individuals(2 * T)[0], second], 0.1, 0.0, 0, camera=CAMERA)
    apart, together = (
        fit(dataclasses.replace(equal, species=names), BIRD, own).bodies for names in ({0: "murre", 1: "gull"}, {})
    )
    assert np.abs(np.diff(together.bone_length, axis=0)).max() < 0.5 * np.abs(np.diff(apart.bone_length, axis=0)).max()
    assert (together.bone_length_sd < apart.bone_length_sd).all()


def test_offsets_are_those_of_all_birds(monkeypatch):
    """The oracle stacks the data of two birds and all priors in one least-squares problem with common columns."""
    monkeypatch.setattr(bodies, "WIDTHS", (1.0,))
    config = dataclasses.replace(OFFSETS, learn_weights=("keypoint_offsets",))
    rng, model = np.random.default_rng(8), fit_model(SHAPED, config)
    D, shapes = 1 + len(offset_directions(SHAPED)), SHAPED.num_shapes
    own, P = BONES + shapes, BONES + shapes + D
    prior, symmetric = np.eye(P), np.zeros((P, P))
    prior[:BONES, :BONES], symmetric[:BONES, :BONES] = prior_precision()
    sds = np.asarray(model.priors.shape_sd, np.float64)
    prior[range(BONES, P), range(BONES, P)] = sds**-2 + 0.01
    symmetric[BONES:, BONES:] = prior[BONES:, BONES:]
    broad = np.diag([1.0] * BONES + [0.01] * (P - BONES))
    mean = np.concatenate([np.asarray(SHAPED.bone_mean, np.float64), np.zeros(P - BONES)])
    white = rng.standard_normal((50, 8, 2))
    white -= white.mean(0)
    rows, right, windows = [], [], []
    root = np.linalg.cholesky(symmetric).T
    for n in range(2):
        place = np.zeros((P, 2 * own + D))
        place[:own, n * own : (n + 1) * own], place[own:, 2 * own :] = np.eye(own), np.eye(D)
        J, y = 20 * rng.standard_normal((40, P)), 5 * rng.standard_normal(40)
        A = J.T @ J + prior
        windows.append(evidence(np.linalg.solve(A - broad, J.T @ y + (prior - broad) @ mean), A, white))
        # the prior of the offsets counts once
        rows += [J @ place, root[:own] @ place, *([root[own:] @ place] if n == 0 else [])]
        right += [y, root[:own] @ mean, *([np.zeros(D)] if n == 0 else [])]
    stacked = np.concatenate(rows)
    expected = np.linalg.lstsq(stacked, np.concatenate(right), rcond=None)[0]
    covariance = np.linalg.inv(stacked.T @ stacked)
    for n, body in estimate_bodies(np.arange(2), windows, model, config).items():
        columns = np.r_[n * own : (n + 1) * own, 2 * own : 2 * own + D]
        found = np.concatenate([body.bone_length, body.betas, body.offsets])
        np.testing.assert_allclose(found, expected[columns], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(body.covariance, covariance[np.ix_(columns, columns)], rtol=1e-4, atol=1e-7)
    # a posture that all birds have in common can explain the same score: the data say less about the offsets
    U = 10 * rng.standard_normal((P, 3 * BONES))
    postured = [window._replace(posture=window.precision @ U) for window in windows]
    unsure = estimate_bodies(np.arange(2), postured, model, config)[0]
    assert (np.diagonal(unsure.covariance)[own:] > 2 * np.diagonal(body.covariance)[own:]).all()


def test_fit_finds_the_offsets_of_the_detector(tmp_path):
    """The keypoints of the result are those of the model, without the offsets; a later fit can keep the offsets."""
    directions = offset_directions(SHAPED)
    offsets = np.tensordot(np.random.default_rng(3).choice([-0.1, 0.1], len(directions)), directions, axes=1)
    mean_pose = np.broadcast_to(np.asarray(SHAPED.pose_mean).reshape(BONES, 3), (T, BONES, 3))
    motions = [jax.tree.map(np.asarray, smooth_motion(SHAPED, T, n)) for n in range(8)]
    poses = [dataclasses.replace(motion, body_pose=mean_pose) for motion in motions]
    known_posture = dataclasses.replace(OFFSETS, terms=dict(OFFSETS.terms) | {"pose_prior": 500.0})
    exact = detect(SHAPED, poses, 0.0, 0.0, 0, camera=CAMERA)
    rig = fold_bird(SHAPED)
    moved_px = [
        np.asarray(project(window_keypoints(move_keypoints(rig, offsets), window_transforms(rig, pose), pose), CAMERA))
        for pose in poses
    ]
    observed = exact.with_keypoints(np.stack(moved_px), exact.confidence)
    fixed, learnt = (
        fit(observed, SHAPED, dataclasses.replace(known_posture, learn_weights=names))
        for names in ((), ("keypoint_offsets",))
    )
    np.testing.assert_array_equal(fixed.bodies.keypoint_offsets, 0)
    found = learnt.bodies.keypoint_offsets
    np.testing.assert_array_equal(found[0], found[1])
    assert np.linalg.norm(found[0] - offsets) < 0.7 * np.linalg.norm(offsets)

    def error_px(solution):
        return np.linalg.norm(solution.keypoints.px - exact.keypoints_px, axis=-1).mean()

    assert error_px(learnt) < 0.85 * error_px(fixed)
    save_solution(learnt, SHAPED, "", {}, tmp_path / "result")
    config = dataclasses.replace(known_posture, learn_weights=("keypoint_offsets",))
    known = bodies_of(load_solution(tmp_path / "result")[0], SHAPED, config)
    again = fit(observed, SHAPED, config, bodies=known)
    np.testing.assert_allclose(again.keypoints.px, learnt.keypoints.px, atol=1e-3)


def test_without_a_usable_window_the_body_is_that_of_the_model():
    unknown = np.full((BONES, BONES), np.nan)
    nothing = BodyEvidence(
        np.ones(BONES), unknown, np.zeros((BONES, 3 * BONES)), np.zeros((8, 2)), np.zeros(8), np.zeros(8), np.ones(())
    )
    of_model = estimate_bodies(np.array([0, 1]), [nothing, None], MODEL, CONFIG)
    for body in of_model.values():
        np.testing.assert_array_equal(body.bone_length, np.asarray(BIRD.bone_mean))
        assert body.frames == 0
        assert body.determined == pytest.approx(0, abs=1e-9)


def test_fit_finds_the_bones_of_each_bird(fitted):
    _, solution = fitted
    error = np.abs(solution.bodies.bone_length - LENGTHS)
    # two short windows, whose unknown postures leave a third of the errors of the mean bird at least
    assert (error.mean(1) < 0.7 * np.abs(1 - LENGTHS).mean(1)).all()
    assert (error < 4 * solution.bodies.bone_length_sd).all()
    # one body in all windows of a track
    assert (solution.poses.bone_length == solution.bodies.bone_length[:, None]).all()
    # the error bars of the poses contain those of the body
    np.testing.assert_allclose(
        np.nanmean(solution.error_bars.bone_length_sd, axis=1), solution.bodies.bone_length_sd, rtol=1e-3
    )


def test_weights_are_learnt_where_the_bodies_are_optimised(fitted):
    """Later stages have fixed bodies, whose numbers would not count as parameters that absorb errors."""
    learning = dataclasses.replace(CONFIG, learn_weights=("keypoint_likelihood",))
    first, shared, _ = stages()
    one_pass = dataclasses.replace(learning, stages=(first, dataclasses.replace(shared, share_body=False)))
    found, expected = (learn_weights(fitted[0], BIRD, each).values for each in (learning, one_pass))
    assert found == expected
    assert found


def test_bones_of_other_species_have_a_wider_prior():
    widened = model_of_fit(BIRD, dataclasses.replace(CONFIG, species_bone_sd=0.2)).priors.bone_whitener
    draws = np.random.default_rng(7).standard_normal((3, 400_000)) * 0.2
    left, right = np.array(BIRD.bone_pairs).T
    change = np.zeros((BONES, 400_000))
    change[:] = draws[:BONES]
    change[right] = change[left]  # a left and a right bone differ from the model alike
    expected = np.asarray(BIRD.bone_covariance) + np.cov(change)
    np.testing.assert_allclose(np.linalg.inv(widened.T @ widened), expected, atol=1e-3)


def test_bodies_do_not_depend_on_other_birds(fitted):
    observed, together = fitted
    alone = fit(observed.select(tracks=[1]), BIRD, dataclasses.replace(CONFIG, error_bars=True))
    np.testing.assert_array_equal(alone.bodies.bone_length[0], together.bodies.bone_length[1])
    np.testing.assert_array_equal(alone.poses.body_pose[0], together.poses.body_pose[1])


@pytest.fixture
def two_windows_tell(monkeypatch):
    """Bodies are estimated from the first and the last window of a track."""
    monkeypatch.setattr(bodies, "BODY_FRAMES", 2 * T)


def test_windows_that_tell_the_body_are_evenly_spaced(monkeypatch):
    monkeypatch.setattr(bodies, "BODY_FRAMES", 3 * T)
    track = np.repeat([0, 1, 2], [7, 2, 3])
    chosen = windows_of_bodies(track, CONFIG)
    assert np.flatnonzero(chosen).tolist() == [0, 3, 6, *range(7, 12)]
    assert windows_of_bodies(track, config()).all()  # no stage shares a body
    # no stage before the bodies would give the other windows their poses
    assert windows_of_bodies(track, dataclasses.replace(CONFIG, stages=stages()[1:])).all()
    # a stage that the others skip chooses the hypothesis
    first, shared, last = stages()
    choosing = dataclasses.replace(CONFIG, stages=(first, dataclasses.replace(shared, keep_best=True), last))
    assert windows_of_bodies(track, choosing).all()


def test_stages_of_windows_that_tell_no_body():
    map_, photo = load_config("map"), load_config("photo")
    for settings, names in (
        (map_, ["keypoints"]),
        (without_mask_stages(map_), ["keypoints", "mask"]),
        (photo, ["camera", "pose"]),
    ):
        some = stages_of_pass(settings, has_bodies=False, tells_body=False)
        assert [settings.stages[i].name for i in some] == names


def test_bodies_of_long_tracks_are_those_of_some_windows(two_windows_tell, monkeypatch):
    observed = detect(BIRD, individuals(4 * T), 0.1, 0.0, 0, camera=CAMERA)
    settings, calls = dataclasses.replace(CONFIG, error_bars=True), []

    def counted(*arguments):
        calls.append(arguments)
        return window_error_bars(*arguments)

    monkeypatch.setattr("jaxfit.fitting.batch.window_error_bars", counted)
    solution = fit(observed, BIRD, settings)
    assert all(of_bodies is not None for *_, of_bodies in calls)  # only with the bodies
    # the oracle: a fit that has no other windows
    (some,) = fit_runs(observed, BIRD, [settings], select=np.array([0, 3, 4, 7]))
    for name, values in vars(some.bodies).items():
        np.testing.assert_array_equal(getattr(solution.bodies, name), values, err_msg=name)
    assert solution.valid.all()
    assert (solution.poses.bone_length == solution.bodies.bone_length[:, None]).all()
    assert np.isfinite(solution.error_bars.keypoints_px_cov).all()
    error_px = np.linalg.norm(solution.keypoints.px - observed.keypoints_px, axis=-1).mean((0, 2)).reshape(4, T).mean(1)
    assert error_px[1:3].max() < 1.1 * error_px[[0, 3]].max()


def test_interrupted_where_some_windows_tell_the_body(two_windows_tell, tmp_path, monkeypatch):
    observed = detect(BIRD, individuals(4 * T), 0.1, 0.0, 0, camera=CAMERA)
    expected = fit(observed, BIRD, CONFIG)
    fit(observed.select(tracks=[0]), BIRD, CONFIG, stored=StoredWindows(Parts(tmp_path / "first", {})))
    added = []

    class Counted(StoredWindows):
        def add(self, windows, results, contents):
            added.extend(results)
            super().add(windows, results, contents)

    again = fit(observed, BIRD, CONFIG, stored=Counted(Parts(tmp_path / "first", {})))
    assert sorted(added) == [4, 4, 5, 5, 6, 6, 7, 7]  # the second bird, in two passes
    # the same windows where all tell the body have other stages
    monkeypatch.setattr(bodies, "BODY_FRAMES", 4 * T)
    fit(observed, BIRD, CONFIG, stored=StoredWindows(Parts(tmp_path / "all", {})))
    monkeypatch.setattr(bodies, "BODY_FRAMES", 2 * T)
    changed = fit(observed, BIRD, CONFIG, stored=StoredWindows(Parts(tmp_path / "all", {})))
    for name, values in expected.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], values, err_msg=name)
        np.testing.assert_array_equal(changed.arrays()[name], values, err_msg=name)


def test_interrupted_between_the_passes(fitted, tmp_path):
    observed, solution = fitted
    settings, add = dataclasses.replace(CONFIG, error_bars=True), StoredWindows.add

    def stopped(self, windows, results, contents):
        add(self, windows, results, contents)
        if any(len(content) > len(CONFIG.stages) for content in contents.values()):  # of the second pass
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StoredWindows, "add", stopped)
        with pytest.raises(KeyboardInterrupt):
            fit(observed, BIRD, settings, stored=StoredWindows(Parts(tmp_path, {})))
    stored = StoredWindows(Parts(tmp_path, {}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxfit.fitting.tasks.fit_batch", None)  # both passes are stored
        again = fit(observed, BIRD, settings, stored=stored)
    assert stored.state == "8 windows fitted"  # four windows in two passes
    for name, values in solution.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], values, err_msg=name)


def test_known_body_is_kept(fitted, tmp_path):
    observed, solution = fitted
    save_solution(solution, BIRD, "", {}, tmp_path / "result")
    loaded, _ = load_solution(tmp_path / "result")
    known = bodies_of(loaded, BIRD, CONFIG)
    assert list(known) == observed.track_id.tolist()
    changed = {1: known[1]._replace(bone_length=np.full(BONES, 1.25, np.float32))}
    again = fit(observed, BIRD, dataclasses.replace(CONFIG, error_bars=True), bodies=changed)
    np.testing.assert_array_equal(again.bodies.bone_length[1], 1.25)
    np.testing.assert_array_equal(again.bodies.bone_length[0], solution.bodies.bone_length[0])
    assert (again.poses.bone_length[1] == 1.25).all()


def test_bodies_of_another_model_are_refused(fitted, tmp_path):
    save_solution(fitted[1], BIRD, "", {}, tmp_path / "result")
    options = argparse.Namespace(body=tmp_path / "result", config="own")
    assert list(_known_bodies(options, CONFIG, BIRD, [1])) == [0, 1]
    for bird in (toy_bird(shapes=0), tiny_bird(shapes=2)):
        with pytest.raises(InputError, match="another model, tiny"):
            _known_bodies(options, CONFIG, bird, [1])


def test_a_shape_that_the_config_fixes_is_refused(fitted, tmp_path):
    solution, bird = fitted[1], tiny_bird(shapes=2)
    cells, shape = solution.valid.shape, np.ones((2, 2), np.float32)
    solution = solution.with_arrays(
        betas=np.ones((*cells, 2), np.float32),
        body_betas=shape,
        body_betas_sd=shape,
        betas_sd=np.ones((*cells, 2), np.float32),
    )
    save_solution(solution, bird, "", {}, tmp_path / "result")
    options = argparse.Namespace(body=tmp_path / "result", config="own")
    with pytest.raises(InputError, match="bodies with a shape"):
        _known_bodies(options, CONFIG, bird, [1])
    assert bodies_of(solution, bird, with_values(load_config("map"), {}))[1].betas.tolist() == [1, 1]


LEARNING = dataclasses.replace(CONFIG, learn_weights=("keypoint_likelihood",))


def test_scale_of_keypoint_errors_is_learnt_for_each_track():
    """The errors of the first bird are eight times as large as the config says, those of the second are smaller."""
    exact = detect(BIRD, individuals(2 * T), 0.0, 0.0, 0, camera=CAMERA)
    noise_px = np.random.default_rng(0).standard_normal(exact.keypoints_px.shape) * np.reshape([4.0, 0.1], (2, 1, 1, 1))
    observed = exact.with_keypoints(exact.keypoints_px + noise_px, exact.confidence)
    fixed, learnt = (fit(observed, BIRD, each) for each in (CONFIG, LEARNING))
    np.testing.assert_array_equal(fixed.bodies.keypoint_scale, 1)
    assert 4 < learnt.bodies.keypoint_scale[0] < 16
    # errors that agree between frames look small: the scale of the config is the least
    assert learnt.bodies.keypoint_scale[1] == 1

    def error_px(solution):
        return np.linalg.norm(solution.keypoints.px[0] - exact.keypoints_px[0], axis=-1).mean()

    assert error_px(learnt) < 0.9 * error_px(fixed)
    # one config for each run, and each bird keeps what was learnt about it
    runs = fit_runs(observed, BIRD, [CONFIG, LEARNING])
    for run, alone in zip(runs, (fixed, learnt), strict=True):
        np.testing.assert_array_equal(run.bodies.keypoint_scale, alone.bodies.keypoint_scale)
        np.testing.assert_allclose(run.poses.body_pose, alone.poses.body_pose, atol=1e-4)
    known = bodies_of(learnt, BIRD, LEARNING)
    again = fit(observed, BIRD, LEARNING, bodies=known)
    np.testing.assert_array_equal(again.poses.body_pose, learnt.poses.body_pose)


def test_several_configs_keep_their_settings(fitted):
    """Error bars too have the settings of their own config."""
    observed, first = fitted
    own = dataclasses.replace(CONFIG, error_bars=True)
    last = dataclasses.replace(own.stages[-1], override={"keypoint_likelihood": {"sd_sure_px": 1.5}})
    other = dataclasses.replace(own, stages=(*own.stages[:-1], last))
    solutions = fit_runs(observed, BIRD, [own, other])
    for found, expected in zip(solutions, (first, fit(observed, BIRD, other)), strict=True):
        for name, values in expected.arrays().items():
            np.testing.assert_array_equal(found.arrays()[name], values, err_msg=name)


def test_keypoints_that_are_off_say_nothing_about_a_body(fitted, tmp_path):
    observed, first = fitted
    np.savez(tmp_path / "poses.npz", **first.arrays())
    initial = load_initial_poses(tmp_path / "poses.npz", observed, BIRD)  # a search would see all keypoints
    name = BIRD.keypoint_names[-1]
    off = dataclasses.replace(CONFIG, stages=tuple(dataclasses.replace(s, keypoints_off=(name,)) for s in stages()))
    points = observed.keypoints_px.copy()
    points[:, :, -1] += 3  # px
    expected, moved = (
        fit(each, BIRD, off, initial_poses=initial)
        for each in (observed, observed.with_keypoints(points, observed.confidence))
    )
    np.testing.assert_allclose(moved.bodies.frames, expected.bodies.frames, rtol=1e-3)


def test_windows_without_a_posterior_are_reported(fitted, monkeypatch, caplog):
    monkeypatch.setattr("jaxfit.fitting.posterior.LARGEST_BYTES", 0)
    solution = fit(fitted[0], BIRD, CONFIG)
    assert caplog.text.count("a window says nothing about the body of its bird: windows of 6 frames are too long") == 4
    np.testing.assert_array_equal(solution.bodies.bone_length, np.tile(np.asarray(BIRD.bone_mean), (2, 1)))


def test_corrected_tracks_keep_the_body_of_their_windows(fitted):
    observed, solution = fitted
    settings, second = dataclasses.replace(CONFIG, error_bars=True), int(observed.frame_index[T])
    # the windows of the new track 2 are copied, with the body of track 0
    cut = apply_edits(observed, [Edit("cut", (0,), second)], "x")
    done = refit(solution, observed, cut, BIRD, settings)
    assert not done.fitted
    for name in ("bone_length", "bone_length_sd", "frames"):
        np.testing.assert_array_equal(getattr(done.solution.bodies, name), getattr(solution.bodies, name)[[0, 1, 0]])
    # the last windows of two birds change places: the body of the first windows stays, and the others are fitted again
    swapped = apply_edits(observed, [Edit("swap", (0, 1), second)], "x")
    done = refit(solution, observed, swapped, BIRD, settings)
    last = observed.frame_index[-1]
    assert done.fitted == [(0, second, last), (1, second, last)]
    np.testing.assert_array_equal(done.solution.bodies.bone_length, solution.bodies.bone_length)
    assert (done.solution.poses.bone_length == solution.bodies.bone_length[:, None]).all()
    # a new number only
    swapped = apply_edits(observed, [Edit("swap", (0, 1), int(observed.frame_index[0]))], "x")
    done = refit(solution, observed, swapped, BIRD, settings)
    assert not done.fitted
    np.testing.assert_array_equal(done.solution.bodies.bone_length, solution.bodies.bone_length[::-1])


def test_error_bars_with_a_body_are_those_of_the_joint_precision():
    rng = np.random.default_rng(3)
    L, P = 5, 3
    H, U = (lambda a: a @ a.T + np.eye(L))(rng.standard_normal((L, L))), rng.standard_normal((L, P))
    of_body = (lambda a: a @ a.T + np.eye(P))(rng.standard_normal((P, P)))
    # the oracle: the precision of pose and body, whose body has the marginal covariance `of_body`
    corner = np.linalg.inv(of_body) + U.T @ np.linalg.solve(H, U)
    expected = np.linalg.inv(np.block([[H, U], [U.T, corner]]))
    slopes = BodySensitivity(-np.linalg.solve(H, U)[None], np.zeros((0, P)), np.arange(P))
    (found,) = _with_body(np.linalg.inv(H)[None], slopes, of_body)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"stages": stages()[:2]}, "stages[1].share_body"),
        ({"stages": (*stages()[:2], stages()[1])}, "stages[1].share_body"),
        ({"stages": (dataclasses.replace(stages()[0], share_body=True), *stages()[2:])}, "stages[0].share_body"),
    ],
)
def test_wrong_use_of_a_shared_body_names_the_stage(changes, key):
    with pytest.raises((ValueError, InputError), match=key.replace("[", r"\[").replace("]", r"\]")):
        dataclasses.replace(CONFIG, **changes)


def test_without_masks_the_body_keeps_its_stages():
    from jaxfit.fitting.solve import without_mask_stages

    left = without_mask_stages(with_values(load_config("map"), {}))
    (shared,) = (stage for stage in left.stages if stage.share_body)
    assert "bone_length" in shared.optimised
    assert not any("mask" in term for stage in left.stages for term in stage.terms)
    assert "bone_length" not in left.stages[-1].optimised
