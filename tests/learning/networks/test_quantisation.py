"""Quantised networks: merged heads, weights in 32 bits, outputs close to those of the floats."""

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from support.onnx_graphs import write_graph

from jaxfit.foundation.errors import InputError
from jaxfit.learning.networks.quantisation import convert_to_floats, merge_heads, quantise
from jaxfit.perception.network import OnnxModel

RNG = np.random.default_rng(0)
HEADS = {"foreground": 1, "offset": 2}


def write_network(path, has_relu=True):
    """A convolution with weights in 16 bits, a Relu, and two heads."""
    weights = {
        "body_16": (RNG.standard_normal((8, 3, 3, 3)) / 5).astype(np.float16),
        **{f"network.heads.{n}.weight": RNG.standard_normal((c, 8, 3, 3)).astype(np.float32) for n, c in HEADS.items()},
        **{f"network.heads.{n}.bias": RNG.standard_normal(c).astype(np.float32) for n, c in HEADS.items()},
    }
    nodes = [
        helper.make_node("Cast", ["body_16"], ["body"], to=TensorProto.FLOAT),
        helper.make_node("Conv", ["input", "body"], ["mixed"], "body_conv", pads=[1] * 4),
        helper.make_node("Relu" if has_relu else "Sigmoid", ["mixed"], ["map"], "activation"),
    ]
    for name in HEADS:
        inputs = ["map", f"network.heads.{name}.weight", f"network.heads.{name}.bias"]
        nodes.append(helper.make_node("Conv", inputs, [name], f"{name}_conv", pads=[1] * 4))
    shapes = {"input": [1, 3, 16, 16]}, {name: [1, c, 16, 16] for name, c in HEADS.items()}
    return write_graph(path, *shapes, nodes, weights, {"longer_side": "64"})


def pictures(count):
    return list(np.random.default_rng(1).random((count, 1, 3, 16, 16), np.float32))


def test_merged_heads_and_weights_in_32_bits_change_no_output(tmp_path):
    path = write_network(tmp_path / "net.onnx")
    model = onnx.load(str(path))
    convert_to_floats(model)
    merge_heads(model)
    assert [node.op_type for node in model.graph.node] == ["Conv", "Relu", "Conv", "Split"]
    assert len(model.graph.initializer) == 4
    onnx.checker.check_model(model)
    onnx.save(model, str(tmp_path / "merged.onnx"))
    expected, found = (OnnxModel(file)(pictures(1)[0]) for file in (path, tmp_path / "merged.onnx"))
    for name in HEADS:
        np.testing.assert_allclose(found[name], expected[name], atol=1e-5)


def test_quantised_outputs_are_close(tmp_path):
    path, out = write_network(tmp_path / "net.onnx"), tmp_path / "small.onnx"
    quantise(path, out, pictures(5))
    quantised = OnnxModel(out)
    assert quantised.metadata["longer_side"] == "64"
    types = {node.op_type for node in onnx.load(str(out)).graph.node}
    assert {"QuantizeLinear", "DequantizeLinear"} <= types
    picture = pictures(6)[-1]
    expected, found = OnnxModel(path)(picture), quantised(picture)
    for name in HEADS:
        assert np.abs(found[name] - expected[name]).max() < 0.05 * np.ptp(expected[name])


def test_a_quantisation_that_is_impossible(tmp_path):
    path = write_network(tmp_path / "net.onnx", has_relu=False)
    with pytest.raises(InputError, match="has no inputs for the quantisation"):
        quantise(path, tmp_path / "small.onnx", [])
    with pytest.raises(InputError, match="has no feature map after a Relu"):
        quantise(path, tmp_path / "small.onnx", pictures(1))
    assert not (tmp_path / "small.onnx").exists()
