"""Figures by behaviour and keypoint, intervals, and what is stored of them: each by hand."""

import dataclasses
import json
import math

import numpy as np
import pytest
from support.evaluated import BIRD, N, T, sides, solution, truth

from jaxfit.cli.tables import breakdown_tables
from jaxfit.evaluation.evaluate import COLUMNS, COLUMNS_3D, COLUMNS_KEYPOINT, Evaluation, evaluate
from jaxfit.evaluation.truth import Truth, read_behaviours
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import json_text

K = BIRD.num_keypoints
ACTS = {5: [(0, "stand"), (12, "preen")], 3: [(0, "walk"), (11, "stand")]}
"""Frames 10, 11, 12, 14: bird 5 stands, stands, preens, preens; bird 3 walks, stands, stands, stands."""


def moved(n, t, k=slice(None), by=(6, 8)):
    """The truth, but for some keypoints of one bird and frame: 10 px off."""
    points = solution().keypoints.px.copy()
    points[n, t, k] += by
    return solution(keypoints_px=points)


def test_behaviours_are_a_partition():
    result = evaluate(moved(0, 1), BIRD, Truth(truth(), behaviours=ACTS))
    rows = result.behaviours
    assert [(name, row["birds"], row["frames"]) for name, row in rows.items()] == [
        ("preen", 1, 2),
        ("stand", 2, 5),
        ("walk", 1, 1),
    ]
    assert sum(row["frames"] for row in rows.values()) == result.frames
    squares = sum(row["frames"] * row["me_p"] ** 2 for row in rows.values()) / result.frames
    assert math.sqrt(squares) == pytest.approx(result.overall["me_p"])  # every frame has all keypoints
    assert rows["stand"]["me_p"] == pytest.approx(math.sqrt(100 / sides()[0, 1] ** 2 / 5), rel=0.02)
    assert rows["preen"]["me_p"] == rows["walk"]["me_p"] == pytest.approx(0, abs=1e-6)
    assert rows["walk"]["iou"] > 0.999


def test_a_pair_of_frames_belongs_to_the_behaviour_of_the_earlier_one():
    """Bird 5 preens from frame 12 on: the jump from 11 to 12 is one of the standing bird."""
    rows = evaluate(moved(0, 2), BIRD, Truth(truth(), behaviours=ACTS)).behaviours
    assert math.isnan(rows["preen"]["me_v"])  # 12 and 14 are no neighbours
    # standing pairs: 10-11 and 11-12 of bird 5, 11-12 of bird 3
    assert rows["stand"]["me_v"] == pytest.approx(math.sqrt(100 / sides()[0, 1] ** 2 / 3), rel=0.02)
    assert rows["walk"]["me_v"] == pytest.approx(0, abs=1e-6)


def test_keypoints_sum_to_the_whole():
    off = moved(1, 0, 2)
    confidence = truth().confidence.copy()
    confidence[0, :2, 1] = 0
    seen = dataclasses.replace(truth(), confidence=confidence)
    result = evaluate(off, BIRD, seen)
    assert list(result.keypoints) == list(BIRD.keypoint_names)
    rows = list(result.keypoints.values())
    assert [row["count"] for row in rows] == [N * T, N * T - 2, *[N * T] * (K - 2)]
    squares, count = sum(row["count"] * row["me_p"] ** 2 for row in rows), sum(row["count"] for row in rows)
    assert math.sqrt(squares / count) == pytest.approx(result.overall["me_p"])
    side = sides()[1, 0]
    assert rows[2]["me_p"] == pytest.approx(math.sqrt(100 / side**2 / (N * T)), rel=0.02)
    assert rows[2]["me_v"] == pytest.approx(math.sqrt(100 / side**2 / 4), rel=0.02)  # one of two pairs a bird
    assert rows[2]["pck@0.05"] == (7 + (0.05 * side >= 10)) / 8
    assert rows[0]["me_p"] == rows[3]["me_v"] == pytest.approx(0, abs=1e-6)


def test_the_overall_figures_are_those_of_the_sums():
    result = evaluate(moved(1, 0), BIRD, truth())
    assert result.sums.birds == ("5", "3")
    assert result.sums.values() == pytest.approx(result.overall)
    assert result.sums.counts["me_p"] == (T * K, T * K)
    assert result.sums.counts["me_v"] == (2 * K, 2 * K)
    assert result.sums.counts["iou"] == (T, T)
    assert tuple(result.intervals) == COLUMNS
    # of two birds, a quarter of the draws is one bird twice
    rows = sorted(row["me_p"] for row in result.tracks.values())
    assert result.intervals["me_p"] == pytest.approx(rows)


def test_all_of_it_can_be_stored():
    true = solution(crop=np.array(solution().crops.square_px))
    valid = np.array([[True] * T, [True, False, True, False]])
    for result in (
        evaluate(moved(0, 1), BIRD, Truth(truth(), true, behaviours=ACTS)),
        evaluate(solution(valid=valid), BIRD, Truth(truth().select(tracks=[1]), true, behaviours=ACTS)),  # NaN metrics
        evaluate(moved(0, 1), BIRD, truth()),
    ):
        text = json_text(result.to_dict())
        assert "NaN" not in text
        back = Evaluation.from_dict(json.loads(text))
        with pytest.raises(ValueError, match="has no sums"):
            Evaluation.from_dict({name: value for name, value in json.loads(text).items() if name != "sums"})
        assert json_text(back.to_dict()) == text
        assert back.sums == result.sums
        assert set(back.tracks) == set(result.tracks)
        assert back.intervals["iou"]._fields == ("low", "high")
    assert "orientation_median_deg" in COLUMNS_3D
    assert "orientation_median_deg" not in result.intervals


def test_tables_of_behaviours_and_keypoints():
    result = evaluate(moved(0, 1), BIRD, Truth(truth(), solution(), behaviours=ACTS))
    picture, space = breakdown_tables(result, "behaviour")
    assert list(picture.columns[0].cells) == list(space.columns[0].cells) == ["preen", "stand", "walk"]
    assert list(picture.columns[2].cells) == ["2", "5", "1"]
    (points,) = breakdown_tables(result, "keypoint")
    assert [column.header for column in points.columns] == ["keypoint", "frames", *COLUMNS_KEYPOINT]
    assert len(points.rows) == K


def test_a_bird_that_does_nothing_known():
    with pytest.raises(InputError, match=r"^s: has no behaviour for bird 3"):
        evaluate(solution(), BIRD, Truth(truth(), source="s", behaviours={5: ACTS[5]}))
    assert evaluate(solution(), BIRD, Truth(truth().select(tracks=[0]), behaviours={5: ACTS[5]})).behaviours["stand"]


def test_behaviours_are_read_from_a_scene(tmp_path):
    assert read_behaviours(tmp_path) is None
    assert read_behaviours(tmp_path / "truth.json") is None
    acts = {"3": [{"from_frame": 0, "behaviour": "walk"}, {"from_frame": 11, "behaviour": "stand"}]}
    (tmp_path / "scene.json").write_text(json.dumps({"behaviour": acts}))
    assert read_behaviours(tmp_path) == {3: ACTS[3]}
    late = {"3": [{"from_frame": 2, "behaviour": "walk"}]}
    for content, message in (
        ({}, "lacks the key behaviour"),
        ({"behaviour": [1]}, "behaviour must be an object"),
        ({"behaviour": late}, r"behaviour\.3 must be the behaviours of a track id"),
        ({"behaviour": {"three": acts["3"]}}, r"behaviour\.three must be the behaviours"),
        ({"behaviour": {"3": acts["3"][::-1]}}, r"behaviour\.3 must be the behaviours"),
        ({"behaviour": {"3": [{"from_frame": 0}]}}, r"behaviour\.3\[0\] lacks the key behaviour"),
    ):
        (tmp_path / "scene.json").write_text(json.dumps(content))
        with pytest.raises(InputError, match=message):
            read_behaviours(tmp_path)
