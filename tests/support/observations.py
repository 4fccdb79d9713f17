"""Comparison of two containers of observations."""

import numpy as np

from jaxfit.data.observations import Observations


def assert_same(a: Observations, b: Observations):
    for name in vars(a):
        if isinstance(getattr(a, name), np.ndarray):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert (a.keypoint_names, a.skeleton, a.fps, a.footage) == (b.keypoint_names, b.skeleton, b.fps, b.footage)
    assert a.own_images == b.own_images
    assert a.masks.keys() == b.masks.keys()
    assert a.amodal_masks.keys() == b.amodal_masks.keys()
    for n, t in {*a.masks, *a.amodal_masks}:
        np.testing.assert_array_equal(a.mask(n, t), b.mask(n, t))
        np.testing.assert_array_equal(a.whole_mask(n, t), b.whole_mask(n, t))
