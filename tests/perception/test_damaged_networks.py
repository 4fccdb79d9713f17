"""Networks with other outputs than declared end in instances, keypoints or one InputError."""

from contextlib import suppress
from functools import partial

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from jaxfit.foundation.errors import InputError
from jaxfit.perception.keypoints import load_keypoint_detector
from jaxfit.perception.network import instance_of
from jaxfit.perception.segmentation import load_segmenter

FRAME = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
NOISE = np.random.default_rng(0).uniform(0, 1, 100_000).astype(np.float32)
INPUT = (1, 3, 64, 64)
SEGMENTERS = {
    "yolo": {"output0": (1, 37, 84), "output1": (1, 32, 16, 16)},
    "final": {"output0": (1, 9, 38), "output1": (1, 32, 16, 16)},
    "rf_detr": {"dets": (1, 9, 4), "labels": (1, 9, 2), "masks": (1, 9, 16, 16)},
    "mask_rcnn": {"boxes": (9, 4), "labels": (9,), "scores": (9,), "masks": (9, 1, 64, 64)},
    "bottom_up": {"foreground": (1, 1, 16, 16), "centre": (1, 1, 16, 16), "offset": (1, 2, 16, 16)},
}
KEYPOINTS = {
    "heatmaps": {"heatmaps": (1, 3, 16, 16)},
    "deeplabcut": {"heatmaps": (1, 3, 16, 16), "locref": (1, 6, 16, 16)},
    "simcc": {"simcc_x": (1, 3, 128), "simcc_y": (1, 3, 128)},
}
NAMES = {"keypoint_names": "a,b,c"}
load = partial(load_segmenter, threads=1)


def write(path, declared, actual=None, shape=INPUT, metadata=None, scale=1.0):
    """Write a network with constant outputs, which may have other shapes than declared."""
    actual = {name: actual.get(name, sides) for name, sides in declared.items()} if actual else declared
    values = {
        f"{name}_value": sides if isinstance(sides, np.ndarray) else (scale * NOISE[: np.prod(sides)]).reshape(sides)
        for name, sides in actual.items()
    }
    # shapes that are computed from the input are unknown to ONNX Runtime before a run
    nodes = [
        helper.make_node("ReduceMax", ["input"], ["most"], keepdims=0),
        helper.make_node("Mul", ["most", "zero"], ["nothing"]),
        helper.make_node("Cast", ["nothing"], ["no_number"], to=TensorProto.INT64),
    ]
    for name in declared:
        nodes.append(helper.make_node("Add", [f"{name}_shape", "no_number"], [f"{name}_sides"]))
        nodes.append(helper.make_node("Reshape", [f"{name}_value", f"{name}_sides"], [name], allowzero=1))
        values[f"{name}_shape"] = np.array(values[f"{name}_value"].shape)
    values["zero"] = np.zeros((), np.float32)
    graph = helper.make_graph(
        nodes,
        "test",
        [helper.make_tensor_value_info("input", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, sides) for name, sides in declared.items()],
        [numpy_helper.from_array(value, name) for name, value in values.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, dict(metadata or {}))
    path.write_bytes(model.SerializeToString())
    return path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "net.onnx"


def test_values_that_are_not_finite(path):
    for value in [np.nan, np.inf, -np.inf, 1e30]:
        for layout in SEGMENTERS:
            write(path, SEGMENTERS[layout], scale=value, metadata={"names": "['bird']", "longer_side": "64"})
            for instance in load(path)(FRAME):
                assert 0 <= instance.score <= 1


def test_outputs_of_other_shapes(path):
    """A wrong rank is an error; other lengths are an error or fewer instances."""
    for change in ["fewer", "empty", "axis"]:
        for layout in SEGMENTERS:
            for name, sides in SEGMENTERS[layout].items():
                other = {"fewer": (*sides[:-1], sides[-1] - 1), "empty": (*sides[:-1], 0), "axis": (*sides, 1)}[change]
                write(path, SEGMENTERS[layout], {name: other}, metadata={"names": "['bird']"})
                with pytest.raises(InputError) if change == "axis" else suppress(InputError):
                    load(path)(FRAME)


@pytest.mark.parametrize("layout", KEYPOINTS)
def test_keypoint_outputs_that_change(path, layout):
    """The first run determines the layout; a later run with other shapes is an error."""
    shapes = {name: ("n", *sides[1:]) for name, sides in KEYPOINTS[layout].items()}
    write(path, shapes, KEYPOINTS[layout], shape=("n", 3, 64, 64), metadata=NAMES)
    birds = [instance_of(np.ones((9, 12), bool), 1.0, "bird", x) for x in (3, 40)]
    detector = load_keypoint_detector(path, threads=1)
    assert detector(FRAME, birds[:1])[0].shape == (1, 3, 2)
    with pytest.raises(InputError, match="a run gives"):
        detector(FRAME, birds)
