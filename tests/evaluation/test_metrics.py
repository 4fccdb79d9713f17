"""Every metric against cases computed by hand."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfit.evaluation.metrics import (
    correct_keypoints,
    distances,
    iou,
    mean_error,
    pck_per_image,
    procrustes_align,
    squared_errors,
    squared_velocity_errors,
)


def me_p(*arguments):
    return math.sqrt(mean_error(squared_errors(*arguments)))


def me_v(*arguments):
    return math.sqrt(mean_error(squared_velocity_errors(*arguments)))


def mpjpe(*arguments):
    return mean_error(distances(*arguments))


def pa_mpjpe(predicted, truth, visible=None):
    return mpjpe(procrustes_align(predicted, truth, visible), truth, visible)


def at_distance(*rows):
    """Observed keypoints at the origin and predicted ones that far away, along (3, 4) / 5."""
    distance = np.array(rows, float)
    return distance[..., None] * np.array([0.6, 0.8]), np.zeros((*distance.shape, 2))


def test_pck_by_hand():
    predicted, observed = at_distance([1, 5, 6, 99], [1, 1, 30, 99])
    visible = np.array([[1, 1, 1, 0], [1, 0, 1, 0]])
    # sides 100 and 200, threshold 0.05: allowed are 5 and 10 pixels
    args = predicted, observed, visible, [100, 200], 0.05
    np.testing.assert_allclose(pck_per_image(*args), [2 / 3, 1 / 2])
    assert mean_error(correct_keypoints(*args)) == pytest.approx(3 / 5)


def test_pck_of_failures():
    predicted, observed = at_distance([0, np.nan], [0, 0], [0, 0])
    visible = np.array([[1, 1], [0, 0], [1, 1]])
    shares = pck_per_image(predicted, observed, visible, [10, 10, 0], 0.1)
    np.testing.assert_array_equal(shares, [0.5, np.nan, 0])  # failed, nothing to see, no side
    assert math.isnan(mean_error(correct_keypoints(predicted, observed, np.zeros((3, 2)), 10, 0.1)))


def test_iou_by_hand():
    a, b = np.zeros((4, 6), bool), np.zeros((4, 6), bool)
    assert math.isnan(iou(a, b))
    a[1:3, 1:4] = True  # 6 pixels
    assert iou(a, b) == 0
    b[1:3, 2:6] = True  # 8 pixels, 4 of them shared
    assert iou(a, b) == iou(b, a) == 4 / 10
    assert iou(a, a) == 1


def test_me_p_by_hand():
    predicted, observed = at_distance([3, 4], [10, 7])
    visible = np.array([[1, 1], [1, 0]])
    # 3/10, 4/10 and 10/50
    expected = math.sqrt((0.09 + 0.16 + 0.04) / 3)
    assert me_p(predicted, observed, visible, [10, 50]) == pytest.approx(expected)
    assert me_p(2 * predicted, 2 * observed, visible, [20, 100]) == pytest.approx(expected)
    assert math.isnan(me_p(predicted, observed, np.zeros((2, 2)), 10))
    predicted[0, 1] = np.nan
    for side in (0, np.nan):  # neither a keypoint that failed nor an image without a side counts
        assert me_p(predicted, observed, np.ones((2, 2)), [10, side]) == pytest.approx(0.3)


def test_me_v_by_hand():
    observed = np.array([[[0.0, 0]], [[10, 0]], [[20, 0]], [[30, 0]]])
    predicted = np.array([[[5.0, 5]], [[15, 5]], [[28, 9]], [[38, 9]]])
    # velocity differences (0, 0), (3, 4), (0, 0), divided by the sides of frames 0, 1, 2
    sides, visible = [10, 20, 40, 1], np.ones((4, 1))
    assert me_v(predicted, observed, visible, sides) == pytest.approx(math.sqrt((5 / 20) ** 2 / 3))
    # the error of a pair belongs to its earlier frame
    errors = squared_velocity_errors(predicted, observed, visible, sides)
    np.testing.assert_allclose(errors, [[0], [(5 / 20) ** 2], [0], [np.nan]])
    # a gap between frames 2 and 4 takes that pair out
    assert me_v(predicted, observed, visible, sides, [1, 2, 4, 5]) == 0
    # every second frame: consecutive frames differ by the file's step, which is 2
    assert me_v(predicted, observed, visible, sides, [4, 6, 8, 10]) == me_v(predicted, observed, visible, sides)
    assert me_v(predicted, observed, visible, sides, [2, 4, 8, 10]) == 0
    # a keypoint missing in frame 0 or 3 takes its pair out
    visible[3] = 0
    assert me_v(predicted, observed, visible, sides) == pytest.approx(math.sqrt((5 / 20) ** 2 / 2))
    visible[1:3] = 0
    assert math.isnan(me_v(predicted, observed, visible, sides))


def test_me_v_does_not_see_a_constant_offset_and_takes_tracks():
    rng = np.random.default_rng(0)
    observed = rng.normal(size=(2, 5, 3, 2))
    assert me_v(observed + 7, observed, np.ones((2, 5, 3)), np.ones((2, 5))) == pytest.approx(0, abs=1e-12)
    predicted = observed + rng.normal(size=observed.shape)
    both = me_v(predicted, observed, np.ones((2, 5, 3)), np.ones((2, 5)))
    each = [me_v(p, o, np.ones((5, 3)), np.ones(5)) for p, o in zip(predicted, observed, strict=True)]
    assert both == pytest.approx(math.sqrt(np.mean(np.square(each))))
    assert math.isnan(me_v(observed[:, :1], observed[:, :1], np.ones((2, 1, 3)), np.ones((2, 1))))


def test_mpjpe_by_hand():
    truth = np.zeros((2, 2, 3))
    predicted = np.array([[[3, 4, 0], [0, 0, 1]], [[0, 0, 0], [np.nan, 0, 0]]])
    assert mpjpe(predicted, truth) == pytest.approx(2)
    assert mpjpe(predicted, truth, [[1, 0], [1, 1]]) == pytest.approx(2.5)
    assert math.isnan(mpjpe(predicted, truth, np.zeros((2, 2))))


def test_pa_mpjpe_undoes_each_frames_own_similarity():
    rng = np.random.default_rng(3)
    truth = rng.normal(size=(6, 8, 3))
    R = Rotation.from_rotvec(rng.normal(size=(6, 3))).as_matrix()
    scale, shift = rng.uniform(0.2, 5, (6, 1, 1)), rng.normal(size=(6, 1, 3))
    predicted = scale * truth @ np.swapaxes(R, -1, -2) + shift
    assert mpjpe(predicted, truth) > 1
    assert pa_mpjpe(predicted, truth) == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(procrustes_align(predicted, truth), truth, atol=1e-9)


def test_procrustes_is_the_best_similarity_and_no_reflection():
    rng = np.random.default_rng(4)
    truth, predicted = rng.normal(size=(2, 7, 3))
    best = np.square(procrustes_align(predicted, truth) - truth).sum()
    for _ in range(200):
        R = Rotation.from_rotvec(rng.normal(size=3) * rng.choice([0.01, 1])).as_matrix()
        moved = rng.uniform(0.5, 1.5) * procrustes_align(predicted, truth) @ R.T + 0.1 * rng.normal(size=3)
        assert np.square(moved - truth).sum() >= best - 1e-12
    mirrored = truth * [1, 1, -1]
    assert pa_mpjpe(mirrored, truth) > 0.1


def test_pa_mpjpe_ignores_what_is_missing():
    rng = np.random.default_rng(5)
    truth = rng.normal(size=(3, 6, 3))
    predicted = 2 * truth + 1
    visible = np.ones((3, 6), bool)
    predicted[0, 2], visible[0, 2] = 1000, False
    predicted[1, 4] = np.nan  # left out though visible
    visible[2, 2:] = False  # two points: any two can be brought together, so they say nothing
    assert pa_mpjpe(predicted, truth, visible) == pytest.approx(0, abs=1e-9)
    assert np.isnan(procrustes_align(predicted, truth, visible)[2]).all()
    assert math.isnan(pa_mpjpe(truth[:, :2], truth[:, :2]))


def test_pa_mpjpe_of_a_prediction_collapsed_to_a_point():
    truth = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 2, 0], [0, -2, 0]])
    assert pa_mpjpe(np.ones((4, 3)), truth) == pytest.approx(1.5)
