"""The whole fit: it recovers a known truth, birds are independent, and the batch size does not change the result."""

import dataclasses
from contextlib import contextmanager

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.birds import exp_map, pose_window
from support.fits import BIRD, CAMERA, ONE_WINDOW_GB, SIZE, T, config, keypoints_of, replaced, truths

from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.masks import encode_mask
from jaxfit.data.solution import save_solution
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.fitting.batch import Batch, fit_batch, frames_per_batch
from jaxfit.fitting.fit import fit
from jaxfit.fitting.initial_poses import load_initial_poses
from jaxfit.fitting.problem import Problem
from jaxfit.fitting.solve import fit_model, report, stage_hyperparameters, stage_program
from jaxfit.fitting.windows import cut_windows, load_targets
from jaxfit.foundation.errors import InputError
from jaxfit.learning.priors import learn_prior
from jaxfit.model.camera import CROP_PX, project
from jaxfit.model.kinematics import Pose
from jaxfit.simulation.noise import detect


@pytest.fixture(scope="module")
def observed():
    return detect(BIRD, truths(), camera=CAMERA)


@pytest.fixture(scope="module")
def solution(observed):
    return fit(observed, BIRD, config())


SHORT = (20, 2)
"""Steps of fits whose accuracy does not matter."""


@pytest.fixture(scope="module")
def short(observed):
    return fit(observed, BIRD, config(steps=SHORT))


@pytest.fixture(scope="module")
def long():
    """A track of two windows, the second of which lacks frames: its fit, and the fits of both parts."""
    observations = detect(BIRD, truths(2 * T - 2, 1), camera=CAMERA)
    parts = [observations.select(frames=some) for some in (slice(0, T), slice(T, None))]
    whole, *apart = (fit(each, BIRD, config(steps=SHORT)) for each in (observations, *parts))
    return observations, whole, apart


ARRAYS = [name for name in Pose.__dataclass_fields__] + ["keypoints_cam", "keypoints_px", "crop", "valid"]


def assert_same(a, b, tracks):
    for name in ARRAYS:
        np.testing.assert_array_equal(a.arrays()[name][tracks], b.arrays()[name][tracks], err_msg=name)


def test_the_fit_recovers_a_known_truth(solution, observed):
    assert solution.status.tolist() == ["ok"] * 3
    assert solution.valid.all()
    error_px = np.linalg.norm(solution.keypoints.px - keypoints_of(truths()), axis=-1)
    assert error_px.max() < 1 * SIZE / 256  # one pixel of a 256-pixel crop
    for n, truth in enumerate(truths()):
        R, R_true = exp_map(solution.poses.global_orient[n]), exp_map(np.asarray(truth.global_orient))
        angle = Rotation.from_matrix(R.transpose(0, 2, 1) @ R_true).magnitude()
        assert np.rad2deg(angle).max() < 12
        # only the ratio of scale and depth is observable
        size = solution.poses.scale[n] / solution.poses.transl[n, :, 2]
        np.testing.assert_allclose(size, float(truth.scale[0]) / 200, rtol=0.03)
    result = evaluate(solution, BIRD, observed).overall
    assert result["pck@0.05"] == 1
    assert result["iou"] > 0.9
    assert result["me_p"] < 0.005


def test_the_arrays_of_the_solution_are_consistent(solution):
    for n in range(3):
        pose = jax.tree.map(lambda values, n=n: values[n], solution.poses)
        pose = dataclasses.replace(pose, bone_length=solution.poses.bone_length[n, 0], betas=solution.poses.betas[n, 0])
        keypoints, _ = pose_window(BIRD, pose)
        np.testing.assert_allclose(solution.keypoints.cam[n], keypoints, atol=1e-3)
        np.testing.assert_allclose(solution.keypoints.px[n], project(keypoints, CAMERA), atol=0.02)
        assert np.ptp(solution.poses.transl[n, :, 2]) == 0  # the depth is fixed and constant in the window
        np.testing.assert_array_equal(solution.poses.bone_length[n], np.ones((T, BIRD.num_joints - 1)))
    assert set(solution.loss) == {"keypoints", "mask", "pose_prior", "velocity", "acceleration"}


@pytest.mark.usefixtures("distant_birds")
@pytest.mark.parametrize("windows_per_batch", [1, 2])
def test_a_diverged_bird_does_not_change_the_other_birds(observed, short, windows_per_batch):
    """Nor does the number of windows in a batch change them."""
    broken = replaced(observed, 1, np.full((T, BIRD.num_keypoints, 2), 1e30))
    result = fit(broken, BIRD, config(steps=SHORT, memory_gb=windows_per_batch * ONE_WINDOW_GB))
    assert result.status.tolist() == ["ok", "diverged", "ok"]
    assert result.valid.all(1).tolist() == [True, False, True]
    assert not result.valid[1].any()
    assert np.isnan(result.poses.global_orient[1]).all()
    assert_same(result, short, [0, 2])


@pytest.mark.usefixtures("distant_birds")
@pytest.mark.parametrize("first_diverges", [True, False])
def test_a_diverged_window_does_not_change_the_other_windows_of_the_track(long, first_diverges):
    """Only the other windows have valid poses and contribute to the loss, in either order of the windows."""
    observations, _, parts = long
    points = observations.keypoints_px.copy()
    bad, good = (slice(T), slice(T, None)) if first_diverges else (slice(T, None), slice(T))
    points[0, bad] = 1e30
    result = fit(observations.with_keypoints(points, observations.confidence), BIRD, config(steps=SHORT))
    healthy = parts[first_diverges]
    frames = len(healthy.frame_index)
    assert result.status.tolist() == ["partly diverged"]
    assert result.valid[0, good].all()
    assert not result.valid[0, bad].any()
    np.testing.assert_array_equal(result.poses.body_pose[0, good], healthy.poses.body_pose[0])
    assert np.isnan(result.poses.body_pose[0, bad]).all()
    for term, loss in healthy.loss.items():
        assert result.loss[term][0] == pytest.approx(loss[0], rel=1e-5)
    (failure,) = result.failures[0]
    assert failure.startswith(f"frames {0 if first_diverges else T} to {T - 1 if first_diverges else 2 * T - 3}: ")
    learnt = learn_prior([("result", result, BIRD)])
    assert (learnt.poses, learnt.birds, learnt.diverged) == (frames, 1, 0)
    assert evaluate(result, BIRD, observations).frames == frames


def test_the_size_of_the_silhouette_does_not_change_the_objective(observed):
    """Quantities in pixels refer to a 256-pixel crop, also if silhouettes and masks are smaller."""
    losses, poses = {}, jax.tree.map(lambda *x: np.stack(x), *truths())
    moved = dataclasses.replace(poses, transl=poses.transl + np.array([1.0, -0.5, 0], np.float32))
    large = in_a_large_image(observed)
    for size_px in (64, 128, 256):
        settings = config(mode="box", steps=(1, 1))
        settings = dataclasses.replace(settings, crop=dataclasses.replace(settings.crop, size_px=size_px))
        fitted, stage = fit_model(BIRD, settings), settings.stages[1]
        one = stage_hyperparameters(settings, stage, BIRD.keypoint_names)
        windows = cut_windows(large, settings)
        problems = Problem(jax.tree.map(lambda x: np.stack([x] * 3), one), moved, load_targets(windows, size_px))
        losses[size_px] = report(stage_program(settings, stage, fitted), problems, moved).loss
    for term in ("keypoints", "pose_prior", "velocity", "acceleration"):
        np.testing.assert_allclose(losses[64][term], losses[256][term], rtol=1e-5, err_msg=term)
    # a smaller silhouette has a coarser outline
    np.testing.assert_allclose(losses[128]["mask"], losses[256]["mask"], rtol=0.02)
    np.testing.assert_allclose(losses[64]["mask"], losses[256]["mask"], rtol=0.08)


def test_a_bird_without_keypoints_has_no_usable_frame(short, observed):
    hidden = replaced(observed, 1, confidence=np.zeros((T, BIRD.num_keypoints)))
    result = fit(hidden, BIRD, config(steps=SHORT))
    assert result.status.tolist() == ["ok", "no usable frame", "ok"]
    assert not result.valid[1].any()
    assert np.isnan(result.loss["keypoints"][1])
    assert_same(result, short, [0, 2])
    with pytest.raises(InputError, match=r"birds\.json: no track has a frame with 4 confident keypoints"):
        fit(hidden.select(tracks=[1]), BIRD, config(), source="birds.json")


def test_missing_frames_have_no_valid_pose(observed):
    confidence = np.ones((T, BIRD.num_keypoints))
    confidence[[0, 3]] = 0
    times_s = np.array([0, 0.1, 0.15, 0.3, 0.4, np.nan])
    gaps = replaced(observed, 0, confidence=confidence).select(tracks=[0])
    result = fit(dataclasses.replace(gaps, timestamp_s=times_s, fps=12.0), BIRD, config())
    np.testing.assert_array_equal(result.timestamp_s, times_s)
    assert result.fps == 12
    assert result.valid[0].tolist() == [False, True, True, False, True, True]
    error_px = np.linalg.norm(result.keypoints.px - keypoints_of(truths()[:1]), axis=-1)
    assert error_px[result.valid].max() < SIZE / 256
    assert np.isnan(result.poses.global_orient[0, [0, 3]]).all()


def test_the_batch_size_does_not_change_the_result(observed, short, compilations):
    """One batch or several batches give the same result, and no program is recompiled."""
    large = config(steps=SHORT, memory_gb=2 * ONE_WINDOW_GB)
    assert [frames_per_batch(BIRD, c) // T for c in (config(), large)] == [1, 2]
    for birds in (2, 3):
        result = fit(observed.select(tracks=slice(birds)), BIRD, large)
        assert_same(result, short, slice(birds))
        for term, loss in result.loss.items():
            np.testing.assert_array_equal(short.loss[term][:birds], loss, err_msg=term)
    assert not [m for m in compilations() if any(name in m for name in ("advance", "begin", "report", "initial"))]


def in_a_large_image(observations, corner=(210, 90), size=(400, 300)):
    """Return the same birds in an image of `size`, shifted by `corner`."""
    masks = {}
    for at in observations.masks:
        full = np.zeros(size[::-1], bool)
        full[corner[1] : corner[1] + SIZE, corner[0] : corner[0] + SIZE] = observations.mask(*at)
        masks[at] = encode_mask(full)
    return dataclasses.replace(
        observations,
        keypoints_px=observations.keypoints_px + np.float32(corner),
        box_px=observations.box_px + np.float32([*corner, 0, 0]),
        image_size_px=np.full((observations.num_frames, 2), size),
        masks=masks,
    )


def test_boxes_in_a_large_image(observed, tmp_path):
    """The results are in image pixels, the mesh covers the mask, and a second fit can start from the result."""
    large = in_a_large_image(observed)
    result = fit(large, BIRD, config(mode="box"))
    assert (result.crops.square_px[..., 2] != SIZE).all(), "the test needs a scaled crop"
    np.testing.assert_array_equal(
        result.crops.image_size_px[result.valid], np.tile([400, 300], (result.valid.sum(), 1))
    )
    assert not result.crops.image_size_px[~result.valid].any()
    error_px = np.linalg.norm(result.keypoints.px - keypoints_of(truths()) - np.array([210, 90]), axis=-1)
    assert error_px.max() < 0.5
    assert evaluate(result, BIRD, large).overall["iou"] > 0.9
    save_solution(result, BIRD, config_to_yaml(config()), {}, tmp_path / "out")
    initial_poses = load_initial_poses(tmp_path / "out" / "poses.npz", large, BIRD)
    again = fit(large, BIRD, config(mode="box", steps=(1, 1)), initial_poses)
    for name in ("global_orient", "body_pose", "transl", "scale"):
        np.testing.assert_allclose(again.arrays()[name], result.arrays()[name], atol=0.05, err_msg=name)
    shifted = config(mode="box", steps=(1, 1))
    shifted = dataclasses.replace(shifted, crop=dataclasses.replace(shifted.crop, padding=0.5))
    with pytest.raises(InputError, match=r"poses\.npz: `crop` of track 0"):
        fit(large, BIRD, shifted, initial_poses)


def test_keypoints_may_have_any_order_but_need_the_names_of_the_model(short, observed):
    order = np.random.default_rng(0).permutation(BIRD.num_keypoints)
    names = tuple(BIRD.keypoint_names[i] for i in order)
    mixed = dataclasses.replace(
        observed,
        keypoint_names=names,
        keypoints_px=observed.keypoints_px[:, :, order],
        confidence=observed.confidence[:, :, order],
    )
    assert_same(fit(mixed, BIRD, config(steps=SHORT)), short, [0, 1, 2])
    other = dataclasses.replace(observed, keypoint_names=("beak", *BIRD.keypoint_names[1:]))
    with pytest.raises(InputError, match=r"birds.*lack bill_tip and have beak"):
        fit(other, BIRD, config(), source="birds")


def test_reported_progress_sums_to_the_total(observed):
    reports = []

    @contextmanager
    def watch(name, total):
        reports.append((name, total))
        yield lambda done, note: reports.append((done, note))

    fit(observed, BIRD, config(steps=(5, 2)), progress=watch)
    poses = int(observed.present.sum())
    second = reports.index(("Measuring", poses))  # the comparison with the masks, for the flags
    third = reports.index(("Comparing keypoints with masks", poses))
    assert reports[0] == ("Fitting 3 birds", 21)
    assert sum(done for done, _ in reports[1:second]) == 21
    assert any(note.startswith("mask: loss ") for _, note in reports[1:second])
    assert sum(done for done, _ in reports[second + 1 : third]) == poses
    assert sum(done for done, _ in reports[third + 1 :]) == poses


def reversed_except(agreeing):
    """Return the first true pose, turned by 180° except in the frames `agreeing`."""
    truth = truths()[0]
    reversed_R = Rotation.from_rotvec([0, 0, np.pi]) * Rotation.from_rotvec(truth.global_orient)
    orient = np.where(np.broadcast_to(agreeing, T)[:, None], truth.global_orient, reversed_R.as_rotvec())
    return dataclasses.replace(truth, global_orient=orient.astype(np.float32))


def fit_from(observed, settings, hypotheses, windows=None):
    """Fit one window from some initial poses."""
    windows = windows or cut_windows(observed, settings)[:1]
    initial_pose = jax.tree.map(lambda *x: np.stack(x)[None], *hypotheses)
    batch = Batch(load_targets(windows, SIZE), initial_pose, *np.zeros((3, 1), int))
    return fit_batch(fit_model(BIRD, settings), [settings], batch, lambda *_: None)


def fit_two_hypotheses(observed, settings, order, windows=None, agreeing=False):
    """Fit one window from the correct initial pose and from a pose that is reversed except in the frames `agreeing`."""
    return fit_from(observed, settings, (truths()[0], reversed_except(agreeing))[::order], windows)


def two_stages(keep_first):
    keypoints_only = config(steps=(30, 5))
    first = dataclasses.replace(keypoints_only.stages[0], keep_best=keep_first)
    second = dataclasses.replace(first, name="on", steps=5, keep_best=False, carry_moments=True)
    return dataclasses.replace(keypoints_only, stages=(first, second))


@pytest.mark.parametrize("after_first", [True, False])
@pytest.mark.parametrize("order", [1, -1])
def test_the_better_hypothesis_is_kept_and_an_almost_equal_one_is_reported(observed, after_first, order):
    """One initial pose is correct, the other is reversed: the fit keeps the correct pose."""
    fitted = fit_two_hypotheses(observed, two_stages(after_first), order)
    assert fitted.pose.global_orient.shape == (1, T, 3)
    assert not any(fitted.failure)
    error_px = np.linalg.norm(fitted.keypoints_px * SIZE / CROP_PX - keypoints_of(truths()[:1]), axis=-1)
    assert error_px.mean() < 0.25
    assert not fitted.ambiguity_deg.any()  # the reversed pose is much less likely
    weak = dataclasses.replace(two_stages(after_first), terms=dict.fromkeys(two_stages(True).terms, 1e-7))
    assert fit_two_hypotheses(observed, weak, order).ambiguity_deg.min() > 150


def test_poses_of_frames_without_the_bird_are_no_second_pose(observed):
    """The hypotheses differ everywhere, but agree in most frames without the bird."""
    settings = two_stages(True)
    weak = dataclasses.replace(settings, terms=dict.fromkeys(settings.terms, 1e-7))
    absent = np.arange(T) >= 2
    windows = cut_windows(observed, weak)[:1]
    windows = dataclasses.replace(windows, present=windows.present & ~absent, has_mask=windows.has_mask & ~absent)
    flipped = fit_two_hypotheses(observed, weak, 1, windows, agreeing=absent)
    assert flipped.ambiguity_deg[0, :2].min() > 150
    assert not flipped.ambiguity_deg[0, 2:].any()
    same = fit_two_hypotheses(observed, weak, 1, windows, agreeing=~absent)
    assert not same.ambiguity_deg.any()


@pytest.mark.extended
def test_the_common_size_is_constant_in_a_window(solution, observed):
    assert (np.ptp(solution.poses.scale, axis=1) == 0).all()
    keypoints_only = dataclasses.replace(config(common_size=False), stages=config(steps=(30, 1)).stages[:1])
    size_per_frame = fit(observed.select(tracks=[0]), BIRD, keypoints_only)
    assert np.ptp(size_per_frame.poses.scale[0]) > 1e-4


def test_the_windows_of_a_long_track_are_independent(long):
    _, result, parts = long
    assert result.valid.all()
    for name in ("global_orient", "keypoints_px", "scale"):
        joined = np.concatenate([part.arrays()[name] for part in parts], axis=1)
        np.testing.assert_array_equal(result.arrays()[name], joined, err_msg=name)
    total = sum(np.asarray(part.loss["keypoints"]) for part in parts)
    np.testing.assert_allclose(result.loss["keypoints"], total, rtol=1e-6)
