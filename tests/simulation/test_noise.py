"""The errors of simulated detections have the stated rates and sizes."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import spearmanr

from jaxfit.data.masks import encode_mask
from jaxfit.data.observations import Observations
from jaxfit.simulation import noise
from jaxfit.simulation.noise import simulate_detections

N, T, K, W, H = 3, 400, 20, 320, 200
PAIRS = ((0, 1), (2, 3), (4, 5))


@pytest.fixture(scope="module")
def truth():
    """Three discs that stand still: two touch, the third is absent in the second half."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:H, :W] + 0.5
    centres, radius = np.array([[80, 100], [159, 100], [260, 100]]), 40
    discs = [np.hypot(columns - x, rows - y) < radius for x, y in centres]
    present = np.ones((N, T), bool)
    present[2, T // 2 :] = False
    offsets = rng.uniform(-28, 28, (N, K, 2))
    offsets[:, :6] = [(side, row) for row in (-15, 0, 15) for side in (-25, 25)]  # pairs stand apart
    points = np.broadcast_to((centres[:, None] + offsets)[:, None], (N, T, K, 2))
    box = np.concatenate([centres - radius, np.full((N, 2), 2 * radius)], axis=1)
    return Observations(
        track_id=np.arange(N),
        frame_index=np.arange(T),
        present=present,
        keypoints_px=points,
        confidence=np.broadcast_to(present[..., None], (N, T, K)).astype(np.float32),
        box_px=np.broadcast_to(box[:, None], (N, T, 4)),
        image_size_px=np.tile([W, H], (T, 1)),
        file_name=np.array([str(t) for t in range(T)]),
        keypoint_names=tuple(f"k{k}" for k in range(K)),
        masks={(n, t): encode_mask(discs[n]) for n, t in np.argwhere(present).tolist()},
    )


@pytest.fixture(scope="module")
def visible():
    """The last five keypoints are always occluded."""
    return np.broadcast_to(np.arange(K) < 15, (N, T, K))


@pytest.fixture(scope="module")
def detected(truth, visible):
    return simulate_detections(truth, visible, PAIRS, seed=1)


def error_px(detected, truth):
    return np.linalg.norm(detected.keypoints_px - truth.keypoints_px, axis=-1)


def test_jitter_has_the_stated_size(detected, truth):
    used = detected.confidence > 0
    plain = np.arange(6, 15)  # no pair, not occluded
    error = error_px(detected, truth)[..., plain][used[..., plain]]
    # median of a Rayleigh distribution of σ = JITTER · 80 px, a little more for the outliers
    assert np.median(error) == pytest.approx(noise.JITTER * 80 * np.sqrt(2 * np.log(2)), rel=0.1)
    hidden = error_px(detected, truth)[..., 15:][used[..., 15:]]
    assert 2 < np.median(hidden) / np.median(error) < 3.2


def test_motion_increases_the_jitter(truth, visible, detected):
    shift = 6.0 * (np.arange(T) % 2)[None, :, None, None] * [1, 0]  # 6 px a frame
    moving = dataclasses.replace(truth, keypoints_px=truth.keypoints_px + shift)
    moved = simulate_detections(moving, visible, PAIRS, seed=1)
    used = (detected.confidence > 0) & (moved.confidence > 0)
    ratio = np.median(error_px(moved, moving)[used]) / np.median(error_px(detected, truth)[used])
    assert 1.4 < ratio < 2.2


def test_error_is_partly_correlated_in_time(detected, truth):
    along = (detected.keypoints_px - truth.keypoints_px)[:2, :, 6:15]
    used = (detected.confidence > 0)[:2, :, 6:15, None] & (np.abs(along) < 5)
    both = used[:, 1:] & used[:, :-1]
    a, b = along[:, 1:][both], along[:, :-1][both]
    assert np.corrcoef(a, b)[0, 1] == pytest.approx(noise.CORRELATED * noise.RHO, abs=0.1)


def test_rate_of_outliers(detected, truth):
    used = detected.confidence > 0
    far = error_px(detected, truth) > 8
    rate = far[..., 6:15][used[..., 6:15]].mean()
    assert 0.3 * noise.OUTLIERS_VISIBLE < rate < 1.5 * noise.OUTLIERS_VISIBLE


def test_rate_of_left_right_flips(detected, truth):
    to_other = np.linalg.norm(detected.keypoints_px[..., 0, :] - truth.keypoints_px[..., 1, :], axis=-1)
    flipped = (to_other < 3) & (detected.confidence[..., 0] > 0)
    rate = flipped[:2].mean()
    assert 0.2 * (noise.FLIPS_ALL + noise.FLIPS_ONE) < rate < 3 * (noise.FLIPS_ALL + noise.FLIPS_ONE)


def test_missing_points_and_frames(detected, truth):
    frames = truth.present & ~detected.present
    assert 0.2 * noise.MISSING_FRAMES < frames.sum() / truth.present.sum() < 3 * noise.MISSING_FRAMES
    missing = (detected.confidence == 0) & detected.present[..., None]
    assert 0.2 < missing[..., 15:][detected.present].mean() < 0.6
    assert missing[..., :15][detected.present].mean() < 0.05
    assert not detected.present[2, T // 2 :].any()


def test_confidence_is_informative_but_not_perfect(detected, truth):
    used = detected.confidence > 0
    rank = spearmanr(detected.confidence[used], error_px(detected, truth)[used]).statistic
    assert -0.9 < rank < -0.2
    wrong = used & (error_px(detected, truth) > 20)
    assert (detected.confidence[wrong] > 0.3).any(), "some outliers have a high confidence"


def test_masks_are_ragged_and_boxes_are_tight(detected, truth):
    for t in range(0, T // 2, 20):
        if not detected.present[2, t]:
            continue
        mask, true = detected.mask(2, t), truth.mask(2, t)
        overlap = (mask & true).sum() / (mask | true).sum()
        assert 0.8 < overlap < 1
        rows, columns = np.nonzero(mask)
        x, y, width, height = detected.box_px[2, t]
        assert (columns.min(), rows.min()) == (x, y)
        assert (columns.max() + 1, rows.max() + 1) == (x + width, y + height)


def test_masks_of_touching_neighbours_may_merge(detected, truth):
    area = np.array([detected.mask(0, t).sum() if detected.present[0, t] else 0 for t in range(T)])
    true = truth.mask(0, 0).sum()
    assert 0.003 < (area > 1.6 * true).mean() < 0.1
    alone = [detected.mask(2, t).sum() for t in range(T // 2) if detected.present[2, t]]
    assert max(alone) < 1.5 * true


def test_seed_determines_the_detections(truth, visible):
    some, seen = truth.select(frames=np.arange(40)), visible[:, :40]
    one, again, other = (simulate_detections(some, seen, PAIRS, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(again.keypoints_px, one.keypoints_px)
    assert (other.keypoints_px != one.keypoints_px).any()


def test_outliers_stay_in_place_during_a_run(detected, truth):
    offset = detected.keypoints_px - truth.keypoints_px
    far = (np.linalg.norm(offset, axis=-1) > 12) & (detected.confidence > 0)
    far[..., :6] = False  # pairs may be flipped
    both = far[:, 1:] & far[:, :-1]
    step = np.linalg.norm(np.diff(detected.keypoints_px, axis=1), axis=-1)[both]
    assert len(step) > 50
    assert np.median(step) < 4


def test_no_detection_at_keypoints_outside_the_picture(truth, visible):
    """A keypoint outside the picture has no position for flips or for outliers of a neighbour."""
    confidence = truth.confidence.copy()
    confidence[1, :, [0, 9]] = 0
    partly = truth.with_keypoints(truth.keypoints_px, confidence).select(frames=np.arange(100))
    detected = simulate_detections(partly, visible[:, :100], PAIRS, seed=4)
    used = detected.confidence > 0
    assert not used[1, :, 0].any()
    assert np.linalg.norm(detected.keypoints_px[used], axis=-1).min() > 20


def test_outliers_on_a_neighbour_are_its_detected_keypoints(detected, truth):
    used = detected.confidence > 0
    for n, other in ((0, 1), (1, 0)):
        distance = np.linalg.norm(detected.keypoints_px[n] - truth.keypoints_px[other], axis=-1)
        near = used[n] & (distance < 5)
        assert near.sum() > 10
        assert distance[near].min() > 1e-4
