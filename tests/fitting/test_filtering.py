"""The weighted median filter against a plain loop, hand-computed cases and its properties."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfit.fitting.windows import weighted_median_filter


def slow_filter(keypoints, confidence, window):
    """The definition of the filter as a loop over frames, keypoints and coordinates."""
    out = keypoints.copy()
    T, K = confidence.shape
    for t in range(T):
        frames = range(max(0, t - window // 2), min(T, t + window // 2 + 1))
        for k in range(K):
            for axis in range(2):
                pairs = sorted((keypoints[i, k, axis], confidence[i, k]) for i in frames if confidence[i, k] > 0)
                total = sum(c for _, c in pairs)
                cumulative = 0.0
                for value, c in pairs:
                    cumulative += c
                    if cumulative >= total / 2:
                        out[t, k, axis] = value
                        break
    return out


# fixed lengths, so that hypothesis does not compile a new program for every example
@pytest.mark.parametrize(("T", "window"), [(1, 5), (3, 5), (7, 3), (8, 5), (4, 1), (14, 21)])
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_agrees_with_the_plain_loop(T, window, data):
    seed = data.draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    # few distinct values, and confidences in sixteenths: equal values, exact halves and missing keypoints occur
    keypoints = rng.integers(-4, 5, (T, 3, 2)).astype(np.float32)
    confidence = (rng.integers(0, 17, (T, 3)) / 16 * (rng.random((T, 3)) < 0.7)).astype(np.float32)
    filtered = jax.jit(weighted_median_filter, static_argnums=2)(keypoints, confidence, window)
    np.testing.assert_array_equal(filtered, slow_filter(keypoints, confidence, window))


def filter_signal(values, confidence, window):
    """Return the filtered signal in x, and the negated signal in y."""
    keypoints = np.stack([values, -np.asarray(values, float)], -1)[:, None].astype(np.float32)
    return np.asarray(weighted_median_filter(keypoints, np.asarray(confidence, np.float32)[:, None], window))[:, 0]


def test_hand_computed():
    # the window of the middle frame has 1, 2, 9 with weights 0.2, 0.3, 0.9: half of the sum, 0.7, is exceeded at 9
    assert filter_signal([1, 2, 9], [0.2, 0.3, 0.9], 3)[1, 0] == 9
    assert filter_signal([1, 2, 9], [1, 1, 1], 3)[1, 0] == 2
    # exactly half is enough, so the lower of two values with equal weights is the median: 1 in x, and −2 in y
    np.testing.assert_array_equal(filter_signal([1, 2], [0.3, 0.3], 3), [[1, -2], [1, -2]])


def test_an_exact_half_is_enough_in_spite_of_rounding():
    # the first three confidences are half of the sum, but their float32 sum is slightly less than half
    for confidence in ([0.1, 0.1, 0.2, 0.3, 0.1], [0.1, 0.1, 0.5, 0.1, 0.6], [0.1, 0.1, 0.7, 0.3, 0.6]):
        assert filter_signal([1, 2, 3, 4, 5], confidence, 5)[2, 0] == 3


@pytest.mark.parametrize("window", [0, 2, -1])
def test_window_must_be_odd(window):
    with pytest.raises(ValueError, match="window must be odd and positive"):
        weighted_median_filter(np.zeros((3, 1, 2)), np.ones((3, 1)), window)
