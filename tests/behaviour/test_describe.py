"""`describe`: standard deviations, missing features, features of other packages, blocks of frames."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.described import (
    BIRD,
    LENGTH_M,
    REST,
    STANDING,
    STRAIGHT,
    UNIT_M,
    flock,
    in_lengths,
    pair,
    points_by_hand,
    renamed,
    result,
    straight_wings,
    turned,
    with_error_bars,
)

import jaxfit.behaviour.describe as describing
from jaxfit.behaviour.describe import describe
from jaxfit.behaviour.registry import NEEDS, own_features
from jaxfit.model.murre import POSTURES

OWN = {each.name: each for each in own_features()}
# ---------------------------------------------------------------------------------------------- standard deviations


@pytest.fixture(scope="module")
def uncertain():
    """Level birds with errors about one axis each, in radians: x, y, z of the body; the neck; the third is pitched."""
    sd, T = 0.05, 50
    orient = sd * np.eye(3)[:, None, :] * np.ones((1, T, 1))
    orient = np.concatenate([orient, np.zeros((2, T, 3))])
    body = np.zeros((5, T, *REST.shape))
    body[3, :, BIRD.joint_names.index("head") - 1, 0] = sd
    orient[4, T // 2 :] = body[4, :10, 3] = np.nan
    turn = turned(np.array([[180], [30], [180], [0], [0]]) * np.ones((5, T)), np.array([[20], [0], [60], [0], [0]]))
    solution = with_error_bars(result(REST, turn, np.arange(5)[:, None, None] * [1.0, 0, 0]), orient, body)
    return np.degrees(sd), describe(flock(solution))


def mean_sd(description, name, bird):
    """Return the mean over frames, whose relative error is about 2 %."""
    return np.nanmean(description.sd[name][bird])


def test_standard_deviations_follow_from_those_of_the_pose(uncertain):
    sd, found = uncertain
    assert mean_sd(found, "body_pitch", 0) == pytest.approx(sd, rel=0.08)  # about the lateral axis
    assert mean_sd(found, "body_roll", 0) == pytest.approx(0, abs=0.01 * sd)
    assert mean_sd(found, "body_heading", 0) == pytest.approx(0, abs=0.01 * sd)
    assert mean_sd(found, "body_roll", 1) == pytest.approx(sd, rel=0.08)  # about the long axis
    assert mean_sd(found, "body_pitch", 1) == pytest.approx(0, abs=0.01 * sd)
    assert mean_sd(found, "gaze_elevation", 3) == pytest.approx(sd, rel=0.08)  # the head
    assert mean_sd(found, "head_angle", 3) == pytest.approx(sd, rel=0.08)
    assert mean_sd(found, "neck_angle", 3) == pytest.approx(0, abs=0.01 * sd)
    assert mean_sd(found, "wing_spread", 0) == pytest.approx(0, abs=1e-6)


def test_a_heading_of_180_has_the_standard_deviation_of_any_heading(uncertain):
    """A turn about the back by a small angle turns the heading of a body with pitch p by the angle / cos p."""
    sd, found = uncertain
    assert np.abs(found.values["body_heading"][2]).min() > 179
    assert mean_sd(found, "body_heading", 2) == pytest.approx(sd / np.cos(np.radians(60)), rel=0.08)
    assert mean_sd(found, "body_pitch", 2) == pytest.approx(0, abs=0.1 * sd)


def test_standard_deviations_are_unknown_where_the_error_bars_are(uncertain):
    _, found = uncertain
    known = np.isfinite(found.sd["body_pitch"])
    assert known[:4].all()
    np.testing.assert_array_equal(known[4], (np.arange(50) >= 10) & (np.arange(50) < 25))
    assert np.isfinite(found.values["body_pitch"]).all()


def test_which_features_have_a_standard_deviation(uncertain):
    _, found = uncertain
    over_time = {name for name, each in OWN.items() if "time" in each.needs}
    assert over_time >= {"speed", "turning", "beat_frequency", "stride_length", "approach_speed"}
    assert not over_time & set(found.sd)
    assert not {"neighbour", "height", "airborne"} & set(found.sd)
    assert {"body_pitch", "gaze_turn", "wing_elevation", "bill_to_body"} <= set(found.sd)
    assert describe(flock(pair())).sd == {}


# ------------------------------------------------------------------------------------------------- missing features


def test_one_bird_has_no_neighbour():
    found = describe(flock(result(shape=(1, 4))))
    expected = {name for name, each in OWN.items() if "neighbours" in each.needs}
    assert dict.fromkeys(expected, NEEDS["neighbours"]) == found.missing
    assert expected >= {"neighbour", "neighbour_distance", "bill_distance", "facing_angle", "approach_speed"}
    assert np.isfinite(found.values["body_pitch"]).all()


def test_unknown_times():
    found = describe(flock(pair(), fps=None))
    expected = {name for name, each in OWN.items() if "time" in each.needs}
    assert dict.fromkeys(expected, NEEDS["time"]) == found.missing
    assert np.isfinite(found.values["neighbour_distance"]).all()
    some = np.array([0, 0.04, np.nan, 0.12])
    assert set(describe(flock(pair(), time_s=some)).missing) == expected


def test_no_ledge():
    """Photographs share no world: the vertical is unknown, and all that is measured within a bird remains."""
    no_world = dict.fromkeys(("R_world_root", "transl_world_m", "keypoints_world_m", "contact"))
    known = flock(pair().with_arrays(**no_world), photographs=True)
    assert (known.level, known.unit) == (False, "bl")
    found, on_ledge = describe(known), describe(flock(pair()))
    for name, each in OWN.items():
        needed = [need for need in each.needs if need in ("level", "ledge", "neighbours")]
        assert found.missing.get(name) == (NEEDS[needed[0]] if needed else None), name
    assert {"neck_angle", "head_angle", "bill_to_body", "wing_spread", "wing_elevation"} <= set(found.values)
    for name in ("neck_angle", "head_angle", "wing_spread", "wing_elevation"):
        np.testing.assert_allclose(found.values[name], on_ledge.values[name], atol=1e-3)
    np.testing.assert_allclose(found.values["bill_to_body"], on_ledge.values["bill_to_body"] / LENGTH_M, rtol=1e-3)


def test_a_model_without_wingtips_and_feet():
    bird = renamed(left_wingtip="left_feather", right_foot="right_toe")
    found = describe(flock(result(bird=bird, shape=(1, 4)), bird=bird))
    wings = ("wing_spread", "wing_elevation", "beat_frequency", "beat_alias", "beat_amplitude", "stroke_phase")
    assert {name: found.missing[name] for name in wings} == dict.fromkeys(
        wings, "the model has no keypoint left_wingtip"
    )
    for name in ("stride_frequency", "stride_length"):
        assert found.missing[name] == "the model has no keypoint right_foot"
    assert {"body_pitch", "gaze_turn", "bill_to_body", "speed", "height"} <= set(found.values)


def test_poses_that_are_not_valid_have_no_values():
    valid = np.ones((2, 4), bool)
    valid[0, 1] = False
    solution = pair(valid=valid)
    broken = np.array(solution.poses.body_pose)
    broken[0, 1] = np.nan
    found = describe(flock(solution.with_arrays(body_pose=broken)))
    for name, values in found.values.items():
        assert np.isnan(values[0, 1]), name
    for name in ("body_pitch", "neck_angle", "wing_spread", "height", "airborne"):
        assert np.isfinite(found.values[name][valid]).all(), name


@pytest.mark.parametrize("shape", [(0, 5), (2, 0), (2, 1)])
def test_no_bird_and_no_frame(shape):
    found = describe(flock(result(shape=shape)))
    assert found.values["neck_angle"].shape == shape


# ----------------------------------------------------------------------------------------------- units and columns


def test_metres_and_body_lengths():
    metric = flock(pair(8))
    lengths = in_lengths(metric)
    assert metric.model_length == pytest.approx(LENGTH_M, rel=1e-3)
    assert lengths.model_length == pytest.approx(1, rel=1e-4)
    first, second = describe(metric), describe(lengths)
    for name, values in first.values.items():
        factor = LENGTH_M if OWN[name].unit.startswith("length") else 1.0
        np.testing.assert_allclose(second.values[name], values / factor, rtol=2e-3, atol=1e-3, err_msg=name)
    assert first.column("neighbour_distance") == "neighbour_distance_m"
    assert second.column("neighbour_distance") == "neighbour_distance_bl"
    assert first.column("speed") == "speed_m_s"
    assert second.column("speed") == "speed_bl_s"
    assert (first.column("body_pitch"), first.column("turning")) == ("body_pitch_deg", "turning_deg_s")
    assert (first.column("neighbour"), first.column("airborne")) == ("neighbour", "airborne")
    assert OWN["speed"].shown_unit("bl") == "body lengths/s"
    assert OWN["speed"].shown_unit("m") == "m/s"


def filmed(turn, place_m, body_pose=STANDING):
    """Return birds as one camera sees them, without a world: 3 m above the ledge, 30 degrees below the horizontal.

    All birds have the size of the model, and the crop of each bird is the whole picture.
    """
    down = np.radians(30)
    forward, right = np.array([0, np.cos(down), -np.sin(down)]), np.array([1.0, 0, 0])
    R_cam_world = np.stack([right, np.cross(forward, right), forward])
    centre_m = np.array([0, -3 / np.tan(down), 3.0])
    N, T = turn.shape[:2]
    R_cam_root = R_cam_world @ turn
    points = [[points_by_hand(body_pose, turn[n, t], place_m[n, t])[1].values() for t in range(T)] for n in range(N)]
    seen = (np.array([[list(each) for each in row] for row in points]) - centre_m) @ R_cam_world.T / UNIT_M
    focal, half = 900.0, 320.0
    whole = {"crop": np.tile([0, 0, 2 * half], (N, T, 1)), "image_size_px": np.full((N, T, 2), 2 * half, int)}
    return result(
        body_pose,
        shape=(N, T),
        **dict.fromkeys(("R_world_root", "transl_world_m", "keypoints_world_m", "contact")),
        **whole,
        global_orient=Rotation.from_matrix(R_cam_root.reshape(-1, 3, 3)).as_rotvec().reshape(N, T, 3),
        transl=(place_m - centre_m) @ R_cam_world.T / UNIT_M,
        keypoints_cam=seen,
        keypoints_px=seen[..., :2] / seen[..., 2:] * focal + half,
        focal_px=focal * 256 / (2 * half),
    )


def test_one_camera_without_a_ledge():
    """The vertical is estimated; angles agree with the truth, and lengths are those of the model."""
    T, pitch = 3, np.degrees(POSTURES["standing"].pitch_rad)
    x, y = np.array([-0.8, 0, 0.9, -0.3]), np.array([0, 0.6, 0.1, 1.5])
    turn = np.repeat(turned(np.array([0, 100, 190, 280]), pitch)[:, None], T, axis=1)
    _, keypoints = points_by_hand(STANDING, turn[0, 0], [0, 0, 0])
    sole = min(point[2] for point in keypoints.values())
    place = np.repeat(np.stack([x, y, np.full(4, -sole)], axis=-1)[:, None], T, axis=1)
    solution, true = filmed(turn, place), describe(flock(result(STANDING, turn, place))).values
    birds = flock(solution)
    assert (birds.unit, birds.level) == ("bl", True)
    assert "the vertical is estimated from 4 birds" in birds.notes[0]
    found = describe(birds).values
    for name in ("neck_angle", "head_angle", "wing_spread", "wing_elevation"):
        np.testing.assert_allclose(found[name], true[name], atol=0.01)
    for name in ("body_pitch", "body_roll", "gaze_elevation", "facing_angle"):
        np.testing.assert_allclose(found[name], true[name], atol=2)
    np.testing.assert_array_equal(found["neighbour"], true["neighbour"])
    for name in ("neighbour_distance", "bill_distance"):
        np.testing.assert_allclose(found[name], true[name] / LENGTH_M, rtol=0.05)
    assert (found["airborne"] < 0.5).all()
    lost = flock(replace(solution, valid=np.zeros((4, T), bool)), source="cliff")
    assert not lost.level
    assert lost.notes[0].startswith("the ledge and the vertical are unknown: ")


@pytest.mark.parametrize(
    ("birds", "tilt_sd_deg", "note"),
    [
        (
            1,
            267.4,
            "the ledge and the vertical are unknown: estimated from 1 bird, its error is ± 267°, and at most 15°",
        ),
        (3, np.nan, "the ledge and the vertical are unknown: estimated from 3 birds"),
        (1, 3.0, "the vertical is estimated from 1 bird (± 3.0°)"),
    ],
)
def test_an_uncertain_vertical_is_unknown(monkeypatch, birds, tilt_sd_deg, note):
    facts = {"birds": birds, "tilt_sd_deg": tilt_sd_deg}
    monkeypatch.setattr(
        "jaxfit.behaviour.birds.estimate_ledge", lambda *_, **__: SimpleNamespace(facts=facts, camera=None)
    )
    monkeypatch.setattr("jaxfit.behaviour.birds.on_ledge", lambda *_, **__: pair())
    found = flock(replace(pair(), contact=None))
    assert found.notes[0].startswith(note)
    assert found.level == (tilt_sd_deg == 3)
    missing = describe(found, own=[OWN["body_pitch"], OWN["airborne"], OWN["neck_angle"]]).missing
    assert set(missing) == (set() if found.level else {"body_pitch", "airborne"})


# ------------------------------------------------------------------------------------------------ blocks of frames


def wild(time_s):
    """Two birds that turn, rise and beat their wings ever faster."""
    elevation = (15 + 5 * np.sin(time_s)) * np.sin(2 * np.pi * (4 * time_s + 0.6 * time_s**2))
    poses = straight_wings(np.stack([elevation, elevation[::-1]]))
    turn = np.stack([turned(100 * np.sin(3 * time_s), 50), turned(200 * time_s, 20 * np.cos(time_s), 10)])
    x = 0.3 * np.sin(5 * time_s)
    place = np.stack([np.stack([x, 0 * x, 0.2 + 0.1 * x], axis=-1), np.stack([1 + x**2, x, 0 * x], axis=-1)])
    return result(poses, turn, place, bird=STRAIGHT)


@pytest.mark.parametrize(
    ("time_s", "chunk"),
    [
        (np.arange(260) / 50, 131),  # at 50 frames/s, a window of wingbeats belongs to two frames
        (np.concatenate([np.arange(90) / 25, 90 / 25 + np.arange(80) / 50]), 120),
    ],
    ids=["even", "changing rate"],
)
def test_values_do_not_depend_on_blocks_of_frames(monkeypatch, time_s, chunk):
    birds = flock(wild(time_s), time_s=time_s, bird=STRAIGHT)
    whole = describe(birds).values
    assert np.isfinite(whole["beat_frequency"]).mean() > 0.8
    monkeypatch.setattr(describing, "CHUNK", chunk)
    parts = describe(birds).values
    assert whole.keys() == parts.keys()
    for name, values in whole.items():
        np.testing.assert_allclose(parts[name], values, rtol=1e-4, atol=1e-3, err_msg=name)
