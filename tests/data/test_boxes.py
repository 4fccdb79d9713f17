import numpy as np

from jaxfit.data.masks import box_iou, box_of_keypoints


def test_box_iou_by_hand():
    for a, b, expected in [
        ((0, 0, 10, 10), (0, 0, 10, 10), 1.0),
        ((0, 0, 10, 10), (5, 5, 10, 10), 25 / 175),
        ((0, 0, 10, 10), (10, 0, 10, 10), 0.0),
        ((0, 0, 10, 10), (30, 40, 10, 10), 0.0),
        ((0, 0, 10, 10), (2, 3, 4, 5), 20 / 100),
        ((0, 0, 0, 0), (0, 0, 10, 10), 0.0),
        ((0, 0, 0, 0), (0, 0, 0, 0), np.nan),
        ((np.nan,) * 4, (0, 0, 10, 10), np.nan),
    ]:
        a, b = np.array(a, float), np.array(b, float)
        np.testing.assert_allclose(box_iou(a, b), expected)
        np.testing.assert_allclose(box_iou(b, a), expected)


def test_box_iou_counts_pixels():
    """Boxes of whole pixels have the intersection over union of their masks."""
    rng = np.random.default_rng(0)
    boxes = np.column_stack([rng.integers(0, 20, (30, 2)), rng.integers(1, 20, (30, 2))]).astype(float)
    masks = np.zeros((30, 40, 40), bool)
    for mask, (x, y, width, height) in zip(masks, boxes.astype(int), strict=True):
        mask[y : y + height, x : x + width] = True
    either, both = masks[:, None] | masks[None], masks[:, None] & masks[None]
    expected = both.sum((-2, -1)) / either.sum((-2, -1))
    np.testing.assert_allclose(box_iou(boxes[:, None], boxes[None]), expected)


def test_box_of_keypoints_ignores_unknown_keypoints():
    points = np.array([[[3.0, 8.0], [7.0, 2.0], [100.0, 100.0]], [[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]])
    known = np.array([[True, True, False], [False, False, False]])
    np.testing.assert_array_equal(box_of_keypoints(points, known), [[3, 2, 4, 6], [np.nan] * 4])
