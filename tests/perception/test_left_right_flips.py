"""Left-right flips are detected by continuity; keypoints of a turning bird do not change."""

import dataclasses

import numpy as np
import pytest

from jaxfit.data.observations import Observations
from jaxfit.perception.tracking import repair_left_right_flips
from jaxfit.simulation import noise

PAIRS = ((0, 1), (2, 3), (4, 5))
OFFSETS = np.array([[-12.0, 20], [12, 20], [-20, -5], [20, -5], [-9, -18], [9, -18], [0, 30]])
K, SIDE = len(OFFSETS), 80


def flock(heading, jitter=0.012, seed=0):
    """Birds with the given heading (N T, radians) that drift; their keypoints jitter."""
    rng = np.random.default_rng(seed)
    heading = np.atleast_2d(heading)
    N, T = heading.shape
    c, s = np.cos(heading), np.sin(heading)
    turned = np.einsum("ntij,kj->ntki", np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2), OFFSETS)
    place = 150 + 200 * np.arange(N)[:, None, None] + 5 * np.arange(T)[:, None] % 40
    points = turned + place[..., None, :] + rng.normal(scale=jitter * SIDE, size=turned.shape)
    return Observations(
        track_id=np.arange(N),
        frame_index=np.arange(T),
        present=np.ones((N, T), bool),
        keypoints_px=points,
        confidence=rng.uniform(0.5, 1, (N, T, K)),
        box_px=np.concatenate([np.broadcast_to(place, (N, T, 2)) - SIDE / 2, np.full((N, T, 2), SIDE)], -1),
        image_size_px=np.tile([2000, 2000], (T, 1)),
        file_name=np.array([str(t) for t in range(T)]),
        keypoint_names=tuple(f"k{k}" for k in range(K)),
    )


def with_flips(seen, flipped):
    """Exchange the pairs of `flipped` (N T P)."""
    arrays = {name: getattr(seen, name).copy() for name in ("keypoints_px", "confidence", "occluded")}
    for n, t, p in np.argwhere(flipped):
        for array in arrays.values():
            array[n, t, list(PAIRS[p])] = array[n, t, list(PAIRS[p][::-1])]
    return dataclasses.replace(seen, **arrays)


def without_keypoints(seen, gone):
    return seen.with_keypoints(seen.keypoints_px, np.where(gone, 0, seen.confidence))


def assert_repaired(flipped, expected, seen, truth):
    np.testing.assert_array_equal(flipped, expected)
    for name in ("keypoints_px", "confidence", "occluded"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(truth, name))


def test_runs_of_flips_are_repaired():
    """All pairs of one bird in one run; single pairs of the other bird in its first frames and in two later runs."""
    truth = flock(np.linspace(0, 3, 60) * [[1], [-1]])
    flipped = np.zeros((2, 60, 3), bool)
    flipped[0, 20:25] = flipped[1, :3, 1] = flipped[1, 30:36, 1] = flipped[1, 44:46, 2] = True
    flipped[0, 22, 0] = False
    repaired, found = repair_left_right_flips(with_flips(truth, flipped), PAIRS)
    assert_repaired(found, flipped, repaired, truth)


def test_flips_are_detected_despite_gaps_and_outliers():
    truth = flock(np.linspace(0, 2, 60))
    flipped = np.zeros((1, 60, 3), bool)
    flipped[0, 20:30] = True
    gone = np.zeros((1, 60, K), bool)
    gone[0, 17:21] = gone[0, 24, [0, 2, 4]] = True  # the start of the flip is missing, later one keypoint of each pair
    points = truth.keypoints_px.copy()
    points[0, [26, 40], 3] += 300
    hidden = without_keypoints(truth.with_keypoints(points, truth.confidence), gone)
    repaired, found = repair_left_right_flips(with_flips(hidden, flipped), PAIRS)
    assert found[0, 21:30].all()
    assert not found[0, :17].any()
    assert not found[0, 30:].any()
    np.testing.assert_array_equal(repaired.keypoints_px[:, 21:], hidden.keypoints_px[:, 21:])


def test_quick_turns_are_not_flips():
    """Half a turn in four frames, there and back or only there; a spin of 50° per frame; standing still."""
    t = np.arange(100)

    def headings(frames):
        there, back = np.clip((t - 20) / frames, 0, 1) * np.pi, np.clip((t - 60) / frames, 0, 1) * np.pi
        return np.stack([there - back, back, np.deg2rad(50) * t, 0.0 * t])

    for seed in range(3):
        assert not repair_left_right_flips(flock(headings(4), 0.02, seed), PAIRS)[1].any()
        # with half of all keypoints missing, half a turn in eight
        seen = flock(headings(8), 0.02, seed)
        gone = np.random.default_rng(seed).random(seen.confidence.shape) < 0.5
        assert repair_left_right_flips(without_keypoints(seen, gone), PAIRS)[1].mean() < 0.01


def test_the_longer_part_is_right_if_the_gap_is_short():
    """Two contradicting parts with a long gap in between do not change: there is no sign of a flip."""
    truth = flock(np.zeros(60))
    gone = np.zeros((1, 60, K), bool)
    gone[:, 20:35] = True
    later = np.zeros((1, 60, 3), bool)
    later[:, 35:] = True
    assert not repair_left_right_flips(without_keypoints(with_flips(truth, later), gone), PAIRS)[1].any()
    # without a gap the shorter part follows the longer part
    later[:] = False
    later[:, 48:] = True
    assert_repaired(repair_left_right_flips(with_flips(truth, later), PAIRS)[1], later, truth, truth)


def test_recall_and_precision_on_the_noise_model(monkeypatch):
    """Jitter, outliers, missing keypoints and runs of flips, as the simulated detector makes them."""
    rng = np.random.default_rng(0)
    heading = np.cumsum(np.cumsum(rng.normal(scale=0.02, size=(6, 300)), axis=1) * 0.3, axis=1)
    truth = flock(heading, 0)
    truth = truth.with_keypoints(truth.keypoints_px, np.ones_like(truth.confidence))
    monkeypatch.setattr(noise, "_masks", lambda rng, truth, detected: ({}, truth.box_px * detected[..., None]))
    monkeypatch.setattr(noise, "_visible_area", lambda truth, n, t: 3000.0)
    seen = np.ones(truth.confidence.shape, bool)
    left, right = np.array(PAIRS).T

    def judged(seed):
        detected = noise.simulate_detections(truth, seen, PAIRS, seed)
        found = repair_left_right_flips(detected, PAIRS)[1]
        points, exact = detected.keypoints_px, truth.keypoints_px
        both = (detected.confidence[:, :, left] > 0) & (detected.confidence[:, :, right] > 0)
        near = 0.15 * SIDE
        as_said = (np.linalg.norm(points - exact, axis=-1) < near)[:, :, left]
        as_said &= (np.linalg.norm(points - exact, axis=-1) < near)[:, :, right]
        other = np.linalg.norm(points[:, :, left] - exact[:, :, right], axis=-1) < near
        other &= np.linalg.norm(points[:, :, right] - exact[:, :, left], axis=-1) < near
        return found, both & other & ~as_said, both & as_said & ~other

    found, flipped, right_way = judged(1)
    assert flipped.sum() > 30
    assert (found & flipped).sum() / flipped.sum() > 0.85
    assert (found & flipped).sum() / (found & (flipped | right_way)).sum() > 0.9
    monkeypatch.setattr(noise, "FLIPS_ALL", 0)
    monkeypatch.setattr(noise, "FLIPS_ONE", 0)
    found, _, right_way = judged(2)
    assert (found & right_way).sum() <= 0.001 * right_way.sum()


@pytest.mark.parametrize("tracks", [[], [0]])
def test_nothing_to_repair(tracks):
    seen = flock(np.zeros(5)).select(tracks=np.array(tracks, int))
    assert repair_left_right_flips(seen, ())[1].shape == (len(tracks), 5, 0)
    assert not repair_left_right_flips(seen, PAIRS)[1].any()
    assert repair_left_right_flips(seen.select(frames=[0]), PAIRS)[1].shape == (len(tracks), 1, 3)
    nothing = seen.with_keypoints(seen.keypoints_px, 0 * seen.confidence)
    assert not repair_left_right_flips(nothing, PAIRS)[1].any()
