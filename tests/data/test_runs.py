"""Runs and checks of many masks at once equal those of each mask."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycocotools import mask as coco_mask

from jaxfit.data.formats.rle import first_invalid, foreground_runs
from jaxfit.data.masks import decode_mask, encode_mask


@st.composite
def mask_lists(draw):
    seed, count = draw(st.integers(0, 10**6)), draw(st.integers(1, 9))
    rng = np.random.default_rng(seed)
    masks = []
    for _ in range(count):
        shape = rng.integers(1, 40, 2)
        masks.append(rng.random(shape) < rng.choice([0, 0.02, 0.5, 0.98, 1]))
    return masks


@settings(deadline=None, max_examples=40)
@given(mask_lists())
def test_runs_and_areas(masks):
    encoded = [encode_mask(mask) for mask in masks]
    encoded[0] = {"size": encoded[0]["size"], "counts": encoded[0]["counts"].decode()}  # text is allowed
    runs = foreground_runs(encoded)
    for i, mask in enumerate(masks):
        drawn = np.zeros(mask.size, int)
        for n, (first, end) in zip(runs.mask, runs.pixels, strict=True):
            if n == i:
                assert end > first
                drawn[first:end] += 1
        np.testing.assert_array_equal(drawn.reshape(mask.shape, order="F"), mask)
        assert runs.areas[i] == mask.sum()
        np.testing.assert_array_equal(decode_mask(encode_mask(mask)), mask)
    assert first_invalid(encoded) is None


@settings(deadline=None, max_examples=100)
@given(runs=st.lists(st.integers(0, 2**24), min_size=1, max_size=12))  # more, and pycocotools writes past its buffer
def test_run_lengths_as_pycocotools_writes_them(runs):
    """A mask is valid exactly where its runs cover its image."""
    mask = coco_mask.frPyObjects({"size": [1, 1], "counts": runs}, 1, 1)
    assert first_invalid([mask | {"size": [sum(runs), 1]}]) is None
    assert first_invalid([mask | {"size": [sum(runs) + 1, 1]}]) == 0
    assert foreground_runs([mask]).areas[0] == sum(runs[1::2])


@pytest.mark.parametrize("text", [b"", b"0\xc8", b"0 ", b"0P", b"PPPPPPPP0", b"o"])
def test_the_first_invalid_mask_is_named(text):
    masks = [encode_mask(np.eye(3) > 0)] * 700
    masks[600] = {"size": [3, 3], "counts": text}
    assert first_invalid(masks) == 600
