"""Segmentation in tiles gives every bird of the whole frame once."""

import numpy as np
import pytest
from support.instances import rectangle_instance

from jaxfit.perception.merging import Tiled
from jaxfit.perception.network import Instance, instance_of


class Perfect:
    """Segments every bird: a bird is the area of one value."""

    class_names = ("bird",)

    def __init__(self):
        self.shapes = []

    def __call__(self, frame):
        self.shapes.append(frame.shape[:2])
        values = frame[..., 0]
        found = [instance_of(values == v, v / 255, "bird") for v in np.unique(values[values > 0])]
        return sorted((one for one in found if one is not None), key=lambda one: -one.score)


def frame_with(*boxes, height=200, width=300):
    frame = np.zeros((height, width, 3), np.uint8)
    for i, (x0, y0, x1, y1) in enumerate(boxes):
        frame[y0:y1, x0:x1] = 100 + i
    return frame


def assert_same(found: list[Instance], expected: list[Instance]):
    assert [one.score for one in found] == [one.score for one in expected]
    for one, other in zip(found, expected, strict=True):
        assert (one.x0, one.y0, one.label) == (other.x0, other.y0, other.label)
        np.testing.assert_array_equal(one.mask, other.mask)


def test_tiles_give_the_instances_of_the_whole_frame():
    for boxes in [
        [],
        [(10, 10, 30, 40)],
        [(60, 20, 75, 40)],  # within the intersection of two tiles
        [(60, 60, 75, 75)],  # four tiles
        [(60, 20, 110, 40)],  # cut by an edge of both
        [(5, 5, 290, 195)],  # through all tiles
        [(50, 20, 84, 40), (84, 20, 110, 40), (50, 40, 110, 60)],  # touching each other, over the same edges
        [(78, 20, 82, 40), (150, 150, 151, 151)],
    ]:
        frame = frame_with(*boxes)
        assert_same(Tiled(Perfect(), 80, 0.25)(frame), Perfect()(frame))


def test_positions_of_tiles():
    segmenter = Perfect()
    Tiled(segmenter, 80, 0.25)(frame_with())
    # 1 + ⌈(300 − 80) / 60⌉ columns, 1 + ⌈(200 − 80) / 60⌉ rows
    assert segmenter.shapes == [(80, 80)] * (5 * 3)
    segmenter = Perfect()
    Tiled(segmenter, 250, 0.0)(frame_with())
    assert segmenter.shapes == [(200, 250)] * 2


class Scripted:
    """Returns the given instances, tile by tile."""

    class_names = ("bird", "cat")

    def __init__(self, *tiles):
        self.tiles = iter(tiles)

    def __call__(self, frame):
        return next(self.tiles)


def bird(x0, x1, score=0.5, label="bird", height=10):
    return rectangle_instance(x0, 0, x1 - x0, height, score, label)


def segment(left, right):
    """Columns 0 to 80 and 60 to 140."""
    return Tiled(Scripted(left, right), 80, 0.25)(np.zeros((80, 140, 3), np.uint8))


def test_parts_are_merged_with_the_best_score():
    # the intersection is 60 to 80: the left part ends with it, the right part is 64 to 100
    (one,) = segment([bird(50, 80, 0.6)], [bird(4, 40, 0.9)])
    assert (one.box_px.tolist(), one.score) == ([50, 0, 50, 10], 0.9)
    assert one.mask.all()


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (bird(50, 80), bird(4, 40, label="cat")),  # another class
        (bird(40, 60), bird(0, 20)),  # they touch
        (bird(50, 80), bird(4, 40)._replace(y0=6)),  # the boxes overlap, the masks by 4 of 10 rows
    ],
)
def test_different_birds_are_not_merged(left, right):
    assert len(segment([left], [right])) == 2


def test_half_of_the_smaller_mask_is_enough():
    assert len(segment([bird(50, 70)], [bird(5, 40)])) == 1  # 5 of the 10 columns of the left mask in the intersection
    assert len(segment([bird(50, 69)], [bird(5, 40)])) == 2  # 4 of 9


def test_instances_of_one_tile_are_never_merged():
    # the right tile merges two neighbours: this mask is merged with the larger share
    found = segment([bird(60, 72), bird(72, 80, 0.4)], [bird(0, 19, 0.3)])
    assert sorted((one.x0, one.mask.shape[1]) for one in found) == [(60, 19), (72, 8)]


@pytest.mark.parametrize(("tile_px", "overlap"), [(8, 0.25), (80, 1.0), (80, -0.1)])
def test_invalid_tiles(tile_px, overlap):
    with pytest.raises(ValueError, match="must be"):
        Tiled(Perfect(), tile_px, overlap)
