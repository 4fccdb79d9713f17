"""Runs, areas and checks of many masks at once equal those of each mask."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfit.data.formats import rle
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


@settings(deadline=None, max_examples=60)
@given(mask_lists())
def test_runs_and_areas(masks):
    encoded = [encode_mask(mask) for mask in masks]
    encoded[0] = {"size": encoded[0]["size"], "counts": encoded[0]["counts"].decode()}  # text is allowed
    runs = rle.foreground_runs(encoded)
    for i, mask in enumerate(masks):
        drawn = np.zeros(mask.size, int)
        for n, (first, end) in zip(runs.mask, runs.pixels, strict=True):
            if n == i:
                assert end > first
                drawn[first:end] += 1
        np.testing.assert_array_equal(drawn.reshape(mask.shape, order="F"), mask)
        assert runs.areas[i] == mask.sum()
        np.testing.assert_array_equal(decode_mask(encode_mask(mask)), mask)
    assert rle.mask_areas(encoded) == [int(mask.sum()) for mask in masks]


def valid(texts, pixels):
    lengths = np.array([len(text) for text in texts])
    return rle.valid_texts(np.frombuffer(b"".join(texts), np.uint8), lengths, np.array(pixels)).tolist()


@settings(deadline=None, max_examples=60)
@given(mask_lists(), st.integers(0, 10**6))
def test_texts_are_valid_exactly_where_their_runs_cover_the_image(masks, seed):
    rng = np.random.default_rng(seed)
    texts, pixels = [encode_mask(mask)["counts"] for mask in masks], [mask.size for mask in masks]
    assert all(valid(texts, pixels))
    damaged = bytearray(texts[0])
    damaged[rng.integers(len(damaged))] = rng.integers(48, 112)
    texts[0] = bytes(damaged)
    runs = rle.run_lengths(texts[0].decode())
    expected = bool(runs) and sum(runs) == pixels[0]
    found = valid(texts, pixels)
    # a text without an end makes all masks be read one by one
    assert found[0] == expected
    assert all(found[1:]) or not expected


@pytest.mark.parametrize("text", [b"0\xc8", b"0 ", b"0P", b"PPPPPPPP0", b"o"])
def test_wrong_characters(text):
    assert not valid([b"9", text], [9, 9])[1]


def test_masks_are_checked_in_chunks(monkeypatch):
    monkeypatch.setattr(rle, "_MASKS_AT_ONCE", 2)
    masks = [np.eye(n) > 0 for n in range(1, 8)]
    encoded = [encode_mask(mask) for mask in masks]
    assert rle.mask_areas(encoded) == [*range(1, 8)]
    sizes = [mask.size for mask in masks]
    sizes[3] += 1
    assert valid([each["counts"] for each in encoded], sizes) == [True, True, True, False, True, True, True]
