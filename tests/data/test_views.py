"""Observations of several cameras: distortion, common frames, rows of birds; matching and checks of cameras."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfit.cameras.camera import Camera
from jaxfit.data.masks import decode_mask
from jaxfit.data.view_check import check_cameras
from jaxfit.data.view_matching import match_birds, matches_of_file
from jaxfit.data.views import Views, assign_cameras, birds_in_rows, on_common_frames, own_steps, straightened
from jaxfit.foundation.errors import InputError
from jaxfit.model.files import load_murre
from jaxfit.simulation.rig import stage_rig

BIRD = load_murre()


@pytest.fixture(scope="module")
def rig():
    return stage_rig(BIRD, 3, birds=3, frames=40, size=(640, 380), seed=3, distorted=True)


@pytest.fixture(scope="module")
def straight(rig):
    return [straightened(camera, scene.detections) for camera, scene in zip(rig.cameras, rig.scenes, strict=True)]


def matched(cameras, lenses, tracks):
    matches = match_birds(cameras, tracks)
    ids = list(range(1, matches.birds + 1))
    rows = tuple(birds_in_rows(own, bird, ids) for own, bird in zip(tracks, matches.bird, strict=True))
    return Views(tuple(cameras), tuple(lenses), rows), matches


def true_birds(scene):
    """The true bird of each detected track: that whose boxes agree in most frames."""
    error = np.abs(scene.detections.box_px[:, None] - scene.truth.box_px[None]).sum(-1)
    both = scene.detections.present[:, None] & scene.truth.present[None]
    return np.nanmedian(np.where(both, error, np.nan), axis=-1).argmin(axis=1)


def test_straight_observations_are_those_of_a_pinhole(rig):
    for camera, scene in zip(rig.cameras, rig.scenes, strict=True):
        pinhole, own = straightened(camera, scene.truth)
        assert not pinhole.distortion.any()
        shift = pinhole.matrix[:2, 2] - camera.matrix[:2, 2]
        seen = scene.truth.confidence > 0
        expected = camera.undistort(scene.truth.keypoints_px[seen]) + shift
        np.testing.assert_allclose(own.keypoints_px[seen], expected, atol=1e-3)
        assert tuple(own.image_size_px[0]) == pinhole.size_px
        for (n, t), rle in list(own.masks.items())[:5]:
            # the mask of the pinhole camera, resampled to the image, is the mask of the image
            back = decode_mask(rle)
            rows, columns = np.nonzero(scene.truth.mask(n, t))
            at = camera.undistort(np.stack([columns + 0.5, rows + 0.5], axis=1)) + shift
            x, y = at.astype(int).T
            assert back[y, x].mean() > 0.93
            assert back.sum() == pytest.approx(len(rows), rel=0.12)


def test_a_camera_without_distortion_changes_nothing(rig):
    camera, scene = rig.cameras[0].pinhole(), rig.scenes[0]
    same, observations = straightened(camera, scene.detections)
    assert observations is scene.detections
    np.testing.assert_array_equal(same.matrix, camera.matrix)


def test_birds_are_matched_over_cameras(rig, straight):
    cameras, tracks = zip(*straight, strict=True)
    matches = match_birds(cameras, tracks)
    assert matches.birds == 3
    assert (matches.error < 0.03).all()
    names = [
        dict(zip(true_birds(scene).tolist(), of.max(axis=1).tolist(), strict=True))
        for scene, of in zip(rig.scenes, matches.bird, strict=True)
    ]
    assert names[0] == names[1] == names[2]


def test_a_track_that_changes_to_another_bird_is_corrected(rig, straight):
    cameras, tracks = map(list, zip(*straight, strict=True))
    before = match_birds(cameras, tracks)
    swapped = {name: getattr(tracks[1], name).copy() for name in ("present", "keypoints_px", "confidence", "box_px")}
    for values in swapped.values():
        values[[0, 1], 25:] = values[[1, 0], 25:]
    tracks[1] = replace(tracks[1], **swapped, masks={}, score=None, occluded=None)
    after = match_birds(cameras, tracks)
    present = tracks[1].present[:2, 25:] & (before.bird[1][[1, 0], 25:] >= 0)
    np.testing.assert_array_equal(after.bird[1][:2, 25:][present], before.bird[1][[1, 0], 25:][present])
    np.testing.assert_array_equal(after.bird[0], before.bird[0])


def test_tracks_that_break_and_change_inside_a_block_are_corrected(rig, straight):
    """In camera 1, two tracks exchange their birds in frames 12 to 27; in camera 0, all tracks break at frame 18."""
    cameras, tracks = map(list, zip(*straight, strict=True))
    names = ("present", "keypoints_px", "confidence", "box_px")
    unknown = dict.fromkeys(("score", "occluded", "keypoint_origin"))
    swapped = {name: getattr(tracks[1], name).copy() for name in names}
    for values in swapped.values():
        values[[0, 1], 12:28] = values[[1, 0], 12:28]
    tracks[1] = replace(tracks[1], **swapped, masks={}, **unknown)
    broken = {name: np.concatenate([getattr(tracks[0], name)] * 2) for name in names}
    for values in broken.values():
        values[:3, 18:], values[3:, :18] = 0, 0
    tracks[0] = replace(tracks[0], **broken, track_id=np.arange(6), masks={}, **unknown)
    matches = match_birds(cameras, tracks)
    assert matches.birds == 3
    true = [np.repeat(true_birds(scene)[:, None], 40, axis=1) for scene in rig.scenes]
    true[1][[0, 1], 12:28] = true[1][[1, 0], 12:28]
    true[0] = np.concatenate([true[0], true[0]])
    number = matches.bird[2].max(axis=1)  # camera 2 has whole tracks: its birds name the true birds
    named = dict(zip(true_birds(rig.scenes[2]).tolist(), number.tolist(), strict=True))
    wrong = [
        (of != np.vectorize(named.get)(birds)) & own.present
        for of, birds, own in zip(matches.bird, true, tracks, strict=True)
    ]
    assert not wrong[2].any()
    assert not wrong[0].any()
    assert not wrong[1][:, [*range(10), *range(15, 25), *range(30, 40)]].any()  # blocks without a change


def test_a_bird_of_a_single_block_is_dropped(rig, straight):
    cameras, tracks = zip(*straight, strict=True)
    short = []
    for own, scene in zip(tracks, rig.scenes, strict=True):
        present, confidence = own.present.copy(), own.confidence.copy()
        outside = [t for t in range(40) if not 10 <= t < 14]
        gone = np.ix_(true_birds(scene) == 0, outside)
        present[gone], confidence[gone] = False, 0
        short.append(
            replace(own, present=present, confidence=confidence, box_px=own.box_px * present[..., None], masks={})
        )
    assert match_birds(cameras, short).birds == 2
    assert match_birds(cameras, [own.select(frames=np.arange(10, 14)) for own in short]).birds == 3


def test_matches_by_hand(rig, straight, tmp_path):
    table = tmp_path / "birds.csv"
    table.write_text("camera,track,bird\ncam0,1,a\ncam1,2,a\ncam2,3,b\n")
    tracks = [own for _, own in straight]
    matches = matches_of_file(table, rig.cameras, tracks)
    assert matches.birds == 2
    assert [of.max(axis=1).tolist() for of in matches.bird] == [[0, -1, -1], [-1, 0, -1], [-1, -1, 1]]
    for text in ("camera,track,bird\ncam9,1,a\n", "camera,track\ncam0,1\n", "camera,track,bird\ncam0,77,a\n"):
        table.write_text(text)
        with pytest.raises(InputError, match="line 2 names no camera and track"):
            matches_of_file(table, rig.cameras, tracks)


def test_rows_of_birds_hold_the_best_of_their_tracks(straight):
    own = straight[0][1]
    bird = np.where(own.present, [[0], [0], [1]], -1)  # two tracks of one bird
    rows = birds_in_rows(own, bird, [5, 6])
    assert rows.track_id.tolist() == [5, 6]
    np.testing.assert_array_equal(rows.present[0], own.present[0] | own.present[1])
    np.testing.assert_array_equal(rows.keypoints_px[1], own.keypoints_px[2])
    assert len([cell for cell in rows.masks if cell[0] == 1]) == len([cell for cell in own.masks if cell[0] == 2])


def test_a_camera_that_tracks_no_bird_has_empty_rows(straight):
    own = straight[0][1]
    rows = birds_in_rows(own.select(tracks=[]), np.zeros((0, own.num_frames), int), [1, 2])
    assert rows.present.shape == (2, own.num_frames)
    assert not rows.present.any()


def test_offsets_and_rates_in_time(straight, caplog):
    own = straight[0][1]
    shifted = replace(own.select(frames=np.arange(3, 40)), frame_index=np.arange(37))
    first, moved = on_common_frames([own, shifted], [0, -3])
    both = moved.present
    assert both[:, 4:].any()
    np.testing.assert_allclose(moved.keypoints_px[both], first.keypoints_px[both], atol=1e-4)
    half = on_common_frames([own, own], [0, 0.5])[1]
    expected = (own.keypoints_px[:, :-1] + own.keypoints_px[:, 1:]) / 2
    seen = half.confidence[:, :-1] > 0
    assert seen.mean() > 0.5
    np.testing.assert_allclose(half.keypoints_px[:, :-1][seen], expected[seen], atol=1e-3)
    # every fifth frame is stored: the neighbours are five frames apart
    thin = own.select(frames=np.arange(0, own.num_frames, 5))
    between = on_common_frames([thin, thin], [0, 2])[1]
    expected = 0.6 * thin.keypoints_px[:, :-1] + 0.4 * thin.keypoints_px[:, 1:]
    seen = between.confidence[:, :-1] > 0
    assert seen.mean() > 0.5
    np.testing.assert_allclose(between.keypoints_px[:, :-1][seen], expected[seen], atol=1e-3)
    apart = own.select(frames=[0, own.num_frames - 1])  # nothing is known of the frames between
    assert on_common_frames([own, apart])[1].present.any(0).nonzero()[0].tolist() == [0, own.num_frames - 1]
    assert f"camera 2 lacks {own.num_frames - 2} of {own.num_frames} frames" in caplog.text
    with pytest.raises(InputError, match="of camera 2 have no time in common"):
        on_common_frames([own, replace(own, frame_index=own.frame_index + 1000)])
    fast = replace(own, fps=50.0, timestamp_s=own.frame_index / 50.0)
    twice = on_common_frames([own, fast])[1]
    np.testing.assert_array_equal(twice.present[:, :20], own.present[:, :40:2])
    with pytest.raises(InputError, match="of camera 2 have no time in common"):
        on_common_frames([own, own], [0, 1000])


def test_cameras_are_assigned_by_name_or_by_order(rig):
    tracks = [scene.detections for scene in rig.scenes]
    by_order = assign_cameras(rig.cameras, tracks, ["a.json", "b.json", "c.json"])
    assert [camera.name for camera in by_order] == ["cam0", "cam1", "cam2"]
    by_name = assign_cameras(rig.cameras, tracks, ["x/cam2/detections.json", "x/cam0/detections.json", "cam1.json"])
    assert [camera.name for camera in by_name] == ["cam2", "cam0", "cam1"]
    some = assign_cameras(rig.cameras, tracks[:2], ["cam2.json", "cam1/detections.json"])
    assert [camera.name for camera in some] == ["cam2", "cam1"]
    for names in (["a", "b"], ["cam1.json", "b.json"], ["x/cam1.json", "y/cam1.json"]):
        with pytest.raises(InputError, match=r"3 cameras \(cam0, cam1, cam2\), but 2 files .*the name of its camera"):
            assign_cameras(rig.cameras, tracks[:2], names)
    other = replace(rig.cameras[0], size_px=(320, 190))
    with pytest.raises(InputError, match="has images of 640×380, but camera cam0 has 320×190"):
        assign_cameras([other, *rig.cameras[1:]], tracks, ["a", "b", "c"])


def checked(lenses, observations, offsets=None):
    pairs = [straightened(camera, replace(own, masks={})) for camera, own in zip(lenses, observations, strict=True)]
    tracks = on_common_frames([own for _, own in pairs], offsets)
    views, matches = matched([camera for camera, _ in pairs], lenses, tracks)
    return check_cameras(views, tracks, matches, offsets, own_steps([own for _, own in pairs]))


def test_right_cameras_pass_the_check(rig):
    result = checked(rig.cameras, [scene.detections for scene in rig.scenes])
    assert result.findings == []
    assert all(error[0] < 3 and error[2] > 0.9 for error in result.by_camera.values())
    assert set(result.by_keypoint) == set(BIRD.keypoint_names)


def test_a_wrong_order_is_named(rig):
    lenses = [rig.cameras[1], rig.cameras[0], rig.cameras[2]]
    (finding,) = checked(lenses, [scene.detections for scene in rig.scenes]).findings
    assert "order of the cameras is wrong: the files fit the cameras cam0, cam1, cam2" in finding


def moved_by(camera: Camera, distance_m: float) -> Camera:
    return replace(camera, transl_cam=camera.transl_cam - camera.R_cam_world @ [0.0, distance_m, 0.0])


def test_a_moved_camera_is_named(rig):
    cameras = [*rig.cameras[:2], moved_by(rig.cameras[2], 0.05)]
    (finding,) = checked(cameras, [scene.detections for scene in rig.scenes]).findings
    assert "camera cam2 is not where its calibration says" in finding


@pytest.mark.parametrize("keypoints", ["detections", "truth"])
def test_a_shift_within_the_errors_of_keypoints_is_no_fault(rig, keypoints):
    """Exact keypoints and 1 mm: the pose from the other cameras explains 0.2 px, less than 1 % of a bird."""
    cameras = [*rig.cameras[:2], moved_by(rig.cameras[2], 0.001)]
    assert checked(cameras, [getattr(scene, keypoints) for scene in rig.scenes]).findings == []


def test_an_offset_in_time_is_named(rig):
    exact = [scene.truth for scene in rig.scenes]
    late = replace(exact[1].select(frames=np.arange(3, 40)), frame_index=np.arange(37))
    (finding,) = checked(rig.cameras, [exact[0], late, exact[2]]).findings
    assert "camera cam1 is 3 frames early: --offsets 0,-3,0" in finding
    assert checked(rig.cameras, [exact[0], late, exact[2]], [0, -3, 0]).findings == []
    # every second frame was read, and a part of the offset was given
    thinned = [replace(own, frame_index=2 * own.frame_index) for own in (exact[0], late, exact[2])]
    (finding,) = checked(rig.cameras, thinned, [0, -2, 0]).findings
    assert "camera cam1 is 4 frames early: --offsets 0,-6,0" in finding
