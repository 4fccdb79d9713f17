"""Bouts and time budgets by rules: values of features that are written by hand, and bouts that are counted by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom
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
HYSTERESIS = {"begins": {"body_pitch": "> 3"}, "lasts": {"body_pitch": "> 1"}}
INTERRUPTED = [60] * 2 + [0] + [60] * 4 + [0] + [60] * 7


@pytest.mark.parametrize(
    ("pitch", "rule", "expected"),
    [
        ([0, 2, 4, 2, 0, 2, 2, 0, 4, 0, 2, 2, 4], HYSTERESIS, [(1, 4), (8, 9), (10, 13)]),
        ([0, 2, 4, 2, 0, 2, 2, 0, 4], {"begins": {"body_pitch": "> 3"}}, [(2, 3), (8, 9)]),
        # a bridge joins runs of which one begins, and there is nothing to bridge at the ends
        ([2, 2, 0, 2, 4, 0, 0, 0, 2], HYSTERESIS | {"bridge_s": 0.2}, [(0, 5)]),
        ([0, 0, 4, 0, 0], HYSTERESIS | {"bridge_s": 0.2}, [(2, 3)]),
        # a limit itself is outside, and a value that is not defined holds no condition
        ([50, 51, 50, 49], {"begins": UP}, [(1, 2)]),
        ([-5, -4, 5, 4], {"begins": {"body_pitch": "-5 to 5"}}, [(1, 2), (3, 4)]),
        ([60, np.nan, 60], {"begins": {"body_pitch": "-500 to 500"}}, [(0, 1), (2, 3)]),
        ([np.nan] * 4, {"begins": UP}, []),
        # an interruption of 3 frames lasts 0.3 s
        ([60] * 5 + [0] * 3 + [60] * 5, {"begins": UP, "bridge_s": 0.3}, [(0, 13)]),
        ([60] * 5 + [0] * 4 + [60] * 5, {"begins": UP, "bridge_s": 0.3}, [(0, 5), (9, 14)]),
        # short runs do not count; five frames last 0.5 s; interruptions are bridged first
        (INTERRUPTED, {"begins": UP, "least_s": 0.5}, [(8, 15)]),
        ([0] + [60] * 5 + [0], {"begins": UP, "least_s": 0.5}, [(1, 6)]),
        (INTERRUPTED, {"begins": UP, "least_s": 1.4, "bridge_s": 0.2}, [(0, 15)]),
    ],
)
def test_bouts_of_one_rule(pitch, rule, expected):
    assert found({"body_pitch": pitch}, rule) == expected


def test_all_conditions_of_a_rule_hold_together():
    values = {"body_pitch": [60, 60, 60, 0, 60], "body_roll": [0, 9, -9, 0, 4]}
    assert found(values, {"begins": UP | {"body_roll": "-5 to 5"}}) == [(0, 1), (4, 5)]


def test_start_and_stop():
    ethogram = find_bouts(described({"body_pitch": [0, 0, 60, 60, 60, 0]}), rules(up={"begins": UP}))
    (bout,) = ethogram.bouts
    assert (bout.start_s, bout.stop_s) == (pytest.approx(0.2), pytest.approx(0.5))
    assert ethogram.frame_s == pytest.approx(0.1)
    late = find_bouts(described({"body_pitch": [0, 60, 60]}, time_s=[7, 7.5, 8.0]), rules(up={"begins": UP}))
    assert (late.bouts[0].start_s, late.bouts[0].stop_s) == (7.5, 8.5)


def test_a_bird_without_a_pose_does_nothing_but_a_short_interruption_belongs_to_its_bout():
    valid = np.array([[True, False, False, False, True, False, True]])
    rule = {"begins": UP, "bridge_s": 0.1}
    ethogram = find_bouts(described({"body_pitch": [60] * 7}, valid=valid), rules(up=rule))
    assert spans(ethogram) == [(0, 0, 1), (0, 4, 7)]
    np.testing.assert_array_equal(ethogram.state == NO_POSE, ~valid)


def test_a_pause_of_the_camera_ends_a_bout():
    time_s = np.concatenate([np.arange(10) / FPS, 3600 + np.arange(10) / FPS])
    bouts = find_bouts(described({"body_pitch": [60] * 20}, time_s=time_s), rules(up={"begins": UP})).bouts
    assert [each.stop_s - each.start_s for each in bouts] == pytest.approx([1.0, 1.0])


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
    config = rules(attack={"begins": UP}, walking={"begins": {"speed": "> 0.3"}, "lasts": {"speed": "> 0.15"}})
    ethogram = find_bouts(described({"speed": speed, "body_pitch": pitch}), config)
    assert spans(ethogram) == [(0, 18, 32)]
    np.testing.assert_array_equal(ethogram.state[0], np.where(pitch > 50, 0, 2))


AIR = {"begins": {"airborne": "> 0.7"}, "lasts": {"airborne": "> 0.3"}}


def flights(airborne, valid=True, around_s=0.2, **how):
    config = rules(
        off={"start_of": "flight", "around_s": around_s}, down={"end_of": "flight", "around_s": around_s}, flight=AIR
    )
    return find_bouts(described({"airborne": airborne}, valid, **how), config)


TIME_S = np.arange(20) / FPS
THERE_AND_BACK = [0] * 6 + [1] * 8 + [0] * 6


@pytest.mark.parametrize(
    ("airborne", "how", "expected"),
    [
        # the first frame in the air is frame 6, and the first frame on the ledge after it is frame 14
        (THERE_AND_BACK, {"around_s": 0.25}, {"off": (4, 9), "flight": (9, 12), "down": (12, 17)}),
        # the take-off does not reach beyond the flight, nor the landing before it
        ([0] * 8 + [1] * 2 + [0] * 8, {"around_s": 0.45}, {"off": (4, 10), "down": (10, 15)}),
        # starts and ends that are not seen: at the ends of the video, without a pose, behind a pause of the video
        ([1] * 8, {}, {"flight": (0, 8)}),
        ([0] * 6 + [1] * 8, {}, {"off": (4, 9), "flight": (9, 14)}),
        ([1] * 8 + [0] * 6, {}, {"flight": (0, 6), "down": (6, 11)}),
        ([0] * 6 + [1] * 8, {"valid": np.arange(14)[None] != 5}, {"flight": (6, 14)}),
        (THERE_AND_BACK, {"time_s": TIME_S + 60 * (TIME_S > 0.55)}, {"flight": (6, 12), "down": (12, 17)}),
        (THERE_AND_BACK, {"time_s": TIME_S + 60 * (TIME_S > 1.35)}, {"off": (4, 9), "flight": (9, 14)}),
    ],
)
def test_starts_and_ends(airborne, how, expected):
    bouts = flights(airborne, **how).bouts
    assert {each.behaviour: (each.frames.start, each.frames.stop) for each in bouts} == expected
    assert len(bouts) == len(expected)


def test_one_frame_in_the_air_is_no_flight():
    """By the shipped rules, at 25 frames/s."""
    config, unknown = load_behaviour_config(), dict.fromkeys(("body_pitch", "neck_angle", "speed"), [np.nan] * 60)
    missing = {each.name: "not measured" for each in config.features if each.name not in {"airborne", *unknown}}

    def shown(last):
        airborne = (np.arange(60) >= 20) & (np.arange(60) < last)
        return find_bouts(described(unknown | {"airborne": airborne}, fps=25, missing=missing), config)

    assert {each.behaviour for each in shown(21).bouts} == {"standing"}
    assert {each.behaviour for each in shown(26).bouts} == {"take_off", "landing", "standing"}
    long = shown(38)
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
    rows, _ = budget([[60] * 4, [60] * 4], valid=np.array([[True] * 4, [False] * 4]))
    assert np.isnan(rows[2, "up"].share)
    assert rows[2, "up"].seconds == 0
    assert rows[None, "up"].share == 1
    assert np.isnan(rows[None, "up"].low)  # one bird has no interval
    assert all(np.isnan(row.share) for row in budget(np.zeros((0, 5)))[1])


def test_fewer_than_eight_birds_have_no_interval():
    """Eight birds: four stand always, four half of the time. The bootstrap is a binomial distribution."""
    pitch = [[60] * 10] * 4 + [[60] * 5 + [0] * 5] * 4
    rows, _ = budget(pitch)
    total = rows[None, "up"]
    ends = 0.5 + binom.ppf([0.025, 0.975], 8, 0.5) / 16
    assert (total.share, total.low, total.high) == pytest.approx((0.75, *ends))
    assert np.isnan(rows[1, "up"].low)
    assert np.isnan(rows[None, "high"].high)  # no bird shows it
    assert np.isnan(budget(pitch[:7])[0][None, "up"].low)


def test_the_interval_of_many_birds():
    """The standard error of the mean of 40 independent birds."""
    rng = np.random.default_rng(0)
    pitch = np.where(rng.random((40, 50)) < rng.uniform(0.2, 0.8, (40, 1)), 60, 0)
    total = budget(pitch)[0][None, "up"]
    share = (pitch > 50).mean(axis=1)
    half = 1.96 * share.std() / np.sqrt(40)
    assert total.share == pytest.approx(share.mean())
    assert (total.low, total.high) == pytest.approx((share.mean() - half, share.mean() + half), abs=0.1 * half)


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
