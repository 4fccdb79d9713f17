"""Signals of uncertainty: each signal is largest in the frame where its cause was put."""

import dataclasses

import numpy as np
import pytest

from jaxfit.data.observations import Observations
from jaxfit.perception.network import instance_of
from jaxfit.review.signals import combine, frame_signals, mirror_disagreement, ranks, segmenter_disagreement

NAMES = ("bill_tip", "left_wrist", "right_wrist", "tail_tip")
T, SIDE = 60, 64


@pytest.fixture(scope="module")
def calm():
    """Two birds with exact keypoints in smooth motion."""
    phase = np.arange(2)[:, None, None] + np.arange(T)[None, :, None] / 30 + np.arange(4)
    points = SIDE / 2 + 15 * np.stack([np.cos(phase), np.sin(phase)], axis=-1)
    return Observations(
        track_id=np.arange(2),
        frame_index=np.arange(T),
        present=np.ones((2, T), bool),
        keypoints_px=points,
        confidence=np.full((2, T, 4), 0.9),
        box_px=np.tile([16, 16, 32, 32], (2, T, 1)),
        image_size_px=np.tile([SIDE, SIDE], (T, 1)),
        file_name=np.array([f"{t}.png" for t in range(T)]),
        keypoint_names=NAMES,
        score=np.full((2, T), 0.8),
    )


def changed(observations, t, **values):
    """Return observations with other values for the first bird in frame t."""
    arrays = {}
    for name, value in values.items():
        arrays[name] = getattr(observations, name).copy()
        arrays[name][0, t] = value
    return dataclasses.replace(observations, **arrays)


def strongest(observations, name):
    return int(np.nanargmax(frame_signals(observations)[name]))


def test_low_confidence(calm):
    assert strongest(changed(calm, 31, confidence=0.1), "low confidence") == 31
    assert strongest(changed(calm, 31, score=0.2), "low bird score") == 31


def test_jitter(calm):
    assert strongest(changed(calm, 17, keypoints_px=calm.keypoints_px[0, 17] + 9), "jitter") == 17


def test_missing_birds(calm):
    lost = changed(calm, 40, present=False, confidence=0, score=0)
    values = frame_signals(lost)["missing birds"]
    assert values[40] == pytest.approx((1 + 1) / 2)  # a gap, and one bird less than the two around it
    assert (np.delete(values, 40) == 0).all()
    assert np.isnan(frame_signals(calm.select(tracks=[]))["low confidence"]).all()


def test_ranks_are_shares_of_smaller_values():
    np.testing.assert_allclose(ranks(np.array([3.0, 1, np.nan, 2, 2])), [0.875, 0.125, 0.5, 0.5, 0.5])
    np.testing.assert_array_equal(ranks(np.full(3, np.nan)), 0.5)


def test_combination_of_signals():
    """Constant signals do not count; the strongest signal names the reason; the unit of a signal has no influence."""
    signals = {"a": np.array([0.0, 1, 2]), "b": np.array([500.0, 100, 300]), "constant": np.zeros(3)}
    score, reasons = combine(signals)
    np.testing.assert_allclose(score, [0.5, 1 / 3, 2 / 3])
    assert reasons == ["b", "a", "a"]
    score, reasons = combine({"constant": np.zeros(3)})
    assert score.tolist() == [0.5] * 3
    assert reasons == [""] * 3


class MirroredTruth:
    """A network that detects the true keypoints of bird 0 in the mirror image, plus an error for one keypoint."""

    keypoint_names = NAMES

    def __init__(self, points, width, error):
        self.points, self.width, self.error = points, width, error

    def __call__(self, frame, instances):
        assert (frame[:, 0] == 1).all(), "the frame is mirrored"
        other = [n.replace("left", "R").replace("right", "left").replace("R", "right") for n in self.keypoint_names]
        points = self.points[[self.keypoint_names.index(name) for name in other]].copy()
        points[:, 0] = self.width - points[:, 0]
        points[0, 1] += self.error
        instance = instances[0]
        assert instance.x0 >= 0
        assert instance.x0 + instance.mask.shape[1] <= self.width
        return points[None], np.ones((1, len(other)), np.float32)


@pytest.mark.parametrize(("error", "side_px", "expected"), [(0, 20, 0), (5, 20, 5 / 20), (50, 20, 0.5)])
def test_mirror_disagreement(calm, error, side_px, expected):
    """Mirrored detections that agree have no distance; an error counts as a share of the box, up to one half."""
    one = calm.select(tracks=[0], frames=[0])
    one = dataclasses.replace(one, box_px=np.array([[[10, 10, side_px, side_px / 2]]]))
    frame = np.zeros((SIDE, SIDE, 3), np.uint8)
    frame[:, -1] = 1
    detector = MirroredTruth(one.keypoints_px[0, 0], SIDE, error)
    assert (one.confidence > 0).all()
    share = mirror_disagreement(frame, one, 0, detector)
    assert share == pytest.approx(expected / one.num_keypoints, abs=1e-6)


def test_segmenter_disagreement(calm):
    """One box of 32×32 pixels stands for the mask; the teacher detects a half, the other side, or nothing."""
    one = calm.select(tracks=[0], frames=[0])
    frame = np.zeros((SIDE, SIDE, 3), np.uint8)

    def disagreement(*birds):
        return segmenter_disagreement(frame, one, 0, lambda _: [instance_of(*bird) for bird in birds])

    half = np.ones((32, 16), bool), 1.0, "bird", 16, 16
    other = np.ones((32, 16), bool), 1.0, "bird", 32, 16
    assert disagreement(half) == pytest.approx(1 / 2)
    assert disagreement(half, other) == 0
    assert disagreement() == 1
    empty = calm.select(tracks=[], frames=[0])
    assert segmenter_disagreement(frame, empty, 0, lambda _: []) == 0
