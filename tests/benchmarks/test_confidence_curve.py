"""The curve of confidences of a network."""

import numpy as np
import pytest
from benchmarks.confidence_curve import Outcomes, fit_curve

from jaxfit.foundation.errors import InputError


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
