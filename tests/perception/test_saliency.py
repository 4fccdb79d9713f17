"""Views of pictures, doubtful boxes, whole masks and photographs, with a detector by hand and the saliency of red."""

import cv2
import numpy as np
import pytest
from support.saliency_graphs import write_saliency

from jaxfit.perception.network import OnnxModel
from jaxfit.perception.saliency import DetectorAndSaliency, Saliency
from jaxfit.perception.segmentation_layouts import Detection, View

SIDE = 400
CENTRE = (200, 200)
BOX = (160, 170, 240, 230)


class Detector:
    """Detects boxes with their scores, only in some views."""

    class_names, is_square = ("bird",), True

    def __init__(self, *boxes, sees=lambda view: True):
        self.boxes, self.sees, self.views = boxes, sees, []

    def __call__(self, frame, *views):
        self.views += views or (View(),)
        is_seen = any(self.sees(view) for view in views or (View(),))
        return [Detection(np.float32(box), score, "bird") for box, score in self.boxes if is_seen]


@pytest.fixture(scope="module")
def saliency(tmp_path_factory):
    return Saliency(OnnxModel(write_saliency(tmp_path_factory.mktemp("nets") / "u2netp.onnx"), 1))


@pytest.fixture
def segmenter(saliency):
    return lambda *boxes, **settings: DetectorAndSaliency(Detector(*boxes, **settings), saliency, 0.3)


def scene(*ellipses):
    """Red objects on blue; see test_detector_saliency."""
    frame = np.full((SIDE, SIDE, 3), (140, 0, 75), np.uint8)
    for centre, axes in ellipses:
        cv2.ellipse(frame, centre, axes, 0, 0, 360, (0, 0, 140), -1)
    return frame


def iou(bird, frame):
    mask, truth = bird.whole((SIDE, SIDE)), frame[..., 2] == 140
    return (mask & truth).sum() / (mask | truth).sum()


@pytest.mark.parametrize("view", [View(z, t, m) for z in (1.0, 0.5) for t in range(4) for m in (False, True)])
def test_boxes_of_a_view_are_mapped_back(view):
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[10:22, 30:38] = 255
    rows, columns = np.nonzero(view.of(picture)[..., 0] == 255)
    seen = np.array([[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]])
    np.testing.assert_allclose(view.back(seen, 64), [[30, 10, 38, 22]])


def test_a_second_size_without_a_certain_bird(segmenter):
    large = segmenter((BOX, 0.5), sees=lambda view: view.zoom < 1)
    assert [bird.score for bird in large(scene((CENTRE, (38, 28))))] == [0.5]
    usual = segmenter((BOX, 0.5))
    usual(scene((CENTRE, (38, 28))))
    assert usual._detector.views == [View()]


@pytest.mark.parametrize(
    ("ellipses", "is_bird"),
    [
        ([(CENTRE, (38, 28))], True),
        ([], False),
        ([((180, 200), (15, 28)), ((222, 200), (15, 28))], False),  # two objects
        ([(CENTRE, (38, 400))], False),  # ends nowhere
    ],
)
def test_a_doubtful_box_needs_one_whole_object(segmenter, ellipses, is_bird):
    assert len(segmenter((BOX, 0.2))(scene(*ellipses))) == is_bird


def test_a_doubtful_box_needs_its_mirror_image_and_is_no_part_of_a_bird(segmenter):
    frame = scene((CENTRE, (38, 28)), ((60, 60), (20, 20)))
    assert not segmenter((BOX, 0.2), sees=lambda view: not view.mirrored)(frame)
    part, other = ((160, 170, 200, 230), 0.2), ((40, 40, 80, 80), 0.2)
    assert [bird.score for bird in segmenter((BOX, 0.9), part, other)(frame)] == [0.9, 0.2]


@pytest.mark.parametrize("axes", [(48, 33), (70, 28)])  # beyond the box, and beyond the picture around the box
def test_a_mask_is_not_cut_by_its_box(segmenter, axes):
    frame = scene((CENTRE, axes))
    (bird,) = segmenter((BOX, 0.9))(frame)
    assert iou(bird, frame) > 0.96


def test_a_mask_is_cut_by_the_boxes_of_other_birds(segmenter):
    frame = scene((CENTRE, (80, 28)))
    left, right = segmenter(((120, 170, 200, 230), 0.9), ((200, 170, 280, 230), 0.8))(frame)
    assert left.x0 + left.mask.shape[1] == right.x0 == 200
    assert left.mask.sum() + right.mask.sum() == pytest.approx((frame[..., 2] == 140).sum(), rel=0.03)


def test_two_boxes_of_one_bird(segmenter):
    assert len(segmenter((BOX, 0.9), ((140, 170, 240, 240), 0.5))(scene((CENTRE, (38, 28))))) == 1


def test_a_photograph_of_a_bird_upside_down(segmenter):
    frame = scene((CENTRE, (38, 28)))
    (bird,) = segmenter((BOX, 0.5), sees=lambda view: view.turns == 2).photograph(frame)
    assert (bird.score, iou(bird, frame) > 0.97) == (pytest.approx(0.5), True)
    assert not segmenter((BOX, 0.5), sees=lambda view: view == View(1.0, 2)).photograph(
        frame
    )  # not in the mirror image


def test_the_bird_of_a_photograph_is_its_salient_object(segmenter):
    small, far = ((60, 60), (12, 12)), ((340, 340), (12, 12))
    boxes = ((BOX, 0.5), ((48, 48, 72, 72), 0.9), ((328, 328, 352, 352), 0.9))
    (bird,) = segmenter(*boxes).photograph(scene((CENTRE, (38, 28)), small, far))
    assert (bird.x0 < 200 < bird.x0 + bird.mask.shape[1], bird.score) == (True, pytest.approx(0.5))
    # a bird beside a larger object that is no bird
    assert len(segmenter(boxes[1]).photograph(scene((CENTRE, (38, 28)), small))) == 1


def test_a_small_bird_of_a_photograph_is_searched_in_parts_of_the_picture(saliency):
    class Near(Detector):
        def __call__(self, frame, *views):
            return super().__call__(frame, *views) if frame.shape[0] < SIDE else []

    frame = scene(((60, 60), (12, 12)))
    detector = Near(((48, 48, 72, 72), 0.5))
    (bird,) = DetectorAndSaliency(detector, saliency, 0.3).photograph(frame)
    assert iou(bird, frame) > 0.9


@pytest.mark.parametrize("score", [0.9, 0.2])  # certain and doubtful
def test_known_birds_are_not_segmented_and_not_returned(segmenter, score, monkeypatch):
    frame = scene((CENTRE, (38, 28)), ((60, 60), (20, 20)))
    both = segmenter((BOX, 0.95), ((40, 40, 80, 80), score))
    large, small = both(frame)
    assert [bird.score for bird in both(frame, [large])] == [small.score]
    assert [bird.score for bird in both(frame, [small])] == [large.score]
    monkeypatch.setattr(both, "_saliency", None)  # no run
    assert both(frame, [large, small]) == []
