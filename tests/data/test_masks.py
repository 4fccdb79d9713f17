"""Masks as run lengths: decoded in part, and their boxes."""

import numpy as np
import pytest

from jaxfit.data.masks import box_of_mask, box_of_rle, decode_columns, encode_mask


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_columns_of_a_mask(share):
    rng = np.random.default_rng(0)
    masks = [rng.random(rng.integers(1, 9, 2)) < share for _ in range(20)]
    columns = [tuple(sorted(rng.integers(-2, 11, 2).tolist())) for _ in masks]
    found = decode_columns([encode_mask(mask) for mask in masks], columns)
    for mask, (first, end), each in zip(masks, columns, found, strict=True):
        expected = mask & ((np.arange(mask.shape[1]) >= first) & (np.arange(mask.shape[1]) < end))
        np.testing.assert_array_equal(each, expected)
        assert each.dtype == bool


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_the_box_of_run_lengths_is_that_of_the_mask(share):
    rng = np.random.default_rng(1)
    for _ in range(20):
        mask = rng.random(rng.integers(1, 9, 2)) < share
        assert box_of_rle(encode_mask(mask)) == box_of_mask(mask)
