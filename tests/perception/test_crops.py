"""Crops of single birds: box, blanked pixels, conversion of points."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from support.instances import rectangle_instance

from jaxfit.perception.keypoints import crop_bird
from jaxfit.perception.network import instance_of


def test_box_is_padded_then_enlarged_about_its_centre():
    frame = np.zeros((400, 400, 3), np.uint8)
    _, crop = crop_bird(frame, rectangle_instance(100, 150, 60, 20), (192, 256), pad_px=10)
    # 80 × 40 padded; 3:4 needs a height of 106.67, rounded to 107, 33 of the 67 rows above
    assert crop == (90, 107, 80, 107, (192, 256))
    _, crop = crop_bird(frame, rectangle_instance(100, 150, 20, 60), (64, 64), pad_px=10)
    assert crop == (70, 140, 80, 80, (64, 64))


def test_pixels_outside_the_dilated_mask_are_black():
    rng = np.random.default_rng(0)
    frame = rng.integers(1, 256, (120, 150, 3), dtype=np.uint8)
    mask = np.zeros((120, 150), bool)
    mask[50:70, 60:90] = rng.random((20, 30)) < 0.02
    bird = instance_of(mask, 1.0, "bird")
    h, w = bird.mask.shape
    side = max(h, w) + 2 * 9
    picture, crop = crop_bird(frame, bird, (side, side), pad_px=9, dilate_px=7)
    shown = binary_dilation(mask, np.ones((7, 7)))
    expected = np.where(shown[..., None], frame, 0)[crop.y0 : crop.y0 + side, crop.x0 : crop.x0 + side]
    assert (crop.width, crop.height) == (side, side)
    np.testing.assert_array_equal(picture, expected)
    undilated, _ = crop_bird(frame, bird, (side, side), pad_px=9, dilate_px=0)
    assert np.count_nonzero(undilated.any(-1)) == mask.sum()


def test_crop_is_black_beyond_the_frame():
    frame = np.full((40, 50, 3), 200, np.uint8)
    picture, crop = crop_bird(frame, rectangle_instance(0, 0, 10, 10), (50, 50), pad_px=20, dilate_px=100)
    assert crop == (-20, -20, 50, 50, (50, 50))
    assert not picture[:20].any()
    assert not picture[:, :20].any()
    assert (picture[20:, 20:] == 200).all()
    whole, crop = crop_bird(frame, rectangle_instance(0, 0, 50, 40), (100, 100), pad_px=0, dilate_px=0)
    assert crop == (0, -5, 50, 50, (100, 100))
    assert (whole[12:88] == 200).all()
    assert not whole[:9].any()


@pytest.mark.parametrize(("side", "size_px"), [(90, (64, 64)), (300, (96, 128)), (40, (192, 192))])
def test_conversion_of_a_spot(side, size_px):
    point = np.array([211.3, 187.8])
    y, x = np.mgrid[:400, :420] + 0.5
    spot = np.exp(-((x - point[0]) ** 2 + (y - point[1]) ** 2) / (2 * 5.0**2))
    frame = np.repeat(np.round(255 * spot).astype(np.uint8)[..., None], 3, -1)
    bird = rectangle_instance(205 - side // 3, 180 - side // 2, side, side)
    picture, crop = crop_bird(frame, bird, size_px)
    weight = picture[..., 0].astype(float)
    rows, columns = np.indices(weight.shape) + 0.5
    centre = np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()
    np.testing.assert_allclose(crop.to_image(centre), point, atol=0.05)
    np.testing.assert_allclose(crop.to_crop(point), centre, atol=0.05)


def test_to_crop_inverts_to_image():
    crop = crop_bird(np.zeros((99, 99, 3), np.uint8), rectangle_instance(3, 5, 40, 17), (192, 256))[1]
    points = np.random.default_rng(1).uniform(-50, 300, (2, 5, 2))
    np.testing.assert_allclose(crop.to_crop(crop.to_image(points)), points)
    np.testing.assert_allclose(crop.to_image(np.zeros(2)), [crop.x0, crop.y0])
    np.testing.assert_allclose(crop.to_image(np.array([192.0, 256.0])), [crop.x0 + crop.width, crop.y0 + crop.height])


def test_reduction_does_not_alias():
    frame = np.zeros((512, 512, 3), np.uint8)
    frame[::2] = 250  # every other row: uniform grey after the reduction
    picture, crop = crop_bird(frame, rectangle_instance(0, 0, 512, 512), (64, 64), pad_px=0)
    assert crop.scale.tolist() == [8, 8]
    np.testing.assert_array_equal(picture, 125)


def test_visible_background_blanks_neighbours_only():
    frame = np.full((60, 80, 3), 200, np.uint8)
    bird, neighbour = rectangle_instance(20, 20, 10, 10), rectangle_instance(34, 20, 10, 10)
    picture, crop = crop_bird(frame, bird, (40, 40), pad_px=15, dilate_px=5, neighbours=[neighbour])
    assert (crop.x0, crop.y0, crop.width, crop.height) == (5, 5, 40, 40)
    expected = np.full((40, 40), 200, np.uint8)
    expected[13:27, 27:40] = 0  # the neighbour is 29 to 39 and 15 to 25; two pixels of dilation on every side
    np.testing.assert_array_equal(picture[..., 0], expected)


def test_own_mask_stays_visible_under_a_neighbour():
    frame = np.full((60, 80, 3), 200, np.uint8)
    bird, neighbour = rectangle_instance(20, 20, 10, 10), rectangle_instance(25, 25, 30, 30)
    picture, _ = crop_bird(frame, bird, (20, 20), pad_px=5, dilate_px=0, neighbours=[neighbour])
    assert (picture[5:15, 5:15] == 200).all()  # the own mask
    assert (picture[15:, 10:] == 0).all()  # the neighbour beside the own mask
    assert (picture[:10] == 200).all()  # the ground
    whole, _ = crop_bird(frame, bird, (20, 20), pad_px=5, dilate_px=0, neighbours=[])
    assert (whole == 200).all()
