"""Bouts and time budgets by rules: values of features that are written by hand, and bouts that are counted by hand."""

from dataclasses import replace

import numpy as np
import pytest
from support.described import LENGTH_M, STANDING, flock, in_lengths, result, rules, turned

from jaxfit.behaviour.bouts import NO_POSE, OTHER, find_bouts, time_budget
from jaxfit.behaviour.describe import Description, describe
from jaxfit.behaviour.registry import find_feature
from jaxfit.behaviour.rules import load_behaviour_config

FPS = 10


def described(values, valid=True, fps=FPS, time_s=None, missing=None, track_id=None):
    """Return a description with the given values of features, each (T,) for one bird or (N, T); neighbours by track."""
    values = {name: np.atleast_2d(np.asarray(rows, float)) for name, rows in values.items()}
    shape = next(iter(values.values())).shape
    track_id = np.arange(1, shape[0] + 1) if track_id is None else np.asarray(track_id)
    birds = flock(result(shape=shape, valid=valid, track_id=track_id), fps, time_s)
    features = tuple(find_feature(name) for name in values)
    tracks = np.unique([each for each in values.get("neighbour", np.array([])).flat if np.isfinite(each)]).astype(int)
    if "neighbour" in values:
        positions = np.searchsorted(tracks, np.nan_to_num(values["neighbour"]))
        values["neighbour"] = np.where(np.isfinite(values["neighbour"]), positions, np.nan)
    return Description(birds, features, values, {}, missing or {}, tracks)


def spans(ethogram, behaviour=None):
    """Return (bird, first frame, frame after the last) of the bouts of a behaviour."""
    bouts = [each for each in ethogram.bouts if behaviour in (None, each.behaviour)]
    return [(each.bird, each.frames.start, each.frames.stop) for each in bouts]


def found(values, rule, **how):
    """Return the spans of one behaviour of one bird."""
    return [span[1:] for span in spans(find_bouts(described(values, **how), rules(up=rule)))]


UP = {"body_pitch": "> 50"}


# ---------------------------------------------------------------------------------------------------------- one rule


def test_a_bout_begins_at_one_limit_and_lasts_to_another():
    pitch = [0, 2, 4, 2, 0, 2, 2, 0, 4, 0, 2, 2, 4]
    rule = {"begins": {"body_pitch": "> 3"}, "lasts": {"body_pitch": "> 1"}}
    assert found({"body_pitch": pitch}, rule) == [(1, 4), (8, 9), (10, 13)]
    assert found({"body_pitch": pitch}, {"begins": {"body_pitch": "> 3"}}) == [(2, 3), (8, 9), (12, 13)]


def test_all_conditions_of_a_rule_hold_together():
    pitch, roll = [60, 60, 60, 0, 60], [0, 9, -9, 0, 4]
    assert found({"body_pitch": pitch, "body_roll": roll}, {"begins": UP | {"body_roll": "-5 to 5"}}) == [
        (0, 1),
        (4, 5),
    ]


def test_a_limit_itself_is_outside():
    assert found({"body_pitch": [50, 51, 50, 49]}, {"begins": UP}) == [(1, 2)]
    assert found({"body_pitch": [-5, -4, 5, 4]}, {"begins": {"body_pitch": "-5 to 5"}}) == [(1, 2), (3, 4)]


def test_a_value_that_is_not_defined_holds_no_condition():
    for condition in ("> 0", "< 100", "-500 to 500"):
        assert found({"body_pitch": [60, np.nan, 60]}, {"begins": {"body_pitch": condition}}) == [(0, 1), (2, 3)]
    nothing = find_bouts(described({"body_pitch": [np.nan] * 4}), rules(up={"begins": UP}))
    assert nothing.bouts == ()
    assert (nothing.state == nothing.names.index(OTHER)).all()


@pytest.mark.parametrize("frames", [1, 2, 3, 4])
def test_short_interruptions_belong_to_the_bout(frames):
    """An interruption of 3 frames lasts 0.3 s."""
    pitch = [60] * 5 + [0] * frames + [60] * 5
    expected = [(0, 10 + frames)] if frames <= 3 else [(0, 5), (5 + frames, 10 + frames)]
    assert found({"body_pitch": pitch}, {"begins": UP, "bridge_s": 0.3}) == expected


def test_a_bridge_joins_runs_of_which_one_begins():
    pitch = [2, 2, 0, 2, 4, 0, 0, 0, 2]
    rule = {"begins": {"body_pitch": "> 3"}, "lasts": {"body_pitch": "> 1"}, "bridge_s": 0.2}
    assert found({"body_pitch": pitch}, rule) == [(0, 5)]
    assert found({"body_pitch": [0, 0, 4, 0, 0]}, rule) == [(2, 3)]  # nothing to bridge at the ends


def test_short_runs_do_not_count():
    pitch = [60] * 2 + [0] + [60] * 4 + [0] + [60] * 7
    assert found({"body_pitch": pitch}, {"begins": UP, "least_s": 0.5}) == [(8, 15)]
    bridged = {"begins": UP, "least_s": 1.4, "bridge_s": 0.2}
    assert found({"body_pitch": pitch}, bridged) == [(0, 15)]  # interruptions are bridged first


def test_frame_rates_do_not_matter():
    """The same second of the same bird at 10, 25 and 50 frames/s."""
    for fps in (10, 25, 50):
        time_s = np.arange(4 * fps) / fps
        up = ((time_s > 0.95) & (time_s < 1.95)) | ((time_s > 2.15) & (time_s < 2.35)) | (time_s > 3.15)
        rule = {"begins": UP, "bridge_s": 0.3, "least_s": 0.9}
        (bout,) = find_bouts(described({"body_pitch": 60.0 * up}, fps=fps), rules(up=rule)).bouts
        assert bout.start_s == pytest.approx(1, abs=0.051)
        assert bout.stop_s == pytest.approx(2.35, abs=0.051)


def test_start_and_stop():
    ethogram = find_bouts(described({"body_pitch": [0, 0, 60, 60, 60, 0]}), rules(up={"begins": UP}))
    (bout,) = ethogram.bouts
    assert (bout.start_s, bout.stop_s) == (pytest.approx(0.2), pytest.approx(0.5))
    assert ethogram.frame_s == pytest.approx(0.1)
    late = find_bouts(described({"body_pitch": [0, 60, 60]}, time_s=[7, 7.5, 8.0]), rules(up={"begins": UP}))
    assert (late.bouts[0].start_s, late.bouts[0].stop_s) == (7.5, 8.5)


def test_a_bird_without_a_pose_does_nothing():
    valid = np.array([[True, False, False, False, True, True]])
    ethogram = find_bouts(described({"body_pitch": [60] * 6}, valid=valid), rules(up={"begins": UP}))
    assert spans(ethogram) == [(0, 0, 1), (0, 4, 6)]
    np.testing.assert_array_equal(ethogram.state == NO_POSE, ~valid)


def test_every_bird_has_its_own_bouts():
    pitch = [[60, 60, 0, 0], [0, 0, 0, 0], [0, 60, 60, 60]]
    ethogram = find_bouts(described({"body_pitch": pitch}, track_id=[5, 3, 9]), rules(up={"begins": UP}))
    assert spans(ethogram) == [(0, 0, 2), (2, 1, 4)]  # a bird is a position, not a track number


def test_one_frame_and_no_frame_with_a_value():
    assert found({"body_pitch": [60]}, {"begins": UP}) == [(0, 1)]
    assert found({"body_pitch": [60]}, {"begins": UP, "least_s": 0.5}) == []


def test_a_short_interruption_without_a_pose_belongs_to_the_bout():
    valid = np.array([[True] * 5 + [False] + [True] * 5])
    ethogram = find_bouts(described({"body_pitch": [60] * 11}, valid=valid), rules(up={"begins": UP, "bridge_s": 0.3}))
    assert spans(ethogram) == [(0, 0, 11)]


def test_a_pause_of_the_camera_ends_a_bout():
    time_s = np.concatenate([np.arange(10) / FPS, 3600 + np.arange(10) / FPS])
    bouts = find_bouts(described({"body_pitch": [60] * 20}, time_s=time_s), rules(up={"begins": UP})).bouts
    assert [each.stop_s - each.start_s for each in bouts] == pytest.approx([1.0, 1.0])


def test_a_bout_of_the_least_duration_counts():
    """Five frames last 0.5 s: `stop_s` - `start_s`."""
    assert found({"body_pitch": [0] + [60] * 5 + [0]}, {"begins": UP, "least_s": 0.5}) == [(1, 6)]


# ----------------------------------------------------------------------------------------------------- several rules


def test_earlier_rules_take_their_frames():
    pitch = [60, 60, 80, 80, 60, 60, 0]
    high, low = {"begins": {"body_pitch": "> 70"}}, {"begins": UP}
    first = find_bouts(described({"body_pitch": pitch}), rules(high=high, low=low))
    assert first.names == ("high", "low", OTHER)
    np.testing.assert_array_equal(first.state, [[1, 1, 0, 0, 1, 1, 2]])
    assert spans(first, "low") == [(0, 0, 2), (0, 4, 6)]
    second = find_bouts(described({"body_pitch": pitch}), rules(low=low, high=high))
    np.testing.assert_array_equal(second.state, [[0, 0, 0, 0, 0, 0, 2]])
    assert spans(second, "high") == []


def test_a_run_that_is_too_short_takes_no_frames():
    high, low = {"begins": {"body_pitch": "> 70"}, "least_s": 0.5}, {"begins": UP}
    ethogram = find_bouts(described({"body_pitch": [60, 80, 80, 60]}), rules(high=high, low=low))
    assert spans(ethogram) == [(0, 0, 4)]


def test_what_an_earlier_rule_leaves_may_be_too_short():
    """Of 0.8 s, the earlier rule leaves 0.2 s and 0.4 s; the later rule has the short rest."""
    pitch = [60] * 2 + [80] * 2 + [60] * 4
    high, up = {"begins": {"body_pitch": "> 70"}}, {"begins": UP, "least_s": 0.3}
    ethogram = find_bouts(described({"body_pitch": pitch}), rules(high=high, up=up, rest={"begins": UP}))
    assert spans(ethogram, "up") == [(0, 4, 8)]
    assert spans(ethogram, "rest") == [(0, 0, 2)]


def test_what_an_earlier_rule_leaves_has_a_frame_in_which_it_begins():
    """Walking begins in frames 20 to 29 only, which are a part of an attack."""
    frame = np.arange(60)
    speed = np.where((frame >= 20) & (frame < 30), 0.5, 0.2) * LENGTH_M
    pitch = np.where((frame >= 18) & (frame < 32), 60, 0)
    walking = {"begins": {"speed": "> 0.3"}, "lasts": {"speed": "> 0.15"}}
    ethogram = find_bouts(
        described({"speed": speed, "body_pitch": pitch}), rules(attack={"begins": UP}, walking=walking)
    )
    assert spans(ethogram) == [(0, 18, 32)]
    np.testing.assert_array_equal(ethogram.state[0], np.where(pitch > 50, 0, 2))


def test_missing_poses_do_not_make_a_long_bout_too_short():
    """Of 2 s, every fourth frame has no pose."""
    valid = (np.arange(20) % 4 != 3)[None]
    ethogram = find_bouts(
        described({"body_pitch": [60] * 20}, valid), rules(up={"begins": UP, "least_s": 0.5, "bridge_s": 0.3})
    )
    assert (ethogram.state[valid] == 0).all()


AIR = {"begins": {"airborne": "> 0.7"}, "lasts": {"airborne": "> 0.3"}}


def flights(airborne, valid=True, around_s=0.2, **how):
    config = rules(
        off={"start_of": "flight", "around_s": around_s}, down={"end_of": "flight", "around_s": around_s}, flight=AIR
    )
    return find_bouts(described({"airborne": airborne}, valid, **how), config)


def test_starts_and_ends_that_are_seen():
    """The first frame in the air is frame 6, and the first frame on the ledge after it is frame 14."""
    ethogram = flights([0] * 6 + [1] * 8 + [0] * 6, around_s=0.25)
    assert spans(ethogram, "off") == [(0, 4, 9)]
    assert spans(ethogram, "down") == [(0, 12, 17)]
    assert spans(ethogram, "flight") == [(0, 9, 12)]


def test_starts_and_ends_that_are_not_seen():
    always = flights([1] * 8)
    assert spans(always) == [(0, 0, 8)]
    leaves = flights([0] * 6 + [1] * 8)
    assert [each.behaviour for each in leaves.bouts] == ["off", "flight"]
    arrives = flights([1] * 8 + [0] * 6)
    assert [each.behaviour for each in arrives.bouts] == ["flight", "down"]
    hidden = np.array([[True] * 5 + [False] + [True] * 8])
    assert [each.behaviour for each in flights([0] * 6 + [1] * 8, hidden).bouts] == ["flight"]


def test_a_short_flight_has_a_take_off_and_a_landing():
    """The take-off does not reach beyond the flight, nor the landing before it."""
    ethogram = flights([0] * 8 + [1] * 2 + [0] * 8, around_s=0.45)
    assert spans(ethogram, "off") == [(0, 4, 10)]
    assert spans(ethogram, "down") == [(0, 10, 15)]


def test_nobody_sees_a_start_or_an_end_behind_a_pause_of_the_video():
    time_s = np.arange(20) / FPS
    paused = time_s + 60 * (np.arange(20) >= 6)
    airborne = [0] * 6 + [1] * 8 + [0] * 6
    assert [each.behaviour for each in flights(airborne, time_s=paused).bouts] == ["flight", "down"]
    paused = time_s + 60 * (np.arange(20) >= 14)
    assert [each.behaviour for each in flights(airborne, time_s=paused).bouts] == ["off", "flight"]


def test_one_frame_in_the_air_is_no_flight():
    """By the shipped rules, at 25 frames/s."""
    airborne = np.zeros(60)
    airborne[20] = 1
    zeros = {name: np.full(60, np.nan) for name in ("body_pitch", "neck_angle", "speed")}
    config = load_behaviour_config()
    missing = {each.name: "not measured" for each in config.features if each.name not in {"airborne", *zeros}}
    one = find_bouts(described(zeros | {"airborne": airborne}, fps=25, missing=missing), config)
    assert {each.behaviour for each in one.bouts} == {"standing"}
    airborne[20:26] = 1
    six = find_bouts(described(zeros | {"airborne": airborne}, fps=25, missing=missing), config)
    assert {each.behaviour for each in six.bouts} == {"take_off", "landing", "standing"}
    airborne[20:38] = 1
    long = find_bouts(described(zeros | {"airborne": airborne}, fps=25, missing=missing), config)
    assert spans(long, "flight") == [(0, 28, 31)]  # what take-off and landing leave, though 0.12 s
    assert not (long.state == long.names.index(OTHER)).any()


def test_rounding_of_times_does_not_change_the_take_off():
    for before in range(4, 12):
        ethogram = flights([0] * before + [1] * 8, around_s=0.3)
        assert spans(ethogram, "off") == [(0, before - 3, before + 4)], before


def test_a_behaviour_that_the_result_cannot_show():
    values = {"body_pitch": [60, 60, 0]}
    config = rules(
        off={"start_of": "flight"}, flight=AIR, both={"begins": UP, "lasts": {"airborne": "< 1"}}, up={"begins": UP}
    )
    ethogram = find_bouts(described(values, missing={"airborne": "the ledge is unknown"}), config)
    assert ethogram.names == ("up", OTHER)
    assert ethogram.missing == dict.fromkeys(("off", "flight", "both"), "airborne: the ledge is unknown")
    assert spans(ethogram) == [(0, 0, 2)]


# ----------------------------------------------------------------------------------------------- partners and means


def test_the_partner_is_the_usual_neighbour():
    values = {"body_pitch": [60] * 5 + [0, 60, 60], "neighbour": [12, 12, 7, np.nan, 12, 7, 7, np.nan]}
    with_partner = find_bouts(described(values), rules(up={"begins": UP, "partner": True}))
    assert [each.partner for each in with_partner.bouts] == [12, 7]
    without = find_bouts(described(values), rules(up={"begins": UP}))
    assert [each.partner for each in without.bouts] == [None, None]
    alone = {"body_pitch": [60, 60], "neighbour": [np.nan, np.nan]}
    assert find_bouts(described(alone), rules(up={"begins": UP, "partner": True})).bouts[0].partner is None
    one_bird = {"body_pitch": [60, 60]}
    assert find_bouts(described(one_bird), rules(up={"begins": UP, "partner": True})).bouts[0].partner is None


def test_any_track_number_can_be_a_partner():
    values = {"body_pitch": [60, 60], "neighbour": [-3, -3]}
    assert find_bouts(described(values), rules(up={"begins": UP, "partner": True})).bouts[0].partner == -3


def test_means_of_a_bout():
    values = {
        "body_pitch": [60, 70, np.nan, 80, 0],
        "body_heading": [170, -170, np.nan, -150, 0],
        "speed": [np.nan] * 5,
        "neighbour": [1, 1, 1, 1, 1],
    }
    config = rules(up={"begins": UP, "bridge_s": 0.2})
    (bout,) = find_bouts(described(values), config).bouts
    assert bout.means["body_pitch"] == pytest.approx(70)
    assert bout.means["body_heading"] % 360 == pytest.approx(360 - 170)  # the middle of 170, 190 and 210
    assert np.isnan(bout.means["speed"])
    assert "neighbour" not in bout.means


# ------------------------------------------------------------------------------------------------------------- units


def test_lengths_of_conditions_are_body_lengths():
    """0.3 body lengths per second are 0.12 m/s."""
    speed = np.array([0.1, 0.29, 0.31, 0.5])
    metric = described({"speed": speed * LENGTH_M})
    assert metric.flock.unit == "m"
    config = rules(walking={"begins": {"speed": "> 0.3"}})
    assert spans(find_bouts(metric, config)) == [(0, 2, 4)]
    lengths = replace(described({"speed": speed}), flock=in_lengths(metric.flock))
    assert spans(find_bouts(lengths, config)) == [(0, 2, 4)]


def test_the_same_birds_in_metres_and_in_body_lengths():
    """Two birds meet, one bows, and one flies off; all by the shipped rules."""
    time_s = np.arange(100) / 25
    place = np.zeros((2, 100, 3))
    place[0, :, 0] = np.interp(time_s, [1, 2.5], [0, 0.6])
    place[1] = [1.0, 0, 0]
    place[..., 2] = 0.17
    place[1, :, 2] += np.interp(time_s, [3, 4], [0, 2])
    contact = np.ones((2, 100))
    contact[1, time_s > 3] = 0
    turn = turned(np.array([[0], [180]]) + 0 * time_s, 50)
    turn[0, (time_s > 2.6) & (time_s < 3)] = turned(0, -40)
    metric = flock(result(STANDING, turn, place, contact=contact))
    config = load_behaviour_config()
    first, second = (find_bouts(describe(birds), config) for birds in (metric, in_lengths(metric)))
    np.testing.assert_array_equal(first.state, second.state)
    assert {"walking", "standing", "flight", "take_off"} <= {each.behaviour for each in first.bouts}
    assert [each[:6] for each in first.bouts] == [each[:6] for each in second.bouts]
    assert first.missing == {}


# ----------------------------------------------------------------------------------------------------------- budgets


def budget(pitch, track_id=None, **how):
    description = described({"body_pitch": pitch}, track_id=track_id, **how)
    ethogram = find_bouts(description, rules(high={"begins": {"body_pitch": "> 70"}}, up={"begins": UP}))
    rows = time_budget(ethogram, description.flock.solution.track_id)
    return {(row.track, row.behaviour): row for row in rows}, rows


def test_the_time_of_every_behaviour():
    valid = np.array([[True] * 8, [True] * 4 + [False] * 4])
    rows, listed = budget([[80, 80, 0, 80, 60, 60, 0, 0], [60, 60, 60, 60, 80, 80, 80, 80]], [4, 2], valid=valid)
    assert rows[4, "high"].seconds == pytest.approx(0.3)
    assert rows[4, "high"].bouts == 2
    assert (rows[4, "up"].share, rows[2, "up"].share) == (pytest.approx(2 / 8), pytest.approx(1))
    assert rows[None, "up"].share == pytest.approx(6 / 12)
    assert (rows[None, "up"].bouts, rows[None, "high"].bouts, rows[2, "high"].bouts) == (2, 2, 0)
    for track in (None, 4, 2):
        own = [row for row in listed if row.track == track]
        assert sum(row.share for row in own) == pytest.approx(1)
        seconds = {None: 1.2, 4: 0.8, 2: 0.4}[track]
        assert sum(row.seconds for row in own) == pytest.approx(seconds)
        assert [row.behaviour for row in own] == ["high", "up", OTHER]
    assert [row.track for row in listed] == [None] * 3 + [2] * 3 + [4] * 3


def test_a_bird_without_a_pose_has_no_share():
    valid = np.array([[True] * 4, [False] * 4])
    rows, _ = budget([[60] * 4, [60] * 4], valid=valid)
    assert np.isnan(rows[2, "up"].share)
    assert rows[2, "up"].seconds == 0
    assert rows[None, "up"].share == 1
    assert np.isnan(rows[None, "up"].low)  # one bird has no interval


def test_the_interval_of_two_birds():
    """Of two birds that are seen equally long, the bootstrap draws both or one of them twice."""
    rows, _ = budget([[60, 60, 60, 0, 0, 0, 0, 0, 0, 0], [60] * 8 + [0] * 2])
    total = rows[None, "up"]
    assert (total.share, total.low, total.high) == pytest.approx((0.55, 0.3, 0.8))
    assert np.isnan(rows[1, "up"].low)
    assert np.isnan(rows[None, "high"].high)  # no bird shows it


def test_the_interval_of_many_birds():
    """The standard error of the mean of 40 independent birds."""
    rng = np.random.default_rng(0)
    pitch = np.where(rng.random((40, 50)) < rng.uniform(0.2, 0.8, (40, 1)), 60, 0)
    total = budget(pitch)[0][None, "up"]
    share = (pitch > 50).mean(axis=1)
    half = 1.96 * share.std() / np.sqrt(40)
    assert total.share == pytest.approx(share.mean())
    assert (total.low, total.high) == pytest.approx((share.mean() - half, share.mean() + half), abs=0.1 * half)


def test_birds_that_are_seen_longer_weigh_more():
    valid = np.ones((3, 100), bool)
    valid[1:, 10:] = False
    rows, _ = budget([[0] * 100, [60] * 100, [60] * 100], valid=valid)
    assert rows[None, "up"].share == pytest.approx(20 / 120)
    assert rows[None, "up"].low == 0
    assert rows[None, "up"].high == 1


def test_no_bird_has_no_budget():
    description = described({"body_pitch": np.zeros((0, 5))})
    ethogram = find_bouts(description, rules(up={"begins": UP}))
    assert ethogram.bouts == ()
    assert all(np.isnan(row.share) for row in time_budget(ethogram, np.zeros(0, int)))


def test_the_time_of_a_video_whose_frame_rate_changes():
    """Upright for 4 s at 25 frames/s, then not for 1 s at 50 frames/s."""
    time_s = np.concatenate([np.arange(100) / 25, 4 + np.arange(50) / 50])
    rows, _ = budget([60] * 100 + [0] * 50, time_s=time_s)
    assert rows[1, "up"].seconds == pytest.approx(4, abs=0.1)
    assert rows[1, OTHER].seconds == pytest.approx(1, abs=0.1)
    assert rows[1, "up"].share == pytest.approx(0.8, abs=0.01)


def test_budget_and_bouts_of_a_video_whose_frame_rate_changes():
    """50 frames at 25 frames/s, then 50 frames at 10 frames/s: no frame of the second half counts as a gap."""
    time_s = np.concatenate([np.arange(50) / 25, 2 + np.arange(50) / 10])
    rows, _ = budget([0] * 25 + [60] * 50 + [0] * 25, time_s=time_s)
    ethogram = find_bouts(described({"body_pitch": [60] * 100}, time_s=time_s), rules(up={"begins": UP}))
    (bout,) = ethogram.bouts
    assert (bout.start_s, bout.stop_s) == (0, pytest.approx(7))
    assert ethogram.frame_s == pytest.approx(np.repeat([0.04, 0.1], 50))
    assert rows[1, "up"].seconds == pytest.approx(1 + 2.5)
    assert rows[1, OTHER].seconds == pytest.approx(1 + 2.5)
    gap = np.concatenate([np.arange(50) / 25, 60 + np.arange(50) / 10])
    rows, _ = budget([60] * 100, time_s=gap)
    assert rows[1, "up"].seconds == pytest.approx(2 + 5, abs=0.07)


# --------------------------------------------------------------------------------------------------- a part of a result


def test_a_part_of_a_result_has_the_values_of_the_whole():
    """Two of three birds, in frames 3 to 8; the partner of the first bird is not one of them."""
    pitch = [[0, 60, 60, 60, 60, 0, 0, 60, 60, 60], [60] * 10, [0] * 10]
    neighbour = [[5] * 10, [9] * 10, [5] * 10]
    whole = described({"body_pitch": pitch, "neighbour": neighbour}, track_id=[4, 5, 9])
    ethogram = find_bouts(whole, rules(up={"begins": UP, "partner": True}))
    rows, columns = np.array([0, 2]), np.arange(3, 9)
    part = whole.select(rows, columns)
    chosen = ethogram.select(rows, columns, part)
    np.testing.assert_array_equal(part.values["body_pitch"], np.array(pitch)[rows][:, columns])
    assert part.tracks("neighbour").tolist() == [[5] * 6, [5] * 6]
    assert part.flock.solution.track_id.tolist() == [4, 9]
    assert spans(chosen) == [(0, 0, 2), (0, 4, 6)]
    assert [each.partner for each in chosen.bouts] == [5, 5]
    assert [time for each in chosen.bouts for time in each[3:5]] == pytest.approx([0.3, 0.5, 0.7, 0.9])
    np.testing.assert_array_equal(chosen.state, ethogram.state[rows][:, columns])
    total = time_budget(chosen, part.flock.solution.track_id)[0]
    assert (total.seconds, total.share, total.bouts) == pytest.approx((0.4, 4 / 12, 2))


# -------------------------------------------------------------------------------------------------- foreign features


@pytest.fixture
def package(tmp_path, monkeypatch):
    (tmp_path / "own_rules.py").write_text("def tall(birds):\n    return birds.place[..., 2]\n")
    monkeypatch.syspath_prepend(str(tmp_path))


def test_a_rule_with_a_feature_of_another_package(package):
    config = rules(up={"begins": {"own_rules:tall": "> 0.5"}})
    description = describe(flock(result(place_m=np.array([[[0, 0, 0.2], [0, 0, 0.8]]]))), config.features)
    assert spans(find_bouts(description, config)) == [(0, 1, 2)]
