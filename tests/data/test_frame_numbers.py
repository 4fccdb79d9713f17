"""The step of a file's frame numbers, by hand."""

import numpy as np
import pytest

from jaxfit.data.frame_numbers import consecutive, frame_step


@pytest.mark.parametrize(
    ("numbers", "step"),
    [([], 1), ([7], 1), ([3, 4, 5], 1), ([0, 2, 4, 10], 2), ([1, 7, 16], 3), ([0, 2, 5], 1), ([4, 9], 5)],
)
def test_step_is_the_greatest_that_divides_all_differences(numbers, step):
    assert frame_step(np.array(numbers, int)) == step


def test_consecutive_frames_differ_by_the_step():
    assert consecutive([0, 2, 4, 10, 12]).tolist() == [True, True, False, True]
    assert consecutive([0, 1, 2, 5]).tolist() == [True, True, False]
    assert consecutive([0]).tolist() == []
