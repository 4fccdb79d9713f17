"""The masks of a window are read when the window is fitted."""

import dataclasses
import pickle

import numpy as np
import pytest
from support.walking import walk

from jaxfit.config.fit import load_config
from jaxfit.fitting.windows import cut_windows, load_targets, window_hash


class Recorded(dict):
    """Masks that record which cells are read."""

    def __init__(self, *given):
        super().__init__(*given)
        self.read = []

    def __getitem__(self, cell):
        self.read.append(cell)
        return super().__getitem__(cell)

    def get(self, cell, default=None):
        if cell not in self:
            return default
        return self[cell]


def config(**changes):
    return dataclasses.replace(load_config("paper"), window=4, filter_window=1, **changes)


@pytest.fixture
def observed():
    plain = walk(range(12))
    return dataclasses.replace(plain, masks=Recorded(plain.masks))


@pytest.mark.parametrize("unknown", [False, True])
def test_only_the_masks_of_the_fitted_windows_are_read(observed, unknown):
    windows = cut_windows(observed, config(unknown_pixels=unknown))
    assert windows.has_mask.all()
    assert not observed.masks.read
    load_targets(windows[np.array([1, 4])], 0)
    assert not observed.masks.read
    load_targets(windows[np.array([1, 4])], 16)  # frames 4 to 7 of both birds
    assert sorted(observed.masks.read) == [(n, t) for n in range(2) for t in range(4, 8)]


def test_masks_are_read_by_frame(observed):
    """Windows of one time share the masks that are read, in the order of the frames."""
    windows = cut_windows(observed, config(unknown_pixels=True))
    assert windows.track.tolist() == [0, 0, 0, 1, 1, 1]
    load_targets(windows, 16)
    assert [t for _, t in observed.masks.read] == sorted(t for _, t in observed.masks.read)
    assert len(observed.masks.read) == 24


@pytest.mark.parametrize("unknown", [False, True])
def test_pickled_windows_hold_their_masks(observed, unknown):
    windows = cut_windows(observed, config(unknown_pixels=unknown))
    some = windows[np.array([2, 5])]
    sent = pickle.loads(pickle.dumps(some))
    assert {t for _, t in observed.masks.read} == set(range(8, 12))
    observed.masks.clear()
    np.testing.assert_array_equal(load_targets(sent, 16).mask, load_targets(some, 16).mask)
    assert window_hash(sent, 1) == window_hash(some, 1)


def test_a_frame_without_a_mask():
    plain = walk(range(4))
    masks = {cell: rle for cell, rle in plain.masks.items() if cell != (0, 1)}
    for unknown in (False, True):
        windows = cut_windows(dataclasses.replace(plain, masks=masks), config(unknown_pixels=unknown))
        assert windows.has_mask.tolist() == [[True, False, True, True], [True] * 4]
        assert windows.masks[0].load().own[1] is None
        assert not load_targets(windows, 16).mask[0, 1].any()
