"""The worlds: true poses have no error, known errors are measured, and worse configs are named."""

import dataclasses
import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.birds import error_bars, toy_bird

from jaxfit.data.observations import Observations
from jaxfit.evaluation.bootstrap import BirdSums
from jaxfit.evaluation.metrics import distances, procrustes_align
from jaxfit.foundation.errors import InputError

FOLDER = Path(__file__).parent


@pytest.fixture(scope="module", autouse=True)
def _scripts_can_be_imported():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        yield


@pytest.fixture(scope="module")
def scenes():
    return importlib.import_module("world_scenes")


@pytest.fixture(scope="module")
def worlds():
    return importlib.import_module("worlds")


@pytest.fixture(scope="module")
def window(scenes):
    return scenes.windows_of(toy_bird(), (3, 1), 2, 4, scenes._gaussian_errors)


@pytest.fixture(scope="module")
def pictures(scenes):
    return scenes.pictures_of(toy_bird(), 1, range(2), 2)


@pytest.fixture(scope="module")
def individuals(scenes):
    return scenes.windows_of(toy_bird(), (3, 1), 2, 4, scenes._gaussian_errors, scenes._individual)


@pytest.mark.parametrize("name", ["window", "individuals", "pictures"])
def test_true_poses_have_no_error(name, worlds, request):
    scene = request.getfixturevalue(name)
    sums, missing = worlds.measure(scene.poses, scene, name == "pictures")
    values = sums.values()
    assert missing == 0
    assert values["iou"] == pytest.approx(1, abs=1e-3)
    for metric in ("me_p", "aligned", "mpjpe/length", "size_error", "bone_error"):
        assert values[metric] == pytest.approx(0, abs=1e-4), metric


def test_known_errors_are_measured(window, worlds):
    poses = window.poses
    moved = poses.keypoints.cam.copy()
    bill = poses.keypoint_names.index("bill_tip")
    moved[:, :, bill] += [0, 0, 1.2]
    wrong = poses.with_arrays(keypoints_cam=moved, scale=1.1 * poses.poses.scale)
    values = worlds.measure(wrong, window, False)[0].values()
    # the mean over 12 keypoints of one error of 1.2 is 0.1; alignment distributes the error over all keypoints
    assert values["aligned"] == pytest.approx(
        distances(procrustes_align(moved, poses.keypoints.cam), poses.keypoints.cam).mean()
    )
    assert 0.05 < values["aligned"] < 0.25
    assert values["size_bias"] == pytest.approx(0.1, abs=0.01)
    length = np.linalg.norm(np.subtract((0, 9, 2.8), (0, -7.9, 0))) * poses.poses.scale.mean()
    assert values["aligned"] / values["aligned/length"] == pytest.approx(length, rel=0.03)


def test_a_fit_with_another_model(scenes, worlds):
    """A model of other proportions, but the same pose, has errors; the true model has none."""
    names = ("bill_tip", "left_wingtip", "right_wingtip", "tail_tip", "nape")
    true = scenes.with_keypoints(toy_bird(), names)
    assert true.keypoint_pairs == ((1, 2),)
    np.testing.assert_allclose(true.keypoints[0], toy_bird().keypoints[toy_bird().keypoint_names.index("bill_tip")])
    scene = scenes.windows_of(true, (8, 1), 2, 4, scenes._gaussian_errors)
    stretched = replace(
        true, joints=true.joints * np.float32([1, 1.3, 1]), vertices=true.vertices * np.float32([1, 1.3, 1])
    )
    other = replace(scene, bird=stretched, true_bird=true)
    values = worlds.measure(scene.poses, replace(scene, true_bird=true), False)[0].values()
    assert values["bone_error"] == pytest.approx(0, abs=1e-6)
    assert values["size_error"] == pytest.approx(0, abs=1e-6)
    values = worlds.measure(scene.poses, other, False)[0].values()
    assert values["aligned"] == pytest.approx(0, abs=1e-4)  # the keypoints of the result are the true ones
    assert 0.02 < values["bone_error"] < 0.3
    assert 0.2 < values["size_bias"] < 0.3  # the rest length is mainly along the body


def test_bones_and_coverage_are_measured(individuals, worlds):
    poses, rng = individuals.poses, np.random.default_rng(0)
    assert np.isnan(worlds.measure(poses, individuals, False)[0].values()["in_0.68"])
    mean = poses.with_arrays(bone_length=np.ones_like(poses.poses.bone_length))
    values = worlds.measure(mean, individuals, False)[0].values()
    assert 0.02 < values["bone_error"] < 0.07
    assert values["bone_error"] == pytest.approx(values["bone_error_mean_bird"])
    error = 0.1 * rng.standard_normal(poses.keypoints.cam.shape)
    error -= error.mean(2, keepdims=True)
    K = error.shape[2]
    covariance = 0.1**2 * (1 - 1 / K) * np.eye(3)
    moved = poses.keypoints.cam + error
    bars = error_bars(poses, keypoints_centred_cov=covariance, misfit=1.0)
    sums = worlds.measure(poses.with_arrays(keypoints_cam=moved, **bars), individuals, False)[0]
    spread = 3 * np.sqrt(0.68 * 0.32 / error[..., 0].size)
    assert sums.value("in_0.68") == pytest.approx(0.68, abs=spread)
    assert sums.value("in_0.95") == pytest.approx(0.95, abs=spread)
    wider = error_bars(poses, keypoints_centred_cov=9 * covariance, misfit=1.0)
    assert (
        worlds.measure(poses.with_arrays(keypoints_cam=moved, **wider), individuals, False)[0].value("in_0.68") > 0.97
    )


def test_several_cameras_tell_place_and_size(window, worlds):
    poses, scene = window.poses, replace(window, views=object())
    values = worlds.measure(poses, scene, False)[0].values()
    assert values["placed/length"] == pytest.approx(0, abs=1e-6)
    length = np.linalg.norm(np.subtract((0, 9, 2.8), (0, -7.9, 0))) * poses.poses.scale[:, :1, None, None]
    moved = poses.keypoints.cam + np.array([0, 0, 0.1]) * length
    values = worlds.measure(poses.with_arrays(keypoints_cam=moved, scale=1.1 * poses.poses.scale), scene, False)[
        0
    ].values()
    assert values["placed/length"] == pytest.approx(0.1, rel=0.03)  # the vertices of the keypoints lie a little beside
    assert values["mpjpe/length"] == pytest.approx(0, abs=1e-6)
    assert values["size_error"] == pytest.approx(0.1)  # although the place along the axis of the camera has changed


def test_rotation_and_size_are_no_aligned_error(window, worlds):
    turn = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    centre = window.poses.keypoints.cam.mean(2, keepdims=True)
    turned = 1.2 * (window.poses.keypoints.cam - centre) @ turn.T + centre
    values = worlds.measure(window.poses.with_arrays(keypoints_cam=turned), window, False)[0].values()
    assert values["aligned"] == pytest.approx(0, abs=1e-4)
    assert values["mpjpe/length"] > 0.02
    valid = window.poses.valid.copy()
    valid[0, 1] = False
    assert worlds.measure(replace(window.poses, valid=valid), window, False)[1] == 1  # an image without a pose


def test_annotators_keypoints_are_constant_and_near(scenes):
    bird = toy_bird()
    first, second = (scenes.draw_offsets(bird, np.random.default_rng(seed)) for seed in (1, 1))
    np.testing.assert_array_equal(first, second)
    share = np.linalg.norm(first, axis=1) / np.linalg.norm(np.subtract((0, 9, 2.8), (0, -7.9, 0)))
    assert (share > 0.009).all()
    assert (share < 0.031).all()
    for left, right in bird.keypoint_pairs:
        np.testing.assert_allclose(first[left], first[right] * [-1, 1, 1])


def test_grown_masks_include_pixels_near_the_bird(scenes):
    """A rectangle from (10.3, 20.1) to (30.2, 25.7): pixels with centres within 0.7 px are inside, but for corners."""
    corners = np.float32([[10.3, 20.1, 5], [30.2, 20.1, 5], [30.2, 25.7, 5], [10.3, 25.7, 5]])
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5)
    outside = np.hypot(np.maximum(np.maximum(10.3 - x, x - 30.2), 0), np.maximum(np.maximum(20.1 - y, y - 25.7), 0))
    for px in (0.44, 0.7):
        mask = scenes.grown_mask(corners, np.array([[0, 1, 2], [0, 2, 3]]), 64, px)
        assert mask[outside < px - 0.15].all()
        assert not mask[outside > px + 0.15].any()
    assert scenes.grown_mask(corners - [10, 0, 0], np.array([[0, 1, 2], [0, 2, 3]]), 64, 0.7)[22, 0]


def test_errors_of_world_7_are_correlated_and_grow_with_speed(scenes):
    rng, still = np.random.default_rng(0), np.zeros((2, 2000, 40, 2))
    fast = still + 20.0 * (np.arange(2000) % 2)[:, None, None] * [1, 0]  # 20 px a frame
    for points, sd in ((still, 3.0), (fast, np.hypot(3.0, 0.15 * 20))):
        exact = Observations(
            track_id=np.arange(2),
            frame_index=np.arange(2000),
            present=np.ones((2, 2000), bool),
            keypoints_px=points,
            confidence=np.ones((2, 2000, 40)),
            box_px=np.ones((2, 2000, 4)),
            image_size_px=np.full((2000, 2), 512),
            file_name=np.arange(2000).astype(str),
            keypoint_names=tuple(f"k{k}" for k in range(40)),
        )
        error = scenes._correlated_errors(rng, exact).keypoints_px[:, :-1] - points[:, :-1]
        near = (np.abs(error) < 4 * sd).all(-1)
        assert error[near].std() == pytest.approx(sd, rel=0.05)
        both = near[:, 1:] & near[:, :-1]
        assert np.corrcoef(error[:, 1:][both].ravel(), error[:, :-1][both].ravel())[0, 1] == pytest.approx(
            0.7, abs=0.05
        )
        # an outlier has both components from N(0, 30 px): beyond 60 px with probability exp(−2)
        far = np.linalg.norm(error, axis=-1) > 60
        assert far.mean() == pytest.approx(0.05 * np.exp(-2), rel=0.1)


def test_individuals_have_bodies_of_their_own_in_the_same_motion(scenes):
    equal, own = (
        scenes.windows_of(toy_bird(), (3, 1), 2, 4, scenes._gaussian_errors, draw)
        for draw in (scenes._mean_body, scenes._individual)
    )
    np.testing.assert_array_equal(own.poses.poses.global_orient, equal.poses.poses.global_orient)
    np.testing.assert_array_equal(own.poses.poses.scale, equal.poses.poses.scale)
    np.testing.assert_array_equal(equal.poses.poses.bone_length, 1)
    bones = own.poses.poses.bone_length
    assert (bones == bones[:, :1]).all()
    assert 0.01 < (bones[0, 0] - bones[1, 0]).std() < 0.2
    assert np.abs(own.poses.poses.betas).min() > 0


def _line(worlds, name, factor):
    squares = tuple(factor * value for value in (1.0, 2.0, 1.5, 1.2, 0.9))
    counts = (10,) * 5
    birds = tuple("abcde")
    return worlds.Line(name, BirdSums(birds, {"me_p": squares, "iou": counts}, {"me_p": counts, "iou": counts}), 1.0, 0)


def test_worse_configs_are_named(worlds):
    lines = [_line(worlds, name, factor) for name, factor in (("paper", 1.0), ("worse", 1.21), ("better", 0.8))]
    (text,) = worlds.verdict(lines, "paper")
    assert "worse" in text
    assert "1.100" in text
    assert "better" not in text
    assert worlds.verdict([lines[0], lines[2]], "paper")[0].startswith("no config")
    assert "not among" in worlds.verdict(lines[1:], "paper")[0]


def test_seeds_of_tuning_and_report_do_not_mix(worlds, capsys):
    assert worlds.main(["--configs", "paper", "--seeds", "200", "500"]) == 2
    assert "use two calls" in capsys.readouterr().err
    assert "do not tune" in worlds.check_seeds([500])
    assert worlds.check_seeds([499]) is None


def test_words_change_a_config(worlds):
    named = worlds.read_named_config("map terms.pose_prior=0.8 unknown_pixels=false")
    assert named.config.terms["pose_prior"] == 0.8
    assert named.config.unknown_pixels is False
    assert named.key != worlds.read_named_config("map").key
    with pytest.raises(InputError, match="pose_priorr"):
        worlds.read_named_config("map terms.pose_priorr=0.8")


def test_stored_runs_are_not_repeated(worlds, tmp_path, monkeypatch, capsys):
    runs = []

    def run(scenes, config, pictures, compiled):
        runs.append(config.name)
        sums = dataclasses.asdict(_line(worlds, config.name, 1.0 if config.name == "paper" else 1.21).sums)
        return [{"part": "", "sums": sums, "seconds": 1.0, "missing": 0}]

    monkeypatch.setattr(worlds, "run", run)
    monkeypatch.setattr(worlds, "WORLDS", {1: worlds.WORLDS[1]._replace(draw=lambda seed, quick, equal: ["scene"])})
    path = tmp_path / "runs.json"
    paper, fast = worlds.read_named_config("paper"), worlds.read_named_config("fast")
    worlds.compare([paper], [1], [200], False, path)
    capsys.readouterr()
    worlds.compare([paper, fast], [1], [200, 201], False, path)
    assert runs == ["paper", "fast", "paper", "fast"]
    shown = capsys.readouterr().out
    for words in ("seeds 200, 201; 10 birds", "1.100 (1.10…1.10)*", "WORSE than paper: fast in me_p × 1.100"):
        assert words in shown
    monkeypatch.setattr(worlds, "code_hash", lambda: "other code")
    worlds.compare([paper], [1], [200], False, path)
    assert len(runs) == 5
