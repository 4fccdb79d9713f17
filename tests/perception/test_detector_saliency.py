"""A detector with boxes on grids, and the mask of the salient object in each box."""

from functools import partial

import cv2
import numpy as np
import pytest
from support.saliency_graphs import (
    BIRD_BOX,
    BIRD_ROW,
    FIRST_OF_STRIDE_16,
    FIRST_OF_STRIDE_32,
    write_saliency,
    write_yolox,
    yolox_head,
)

from jaxfit.perception.network import OnnxModel
from jaxfit.perception.segmentation import load_segmenter
from jaxfit.perception.segmentation_layouts import Yolox

load = partial(load_segmenter, threads=1)  # one thread is faster on a busy machine


def test_boxes_are_decoded(tmp_path):
    rows = [
        BIRD_ROW,
        (
            FIRST_OF_STRIDE_16 + 7 * 26 + 11,
            (-0.5, 0.25, np.log(4), np.log(2)),
            0.7,
            14,
            0.9,
        ),  # the same box, lower score
        (3 * 52 + 2, (0.5, 0.5, 0, np.log(2)), 0.5, 14, 1),  # centre (20, 28), size (8, 16)
        (FIRST_OF_STRIDE_32 + 13, (0, 0, 0, 0), 1, 14, 0.5),  # centre (0, 32), size 32: half of the box is outside
        (FIRST_OF_STRIDE_32 + 5, (0, 0, 0, 0), 1, 2, 0.9),  # no bird
        (FIRST_OF_STRIDE_32 + 7, (0, 0, 0, 0), 0.5, 14, 0.5),  # score too low
    ]
    found = Yolox(OnnxModel(write_yolox(tmp_path / "d.onnx", yolox_head(*rows)), 1))(np.zeros((416, 832, 3), np.uint8))
    boxes = [one.corners_px for one in found]
    np.testing.assert_allclose(boxes, [BIRD_BOX, [32, 40, 48, 72], [0, 32, 32, 96]], atol=1e-3)
    np.testing.assert_allclose([one.score for one in found], [0.72, 0.5, 0.5], atol=1e-6)
    assert {one.label for one in found} == {"bird"}


@pytest.mark.parametrize(("pixel", "value"), [((0, 0, 9, 9), 7), ((0, 2, 9, 9), 3), ((0, 0, 415, 9), 114)])
def test_detector_input_is_blue_green_red_with_a_grey_margin(tmp_path, pixel, value):
    cell, box, _, label, _ = BIRD_ROW
    head = yolox_head((cell, box, 0.5, label, 0))
    path = write_yolox(tmp_path / "d.onnx", head, {"output": {(0, cell, 5 + label): pixel}})
    (found,) = Yolox(OnnxModel(path, 1))(np.full((416, 832, 3), (7, 5, 3), np.uint8))
    assert found.score == pytest.approx(value / 2)


@pytest.fixture
def segmenter(tmp_path):
    detector = write_yolox(tmp_path / "yolox.onnx", yolox_head(BIRD_ROW))
    return load(f"{detector}+{write_saliency(tmp_path / 'u2netp.onnx')}")


def scene(*ellipses):
    """Red objects on blue. The largest value is 140; after normalisation, red above 0.6 · 140 is above 1/2."""
    frame = np.full((416, 832, 3), (140, 0, 75), np.uint8)
    for centre, axes in ellipses:
        cv2.ellipse(frame, centre, axes, 0, 0, 360, (0, 0, 140), -1)
    return frame


def test_mask_is_the_salient_object_in_the_box(segmenter):
    frame = scene(((336, 232), (60, 30)))
    (bird,) = segmenter(frame)
    truth = frame[..., 2] == 140
    mask = np.zeros_like(truth)
    height, width = bird.mask.shape
    mask[bird.y0 : bird.y0 + height, bird.x0 : bird.x0 + width] = bird.mask
    assert (mask & truth).sum() / (mask | truth).sum() > 0.97
    assert (bird.label, pytest.approx(bird.score, abs=1e-6)) == ("bird", 0.72)
    assert segmenter.class_names == ("bird",)


def test_mask_excludes_other_objects_and_ends_at_the_box(segmenter):
    alone = segmenter(scene(((336, 232), (40, 20))))[0]
    (with_others,) = segmenter(scene(((336, 232), (40, 20)), ((285, 210), (5, 5)), ((420, 232), (12, 12))))
    np.testing.assert_array_equal(with_others.mask, alone.mask)
    (cut,) = segmenter(scene(((336, 232), (60, 200))))
    assert (cut.y0, len(cut.mask)) == (196, 72)  # 64/20 beyond the box, rounded outwards


def test_no_salient_object_gives_no_instance(segmenter):
    assert segmenter(scene()) == []
    assert segmenter(np.zeros((416, 832, 3), np.uint8)) == []
