"""The weights of an ONNX file as the start of a fine-tuning."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

import onnx  # noqa: E402
from support.onnx_graphs import write_constant  # noqa: E402

from jaxfit.foundation.errors import InputError  # noqa: E402
from jaxfit.learning.networks.keypoints import KeypointMaps  # noqa: E402
from jaxfit.learning.networks.network_files import (  # noqa: E402
    Probabilities,
    base_file,
    load_keypoint_base,
    load_segmenter_base,
)
from jaxfit.model.anatomy import MURRE_KEYPOINTS  # noqa: E402
from jaxfit.perception.network import OnnxModel  # noqa: E402

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


def test_weights_that_are_not_finite_are_rejected(tmp_path):
    model = onnx.load(str(base_file("segmenter", "builtin")))
    weight = next(w for w in model.graph.initializer if w.name == "network.heads.centre.bias")
    weight.CopyFrom(onnx.numpy_helper.from_array(np.array([np.nan], np.float32), weight.name))
    (tmp_path / "nan.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(InputError, match="another layout"):
        load_segmenter_base(tmp_path / "nan.onnx")
