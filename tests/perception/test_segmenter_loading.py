"""Loading of segmenters, and errors for unsupported files."""

import re
from functools import partial

import numpy as np
import onnx
import pytest
from onnx import TensorProto
from support.onnx_graphs import write_constant, write_reading

from jaxfit.foundation.errors import InputError
from jaxfit.perception.network import OnnxModel
from jaxfit.perception.segmentation import KINDS, load_segmenter
from jaxfit.perception.segmentation_inputs import Placement, non_maximum_suppression

load = partial(load_segmenter, threads=1)  # one thread is faster on a busy machine
HEAD, PROTOS = np.zeros((1, 116, 84)), np.zeros((1, 32, 16, 16))


def write(path, input_shape=(1, 3, 64, 64), kind=TensorProto.FLOAT, metadata=None, **outputs):
    return write_reading(path, input_shape, outputs, {}, metadata, kind)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "net.onnx"


def test_outputs_determine_the_layout(path):
    write(path, output0=HEAD, output1=PROTOS)
    for kind in ("auto", "yolo"):
        assert load(path, kind=kind).class_names == ("bird",)
    with pytest.raises(InputError, match="supported are rf_detr: outputs dets"):
        load(path, kind="rf_detr")
    with pytest.raises(ValueError, match="kind must be one of auto, bottom_up"):
        load(path, kind="other")
    with pytest.raises(ValueError, match="min_score"):
        load(path, min_score=50)
    assert load(path, tile_px=32).class_names == ("bird",)
    assert "yolo" in KINDS


@pytest.mark.parametrize(
    "outputs",
    [
        {"logits": np.zeros((1, 1000))},
        {"output0": np.zeros((1, 6300, 38)), "output1": PROTOS},  # YOLOv5 of one class
        {"dets": np.zeros((1, 9, 5)), "labels": np.zeros((1, 9)), "masks": np.zeros((1, 9, 8, 8))},  # mmdeploy
        {"boxes": np.zeros((1, 9, 4)), "labels": np.zeros(9), "scores": np.zeros(9), "masks": np.zeros((9, 1, 8, 8))},
    ],
)
def test_unknown_layouts_are_reported_with_the_supported_layouts(path, outputs):
    write(path, (1, 3, 320, 320), **outputs)
    with pytest.raises(InputError) as error:
        load(path)
    name, value = next(iter(outputs.items()))
    for text in (str(path), f"{name} ({', '.join(map(str, value.shape))})", "yolo", "rf_detr", "mask_rcnn"):
        assert text in str(error.value)


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        ((1, 1, 64, 64), TensorProto.FLOAT),
        ((1, 64, 64, 3), TensorProto.FLOAT),
        ((2, 3, 64, 64), TensorProto.FLOAT),
        ((1, 3, 64, "width"), TensorProto.FLOAT),
        ((1, 3, 64, 64), TensorProto.UINT8),
        ((3, 64, 64), TensorProto.FLOAT),
    ],
)
def test_unsupported_inputs(path, shape, kind):
    write(path, shape, kind, output0=np.zeros((1, 116, 9000)), output1=PROTOS)
    sides = ", ".join("?" if side == "width" else str(side) for side in shape)
    with pytest.raises(InputError, match=rf"images \({re.escape(sides)}\) of tensor.*export it as \(1, 3,"):
        load(path)


def test_classes(path):
    def names(classes=None, names=None, count=2):
        write(path, output0=np.zeros((1, 36 + count, 84)), output1=PROTOS)
        return load(path, classes=classes, names=names).class_names

    assert names(count=80) == ("bird",)
    assert names(("cat", "bird"), count=80) == ("bird", "cat")
    assert names(count=1) == ("class_0",)
    assert names(names=("murre", "bird")) == ("bird",)
    assert names(("murre",), names=("murre", "egg")) == ("murre",)
    write(path, output0=np.zeros((1, 38, 84)), output1=PROTOS, metadata={"names": "{0: 'murre', 1: 'egg'}"})
    assert load(path, classes=("egg",)).class_names == ("egg",)
    with pytest.raises(InputError, match="no class called bird; its classes are murre, egg"):
        load(path)
    with pytest.raises(InputError, match="lacks puffin; its classes are murre, egg"):
        load(path, classes=("egg", "puffin"))
    with pytest.raises(InputError, match="lacks a class"):
        load(path, classes=())
    with pytest.raises(InputError, match="has 2 classes, but its names are a, b, c"):
        load(path, names=("a", "b", "c"))
    for text in ("{0: murre}", "3", "{'a': 'b'}"):
        write(path, output0=np.zeros((1, 38, 84)), output1=PROTOS, metadata={"names": text})
        with pytest.raises(InputError, match="names"):
            load(path)


def test_external_data_are_refused(tmp_path, path):
    """ONNX Runtime reads every file that a network names, also the file of the network itself."""
    whole = onnx.load(write(path, output0=HEAD, output1=PROTOS))
    assert load(path).class_names == ("bird",)
    for location in ("net.onnx.data", path.name):
        for tensor in whole.graph.initializer:
            tensor.ClearField("external_data")
            onnx.external_data_helper.set_external_data(tensor, location, offset=0)
        (tmp_path / "net.onnx.data").write_bytes(bytes(1 << 16))
        path.write_bytes(whole.SerializeToString())
        with pytest.raises(InputError, match=r"external data.*save the network as one file"):
            load(path)
    onnx.helper.set_model_props(whole := onnx.load(write(path, output0=HEAD, output1=PROTOS)), {"location": "ledge 3"})
    path.write_bytes(whole.SerializeToString())
    OnnxModel(path)


def test_detector_needs_a_saliency_network(tmp_path, path):
    write(path, output=np.zeros((1, 84, 85)))
    with pytest.raises(InputError, match=r"no masks: .* \(add a network for the masks: net.onnx\+u2netp.onnx\)"):
        load(path)
    masks = write_constant(tmp_path / "masks.onnx", (1, 3, 32, 32), {"mask": np.zeros((1, 32, 32))})
    assert load(f"{path}+{masks}").class_names == ("bird",)
    with pytest.raises(InputError, match="YOLOX detector"):
        load(f"{masks}+{masks}")
    with pytest.raises(InputError, match="saliency: first output"):
        load(f"{path}+{path}")
    with pytest.raises(InputError, match=r"is one file, but kind yolox\+saliency needs two files"):
        load(path, kind="yolox+saliency")
    with pytest.raises(InputError, match="kind yolo needs one file"):
        load(f"{path}+{masks}", kind="yolo")


def test_file_name_with_a_plus(tmp_path):
    path = write(tmp_path / "a.onnx+b.onnx", output0=HEAD, output1=PROTOS)
    assert load(path).class_names == ("bird",)


def test_placements():
    frame = np.full((90, 201, 3), 7, np.uint8)
    centred = Placement.letterboxed((201, 90), (100, 101), centred=True)
    picture = centred.picture(frame)
    assert picture.shape == (101, 100, 3)
    # 45 rows of 101: 28 above and below; 101 x 90 at 100 / 201
    assert (picture[[27, 73]] == 114).all()
    assert (picture[28:73] == 7).all()
    boxes = np.array([[0, 28, 100, 73], [50, 30, 60, 200]], np.float32)
    np.testing.assert_allclose(centred.to_frame(boxes), [[0, 0, 201, 90], [100.5, 4, 120.6, 90]], rtol=1e-6)
    cropped = Placement.cropped((201, 90), (30, 40), np.array([20, 10, 80, 90]))
    assert cropped.picture(frame).shape == (40, 30, 3)
    np.testing.assert_allclose(cropped.to_frame(np.array([[0, 0, 30, 40.0]])), [[20, 10, 80, 90]])


def test_masks_are_interpolated():
    placement = Placement.cropped((60, 40), (20, 20), np.array([10, 10, 50, 30]))
    rows, columns = np.indices((5, 10)) + 0.5  # over the crop: 4 pixels per cell
    half = placement.instance(columns - 5.3, np.array([12.0, 10, 47.6, 29.4]), 0.0, 1, "bird")
    # x − 10 > 5.3 · 4, to the last centre below 47.6
    assert half is not None
    assert half.box_px.tolist() == [31, 10, 17, 19]
    both = np.stack([columns, rows, np.ones_like(rows)])
    corner = placement.instance(both, np.array([0.0, 0, 60, 40]), 0.0, 1, "bird", np.array([1, 0.0, -9.4]))
    # beyond the outermost centres the map is constant: 9.5 − 9.4 > 0
    assert corner is not None
    assert corner.box_px.tolist() == [48, 0, 12, 40]
    assert placement.instance(columns, np.array([70.0, 0, 80, 9]), 0.0, 1, "bird") is None
    assert placement.instance(columns, np.array([20.6, 0, 21.4, 9]), 0.0, 1, "bird") is None


def test_non_maximum_suppression_within_a_class():
    boxes = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [0, 0, 10, 10], [5, 0, 15, 10]], np.float32)
    scores, labels = np.array([0.8, 0.9, 0.5, 0.7], np.float32), np.array([3, 3, 4, 3])
    # IoU of the first two: 9 / 11; of the best and the last: 6 / 14
    assert non_maximum_suppression(boxes, scores, labels, 0.5).tolist() == [1, 3, 2]
    assert non_maximum_suppression(boxes, scores, labels, 0.4).tolist() == [1, 2]
    assert non_maximum_suppression(boxes[:0], scores[:0], labels[:0], 0.5).tolist() == []
