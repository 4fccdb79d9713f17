"""Files of networks: weights as the start of a fine-tuning, statistics of activations."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

import onnx  # noqa: E402
from onnx import helper  # noqa: E402
from support.onnx_graphs import write_constant, write_graph  # noqa: E402

from jaxfit.foundation.errors import InputError  # noqa: E402
from jaxfit.learning.networks.keypoints import KeypointMaps  # noqa: E402
from jaxfit.learning.networks.network_files import (  # noqa: E402
    Probabilities,
    base_file,
    load_keypoint_base,
    load_segmenter_base,
    store_activations,
)
from jaxfit.model.anatomy import MURRE_KEYPOINTS  # noqa: E402
from jaxfit.perception.network import OnnxModel, activation_monitor  # noqa: E402

REST = tuple(name for name in MURRE_KEYPOINTS[2:] if name != "bill_tip")


def test_loaded_segmenter_gives_the_outputs_of_the_file():
    path = base_file("segmenter", "builtin")
    pictures = np.random.default_rng(0).random((1, 3, 64, 96), np.float32)
    expected = OnnxModel(path)(pictures)
    with torch.inference_mode():
        found = Probabilities(load_segmenter_base(path))(torch.from_numpy(pictures))
    for name, values in zip(("foreground", "centre", "offset"), found, strict=True):
        assert expected[name].std() > 1e-3
        np.testing.assert_allclose(values.numpy(), expected[name], atol=1e-4)


def test_loaded_keypoint_network_gives_the_outputs_of_the_file():
    path = base_file("keypoints", "builtin")
    names = ("my_own_point", "beak", "eyeR", *REST)
    network, found = load_keypoint_base(path, names)
    assert found == ("", "bill_tip", "right_eye", *REST)
    crops = np.random.default_rng(0).random((1, 3, 192, 192), np.float32)
    expected = OnnxModel(path)(crops)["heatmaps"][0]
    with torch.inference_mode():
        maps = KeypointMaps(network, len(names))(torch.from_numpy(crops))[0].numpy()
    for name, own in zip(found, maps, strict=True):
        if name:
            np.testing.assert_allclose(own, expected[MURRE_KEYPOINTS.index(name)], atol=1e-3)


def test_other_layouts_are_rejected(tmp_path):
    maps = np.zeros((2, 8, 8), np.float32)
    other = write_constant(tmp_path / "other.onnx", (1, 3, 64, 64), {"output": maps})
    with pytest.raises(InputError, match="another layout"):
        load_segmenter_base(other)
    with pytest.raises(InputError, match="another layout"):
        load_keypoint_base(other, ["beak"])
    named = {"foreground": maps[:1], "centre": maps[:1], "offset": maps}
    same_outputs = write_constant(tmp_path / "same.onnx", (1, 3, 64, 64), named)
    with pytest.raises(InputError, match=r"same\.onnx: is a network of another layout.*it lacks fitting weights"):
        load_segmenter_base(same_outputs)
    with pytest.raises(InputError, match="does not exist"):
        load_segmenter_base(tmp_path / "absent.onnx")


RNG = np.random.default_rng(0)
WEIGHT = RNG.standard_normal((4, 3, 2, 2)).astype(np.float32)


def write_network(path, metadata=None):
    """A convolution of stride 2 between two Relus, and a head; the last feature map has 4 channels."""
    nodes = [
        helper.make_node("Relu", ["input"], ["fine"]),
        helper.make_node("Conv", ["fine", "weight"], ["mixed"], strides=[2, 2]),
        helper.make_node("Relu", ["mixed"], ["deep"]),
        helper.make_node("ReduceMean", ["deep"], ["heatmaps"], axes=[1], keepdims=1),
    ]
    shapes = {"input": ["n", 3, 8, 8]}, {"heatmaps": ["n", 1, 4, 4]}
    return write_graph(path, *shapes, nodes, {"weight": WEIGHT}, metadata)


def inputs(count, shift=0.0, seed=1):
    return np.random.default_rng(seed).random((count, 1, 3, 8, 8), np.float32) + np.float32(shift)


def pooled(arrays):
    """The mean of the deep map, by NumPy."""
    blocks = np.maximum(arrays[:, 0], 0).reshape(-1, 3, 4, 2, 4, 2)
    mixed = np.einsum("nchiwj,kcij->nkhw", blocks, WEIGHT)
    return np.maximum(mixed, 0).mean((2, 3))


def test_stored_statistics_are_those_of_the_training_inputs(tmp_path):
    path = write_network(tmp_path / "net.onnx", {"colour": "bgr"})
    before = OnnxModel(path)(inputs(1)[0])["heatmaps"]
    training = inputs(300)
    statistics = store_activations(path, training)
    model = OnnxModel(path)
    assert model.metadata["colour"] == "bgr"
    np.testing.assert_array_equal(model(inputs(1)[0])["heatmaps"], before)
    np.testing.assert_allclose(model(training[0])["activations"], pooled(training[:1]), rtol=1e-5)
    monitor = activation_monitor(model)
    for array in training:
        monitor.add(model(array), 1)
    distances = monitor.take()
    assert (distances < 1).mean() == pytest.approx(0.99, abs=0.005)
    np.testing.assert_allclose(distances, statistics.distance(pooled(training)), rtol=1e-4)
    assert not len(monitor.take())

    difference = pooled(training) - pooled(training).mean(0)
    mahalanobis = np.sqrt(np.einsum("ni,ij,nj->n", difference, np.linalg.inv(np.cov(difference.T)), difference))
    assert np.corrcoef(distances, mahalanobis)[0, 1] > 0.99


def test_unlike_inputs_are_far_away_and_statistics_can_be_replaced(tmp_path):
    path = write_network(tmp_path / "net.onnx")
    store_activations(path, inputs(50, 5.0))
    store_activations(path, inputs(200))
    assert [output.name for output in onnx.load(str(path)).graph.output] == ["heatmaps", "activations"]
    model = OnnxModel(path)
    monitor = activation_monitor(model)
    for shift, seed in ((0.0, 2), (3.0, 3)):
        for array in inputs(50, shift, seed):
            monitor.add(model(array), 1)
    alike, unlike = np.split(monitor.take(), 2)
    assert np.median(alike) < 1 < 3 < unlike.min()


def test_unusable_inputs(tmp_path):
    path = write_network(tmp_path / "net.onnx")
    for arrays in ((), inputs(5), np.zeros((20, 1, 3, 8, 8), np.float32)):
        with pytest.raises(InputError, match="at least 10"):
            store_activations(path, arrays)


@pytest.mark.parametrize("damage", ["no base64!", "", "A" * 1000, None])
def test_damaged_statistics(tmp_path, damage):
    """Perception names statistics that are damaged, or that belong to a network without the output."""
    path = write_network(tmp_path / "net.onnx")
    store_activations(path, inputs(50))
    stored = {key: text for key, text in OnnxModel(path).metadata.items() if key.startswith("activation")}
    if damage is None:
        other, message = write_network(tmp_path / "other.onnx", stored), "output `activations`"
    else:
        model, other, message = onnx.load(str(path)), tmp_path / "damaged.onnx", "activation_mean"
        helper.set_model_props(model, stored | {"activation_whitening": damage})
        other.write_bytes(model.SerializeToString())
    with pytest.raises(InputError, match=message):
        activation_monitor(OnnxModel(other))
    assert activation_monitor(OnnxModel(write_network(tmp_path / "plain.onnx"))) is None
