"""Decoding of heatmaps and SimCC vectors, against values computed by hand."""

import numpy as np
import pytest

from jaxfit.perception.keypoint_layouts import apply_activation, heatmap_peaks, simcc_peaks, subcell_offsets


def _gaussian(x0, y0, covariance, size=(12, 9), height=0.8):
    y, x = np.mgrid[: size[1], : size[0]]
    d = np.stack([x - x0, y - y0], -1)
    return height * np.exp(-0.5 * np.einsum("...i,ij,...j", d, np.linalg.inv(covariance), d))


@pytest.mark.parametrize(
    ("x0", "y0", "covariance"),
    [(4.3, 5.0, np.eye(2)), (7.45, 2.6, 4 * np.eye(2)), (5.2, 4.1, [[2.0, 0.7], [0.7, 1.0]])],
)
def test_peak_of_a_gaussian_lies_between_the_cells(x0, y0, covariance):
    heatmap = _gaussian(x0, y0, np.array(covariance))[None, None]
    cells, peak = heatmap_peaks(heatmap)
    assert cells[0, 0].tolist() == [round(x0), round(y0)]
    assert peak[0, 0] == heatmap[0, 0, round(y0), round(x0)]
    np.testing.assert_allclose((cells + subcell_offsets(heatmap, cells))[0, 0], [x0, y0], atol=1e-9)


def test_offset_by_hand():
    # ln 4 and ln 1 beside ln 8 along x: slope ln 4 / 2, curvature ln 4 − 2 ln 8 = −ln 16, so 1/4 of a cell
    heatmap = np.array([[1, 1, 1], [1 / 8, 1, 1 / 2], [1, 1, 1]])
    heatmap[[0, 2]] = [[1 / 16, 1 / 2, 1 / 4]] * 2
    offset = subcell_offsets(heatmap[None, None], np.array([[[1, 1]]]))
    np.testing.assert_allclose(offset[0, 0], [0.25, 0])


@pytest.mark.parametrize(
    "heatmap", [np.zeros((4, 4)), np.ones((4, 4)), np.eye(1, 16, 5).reshape(4, 4), -np.ones((4, 4)), np.ones((1, 1))]
)
def test_without_a_peak_the_offset_is_zero(heatmap):
    cells, _ = heatmap_peaks(heatmap[None, None])
    assert subcell_offsets(heatmap[None, None], cells)[0, 0].tolist() == [0, 0]


def test_no_offset_across_the_border():
    heatmap = _gaussian(-0.4, 3.3, np.eye(2))[None, None]
    cells, _ = heatmap_peaks(heatmap)
    assert cells[0, 0].tolist() == [0, 3]
    np.testing.assert_allclose(subcell_offsets(heatmap, cells)[0, 0], [0, 0.3], atol=1e-9)
    heatmap = heatmap[..., ::-1, ::-1]
    cells, _ = heatmap_peaks(heatmap)
    assert cells[0, 0].tolist() == [11, 5]
    np.testing.assert_allclose(subcell_offsets(heatmap, cells)[0, 0], [0, -0.3], atol=1e-9)


def test_simcc_bins_and_confidences():
    x = np.array([[[0.1, 0.7, 0.2], [0.0, 0.0, 0.9]]])
    y = np.array([[[0.3, 0.1, 0.2, 0.4], [0.95, 0.0, 0.0, 0.0]]])
    bins, values = simcc_peaks(x, y)
    assert bins.tolist() == [[[1, 3], [2, 0]]]
    assert values.tolist() == [[0.4, 0.9]]


def test_activations():
    values = np.array([[[[0.0, np.log(3)], [-np.inf, 0]], [[0, np.log(3)], [np.log(4), 0]]]])
    for activation, expected in (
        ("none", values[0, 1]),
        ("sigmoid", [[1 / 2, 3 / 4], [4 / 5, 1 / 2]]),
        ("softmax", [[1 / 9, 3 / 9], [4 / 9, 1 / 9]]),
    ):
        confident, finite = apply_activation(values, activation)
        assert finite.tolist() == [[False, True]]
        assert np.isfinite(confident).all()
        np.testing.assert_allclose(confident[0, 1], expected)
