"""Masks as run lengths: decoded in part, and their boxes."""

import numpy as np
import pytest

from jaxfit.data.masks import box_of_mask, box_of_rle, decode_mask, encode_mask


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_columns_of_a_mask(share):
    rng = np.random.default_rng(0)
    for _ in range(20):
        mask = rng.random(rng.integers(1, 9, 2)) < share
        first, end = sorted(rng.integers(-2, 11, 2).tolist())
        expected = mask & ((np.arange(mask.shape[1]) >= first) & (np.arange(mask.shape[1]) < end))
        found = decode_mask(encode_mask(mask), (first, end))
        np.testing.assert_array_equal(found, expected)
        assert found.dtype == bool


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_the_box_of_run_lengths_is_that_of_the_mask(share):
    rng = np.random.default_rng(1)
    for _ in range(20):
        mask = rng.random(rng.integers(1, 9, 2)) < share
        assert box_of_rle(encode_mask(mask)) == box_of_mask(mask)
