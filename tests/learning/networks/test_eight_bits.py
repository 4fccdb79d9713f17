"""Networks in 8 bits: nearly the same outputs, joined last convolutions, weights that no processor saturates."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

import onnx
from onnx import helper, numpy_helper
from support.onnx_graphs import write_graph

from jaxfit.learning.networks import eight_bits
from jaxfit.learning.networks.eight_bits import write_eight_bits
from jaxfit.perception.keypoints import BUILTIN_PATH
from jaxfit.perception.network import OnnxModel
from jaxfit.perception.segmentation import BUILTIN


@pytest.fixture
def plain(tmp_path, monkeypatch):
    """Two convolutions, and two outputs of two convolutions of their map."""
    monkeypatch.setattr(eight_bits, "FIRST", 1)
    rng = np.random.default_rng(0)
    shapes = {"first": (8, 3, 3, 3), "second": (16, 8, 3, 3), "one": (1, 16, 3, 3), "two": (2, 16, 3, 3)}
    constants = {name: rng.normal(0, 0.2, shape).astype(np.float32) for name, shape in shapes.items()}
    constants |= {
        f"{name}_bias": rng.normal(0, 0.2, len(value)).astype(np.float32) for name, value in constants.items()
    }
    nodes = [
        helper.make_node("Conv", ["x", "first", "first_bias"], ["f"], "first_conv", pads=[1] * 4),
        helper.make_node("Relu", ["f"], ["r"]),
        helper.make_node("Conv", ["r", "second", "second_bias"], ["c"], "second_conv", pads=[1] * 4),
        helper.make_node("Relu", ["c"], ["map"]),
        helper.make_node("Conv", ["map", "one", "one_bias"], ["a"], "one_conv", pads=[1] * 4),
        helper.make_node("Conv", ["map", "two", "two_bias"], ["b"], "two_conv", pads=[1] * 4),
        helper.make_node("Sigmoid", ["a"], ["p"]),
    ]
    outputs = {"p": [None, 1, None, None], "b": [None, 2, None, None]}
    path = tmp_path / "plain.onnx"
    return write_graph(path, {"x": ["n", 3, "h", "w"]}, outputs, nodes, constants, {"names": "bird"})


def test_outputs_are_nearly_the_same(plain, tmp_path):
    rng, path = np.random.default_rng(1), tmp_path / "small.onnx"
    inputs = [rng.random((2, 3, 12, 20), np.float32) for _ in range(4)]
    write_eight_bits(plain, iter(inputs), path)
    network, small = OnnxModel(plain), OnnxModel(path)
    assert small.metadata["names"] == "bird"
    assert [port.name for port in small.outputs] == ["p", "b"]
    for shape in ((1, 3, 12, 20), (3, 3, 30, 8)):  # other numbers and sizes than before
        x = rng.random(shape, np.float32)
        for name, expected in network(x).items():
            found = small(x)[name]
            # a step of a map is 1/255 of its range, a step of a weight 1/63
            assert 0 < np.abs(found - expected).max() < 0.05 * np.ptp(expected)


def test_the_first_and_the_last_convolutions_are_floats_and_the_last_are_one(plain, tmp_path):
    write_eight_bits(plain, [np.ones((1, 3, 8, 8), np.float32)], tmp_path / "small.onnx")
    graph = onnx.load(str(tmp_path / "small.onnx")).graph
    weights = {weight.name: numpy_helper.to_array(weight) for weight in graph.initializer}
    of_conv = [weights.get(node.input[1]) for node in graph.node if node.op_type == "Conv"]
    assert [None if weight is None else weight.shape for weight in of_conv] == [(8, 3, 3, 3), None, (3, 16, 3, 3)]
    assert {opset.domain for opset in onnx.load(str(tmp_path / "small.onnx")).opset_import} == {""}


@pytest.mark.parametrize("file", [BUILTIN, BUILTIN_PATH], ids=["segmenter", "keypoints"])
def test_no_sum_of_two_products_of_the_built_in_networks_leaves_16_bits(file):
    """Processors without VNNI add two products of an activation (at most 255) and a weight in 16 bits."""
    graph = onnx.load(str(file)).graph
    weights = {weight.name: numpy_helper.to_array(weight) for weight in graph.initializer}
    in_8_bits = [value for value in weights.values() if value.dtype == np.int8 and value.ndim == 4]
    assert len(in_8_bits) > 20
    assert max(np.abs(value.astype(int)).max() for value in in_8_bits) * 255 * 2 < 2**15
