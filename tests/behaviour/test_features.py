"""Every feature of jaxfit on birds whose geometry is known: expected values are derived here, not by the package."""

import re
from pathlib import Path

import numpy as np
import pytest
from support.described import (
    BIRD,
    REST,
    STANDING,
    STRAIGHT,
    UNIT_M,
    bent,
    flock,
    points_by_hand,
    result,
    straight_wings,
    turned,
    wing_lengths,
)

from jaxfit.behaviour.birds import usual_steps, whole_frames
from jaxfit.behaviour.describe import describe
from jaxfit.behaviour.registry import own_features
from jaxfit.model.murre import POSTURES

DRAWING = Path(__file__).resolve().parents[2] / "docs" / "media" / "behaviour.svg"


def values_of(solution, fps=25.0, bird=BIRD, **how):
    return describe(flock(solution, fps, bird=bird, **how)).values


def assert_turns(found, expected, atol=1e-3):
    """Compare directions in degrees; NaN equals NaN."""
    expected = np.broadcast_to(expected, np.shape(found))
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    np.testing.assert_allclose(np.nan_to_num((found - expected + 180) % 360 - 180), 0, atol=atol)


# ---------------------------------------------------------------------------------------------- body, neck and head


def test_the_orientation_of_the_body():
    heading = np.array([120, 90, 0, -90, 180, -179, 30, 45, 200, 10.0])
    pitch = np.array([30, 0, 50, -20, 79, 57, 10, 85, -85, 80.5])
    roll = np.array([10, 0, -25, 90, 179, 0, -179, 10, 10, 0.0])
    found = values_of(result(turn=turned(heading, pitch, roll)[None]))
    np.testing.assert_allclose(found["body_pitch"][0], pitch, atol=1e-4)
    steep = np.abs(pitch) > 80
    assert_turns(found["body_roll"][0], np.where(steep, np.nan, roll))
    assert_turns(found["body_heading"][0], np.where(steep, np.nan, heading))


def test_pitch_roll_and_heading_by_the_axes_of_the_body():
    """A murre at a heading of 120°, pitched by 30° and rolled by 10°, right side down."""
    R = turned(120, 30, 10)
    forward, right = R[:, 1], R[:, 0]
    np.testing.assert_allclose(forward, [np.cos(np.pi / 6) * -0.5, np.cos(np.pi / 6) * np.sqrt(0.75), 0.5], atol=1e-12)
    assert right[2] == pytest.approx(-np.cos(np.pi / 6) * np.sin(np.radians(10)))  # the right side is down
    found = values_of(result(turn=R))
    for name, expected in {"body_pitch": 30, "body_roll": 10, "body_heading": 120}.items():
        assert found[name] == pytest.approx(expected, abs=1e-3)


REST_NECK = np.degrees(np.arctan2(5.45 - 2.3, 6.25 - 3.8))
"""Elevation of the line from `neck_root` to `head` in the rest pose, whose coordinates (y, z) are in units."""
REST_GAZE = np.degrees(np.arctan2(5.47 - 6.22, 11.85 - 8.54))
"""Elevation of the gaze in the rest pose: from the middle between the eyes to the tip of the bill."""


def test_the_angles_of_neck_and_head_in_the_plane_of_the_body():
    neck, head = np.array([0, 0, -30, 25.0]), np.array([0, 40, 0, -50.0])
    poses = np.stack([bent(neck_root=(n, 0, 0), head=(h, 0, 0)) for n, h in zip(neck, head, strict=True)])
    found = values_of(result(poses[None], turned(-60, 35)))
    np.testing.assert_allclose(found["neck_angle"][0], REST_NECK + neck, atol=0.1)
    np.testing.assert_allclose(found["head_angle"][0], REST_NECK - REST_GAZE - head, atol=0.2)
    np.testing.assert_allclose(found["gaze_elevation"][0], 35 + REST_GAZE + neck + head, atol=0.2)
    assert_turns(found["gaze_heading"], -60, atol=0.01)
    np.testing.assert_allclose(found["gaze_turn"], 0, atol=0.01)


@pytest.mark.parametrize("angle", [40.0, -75.0, 170.0])
def test_a_head_that_turns_to_the_side(angle):
    """In the rest pose of a level bird, the head turns about the vertical; positive to the left."""
    found = values_of(result(bent(head=(0, 0, angle)), turned(150)))
    assert_turns(found["gaze_heading"], 150 + angle, atol=0.01)
    np.testing.assert_allclose(found["gaze_turn"], abs(angle), atol=0.01)
    np.testing.assert_allclose(found["gaze_elevation"], REST_GAZE, atol=0.2)
    assert_turns(found["body_heading"], 150)


def test_the_gaze_of_a_bird_that_looks_straight_down_has_no_heading():
    found = values_of(result(bent(head=(-70, 0, 0))))
    assert found["gaze_elevation"] == pytest.approx(REST_GAZE - 70, abs=0.2)
    assert np.isnan(found["gaze_heading"]).all()
    assert np.isnan(found["gaze_turn"]).all()


@pytest.fixture(scope="module")
def murres():
    """Birds in all postures of the murre, two birds in each frame, and the points of each bird by hand."""
    rng, names = np.random.default_rng(0), list(POSTURES)
    poses = np.stack([[POSTURES[names[(t + n) % len(names)]].body_pose for t in range(len(names))] for n in (0, 4)])
    turn = turned(*rng.uniform([[[-180]], [[-60]], [[-60]]], [[[180]], [[70]], [[60]]], (3, *poses.shape[:2])))
    place = rng.uniform([0, 0, 0.1], [1, 1, 0.4], (*poses.shape[:2], 3))
    size = np.array([[1.1], [0.95]])
    values = values_of(result(poses, turn, place, scale=size))
    hand = [
        [points_by_hand(poses[n, t], turn[n, t], place[n, t], size[n, 0]) for t in range(poses.shape[1])]
        for n in range(2)
    ]
    return values, turn, place, hand


def angle(a, b):
    return np.degrees(np.arccos(np.dot(a, b) / np.linalg.norm(a) / np.linalg.norm(b)))


def by_hand(joints, keypoints, R):
    """The features of one bird in one frame."""
    forward, back = R @ [0, 1, 0], R @ [0, 0, 1]
    neck = joints["head"] - joints["neck_root"]
    gaze = keypoints["bill_tip"] - 0.5 * (keypoints["left_eye"] + keypoints["right_eye"])
    turn = angle([*gaze[:2], 0], [*forward[:2], 0])
    start, end = joints["neck_root"], joints["lower_body"]
    line = start + np.linspace(0, 1, 2001)[:, None] * (end - start)
    span = np.linalg.norm(joints["left_shoulder"] - joints["right_shoulder"])
    raised = []
    for side in ("left", "right"):
        chain = [joints[f"{side}_{bone}"] for bone in ("shoulder", "elbow", "wrist")] + [keypoints[f"{side}_wingtip"]]
        span += np.linalg.norm(np.diff(chain, axis=0), axis=1).sum()
        raised.append(90 - angle(chain[-1] - chain[0], back))
    return {
        "neck_angle": angle(neck, forward),
        "head_angle": angle(neck, gaze),
        "gaze_elevation": 90 - angle(gaze, [0, 0, 1]),
        "gaze_turn": turn if abs(90 - angle(gaze, [0, 0, 1])) < 80 else np.nan,
        "bill_to_body": np.linalg.norm(line - keypoints["bill_tip"], axis=1).min(),
        "height": min(point[2] for point in keypoints.values()),
        "wing_spread": np.linalg.norm(keypoints["left_wingtip"] - keypoints["right_wingtip"]) / span,
        "wing_elevation": np.mean(raised),
    }


def test_features_of_postures_are_those_of_points_by_hand(murres):
    values, turn, _, hand = murres
    for n, row in enumerate(hand):
        for t, (joints, keypoints) in enumerate(row):
            for name, expected in by_hand(joints, keypoints, turn[n, t]).items():
                tolerance = 1e-4 if name in ("bill_to_body", "height", "wing_spread") else 0.01
                assert values[name][n, t] == pytest.approx(expected, abs=tolerance, nan_ok=True), (name, n, t)


# ------------------------------------------------------------------------------------------------------------- wings


def test_straight_wings():
    """The spread is 1 and the elevation is 0 if both wings are straight to the sides, however the bird is turned."""
    raised = np.array([0, 20, -30, 65.0])
    shoulders, wing = wing_lengths()
    found = values_of(result(straight_wings(raised)[None], turned(77, 40, 25), bird=STRAIGHT), bird=STRAIGHT)
    np.testing.assert_allclose(found["wing_elevation"][0], raised, atol=1e-3)
    spread = (shoulders + 2 * wing * np.cos(np.radians(raised))) / (shoulders + 2 * wing)
    np.testing.assert_allclose(found["wing_spread"][0], spread, atol=1e-5)
    shoulder = BIRD.joint_names.index("right_shoulder") - 1
    uneven = straight_wings(10.0).copy()
    uneven[..., shoulder, :] = straight_wings(50.0)[..., shoulder, :]
    assert values_of(result(uneven, bird=STRAIGHT), bird=STRAIGHT)["wing_elevation"] == pytest.approx(30, abs=1e-3)


# ------------------------------------------------------------------------------------------------------------ motion

FPS = 25
TIME_S = np.arange(50) / FPS


def moved(x=0.0, y=0.0, z=0.2):
    """Places of a bird over time, (1, T, 3), metres."""
    return np.stack(np.broadcast_arrays(x, y, z, np.zeros(len(TIME_S)))[:3], axis=-1)[None]


def test_the_speed_of_a_bird_that_walks_and_rises():
    found = values_of(result(turn=turned(0), place_m=moved(0.3 * TIME_S, -0.4 * TIME_S, 0.2 + 0.7 * TIME_S)))
    np.testing.assert_allclose(found["speed"], 0.5, rtol=1e-4)
    np.testing.assert_allclose(found["vertical_speed"], 0.7, rtol=1e-4)
    np.testing.assert_allclose(found["turning"], 0, atol=1e-3)
    falling = values_of(result(place_m=moved(z=2 - 0.5 * TIME_S)))
    np.testing.assert_allclose(falling["vertical_speed"], -0.5, rtol=1e-4)
    np.testing.assert_allclose(falling["speed"], 0, atol=1e-5)


def test_a_bird_that_walks_in_a_circle():
    """It turns by 90 degrees per second, also where its heading jumps from 180 to -180."""
    angle = np.pi / 2 * TIME_S
    place = moved(0.5 * np.cos(angle), 0.5 * np.sin(angle))
    found = values_of(result(turn=turned(np.degrees(angle) + 90, 50)[None], place_m=place))
    np.testing.assert_allclose(found["turning"], 90, rtol=1e-3)
    np.testing.assert_allclose(found["speed"], 0.5 * np.pi / 2, rtol=0.01)  # the chord of 0.2 s is 0.4 % shorter
    right = values_of(result(turn=turned(-60 * TIME_S)[None]))
    np.testing.assert_allclose(right["turning"], -60, rtol=1e-3)


def test_a_speed_is_measured_in_a_fifth_of_a_second():
    """A bird jumps by 10 cm between two frames."""
    found = values_of(result(place_m=moved(np.where(TIME_S < 1, 0, 0.1))))["speed"][0]
    assert (found[np.abs(TIME_S - 0.98) > 0.13] == 0).all()
    assert found.max() == pytest.approx(0.1 / 0.2, rel=0.3)
    assert found.sum() / FPS == pytest.approx(0.1, rel=0.01)


def test_a_speed_needs_both_ends_of_its_window():
    """Without a pose, or over a gap in time, the speed is unknown; it is never 0."""
    place, valid = moved(0.3 * TIME_S), np.ones((1, len(TIME_S)), bool)
    valid[0, 20] = False
    found = values_of(result(place_m=place, valid=valid))["speed"][0]
    unknown = np.isnan(found)
    assert unknown[20]
    assert unknown.sum() == 3  # this frame, and a frame on each side whose window ends there
    np.testing.assert_allclose(found[~unknown], 0.3, rtol=1e-4)
    time_s = np.where(np.arange(50) < 25, TIME_S, TIME_S + 60)
    found = values_of(result(place_m=moved(0.3 * time_s)), time_s=time_s)["speed"][0]
    unknown = np.isnan(found)
    assert unknown[24:26].all()
    assert not unknown[:20].any()
    assert not unknown[30:].any()
    np.testing.assert_allclose(found[~unknown], 0.3, rtol=1e-3)


def test_the_times_count_and_not_the_frames():
    rng = np.random.default_rng(0)
    time_s = np.cumsum(rng.uniform(0.02, 0.06, 50))
    found = values_of(result(turn=turned(40 * time_s)[None], place_m=moved(0.3 * time_s)), time_s=time_s)
    np.testing.assert_allclose(found["speed"], 0.3, rtol=1e-4)
    np.testing.assert_allclose(found["turning"], 40, rtol=1e-3)


def test_the_height_and_the_ledge():
    contact = np.where(TIME_S < 1, 1, 0.2)[None]
    found = values_of(result(REST, place_m=moved(z=0.5), contact=contact))
    # at rest, the lowest keypoints are the feet, 3.25 units below the root
    np.testing.assert_allclose(found["height"], 0.5 - 3.25 * UNIT_M, atol=1e-4)
    np.testing.assert_allclose(found["airborne"], 1 - contact, atol=1e-6)


def test_strides():
    """Legs that swing in turn: a stride of 2.5 Hz, and its length from the speed of the bird."""
    swing = 25 * np.sin(2 * np.pi * 2.5 * TIME_S)
    poses = np.stack([bent(left_hip=(a, 0, 0), right_hip=(-a, 0, 0)) for a in swing])
    found = values_of(result(poses[None], turned(20), moved(0.3 * TIME_S)))
    np.testing.assert_allclose(found["stride_frequency"], 2.5, rtol=0.03)
    np.testing.assert_allclose(found["stride_length"], 0.3 / 2.5, rtol=0.03)
    flying = values_of(result(poses[None], place_m=moved(0.3 * TIME_S), contact=0.1))
    assert np.isnan(flying["stride_frequency"]).all()
    assert np.isnan(flying["stride_length"]).all()


# -------------------------------------------------------------------------------------------------------- neighbours


@pytest.fixture(scope="module")
def walkers():
    """Birds 7 and 4 walk towards each other along x; bird 9 stands at their side and turns its back to them."""
    N = np.ones(len(TIME_S))
    place = np.concatenate([moved(0.3 * TIME_S), moved(2 - 0.1 * TIME_S, z=0.25), moved(1, 3)])
    turn = np.stack([turned(0 * N, 50), turned(180 * N, 50), turned(90 * N, 50)])
    found = describe(flock(result(STANDING, turn, place, track_id=np.array([7, 4, 9]))))
    return found.values | {"neighbour": found.tracks("neighbour")}


def test_the_nearest_neighbour_and_its_distance(walkers):
    np.testing.assert_array_equal(walkers["neighbour"][0], 4)
    np.testing.assert_array_equal(walkers["neighbour"][1], 7)
    distance = np.hypot(2 - 0.4 * TIME_S, 0.05)
    np.testing.assert_allclose(walkers["neighbour_distance"][:2], np.stack([distance, distance]), rtol=1e-5)
    # the third bird has the nearest of the two others, which are at 0.3 t and 2 - 0.1 t along x
    first, second = (
        np.hypot(1 - 0.3 * TIME_S, 3),
        np.linalg.norm([1 - 0.1 * TIME_S, 3 + 0 * TIME_S, 0.05 + 0 * TIME_S], axis=0),
    )
    np.testing.assert_allclose(walkers["neighbour_distance"][2], np.minimum(first, second), rtol=1e-5)
    np.testing.assert_array_equal(walkers["neighbour"][2], np.where(first <= second, 7, 4))


def test_bills_of_birds_that_face_each_other(walkers):
    """Each tip is before its bird by the same distance, that of a bird at x = 0."""
    _, keypoints = points_by_hand(STANDING, turned(0, 50), [0, 0, 0])
    reach = keypoints["bill_tip"]
    expected = np.hypot(2 - 0.4 * TIME_S - 2 * reach[0], 0.05)
    assert abs(reach[1]) < 1e-6
    np.testing.assert_allclose(walkers["bill_distance"][:2], np.stack([expected, expected]), atol=1e-4)


def test_approach(walkers):
    np.testing.assert_allclose(walkers["approach_speed"][:2].mean(axis=1), [0.3, 0.1], rtol=1e-4)
    np.testing.assert_allclose(walkers["neighbour_approach_speed"][:2].mean(axis=1), [0.1, 0.3], rtol=1e-4)
    np.testing.assert_allclose(walkers["facing_angle"][:2], 0, atol=1e-3)
    assert (walkers["facing_angle"][2] > 90).all()
    np.testing.assert_allclose(walkers["approach_speed"][2], 0, atol=1e-6)


def test_a_bird_that_withdraws_at_an_angle():
    """The neighbour is straight ahead along y; the bird looks 30° beside it and walks backwards, 60° off the line."""
    speed = 0.4 * np.array([-np.sin(np.radians(60)), -np.cos(np.radians(60))])
    place = np.concatenate([moved(speed[0] * 0, speed[1] * TIME_S), moved(0, 2)])
    found = values_of(result(turn=np.stack([turned(120, 20), turned(-90, 20)])[:, None], place_m=place))
    np.testing.assert_allclose(found["facing_angle"][0], 30, atol=1e-3)
    np.testing.assert_allclose(found["facing_angle"][1], 0, atol=1e-3)
    np.testing.assert_allclose(found["approach_speed"][0], -0.2, rtol=1e-4)
    np.testing.assert_allclose(found["neighbour_approach_speed"][1], -0.2, rtol=1e-4)


def test_only_movement_along_the_line_is_approach():
    """A bird passes its neighbour at a distance of 2 m, and rises."""
    x = 0.5 * (TIME_S - 1)
    found = values_of(result(place_m=np.concatenate([moved(x, 0, 0.2 + 0.3 * TIME_S), moved(0, 2)])))
    np.testing.assert_allclose(found["approach_speed"][0], -0.5 * x / np.hypot(x, 2), atol=1e-3)


def test_a_bird_without_a_pose_is_no_neighbour():
    valid = np.ones((3, len(TIME_S)), bool)
    valid[1, :10], valid[2, 20:] = False, False
    place = np.concatenate([moved(0), moved(1), moved(3)])
    found = values_of(result(place_m=place, valid=valid))
    frame = np.arange(len(TIME_S))
    np.testing.assert_array_equal(found["neighbour"][0], np.where(frame < 10, 2, 1))  # positions
    np.testing.assert_allclose(found["neighbour_distance"][0], np.where(frame < 10, 3, 1), rtol=1e-5)
    assert np.isnan(found["neighbour"][1, :10]).all()
    assert np.isnan(found["neighbour_distance"][2, 20:]).all()
    alone = values_of(result(place_m=place, valid=valid & [[True], [False], [False]]))
    for name in ("neighbour", "neighbour_distance", "bill_distance", "facing_angle", "approach_speed"):
        assert np.isnan(alone[name]).all(), name


def test_a_bird_above_its_neighbour_faces_no_direction():
    found = values_of(result(place_m=np.concatenate([moved(z=0.2), moved(z=1.2)])))
    assert np.isnan(found["facing_angle"]).all()
    np.testing.assert_allclose(found["neighbour_distance"], 1, rtol=1e-5)


# ------------------------------------------------------------------------------------------------- drawing of docs/


def test_the_drawing_shows_features_by_their_names():
    """The comments of the file hold its labels."""
    labels = re.findall(r"<!-- (\w+_\w+) ", DRAWING.read_text(encoding="utf-8"))
    assert len(labels) == len(set(labels)) >= 13
    assert set(labels) <= {each.name for each in own_features()}


# ------------------------------------------------------------------------------------------------ usual steps of time


def test_the_speed_in_a_video_whose_frame_rate_changes():
    """A bird walks 0.5 m/s, in 50 frames at 25 frames/s and 50 frames at 10 frames/s."""
    time_s = np.concatenate([np.arange(50) / 25, 2 + np.arange(50) / 10])
    place = np.stack([0.5 * time_s, 0 * time_s, 0.2 + 0 * time_s], axis=-1)[None]
    found = describe(flock(result(place_m=place), time_s=time_s)).values
    np.testing.assert_allclose(found["speed"], 0.5, rtol=1e-4)


def test_usual_steps_follow_a_new_frame_rate_and_no_gap():
    steps = np.array([0.04] * 50 + [3] + [0.04] * 30 + [0.1] * 60)
    usual = usual_steps(np.cumsum(np.append(0, steps)))
    np.testing.assert_allclose(usual[:80], 0.04)
    np.testing.assert_allclose(usual[82:], 0.1)
    np.testing.assert_allclose(usual_steps(np.array([0, 9, 9.1, 9.2, 9.3])), 0.1)
    assert np.isnan(usual_steps(np.array([0, np.nan, 1]))).all()
    assert np.isnan(usual_steps(np.array([4.0]))).all()


def test_rounding_of_steps_does_not_change_the_number_of_frames():
    step_s = np.nextafter(0.04, [0, 1])
    assert whole_frames(0.1, step_s).tolist() == [3, 3]
    assert whole_frames(0.1, np.array([1.0, 0.01, 0.045])).tolist() == [1, 10, 2]
