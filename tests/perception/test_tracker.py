"""Trackers: assignment, memory, and the adapter to an optional package."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from support.instances import rectangle_instance

from jaxfit.foundation.errors import InputError
from jaxfit.perception.external_trackers import EXTERNAL_TRACKERS
from jaxfit.perception.tracking import TRACKERS, load_tracker


def bird(x, y=0, width=20, height=10, score=0.9):
    return rectangle_instance(x, y, width, height, score)


def follow(tracker, frames):
    """Identities of each frame; frames: number → columns at which birds begin."""
    return [tracker.update(t, [bird(x) for x in columns]) for t, columns in frames.items()]


def test_identities_do_not_depend_on_the_order_of_instances():
    assert follow(load_tracker(), {0: [0, 100], 1: [104, 3], 2: [6, 108, 200]}) == [[1, 2], [2, 1], [1, 2, 3]]


def test_assignment_maximises_the_sum_of_ious():
    """The pair with the greatest IoU, 17/23 of box 2 and bird 1, is not assigned: 17/23 + 4/36 < 13/27 + 14/26."""
    tracker = load_tracker()
    tracker.update(0, [bird(0), bird(10)])
    assert tracker.update(1, [bird(7), bird(16)]) == [1, 2]


def test_iou_must_exceed_min_iou():
    # shifted by 10 of 20 columns: 10 / 30 are shared
    for least, expected in ((0.33, [1]), (1 / 3, [2]), (0.4, [2])):
        tracker = load_tracker(min_iou=least)
        tracker.update(0, [bird(0)])
        assert tracker.update(1, [bird(10)]) == expected
    tracker = load_tracker(min_iou=0.0)
    tracker.update(0, [bird(0)])
    assert tracker.update(1, [bird(20)]) == [2]  # the boxes touch


@pytest.mark.parametrize("seen", [False, True])
@pytest.mark.parametrize("name", TRACKERS)
def test_memory_counts_missing_frames(name, seen):
    """A track survives five missed frames, but not six, whether the bird or the whole frame is missing."""
    if name in EXTERNAL_TRACKERS:
        pytest.importorskip("trackers", reason="the optional trackers package is not installed")
    for step in (1, 3):
        for missed, back in ((5, 1), (6, None if name in EXTERNAL_TRACKERS else 2)):
            tracker = load_tracker(name, step=step)
            for t in range(4):
                tracker.update(t * step, [bird(50)])
            if seen:
                for t in range(4, 4 + missed):
                    assert tracker.update(t * step, []) == []
            assert tracker.update((4 + missed) * step, [bird(50)]) == [back]


def test_identities_are_never_reused():
    tracker, rng, gone, before = load_tracker(memory=1), np.random.default_rng(0), set(), set()
    last = {}
    for t in range(300):
        found = tracker.update(t, [bird(int(x)) for x in rng.integers(0, 400, rng.integers(0, 6))])
        assert len(set(found)) == len(found)
        assert not gone & set(found)
        assert all(one in before or one > max(before, default=0) for one in found)
        before |= set(found)
        last |= dict.fromkeys(found, t)
        gone = {one for one in before if t - last[one] >= 2}
    assert len(gone) > 50


def test_first_frame_without_birds():
    assert follow(load_tracker(), {0: [], 1: [], 7: [5]}) == [[], [], [1]]


@pytest.mark.parametrize("name", EXTERNAL_TRACKERS)
def test_external_trackers_predict_positions(name):
    """Two birds cross and one is missed meanwhile; in two of the trackers a track starts with the second detection."""
    pytest.importorskip("trackers", reason="the optional trackers package is not installed")
    tracker = load_tracker(name, memory=10)
    found = []
    for t in range(30):
        birds = [bird(200 - 6 * t, 6, 40, 40), bird(6 * t, 0, 40, 40)]
        found.append(tracker.update(t, birds[:1] if 15 <= t < 19 else birds, np.zeros((60, 260, 3), np.uint8)))
    assert found[0] == ([1, 2] if name == "botsort" else [None, None])
    assert all(len(set(pair)) == len(pair) for pair in found[1:])
    assert found[5] == found[-1]
    assert sorted(found[5]) == [1, 2]


@pytest.mark.parametrize("name", EXTERNAL_TRACKERS)
def test_external_trackers_start_no_track_with_a_low_score(name):
    pytest.importorskip("trackers", reason="the optional trackers package is not installed")
    for least, expected in ((0.3, 1), (0.5, None)):
        tracker = load_tracker(name, min_score=least)
        assert [tracker.update(t, [bird(5, score=0.4)]) for t in range(4)][-1] == [expected]


class FakeDetections(SimpleNamespace):
    """The part of `supervision.Detections` that the adapter uses."""

    @staticmethod
    def empty():
        return FakeDetections(xyxy=np.zeros((0, 4)))

    def __len__(self):
        return len(self.xyxy)


class FakeTracker:
    """Drops the first instance and returns the others in reverse order; the last instance has no track yet."""

    def __init__(self, **settings):
        self.settings, self.calls = settings, []

    def update(self, detections, frame=None):
        self.calls.append((detections, frame))
        order = np.arange(len(detections))[:0:-1]
        ids = np.where(order == len(detections) - 1, -1, order + 40)
        return FakeDetections(xyxy=detections.xyxy[order], tracker_id=ids, data={"instance": order})


@pytest.fixture
def fake_package(monkeypatch):
    names = ("ByteTrackTracker", "OCSORTTracker", "BoTSORTTracker")
    contents = {"trackers": dict.fromkeys(names, FakeTracker), "supervision": {"Detections": FakeDetections}}
    for name, content in contents.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)


@pytest.mark.parametrize("name", EXTERNAL_TRACKERS)
def test_adapter_assigns_identities_to_instances(fake_package, name):
    tracker = load_tracker(name, memory=3, min_iou=0.2, min_score=0.4, step=2)
    inner, frame = tracker._tracker, np.zeros((9, 9, 3), np.uint8)
    assert inner.settings["lost_track_buffer"] == 3
    assert inner.settings["frame_rate"] == 30
    assert inner.settings["high_conf_det_threshold"] == 0.4
    assert 0.2 in inner.settings.values()
    birds = [bird(0), bird(30, 5, 8, 4, 0.75), bird(60), bird(90)]
    assert tracker.update(10, birds, frame) == [None, 42, 43, None]
    detections, shown = inner.calls[0]
    np.testing.assert_array_equal(detections.xyxy[1], [30, 5, 38, 9])
    np.testing.assert_array_equal(detections.confidence, np.float32([0.9, 0.75, 0.9, 0.9]))
    assert (shown is frame) == (name == "botsort")
    # 12 and 14 are missing; a gap of any length needs at most memory + 1 empty updates
    tracker.update(16, birds[:2])
    assert [len(found) for found, _ in inner.calls] == [4, 0, 0, 2]
    assert tracker.update(9016, []) == []
    assert [len(found) for found, _ in inner.calls[4:]] == [0] * 5


def test_missing_package_is_reported_with_the_command_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "trackers", None)
    with pytest.raises(InputError, match=r'tracker ocsort: needs the package \w+.*pip install "\.\[trackers\]" in'):
        load_tracker("ocsort")


def test_invalid_settings_are_rejected(fake_package):
    with pytest.raises(InputError, match=r"tracker sort: is unknown \(choose one of iou, bytetrack, ocsort, botsort\)"):
        load_tracker("sort")
    for wrong in ({"memory": -1}, {"min_iou": 1.5}, {"min_score": -0.1}, {"step": 0}):
        with pytest.raises(ValueError, match=f"memory must be .*{next(iter(wrong.values()))}"):
            load_tracker(**wrong)
    for name in ("iou", "bytetrack"):
        tracker = load_tracker(name)
        tracker.update(4, [])
        with pytest.raises(ValueError, match="frame_index must increase, but 4 follows 4"):
            tracker.update(4, [])
