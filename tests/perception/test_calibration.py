"""Curves of confidences: reading, use in the keypoint detector, and damaged curves."""

import numpy as np
import pytest
from support.onnx_graphs import write_constant

from jaxfit.foundation.errors import InputError
from jaxfit.perception.keypoints import load_keypoint_detector
from jaxfit.perception.network import CONFIDENCE_KEY, Curve, OnnxModel, instance_of, read_curve

FRAME = np.zeros((64, 64, 3), np.uint8)
BIRD = instance_of(np.ones((20, 20), bool), 1.0, "bird", 10, 10)


def write_heatmaps(path, peaks, **metadata):
    maps = np.zeros((len(peaks), 8, 8), np.float32)
    maps[:, 4, 3] = peaks
    names = ",".join(f"point{k}" for k in range(len(peaks)))
    return write_constant(path, (None, 3, 32, 32), {"heatmaps": maps}, {"keypoint_names": names, **metadata})


def test_confidences_are_those_of_the_curve(tmp_path):
    peaks = [0.0, 0.1, 0.25, 0.4, 0.9]
    plain = load_keypoint_detector(write_heatmaps(tmp_path / "plain.onnx", peaks))
    curved = load_keypoint_detector(
        write_heatmaps(tmp_path / "curved.onnx", peaks, confidence_curve="0.1:0.2,0.4:0.8,0.5:1")
    )
    points, raw = plain(FRAME, [BIRD])
    same_points, confidence = curved(FRAME, [BIRD])
    np.testing.assert_array_equal(points, same_points)
    np.testing.assert_allclose(raw, [peaks])
    np.testing.assert_allclose(confidence, [[0, 0.2, 0.5, 0.8, 1]], atol=1e-6)
    assert confidence.dtype == np.float32


def test_a_curve_survives_its_text(tmp_path):
    curve = Curve(np.array([0.01, 0.333333, 0.76]), np.array([0.0, 0.5, 0.998]))
    path = write_heatmaps(tmp_path / "net.onnx", [0.5], confidence_curve=curve.text())
    again = read_curve(OnnxModel(path), CONFIDENCE_KEY)
    np.testing.assert_allclose(again.values, curve.values, rtol=1e-5)
    np.testing.assert_allclose(again.probabilities, curve.probabilities, rtol=1e-3)
    assert read_curve(OnnxModel(write_heatmaps(tmp_path / "plain.onnx", [0.5])), CONFIDENCE_KEY) is None


@pytest.mark.parametrize(
    "text",
    ["", "a:b", "0:0,0:1", "0:0.5,1:0.4", "0:0,1:1.1", "0:nan,1:1", "0:0:0,1:1:1"],
)  # fmt: skip
def test_damaged_curves(tmp_path, text):
    path = write_heatmaps(tmp_path / "net.onnx", [0.5], confidence_curve=text)
    with pytest.raises(InputError, match="confidence_curve"):
        load_keypoint_detector(path)
