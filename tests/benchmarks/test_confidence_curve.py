"""Calibration on known birds: which keypoints count, which keypoints are right, and the fitted curve."""

import numpy as np
import pytest
from benchmarks.confidence_curve import Outcomes, fit_curve, keypoint_outcomes

from jaxfit.foundation.errors import InputError
from jaxfit.learning.networks.labelled_frames import LabelledFrames
from jaxfit.perception.network import instance_of


def outcomes(probability, count=20_000, seed=0):
    rng = np.random.default_rng(seed)
    values = rng.random(count)
    return Outcomes(values, rng.random(count) < probability(values))


def test_the_curve_is_the_probability():
    curve = fit_curve(outcomes(lambda value: value**2))
    at = np.linspace(0.05, 0.95, 19)
    np.testing.assert_allclose(curve(at), at**2, atol=0.03)
    assert (np.diff(curve.probabilities) >= 0).all()
    assert curve(np.zeros(1)) == 0


def test_too_few_detections():
    with pytest.raises(InputError, match="at least 200"):
        fit_curve(Outcomes(np.linspace(0.1, 1, 50), np.ones(50, bool)))


def square(mask_x, shape=(60, 100)):
    owner = np.zeros(shape, bool)
    owner[10:50, mask_x : mask_x + 40] = True
    return owner


class Segmenter:
    class_names = ("bird",)

    def __call__(self, frame):
        return [instance_of(square(55), 0.9, "bird"), instance_of(square(5), 0.8, "bird")]


class Keypoints:
    """Reports each keypoint with a known error: 40 pixels are the longer side, so 2 pixels are 5 %."""

    keypoint_names = ("a", "b", "c")

    def __call__(self, frame, birds):
        points = np.array([[[bird.x0 + 20, 30 + 1.9], [bird.x0 + 22.1, 30], [0, 0]] for bird in birds])
        return points, np.tile([0.3, 0.6, 0.9], (len(birds), 1))


def test_outcomes_of_known_birds():
    """Two birds; the first is known, and its third keypoint has no known position."""
    picture = np.zeros((60, 100, 3), np.uint8)
    points = np.zeros((2, 3, 2), np.float32)
    points[0] = (25, 30)
    visibility = np.array([[2, 1, 0], [0, 0, 0]], np.uint8)
    labels = [picture, square(5).astype(np.uint8), points, visibility, np.float32(9)]
    found = keypoint_outcomes(LabelledFrames(*(np.stack([array]) for array in labels)), Segmenter(), Keypoints())
    assert found.values.tolist() == [0.3, 0.6]
    assert found.right.tolist() == [True, False]
