"""Replacement of the parts of large birds."""

import numpy as np

from jaxfit.perception.merging import replace_parts
from jaxfit.perception.network import Instance


def box(x0, y0, x1, y1, score=0.9):
    return Instance(np.ones((y1 - y0, x1 - x0), bool), x0, y0, score, "bird")


def boxes(birds):
    return [(*bird.box_px.astype(int).tolist(), bird.score) for bird in birds]


def test_long_bird_replaces_its_parts_and_nothing_else():
    head, body, other = box(0, 0, 40, 40), box(40, 0, 100, 40), box(90, 40, 130, 80)
    whole = box(5, 0, 100, 60, 0.5)  # a third of the other bird lies in it
    found = replace_parts([head, body, other], [whole], 90)
    assert boxes(found) == [(90, 40, 40, 40, 0.9), (5, 0, 95, 60, 0.5)]


def test_short_birds_of_the_smaller_input_are_dropped():
    part = box(0, 0, 40, 40)
    assert replace_parts([part], [box(0, 0, 89, 40)], 90) == [part]
    assert len(replace_parts([], [box(0, 0, 90, 40)], 90)) == 1


def test_bird_that_reaches_farther_stays():
    longer = box(0, 0, 300, 40)
    assert replace_parts([longer], [box(0, 0, 120, 40)], 90) == [longer]


def test_parts_count_by_their_masks_not_by_their_boxes():
    ring = np.ones((100, 100), bool)
    ring[20:80, 20:80] = False
    inside = box(30, 30, 70, 70)
    found = replace_parts([inside], [Instance(ring, 0, 0, 0.8, "bird")], 90)
    assert boxes(found) == [(30, 30, 40, 40, 0.9), (0, 0, 100, 100, 0.8)]
