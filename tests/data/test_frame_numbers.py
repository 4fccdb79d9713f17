"""The step of a file's frame numbers and the time between its frames, by hand."""

import numpy as np
import pytest

from jaxfit.data.tracks import consecutive, frame_interval_s, frame_step


def test_step_is_the_greatest_that_divides_all_differences():
    for numbers, step in [
        ([], 1),
        ([7], 1),
        ([3, 4, 5], 1),
        ([0, 2, 4, 10], 2),
        ([1, 7, 16], 3),
        ([0, 2, 5], 1),
        ([4, 9], 5),
    ]:
        assert frame_step(np.array(numbers, int)) == step


def test_consecutive_frames_differ_by_the_step():
    assert consecutive([0, 2, 4, 10, 12]).tolist() == [True, True, False, True]
    assert consecutive([0, 1, 2, 5]).tolist() == [True, True, False]
    assert consecutive([0]).tolist() == []


def test_interval_of_consecutive_frames():
    assert frame_interval_s([0, 1, 2], None, 50.0) == pytest.approx(0.02)
    assert frame_interval_s([0, 2, 4, 10], None, 50.0) == pytest.approx(0.04)  # every second frame of the video
    assert frame_interval_s([0, 2], [0.0, 3.0], 50.0) == pytest.approx(0.04)  # the rate is more exact than the times
    nan = np.nan
    assert frame_interval_s([0, 2, 4, 10], [1.0, 1.1, 1.2, 1.5]) == pytest.approx(0.1)
    assert frame_interval_s([0, 1, 2, 3, 4], [nan, 0.5, nan, 2.0, 2.25]) == pytest.approx(0.25)


@pytest.mark.parametrize("times_s", [None, [np.nan] * 3, [0.0, np.nan, 1.0], [0.0, 0.0, 0.0], [2.0, 1.0, 0.0]])
def test_unknown_interval(times_s):
    assert frame_interval_s([0, 1, 2], times_s) is None
    assert frame_interval_s([], []) is None


def test_interval_is_within_the_limits_of_frame_rates():
    assert frame_interval_s([0, 1], None, 1e30) == 1e-5
    assert frame_interval_s([0, 1], [0.0, 1e9]) == 1e5
