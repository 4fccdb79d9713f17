"""Fits of several calibrated cameras against simulated truth."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfit.cameras.files import read_cameras, write_cameras
from jaxfit.cli.main import main
from jaxfit.config.build import with_values
from jaxfit.config.fit import load_config
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.flags import flag_counts
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.solution import load_solution, save_solution
from jaxfit.data.views import Views, birds_in_rows, stacked_keypoints, straightened
from jaxfit.export.export import export_result
from jaxfit.export.result import open_result
from jaxfit.fitting.views import fit_views, initial_poses, views_config, with_unit, without_orientation
from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import rest_length
from jaxfit.model.files import load_murre, save_bird
from jaxfit.model.kinematics import fold_bird, joint_transforms, posed_keypoints, rest_pose
from jaxfit.review.correct import read_tracks
from jaxfit.simulation.rig import stage_rig
from jaxfit.video.reader import VideoInfo
from jaxfit.view.overlay import check_belongs

BIRD = load_murre()
UNIT = BIRD.metres_per_unit
FRAMES = 8
SHORT = {"window": 6, "overlap": 4, "error_bars": True, "crop.size_px": 64, "filter_window": 1}
CONFIG = with_values(load_config("fast"), SHORT)


@pytest.fixture(scope="module")
def rig():
    return stage_rig(BIRD, 3, birds=2, frames=FRAMES, size=(640, 380), seed=3, distorted=True)


def views_of(rig, which, observations):
    """Views of some cameras of the truth, whose track ids agree."""
    pairs = [straightened(rig.cameras[v], own) for v, own in zip(which, observations, strict=True)]
    rows = []
    for _, own in pairs:
        bird = np.where(own.present, np.arange(own.num_tracks)[:, None], -1)
        rows.append(birds_in_rows(own, bird, [1, 2]))
    return Views(tuple(camera for camera, _ in pairs), tuple(rig.cameras[v] for v in which), tuple(rows))


@pytest.fixture(scope="module")
def truth_m(rig):
    """True keypoints in the world, metres."""
    camera = rig.cameras[0]
    return (rig.scenes[0].poses.keypoints.cam.astype(float) * UNIT - camera.transl_cam) @ camera.R_cam_world


@pytest.fixture(scope="module")
def views(rig):
    return views_of(rig, (0, 1, 2), [scene.truth for scene in rig.scenes])


@pytest.fixture(scope="module")
def solution(views):
    return fit_views(views, BIRD, CONFIG)


def error_mm(solution, truth_m):
    error = np.linalg.norm(solution.world.keypoints_world_m - truth_m, axis=-1)
    return 1000 * error[solution.valid].mean()


def test_exact_keypoints_give_the_birds_in_the_world(rig, solution, truth_m):
    assert solution.status.tolist() == ["ok", "ok"]
    assert solution.valid.all()
    assert not solution.flags.doubts.any()  # keypoints and masks of all views support the poses
    assert error_mm(solution, truth_m) < 6  # of a bird of 42 cm
    sizes = solution.poses.scale[:, 0] / rig.scenes[0].poses.poses.scale[:, 0]
    np.testing.assert_allclose(sizes, 1, atol=0.03)
    true_root = (rig.scenes[0].poses.poses.transl * UNIT - rig.cameras[0].transl_cam) @ rig.cameras[0].R_cam_world
    assert np.abs(solution.world.transl_world_m - true_root).max() < 0.015


def test_triangulated_keypoints_are_stored_beside_those_of_the_model(solution, truth_m):
    found = solution.triangulated
    assert np.abs(found.keypoints_triangulated_m - truth_m).max() < 0.0002
    assert found.keypoints_triangulated_sd_m.max() < 0.0002


def test_the_pose_in_the_first_camera_is_the_pose_in_the_world(rig, solution):
    camera = rig.cameras[0]
    np.testing.assert_allclose(
        camera.to_camera(solution.world.keypoints_world_m) / UNIT, solution.keypoints.cam, atol=1e-3
    )
    np.testing.assert_allclose(camera.project(solution.world.keypoints_world_m), solution.keypoints.px, atol=1e-2)
    crop = solution.crops.square_px[0, 0]
    pinhole = camera.pinhole().project(solution.world.keypoints_world_m[0, 0])
    focal = solution.crops.focal_px * crop[2] / solution.crops.crop_px
    points = solution.keypoints.cam[0, 0].astype(float)
    np.testing.assert_allclose(focal * points[:, :2] / points[:, 2:] + crop[:2] + crop[2] / 2, pinhole, atol=1e-2)


def seen_only(observations, present, **changes):
    """Return the observations without the absent birds."""
    return replace(
        observations,
        present=present,
        confidence=np.where(present[..., None], observations.confidence, 0),
        masks={cell: rle for cell, rle in observations.masks.items() if present[cell]},
        occluded=None,
        score=None,
        **changes,
    )


def test_views_that_miss_things_cost_nothing(rig, truth_m):
    """One view without masks and half the keypoints, one without one bird, and frames without views."""
    first, second, third = (scene.truth for scene in rig.scenes)
    confidence = second.confidence.copy()
    confidence[:, :, ::2] = 0
    second = replace(second, masks={}, amodal_masks={}).with_keypoints(second.keypoints_px, confidence)
    present = third.present.copy()
    present[1] = present[0, :3] = False
    found = fit_views(views_of(rig, (0, 1, 2), [first, second, seen_only(third, present)]), BIRD, CONFIG)
    assert found.valid.all()
    assert error_mm(found, truth_m) < 12


def test_a_bird_that_one_camera_sees_has_no_pose(rig):
    first, second, third = (scene.truth for scene in rig.scenes)
    one, none = np.array([[True], [False]]) & second.present, np.zeros_like(third.present)
    views = views_of(rig, (0, 1, 2), [first, seen_only(second, one, amodal_masks={}), seen_only(third, none)])
    quick = replace(CONFIG, stages=(replace(CONFIG.stages[0], steps=2),), error_bars=False)
    found = fit_views(views, BIRD, quick)
    assert found.valid[0].all()
    assert not found.valid[1].any()
    assert found.status.tolist() == ["ok", "no usable frame"]
    assert np.isfinite(found.triangulated.keypoints_triangulated_m[0]).all()
    assert np.isnan(found.triangulated.keypoints_triangulated_m[1]).all()
    assert np.isnan(found.triangulated.keypoints_triangulated_sd_m[1]).all()
    assert found.failures == {2: ("not fitted: no frame has 4 keypoints that two cameras agree on",)}
    with pytest.raises(InputError, match="have no bird with 21 keypoints in two cameras"):
        fit_views(views, BIRD, replace(quick, min_keypoints=21))


def test_a_bird_whose_keypoints_lie_on_a_line_is_named(rig, views, truth_m, caplog):
    points = truth_m / UNIT
    points[1] = np.linspace(0, 9, points.shape[2])[:, None]
    initial = initial_poses(BIRD, points, np.ones(points.shape[:3]), "truth")
    has_pose = np.isfinite(initial.global_orient).all(-1)
    texts = without_orientation(views.observations[0], points, has_pose)
    reason = f"in {FRAMES} frames, the keypoints are too close to a line, so its orientation is unknown"
    assert texts == {2: (f"not fitted: {reason}",)}
    assert caplog.messages == [f"bird 2 is not fitted: {reason}"]


def test_one_view_is_the_fit_of_one_camera(rig, truth_m, monkeypatch):
    """The poses are those of `fit`, here the true poses; in the world, every bird has the size of the model."""
    views, true = views_of(rig, (1,), [rig.scenes[1].truth]), rig.scenes[1].poses
    monkeypatch.setattr(
        "jaxfit.fitting.views.fit", lambda observed, *_, **__: observed is views.observations[0] and true
    )
    monkeypatch.setattr("jaxfit.fitting.views.check_observations", lambda observed, *_: observed)
    found = fit_views(views, BIRD, CONFIG)
    for name in ("global_orient", "transl", "scale", "keypoints_px", "crop"):
        np.testing.assert_array_equal(found.arrays()[name], true.arrays()[name])
    # one view does not know the size of a bird: 10 % of a distance of 5 m
    assert error_mm(found, truth_m) < 500
    shown = rig.cameras[1].pinhole().project(found.world.keypoints_world_m)
    shift = views.cameras[0].matrix[:2, 2] - rig.cameras[1].matrix[:2, 2]
    assert np.abs(shown + shift - found.keypoints.px)[found.valid].max() < 4


def test_the_film_of_another_camera_is_refused_with_the_option_that_helps(solution):
    with pytest.raises(InputError, match=r"is not the video of the result: .*\(--camera of overlay and view\)"):
        check_belongs(solution, None, Path("cam1.mp4"), VideoInfo(FRAMES, 25, (99, 60)))


def test_exports_hold_the_world_and_the_true_size(solution, rig, tmp_path):
    facts = {"model": "murre"}
    save_solution(solution, BIRD, config_to_yaml(CONFIG), facts, tmp_path / "result")
    exported = open_result(tmp_path / "result", tracks=[2])
    np.testing.assert_array_equal(exported.solution.world.transl_world_m, solution.world.transl_world_m[1:])
    # the camera frame of the export is that of the first camera, in metres
    expected = rig.cameras[0].to_camera(solution.world.keypoints_world_m[1:])
    np.testing.assert_allclose(exported.keypoints_3d, expected, atol=1e-3)
    export_result(tmp_path / "result", "csv", tmp_path / "birds.csv")
    with (tmp_path / "birds.csv").open() as file:
        first = next(csv.DictReader(file))
    world = [float(first[f"root_{axis}_world_m"]) for axis in "xyz"]
    np.testing.assert_allclose(world, solution.world.transl_world_m[0, 0], atol=1e-9)
    with pytest.raises(InputError, match="is in a world, where tracks cannot be corrected"):
        read_tracks(tmp_path / "result")


def test_a_wrong_unit_is_reported(views):
    far = views._replace(
        cameras=tuple(camera.scaled(1000) for camera in views.cameras),
        lenses=tuple(camera.scaled(1000) for camera in views.lenses),
    )
    with pytest.raises(InputError, match=r"show birds of .* the size of the model .*--unit"):
        fit_views(far, BIRD, CONFIG)


def test_cameras_measure_the_unit_of_a_model(rig):
    views = views_of(rig, (0, 1, 2), [scene.truth for scene in rig.scenes])
    without = replace(BIRD, metres_per_unit=None)
    truth_m = UNIT * np.median(rig.scenes[0].poses.poses.scale[:, 0])
    assert with_unit(views, without).metres_per_unit == pytest.approx(truth_m, rel=0.05)
    assert with_unit(views, BIRD).metres_per_unit == UNIT
    with pytest.raises(InputError, match=r"has no unit of length.*--length-cm"):
        fit_views(views, without, CONFIG)
    with pytest.raises(InputError, match=r"has no unit of length.*--length-cm"):
        with_unit(Views(*(part[:1] for part in views)), without)
    with pytest.raises(InputError, match=r"show birds of .* m .*--unit"):
        with_unit(views._replace(cameras=tuple(camera.scaled(1000) for camera in views.cameras)), without)


def test_initial_poses_align_the_bird_with_triangulated_keypoints(rig, views, truth_m):
    found = stacked_keypoints(views.observations).triangulated(views.cameras)
    both = np.isfinite(found.points_world).all(-1)
    assert both.mean() > 0.7
    assert np.abs(found.points_world - truth_m)[both].max() < 0.002
    points = found.points_world / UNIT
    initial = initial_poses(BIRD, points, both.astype(float), "truth")
    true_scale = rig.scenes[0].poses.poses.scale[:, 0]
    np.testing.assert_allclose(initial.scale[:, 0] / true_scale, 1, atol=0.1)
    nothing = np.zeros(both.shape)
    with pytest.raises(InputError, match="have no frame with 4 keypoints"):
        initial_poses(BIRD, points, nothing, "truth")


def random_turns(count, seed=4):
    return Rotation.random(count, random_state=seed).as_matrix()


@pytest.mark.parametrize("z", [-3, 0, 2.5])
def test_birds_with_spread_wings_start_from_spread_wings(z):
    """Bodies along the third axis of the pose prior, the spread of the wings, in any orientation."""
    variance, axes = np.linalg.eigh(np.asarray(BIRD.pose_covariance, float))
    rig, rest = fold_bird(BIRD), rest_pose(BIRD)
    turned = z * np.sqrt(variance[-3]) * axes[:, -3].reshape(rest.body_pose.shape)
    pose = replace(rest, body_pose=jnp.asarray(rest.body_pose + turned, jnp.float32))
    shape = np.asarray(posed_keypoints(rig, joint_transforms(rig, pose), pose), float)
    R = random_turns(5)
    points = 1.1 * shape @ R.swapaxes(1, 2) + np.array([3.0, -2, 9])
    initial = initial_poses(BIRD, points[None], np.ones((1, 5, BIRD.num_keypoints)), "truth")
    found = Rotation.from_rotvec(initial.global_orient[0]).as_matrix()
    angle_deg = np.degrees(Rotation.from_matrix(found @ R.swapaxes(1, 2)).magnitude())
    assert angle_deg.max() < 5
    np.testing.assert_allclose(initial.scale, 1.1, rtol=0.05)  # postures have steps
    assert np.abs(initial.body_pose[0] - pose.body_pose).max() < 0.6 * np.sqrt(variance[-3])


def test_frames_with_unsure_keypoints_start_from_the_posture_of_their_neighbours():
    variance, axes = np.linalg.eigh(np.asarray(BIRD.pose_covariance, float))
    rig, rest = fold_bird(BIRD), rest_pose(BIRD)
    spread = np.asarray(rest.body_pose - 3 * np.sqrt(variance[-3]) * axes[:, -3].reshape(rest.body_pose.shape))
    pose = replace(rest, body_pose=jnp.asarray(spread, jnp.float32))
    shape = np.asarray(posed_keypoints(rig, joint_transforms(rig, pose), pose), float)
    weight = np.ones((1, 5, BIRD.num_keypoints))
    weight[:, 2] = 0.05
    initial = initial_poses(BIRD, np.broadcast_to(shape, (1, 5, *shape.shape)), weight, "truth")
    np.testing.assert_allclose(initial.body_pose[0], np.broadcast_to(spread, (5, *spread.shape)), atol=1e-4)


def test_slender_birds_have_an_orientation():
    """Keypoints along the back of a bird are no line; on a line, they have no orientation."""
    R = random_turns(5)
    thin = np.zeros((1, 5, BIRD.num_keypoints))
    thin[..., [BIRD.keypoint_names.index(name) for name in ("bill_tip", "crown", "back", "tail_tip", "breast")]] = 1
    rig, rest = fold_bird(BIRD), rest_pose(BIRD)
    shape = np.asarray(posed_keypoints(rig, joint_transforms(rig, rest), rest), float)
    initial = initial_poses(BIRD, (shape @ R.swapaxes(1, 2))[None], thin, "truth")
    found = Rotation.from_rotvec(initial.global_orient[0]).as_matrix()
    assert np.degrees(Rotation.from_matrix(found @ R.swapaxes(1, 2)).magnitude()).max() < 1


def test_several_views_learn_offsets_where_these_have_a_prior():
    config = load_config("map")
    assert views_config(config, has_masks=True).learns_offsets
    assert not config.learns_offsets
    without = [
        replace(stage, terms=tuple(name for name in stage.terms if name != "shape_prior")) for stage in config.stages
    ]
    for own in (replace(config, stages=tuple(without)), replace(config, learn_weights=())):
        assert views_config(own, has_masks=True).learn_weights == own.learn_weights


def test_views_config_estimates_depth_and_size():
    for name in ("paper", "fast", "map", "photo"):
        config = views_config(load_config(name), has_masks=True)
        for stage in config.stages:
            assert {"transl", "scale"} <= set(stage.optimised)
            assert "transl" not in stage.step_scale
            assert "size_prior" in stage.terms
        assert config.edge == "unbiased"
    assert all("mask" not in stage.terms for stage in views_config(load_config("paper"), has_masks=False).stages)


def test_the_command_fits_all_views(rig, tmp_path, capsys, truth_m):
    write_cameras(rig.cameras, tmp_path / "rig.toml")
    files = []
    for camera, scene in zip(rig.cameras, rig.scenes, strict=True):
        files.append(str(tmp_path / f"{camera.name}.json"))
        write_coco(scene.detections, files[-1])
    config = tmp_path / "quick.yaml"
    config.write_text("base: fast\nwindow: 6\noverlap: 4\nfilter_window: 1\ncrop: {size_px: 64}\n")
    out = tmp_path / "result"
    save_bird(replace(BIRD, metres_per_unit=None), tmp_path / "model.npz")
    command = ["fit", *files, "--config", str(config), "--model", str(tmp_path / "model.npz"), "--out", str(out)]
    assert main([*command, "--cameras", str(tmp_path / "rig.toml")]) == 0
    printed = capsys.readouterr().out
    assert "16 poses of 2 birds in 3 views" in printed
    assert re.search(r"poses: [\d.]+ % ok, [\d.]+ % unsure, [\d.]+ % contradicted", printed)
    solution, summary = load_solution(out)[0], json.loads((out / "summary.json").read_text())
    assert summary["flags"] == flag_counts(solution.flags.doubts)
    assert sum(summary["flags"].values()) == 16
    true_cm = 100 * UNIT * rest_length(BIRD)
    assert summary["measured_length_cm"] == pytest.approx(true_cm, rel=0.05)
    assert main(["report", str(out)]) == 0
    length = f"{summary['measured_length_cm']:.1f} cm from bill to tail, measured by the cameras"
    assert length in (out / "report.html").read_text()
    assert f"bill to tail {summary['measured_length_cm']:.1f} cm" in printed
    assert solution.world is not None
    order = np.linalg.norm(solution.world.transl_world_m[:, None, 0] - truth_m[None, :, 0].mean(-2), axis=-1).argmin(1)
    assert error_mm(solution, truth_m[order]) < 15
    assert [camera.name for camera in read_cameras(out / "cameras.toml")] == ["cam0", "cam1", "cam2"]
    assert main([*command[:-1], str(tmp_path / "x")]) == 2
    assert "without --cameras" in capsys.readouterr().err
    assert main([*command[:2], "--out", str(tmp_path / "x"), "--offsets", "1"]) == 2
    assert main([*command, "--cameras", str(tmp_path / "rig.toml"), "--overwrite", "--offsets", "1,2"]) == 2
    assert "give 3 numbers" in capsys.readouterr().err
    assert main([*command, "--cameras", str(tmp_path / "rig.toml"), "--overwrite", "--offsets", "1,0,0"]) == 2
    assert "begin with 0" in capsys.readouterr().err
    check = ["cameras", "check", str(tmp_path / "rig.toml"), *files]
    assert main(check) == 0
    assert "the cameras agree" in capsys.readouterr().out


def test_windows_that_share_frames_are_blended_and_have_error_bars(solution, truth_m):
    assert CONFIG.window < FRAMES
    step_mm = 1000 * np.abs(np.diff(solution.world.keypoints_world_m - truth_m, axis=1)).max()
    assert step_mm < 15  # windows do not jump
    sd_mm = 1000 * UNIT * np.sqrt(solution.error_bars.keypoints_cam_cov.trace(axis1=-2, axis2=-1))
    assert 0.5 < np.median(sd_mm) < 12
    assert (solution.error_bars.scale_sd > 0).all()  # several cameras know the size, up to an error
    assert solution.error_bars.keypoints_px_cov.shape == (2, FRAMES, BIRD.num_keypoints, 2, 2)
    assert np.linalg.eigvalsh(solution.error_bars.keypoints_cam_cov).min() > 0
