"""Trust: the signals of tracks by hand, and the rule of every signal."""

import numpy as np
import pytest

from jaxfit.perception import trust
from jaxfit.perception.network import instance_of
from jaxfit.perception.tracking import observations_of, record_frame
from jaxfit.perception.trust import FootageSignals, footage_signals, judge

GOOD = FootageSignals(
    birds_per_frame=5.0,
    short_tracks=1,
    tracks=6,
    short_share=0.01,
    contradicted_share=0.0,
    count_change=0.02,
    score=0.95,
    confidence=0.9,
    frame_distance=0.8,
    bird_distance=0.7,
)


def observed(frames):
    """Observations of frames, each a dictionary: track → (score, confidence of both keypoints)."""
    recorded = []
    for t, birds in enumerate(frames):
        instances = [instance_of(np.ones((4, 4), bool), score, "bird") for score, _ in birds.values()]
        confidence = np.array([[value, value] for _, value in birds.values()], np.float32).reshape(-1, 2)
        points = np.zeros((len(birds), 2, 2), np.float32)
        recorded.append(record_frame(t, f"{t}.png", (20, 20), instances, list(birds), points, confidence))
    return observations_of(recorded, ("a", "b"))


def test_signals_by_hand():
    tracks = observed([{1: (0.9, 0.5)}, {1: (0.8, 0.7), 2: (0.3, 0.1)}, {1: (0.7, 0.6)}, {1: (0.6, 0.4)}])
    signals = footage_signals(tracks, {2: 1}, ([1.0, 3.0, 2.0], [0.5]), calibrated=True)
    assert (signals.tracks, signals.short_tracks, signals.birds_per_frame) == (2, 1, 1.25)
    assert signals.short_share == pytest.approx(1 / 5)
    assert signals.count_change == pytest.approx(2 / 3 / 1.25)
    assert signals.contradicted_share == 0
    assert signals.score == pytest.approx(0.7)
    assert signals.confidence == pytest.approx(0.5)
    assert (signals.frame_distance, signals.bird_distance) == (2.0, 0.5)


def test_networks_without_statistics():
    signals = footage_signals(observed([{1: (0.1, 0.1)}] * 3), {})
    assert (signals.score, signals.confidence, signals.frame_distance, signals.bird_distance) == (None,) * 4
    judged = judge(signals)
    assert judged.level == "high"
    assert "not certain" in judged.sentence()


@pytest.mark.parametrize(
    ("signal", "limit", "beyond"),
    [
        ("frame_distance", trust.MAX_FRAME_DISTANCE, 1),
        ("bird_distance", trust.MAX_BIRD_DISTANCE, 1),
        ("score", trust.MIN_SCORE, -1),
        ("confidence", trust.MIN_CONFIDENCE, -1),
        ("contradicted_share", trust.MAX_CONTRADICTED_SHARE, 1),
        ("short_share", trust.MAX_SHORT_SHARE, 1),
        ("count_change", trust.MAX_COUNT_CHANGE, 1),
    ],
)
def test_every_signal_has_a_limit(signal, limit, beyond):
    assert judge(GOOD).level == "high"
    assert judge(GOOD._replace(**{signal: limit})).level == "high"
    judged = judge(GOOD._replace(**{signal: limit + 0.02 * beyond}))
    assert judged.level == "low"
    (reason,) = judged.reasons
    assert f" {limit:.0%} " in reason or f" {limit:.2g} " in reason
    sentence = judged.sentence()
    assert sentence.startswith(f"trust is low: {reason};")
    for remedy in ("--segmenter", "jaxfit suggest", "crop"):
        assert remedy in sentence


def test_several_reasons():
    judged = judge(GOOD._replace(score=0.1, short_share=0.9))
    assert len(judged.reasons) == 2
    assert judged.info() == {"trust": "low", "trust_reasons": "; ".join(judged.reasons)}


@pytest.mark.parametrize("frames", [1, 3])
def test_no_bird(frames):
    judged = judge(footage_signals(observed([{}] * frames), {}, ([0.5] * frames, []), calibrated=True))
    assert (judged.level, judged.reasons) == ("low", ("no bird was tracked",))


def test_a_single_frame():
    signals = footage_signals(observed([{1: (0.9, 0.9)}]), {}, ([0.5], [0.5]), calibrated=True)
    assert signals.count_change is None
    assert judge(signals).level == "high"


def test_frames_without_birds_that_differ_from_the_training():
    judged = judge(footage_signals(observed([{}] * 3), {}, ([9.0] * 3, [])))
    assert judged.reasons[0] == "no bird was tracked"
    assert "distance 9.00" in judged.reasons[1]
