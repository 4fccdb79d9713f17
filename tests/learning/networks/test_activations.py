"""Statistics of activations: the added output, the stored metadata, the distances."""

import numpy as np
import onnx
import pytest
from onnx import helper
from support.onnx_graphs import write_graph

from jaxfit.foundation.errors import InputError
from jaxfit.learning.networks.familiarity import activation_statistics, store_activations
from jaxfit.perception.network import OnnxModel, activation_monitor

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


def test_unlike_inputs_are_far_away(tmp_path):
    path = write_network(tmp_path / "net.onnx")
    store_activations(path, inputs(200))
    model = OnnxModel(path)
    monitor = activation_monitor(model)
    for shift, seed in ((0.0, 2), (3.0, 3)):
        for array in inputs(50, shift, seed):
            monitor.add(model(array), 1)
    alike, unlike = np.split(monitor.take(), 2)
    assert np.median(alike) < 1 < 3 < unlike.min()


def test_the_statistics_can_be_replaced(tmp_path):
    path = write_network(tmp_path / "net.onnx")
    first = store_activations(path, inputs(50))
    second = store_activations(path, inputs(50, 5.0))
    assert not np.allclose(first.mean, second.mean)
    names = [output.name for output in onnx.load(str(path)).graph.output]
    assert names == ["heatmaps", "activations"]


def test_dead_and_constant_channels_have_finite_distances():
    values = RNG.random((40, 3))
    values[:, 1] = 0
    statistics = activation_statistics(values)
    assert np.isfinite(statistics.whitening).all()
    far = statistics.distance(np.array([[0.5, 9.0, 0.5], [np.nan, 0, 0], [np.inf, 0, 0]]))
    assert (far > 1).all()
    assert np.isfinite(far).all()


def test_unusable_inputs(tmp_path):
    path = write_network(tmp_path / "net.onnx")
    for arrays in ((), inputs(5), np.zeros((20, 1, 3, 8, 8), np.float32)):
        with pytest.raises(InputError, match="at least 10"):
            store_activations(path, arrays)


def test_damaged_statistics(tmp_path):
    path = write_network(tmp_path / "net.onnx")
    store_activations(path, inputs(50))
    stored = dict(OnnxModel(path).metadata)
    mean, whitening = stored["activation_mean"], stored["activation_whitening"]
    nan = "AADAfw==" * 1
    for damage in (
        {"activation_mean": "not base64!"},
        {"activation_mean": mean[:-4]},
        {"activation_mean": whitening},
        {"activation_whitening": whitening[:-8]},
        {"activation_whitening": nan},
        {"activation_whitening": ""},
        {"activation_mean": ""},
        {"activation_whitening": "A" * 20_000_000},
    ):
        model = onnx.load(str(path))
        helper.set_model_props(model, stored | damage)
        (tmp_path / "damaged.onnx").write_bytes(model.SerializeToString())
        with pytest.raises(InputError, match="activation_mean"):
            activation_monitor(OnnxModel(tmp_path / "damaged.onnx"))


def test_statistics_without_the_output(tmp_path):
    path = write_network(tmp_path / "net.onnx")
    store_activations(path, inputs(50))
    stored = {key: text for key, text in OnnxModel(path).metadata.items() if key.startswith("activation")}
    other = write_network(tmp_path / "other.onnx", stored)
    with pytest.raises(InputError, match="output `activations`"):
        activation_monitor(OnnxModel(other))
    assert activation_monitor(OnnxModel(write_network(tmp_path / "plain.onnx"))) is None
