"""Segmentation networks of every supported layout, on graphs with known outputs."""

import json
from functools import partial

import numpy as np
import pytest
from onnx import TensorProto, helper
from support.onnx_graphs import write_graph, write_reading

from jaxfit.foundation.errors import InputError
from jaxfit.perception.segmentation import load_segmenter
from jaxfit.perception.segmentation_inputs import COCO, coco_by_category

load = partial(load_segmenter, threads=1)  # one thread is faster on a busy machine
BIRD, CAT = 14, 15
COLOUR = (51, 102, 204)  # blue, green, red: shares 0.2, 0.4, 0.8


def yolo_protos():
    """32 prototypes: the first is the centre of the column, the second the centre of the row, the third 1."""
    protos = np.zeros((1, 32, 160, 160), np.float32)
    protos[0, 1], protos[0, 0] = np.indices((160, 160)) + 0.5
    protos[0, 2] = 1
    return protos


def raw_head(*rows, classes=80):
    """Rows of (cx, cy, w, h), class, score, three coefficients."""
    head = np.zeros((1, 4 + classes + 32, 8400), np.float32)
    for i, (box, label, score, coefficients) in enumerate(rows):
        head[0, :4, 7 * i], head[0, 4 + label, 7 * i] = box, score
        head[0, 4 + classes : 7 + classes, 7 * i] = coefficients
    return head


def final_head(*rows):
    """Rows of (x0, y0, x1, y1), class, score, three coefficients."""
    head = np.zeros((1, 300, 38), np.float32)
    for i, (box, label, score, coefficients) in enumerate(rows):
        head[0, i, :4], head[0, i, 4:6], head[0, i, 6:9] = box, (score, label), coefficients
    return head


def write_yolo(path, head, read=None, input_shape=(1, 3, 640, 640), **metadata):
    outputs = {"output0": head, "output1": yolo_protos()}
    return write_reading(path, input_shape, outputs, read or {}, metadata)


def box_of(instance):
    return instance.box_px.tolist()


def test_coco_numbers():
    assert COCO[BIRD] == coco_by_category()[16] == "bird"
    assert coco_by_category()[90] == COCO[79] == "toothbrush"


def test_yolo_raw_head(tmp_path):
    # 1280 x 720 at a half is 640 x 360, with 140 rows of grey above and below
    box, right_of = (320, 320, 200, 100), (1, 0, -80.1)  # columns of a quarter of the input: x > 320.4 there
    rows = [
        (box, BIRD, 0.6, (0, 0, 1)),  # overlaps the next row, which has a higher score
        ((322, 320, 200, 100), BIRD, 0.9, right_of),
        (box, CAT, 0.95, (0, 0, 1)),
        ((100, 300, 40, 40), BIRD, 0.7, (0, 1, -75)),  # rows of a quarter of the input: y > 300 there
        ((500, 300, 40, 40), BIRD, 0.2, (0, 0, 1)),
        ((500, 300, 40, 40), BIRD, 0.3, (0, 0, -1)),  # nothing above 0: no mask
    ]
    path = write_yolo(tmp_path / "seg.onnx", raw_head(*rows))
    segmenter, frame = load(path), np.zeros((720, 1280, 3), np.uint8)
    assert segmenter.class_names == ("bird",)
    first, second = segmenter(frame)
    # centres at x + 0.5 > 640.8, the box ends at (322 + 100) · 2 = 844; y from (270 - 140) · 2 to (370 - 140) · 2
    assert box_of(first) == [641, 260, 203, 200]
    assert first.mask.all()
    assert (first.label, pytest.approx(first.score)) == ("bird", 0.9)
    assert box_of(second) == [160, 320, 80, 40]
    both = load(path, classes=("cat", "bird"), min_score=0.65)(frame)
    assert [(one.label, round(one.score, 2)) for one in both] == [("cat", 0.95), ("bird", 0.9), ("bird", 0.7)]
    assert box_of(both[0]) == [440, 260, 400, 200]


def test_yolo_final_head(tmp_path):
    rows = [((220, 270, 420, 370), BIRD, 0.5, (0, 0, 1)), ((220, 270, 420, 370), BIRD, 0.9, (1, 0, -80.1))]
    path = write_yolo(tmp_path / "seg.onnx", final_head(*rows, ((0, 200, 9, 209), 0, 0.9, (0, 0, 1))))
    first, second = load(path)(np.zeros((720, 1280, 3), np.uint8))
    # no suppression: the network does it
    assert (box_of(first), pytest.approx(first.score)) == ([641, 260, 199, 200], 0.9)
    assert (box_of(second), pytest.approx(second.score)) == ([440, 260, 400, 200], 0.5)


@pytest.mark.parametrize("kind", [TensorProto.FLOAT, TensorProto.FLOAT16])
def test_yolo_input_is_red_green_blue_with_a_grey_margin(tmp_path, kind):
    head = final_head(*(((0, 140 + 20 * i, 20, 160 + 20 * i), BIRD, 0, (0, 0, 1)) for i in range(4)))
    at = [(0, 0, 320, 5), (0, 1, 320, 5), (0, 2, 320, 5), (0, 0, 139, 5)]
    read = {"output0": {(0, i, 4): pixel for i, pixel in enumerate(at)}}
    outputs = {"output0": head, "output1": yolo_protos()}
    path = write_reading(tmp_path / "seg.onnx", (1, 3, 640, 640), outputs, read, kind=kind)
    frame = np.full((720, 1280, 3), COLOUR, np.uint8)
    found = load(path, min_score=0.1)(frame)
    by_row = {one.y0: one.score for one in found}
    assert by_row == pytest.approx({0: 0.8, 40: 0.4, 80: 0.2, 120: 114 / 255}, abs=1e-3)


def test_yolo_of_variable_size_uses_the_metadata(tmp_path):
    head = final_head(((0, 0, 32, 32), 0, 0.5, (0, 0, 1)))
    path = write_yolo(
        tmp_path / "seg.onnx",
        head,
        {"output0": {(0, 0, 4): (0, 0, 255, 319)}},  # a larger index would fail
        (1, 3, "height", "width"),
        names="{0: 'murre'}",
        imgsz="[256, 320]",
    )
    segmenter = load(path)
    assert segmenter.class_names == ("murre",)
    (found,) = segmenter(np.full((512, 640, 3), 204, np.uint8))
    assert box_of(found) == [0, 0, 64, 64]
    assert found.score == pytest.approx(0.8)


def rf_detr_outputs(slots=91):
    masks = np.full((1, 200, 108, 108), -1, np.float32)
    masks[0, 3] = np.arange(108)[:, None] + 0.5 - 54.3
    masks[0, 4] = 1
    dets, labels = np.zeros((1, 200, 4), np.float32), np.full((1, 200, slots), -5, np.float32)
    dets[0, 3], dets[0, 4] = (0.5, 0.5, 0.25, 0.5), (0.1, 0.1, 0.1, 0.1)
    return {"dets": dets, "labels": labels, "masks": masks}


def test_rf_detr(tmp_path):
    outputs = rf_detr_outputs()
    outputs["labels"][0, 3, 16], outputs["labels"][0, 4, 17] = 2, 4
    path = write_reading(tmp_path / "seg.onnx", (1, 3, 432, 432), outputs, {})
    frame = np.zeros((864, 1296, 3), np.uint8)
    (bird,) = load(path)(frame)
    # x: (0.5 ∓ 0.125) · 1296; y: 54.3 of 108 rows are 434.4 of 864, to (0.5 + 0.25) · 864
    assert box_of(bird) == [486, 434, 324, 214]
    assert bird.score == pytest.approx(1 / (1 + np.exp(-2)))
    cat, bird = load(path, classes=("bird", "cat"))(frame)
    assert (cat.label, bird.label) == ("cat", "bird")
    assert load(path, min_score=0.9)(frame) == []


def test_rf_detr_input_is_normalised_and_stretched(tmp_path):
    outputs = rf_detr_outputs()
    outputs["dets"][0, 5:7], outputs["masks"][0, 5:7] = (0.9, 0.9, 0.1, 0.1), 1
    read = {"labels": {(0, 4, 16): (0, 0, 0, 0), (0, 5, 16): (0, 1, 431, 431), (0, 6, 16): (0, 2, 0, 431)}}
    path = write_reading(tmp_path / "seg.onnx", (1, 3, 432, 432), outputs, read)
    found = load(path, min_score=0)(np.full((100, 300, 3), COLOUR, np.uint8))
    logits = [(0.8 - 0.485) / 0.229, (0.4 - 0.456) / 0.224, (0.2 - 0.406) / 0.225]
    scores = sorted(one.score for one in found)[-3:]
    np.testing.assert_allclose(scores, sorted(1 / (1 + np.exp(-np.array(logits)))), atol=1e-6)


def test_rf_detr_names(tmp_path):
    def classes(slots, names=None, **metadata):
        path = write_reading(tmp_path / "seg.onnx", (1, 3, 432, 432), rf_detr_outputs(slots), {}, metadata)
        return load(path, names=names).class_names

    assert classes(2) == ("class_0",)  # the last slot is "no object"
    assert classes(3, names=("egg", "bird")) == ("bird",)
    metadata = json.dumps({"class_id_to_name": {"1": "murre"}})
    assert classes(2, rfdetr_inference=metadata) == ("murre",)
    with pytest.raises(InputError, match="class_0, class_1"):
        classes(3)
    with pytest.raises(InputError, match="2 classes"):
        classes(3, names=("bird",))
    with pytest.raises(InputError, match="rfdetr_inference"):
        classes(2, rfdetr_inference="[]")


def write_mask_rcnn(path, boxes, labels, scores, input_shape=(3, "height", "width"), **metadata):
    """Every mask is the red channel of the input."""
    batched = len(input_shape) == 4
    nodes = [
        helper.make_node("Gather", ["images", "zero"], ["red"], axis=1 if batched else 0),
        helper.make_node("Reshape", ["red", "lone"], ["plane"]) if batched else None,
        helper.make_node("Unsqueeze", ["plane" if batched else "red", "first"], ["one"]),
        helper.make_node("Tile", ["one", "times"], ["masks"]),
        *(helper.make_node("Identity", [f"{name}_value"], [name]) for name in ("boxes", "labels", "scores")),
    ]
    n = len(boxes)
    constants = {
        "zero": np.array([0]),
        "lone": np.array([1, *input_shape[2:]]) if batched else np.array([0]),
        "first": np.array([0]),
        "times": np.array([n, 1, 1, 1]),
        "boxes_value": np.array(boxes, np.float32),
        "labels_value": np.array(labels),
        "scores_value": np.array(scores, np.float32),
    }
    outputs = {"boxes": (n, 4), "labels": (n,), "scores": (n,), "masks": (None, 1, None, None)}
    kinds = {"labels": TensorProto.INT64}
    nodes = [node for node in nodes if node is not None]
    return write_graph(path, {"images": input_shape}, outputs, nodes, constants, metadata, output_kinds=kinds)


def red_until(x, width, height):
    frame = np.zeros((height, width, 3), np.uint8)
    frame[:, :x, 2] = 255
    return frame


def test_mask_rcnn(tmp_path):
    boxes = [(10, 5, 90, 50), (20.4, 5, 90, 50.5), (20, 5, 90, 50), (60, 5, 90, 50)]
    path = write_mask_rcnn(tmp_path / "m.onnx", boxes, [16, 16, 17, 16], [0.6, 0.9, 0.95, 0.9])
    first, second = load(path)(red_until(50, 100, 60))  # the fourth box contains no red
    assert (box_of(first), box_of(second)) == ([20, 5, 30, 45], [10, 5, 40, 45])
    assert (pytest.approx(first.score), first.label) == (0.9, "bird")
    path = write_mask_rcnn(tmp_path / "m.onnx", boxes[:1], [1], [0.6], names="['murre']")
    assert [one.label for one in load(path)(red_until(50, 100, 60))] == ["murre"]


def test_mask_rcnn_reduces_long_frames(tmp_path):
    path = write_mask_rcnn(tmp_path / "m.onnx", [(0, 0, 1333, 50)], [16], [0.9])
    (found,) = load(path)(red_until(1334, 2666, 100))
    assert box_of(found) == [0, 0, 1334, 100]


def test_mask_rcnn_of_fixed_size_is_letterboxed(tmp_path):
    path = write_mask_rcnn(tmp_path / "m.onnx", [(0, 0, 64, 64)], [16], [0.9], (1, 3, 64, 64))
    (found,) = load(path)(red_until(40, 128, 64))
    assert box_of(found) == [0, 0, 40, 64]
