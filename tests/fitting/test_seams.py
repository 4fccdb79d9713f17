"""Windows that share frames, and the poses at their seams."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from support.corrected import BIRD, CONFIG, observations
from support.fits import config

from jaxfit.config.checks import ConfigKeyError
from jaxfit.data.solution import LAYOUT, save_solution
from jaxfit.fitting.collect import FittedWindow, _keypoints, blend_seams, collect_windows, shared_frames
from jaxfit.fitting.fit import fit
from jaxfit.fitting.initial_poses import load_initial_poses
from jaxfit.fitting.solve import fit_model
from jaxfit.fitting.windows import cut_windows
from jaxfit.foundation.errors import InputError
from jaxfit.model.camera import crop_to_image
from jaxfit.model.kinematics import Pose
from jaxfit.review.correct import refit
from jaxfit.review.edits import Edit, apply_edits
from jaxfit.simulation.flock import smooth_motion

SHARED = dataclasses.replace(CONFIG, overlap=2)
MODEL = fit_model(BIRD, CONFIG)
CELLS = [name for name, (shape, _) in LAYOUT.items() if shape.startswith("N T")]


def test_windows_share_frames():
    """A window begins where the window before has `overlap` frames left, and exists only for new frames."""
    windows = cut_windows(observations(), SHARED)
    assert windows.track.tolist() == [0] * 4 + [1] * 4 + [2] * 3
    assert windows.frame[:4, 0].tolist() == [0, 4, 8, 12]
    assert windows.frame[3].tolist() == [12, 13, 14, 15, 16, -1]
    assert windows.frame[10].tolist() == [8, 9, 10, 11, -1, -1]  # the track ends at 11
    assert [each.tolist() for each in shared_frames(windows, 1)] == [[4, 5], [0, 1]]
    assert [len(each) for w in (0, 4) for each in shared_frames(windows, w)] == [0] * 4
    no_new_frame = observations().select(frames=slice(0, 6))
    assert cut_windows(no_new_frame, SHARED).track.tolist() == [0, 1, 2]


def test_the_overlap_is_at_most_half_of_the_window():
    half = cut_windows(observations(), dataclasses.replace(CONFIG, overlap=20))
    assert half.frame[:5, 0].tolist() == [0, 3, 6, 9, 12]  # windows of 6 frames
    assert config(window=1, overlap=20).overlap_frames == 0
    with pytest.raises(ConfigKeyError, match="expected 0 or more"):
        dataclasses.replace(CONFIG, overlap=-1)


def windows_of_two():
    """Two windows of one track with frames 0 to 5 and 4 to 9; their crops have the same centres and other sizes."""
    windows = cut_windows(observations().select(tracks=[0], frames=slice(0, 10)), SHARED)
    crop = np.array(windows.crop)
    centre = np.stack([40 + np.arange(10), 50 - np.arange(10)], axis=1)
    for w, size in enumerate((80.0, 100.0)):
        crop[w] = np.concatenate([centre[windows.frame[w]] - size / 2, np.full((6, 1), size)], axis=1)
    return dataclasses.replace(windows, crop=crop)


def result_of(pose, failure=""):
    pose = Pose(**{name: np.asarray(value, np.float32) for name, value in vars(pose).items()})
    points_cam, points_px = (np.asarray(each) for each in _keypoints(MODEL.rig, MODEL.camera, pose))
    return FittedWindow(
        pose, {"keypoints": 1.0}, points_cam, points_px, failure, np.zeros(len(pose.transl), np.float32)
    )


def two_results(turn=None):
    """The same motion in both windows; the root of the second window is turned by `turn`."""
    motion = smooth_motion(BIRD, 10, 0)
    root = np.asarray(MODEL.rig.joints)[0]

    def part(frames, size):
        take = {name: np.asarray(getattr(motion, name))[frames] for name in ("global_orient", "body_pose")}
        scale = np.broadcast_to(motion.scale, 10)[frames]
        root_cam = np.asarray(motion.transl)[frames] + scale[:, None] * root
        root_cam[:, :2] *= 80 / size  # the bird is smaller in a larger crop
        scale = scale * 80 / size
        take |= {"transl": root_cam - scale[:, None] * root, "scale": scale}
        return Pose(**take, bone_length=motion.bone_length, betas=motion.betas)

    second = part(slice(4, 10), 100.0)
    if turn is not None:
        R = Rotation.from_rotvec(second.global_orient) * Rotation.from_rotvec(turn)
        second = dataclasses.replace(second, global_orient=R.as_rotvec())
    return [result_of(part(slice(0, 6), 80.0)), result_of(second)]


def image_px(windows, results, w):
    return crop_to_image(results[w].keypoints_px, windows.crop[w])


def test_windows_that_agree_do_not_change():
    """The crops differ, but not the bird in the image: the conversion between crops has no error."""
    windows, results = windows_of_two(), two_results()
    before = image_px(windows, results, 0)[4:]
    np.testing.assert_allclose(image_px(windows, results, 1)[:2], before, atol=0.3)  # perspective of another crop
    blended = blend_seams(windows, results, MODEL)
    np.testing.assert_allclose(image_px(windows, blended, 1), image_px(windows, results, 1), atol=1e-3)
    np.testing.assert_allclose(blended[1].pose.body_pose, results[1].pose.body_pose, atol=1e-5)
    assert blended[0] is results[0]


def test_rotations_follow_the_shortest_path():
    windows, turn = windows_of_two(), np.array([0.3, -0.6, 0.2])
    results = two_results(turn)
    blended = blend_seams(windows, results, MODEL)
    np.testing.assert_array_equal(blended[1].pose.global_orient[2:], results[1].pose.global_orient[2:])
    for t, weight in ((0, 1 / 3), (1, 2 / 3)):
        ends = Rotation.from_rotvec([results[0].pose.global_orient[4 + t], results[1].pose.global_orient[t]])
        expected = Slerp([0, 1], ends)(weight)
        own = Rotation.from_rotvec(blended[1].pose.global_orient[t])
        assert (expected.inv() * own).magnitude() < 1e-5
    expected = _keypoints(MODEL.rig, MODEL.camera, blended[1].pose)[0]
    np.testing.assert_allclose(blended[1].keypoints_cam, expected, atol=1e-5)


def test_position_and_size_pass_from_window_to_window():
    windows, results = windows_of_two(), two_results()
    pose = results[1].pose
    moved = dataclasses.replace(pose, transl=pose.transl + np.float32([0.3, 0, 0]), scale=pose.scale * 1.21)
    blended = blend_seams(windows, [results[0], result_of(moved)], MODEL)[1].pose
    np.testing.assert_allclose(blended.scale[:2] / pose.scale[:2], [1.21 ** (1 / 3), 1.21 ** (2 / 3)], rtol=1e-4)
    np.testing.assert_array_equal(blended.scale[2:], moved.scale[2:])
    root = np.asarray(MODEL.rig.joints)[0]
    at = [each.transl[:2] + each.scale[:2, None] * root for each in (pose, moved, blended)]
    between = (at[2] - at[0])[:, 0] / (at[1] - at[0])[:, 0]
    np.testing.assert_allclose(between, [1 / 3, 2 / 3], atol=0.02)


def test_a_flipped_window_is_not_blended():
    windows, results = windows_of_two(), two_results(np.array([0, 0, 3.0]))
    pose = blend_seams(windows, results, MODEL)[1].pose.global_orient
    angles = [
        (Rotation.from_rotvec(pose[t]).inv() * Rotation.from_rotvec(other)).magnitude()
        for t, other in ((0, results[0].pose.global_orient[4]), (1, results[1].pose.global_orient[1]))
    ]
    assert max(angles) < 1e-4


@pytest.mark.parametrize("failed", [0, 1])
def test_a_window_that_diverged_has_no_part_in_a_seam(failed):
    """The shared frames have the poses of the other window."""
    windows, results = windows_of_two(), two_results(np.array([0.3, 0, 0]))
    results[failed] = results[failed]._replace(failure="diverged")
    blended = blend_seams(windows, results, MODEL)
    assert blended == results
    observed = observations().select(tracks=[0], frames=slice(0, 10))
    solution = collect_windows(observed, windows, blended, BIRD, MODEL.camera, False, {})
    assert solution.valid[0].tolist() == [failed == 1 or t >= 4 for t in range(6)] + [failed == 0] * 4
    good = results[1 - failed].pose.global_orient
    shared = good[:2] if failed == 0 else good[4:]
    np.testing.assert_array_equal(solution.poses.global_orient[0, 4:6], shared)


@pytest.mark.extended
def test_a_fit_with_shared_frames_and_its_corrections(tmp_path):
    """Every frame has a pose; a correction gives the poses of a fit of all corrected observations."""
    observed = observations()
    whole = fit(observed, BIRD, SHARED)
    assert (whole.valid == observed.present).all()
    assert set(whole.status) == {"ok"}
    save_solution(whole, BIRD, "", {}, tmp_path / "result")
    poses = load_initial_poses(tmp_path / "result" / "poses.npz", observed, BIRD)
    with pytest.raises(InputError, match=r"poses\.npz: holds one crop for every frame.*set `overlap: 0`"):
        fit(observed, BIRD, SHARED, poses)
    corrected = apply_edits(observed, [Edit("swap", (2, 4), 112)], "observations")
    again = refit(whole, observed, corrected, BIRD, SHARED)
    assert {track for track, _, _ in again.fitted} == {2, 4}
    expected = fit(corrected, BIRD, SHARED)
    for name in CELLS:
        np.testing.assert_array_equal(again.solution.arrays()[name], expected.arrays()[name], err_msg=name)
