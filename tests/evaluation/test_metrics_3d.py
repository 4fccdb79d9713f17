"""The parts of the errors in space, each by hand."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfit.evaluation.spatial import acceleration_errors, best_scale, crop_rotation


def test_crop_rotation_by_hand():
    """45° to the right: ahead is right and forward, down stays down, right is right and backward."""
    half = math.sqrt(0.5)
    R = crop_rotation([1100, 200], [100, 200], 1000.0)
    np.testing.assert_allclose(R, [[half, 0, half], [0, 1, 0], [-half, 0, half]], atol=1e-12)
    np.testing.assert_array_equal(crop_rotation([100, 200], [100, 200], 1000.0), np.eye(3))
    centres = np.random.default_rng(0).uniform(-3000, 3000, (5, 4, 2))
    R = crop_rotation(centres, [0, 0], 1000.0)
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    ahead = R[..., 2]
    np.testing.assert_allclose(1000 * ahead[..., :2] / ahead[..., 2:], centres, atol=1e-8)
    axis = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec()
    np.testing.assert_allclose(axis[:, 2], 0, atol=1e-12)  # no turn about the optical axis


def test_best_scale_by_hand():
    p = np.array([[[1.0, 0, 0], [0, 2, 0]]])  # Σ p·p = 5
    q = np.array([[[3.0, 9, 9], [9, 1, 9]]])  # Σ p·q = 5
    assert best_scale(p, q, [True]) == 1
    assert best_scale(p, -q, [True]) == 0  # never a mirror image
    assert math.isnan(best_scale(p, q, [False]))
    assert math.isnan(best_scale(0 * p, q, [True]))


def acceleration_error(*arguments):
    counted = acceleration_errors(*arguments)
    counted = counted[np.isfinite(counted)]
    return counted.mean() if counted.size else math.nan


def test_acceleration_by_hand():
    """One frame of five off by d: three triples see d, 2d, d, each at its middle."""
    truth = np.random.default_rng(0).normal(size=(5, 4, 3))
    predicted = truth.copy()
    predicted[2] += [0, 3, 4]
    every = np.ones(5, bool)
    assert acceleration_error(predicted, truth, every, range(5)) == pytest.approx(5 * (1 + 2 + 1) / 3)
    at = acceleration_errors(predicted, truth, every, range(5))
    np.testing.assert_allclose(at, np.tile([[np.nan], [5], [10], [5], [np.nan]], 4))
    assert acceleration_error(predicted, truth, every, [0, 1, 2, 3, 7]) == pytest.approx(5 * (1 + 2) / 2)
    assert acceleration_error(truth + np.arange(3), truth, every, range(5)) == pytest.approx(0)
    gap = np.array([True, True, True, False, True])
    assert acceleration_error(predicted, truth, gap, range(5)) == pytest.approx(5)
    assert acceleration_error(predicted, truth, every, [0, 2, 4, 6, 8]) == pytest.approx(5 * (1 + 2 + 1) / 3)
    assert acceleration_error(predicted, truth, every, [0, 2, 4, 6, 14]) == pytest.approx(5 * (1 + 2) / 2)
    assert math.isnan(acceleration_error(predicted[:4], truth[:4], every[:4], [0, 2, 5, 7]))
    assert math.isnan(acceleration_error(predicted[:2], truth[:2], every[:2], [0, 1]))
