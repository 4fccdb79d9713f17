"""Windows: frames, crops, targets, and the conversion between image and crop."""

import dataclasses

import numpy as np
import pytest
from support.walking import HEIGHT, WIDTH, K, walk

from jaxfit.config.fit import CropConfig, load_config
from jaxfit.fitting.crops import cut_mask
from jaxfit.fitting.windows import (
    cut_windows,
    filter_observations,
    load_targets,
    weighted_median_filter,
    window_content,
)
from jaxfit.foundation.errors import InputError
from jaxfit.model.camera import CROP_PX, crop_to_image


def config(window=4, **changes):
    return dataclasses.replace(load_config("paper"), window=window, filter_window=1, **changes)


def changed(observations, absent=(), **changes):
    """Return the observations without the (bird, frame) pairs in `absent`."""
    present, confidence = observations.present.copy(), observations.confidence.copy()
    for at in absent:
        present[at], confidence[at] = False, 0
    return dataclasses.replace(observations, present=present, confidence=confidence, **changes)


def test_tracks_are_cut_into_windows():
    windows = cut_windows(walk(range(10)), config())
    assert windows.track.tolist() == [0, 0, 0, 1, 1, 1]
    assert windows.frame[:3].tolist() == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, -1, -1]]
    assert windows.present.tolist() == (windows.frame >= 0).tolist()
    assert len(windows[1:3]) == 2
    assert windows[np.array([5, 0])].track.tolist() == [1, 0]


def test_windows_begin_at_the_first_usable_frame():
    observations = changed(walk(range(10)), [(0, 0), (0, 1), (0, 5), (0, 9), *((1, t) for t in range(10))])
    windows = cut_windows(observations, config())
    assert windows.track.tolist() == [0, 0]  # the second bird has no usable frame: no window
    assert windows.frame.tolist() == [[2, 3, 4, 5], [6, 7, 8, -1]]
    assert windows.present.tolist() == [[True, True, True, False], [True, True, True, False]]


def test_a_frame_with_too_few_keypoints_is_not_usable():
    observations = walk(range(4))
    confidence = observations.confidence.copy()
    confidence[0, 2, :2] = 0
    few = dataclasses.replace(observations, confidence=confidence)
    assert cut_windows(few, config(min_keypoints=4)).present[0].tolist() == [True, True, False, True]
    assert cut_windows(few, config(min_keypoints=3)).present[0].tolist() == [True] * 4


def test_missing_numbers_are_missing_frames():
    """Frames 1 and 4 are not neighbours. Frames 0, 2, 4 are neighbours in a file with every second frame."""
    windows = cut_windows(walk([0, 1, 4, 5, 15]), config())
    assert windows.frame[:3].tolist() == [[0, 1, -1, -1], [2, 3, -1, -1], [-1, -1, -1, 4]]
    assert windows.present[:3].tolist() == (windows.frame[:3] >= 0).tolist()
    assert cut_windows(walk([10, 12, 14, 18]), config()).frame[:2].tolist() == [[0, 1, 2, -1], [3, -1, -1, -1]]
    with pytest.raises(InputError, match=r"frame_index ends at 1000000000, .*number the frames"):
        cut_windows(dataclasses.replace(walk(range(3)), frame_index=np.array([0, 1, 10**9])), config())


def test_the_crop_keeps_its_size_and_follows_the_bird():
    observations = changed(walk(range(8)), [(0, 2)])
    windows = cut_windows(observations, config(window=8, crop=CropConfig(padding=0.25)))
    for n, crop in enumerate(windows.crop):
        assert len(set(crop[:, 2])) == 1
        assert (crop == np.round(crop)).all()
        boxes = observations.box_px[n][windows.present[n]]
        assert crop[0, 2] == np.ceil(boxes[:, 2:].max() * 1.5)
        centre = boxes[:, :2] + boxes[:, 2:] / 2
        apart = crop[windows.present[n], :2] + crop[windows.present[n], 2:] / 2 - centre
        assert np.abs(apart).max() <= 0.51  # whole pixels
    # a missing frame has the crop of a neighbour
    assert windows.crop[0, 2].tolist() in windows.crop[0, [1, 3]].tolist()


def test_crops_without_boxes_contain_all_keypoints():
    observations = walk(range(4))
    windows = cut_windows(dataclasses.replace(observations, box_px=np.zeros((2, 4, 4))), config())
    inside = observations.keypoints_px[windows.track[:, None], windows.frame] - windows.crop[:, :, None, :2]
    assert (inside > 0).all()
    assert (inside < windows.crop[:, :, None, 2:]).all()


def test_keypoints_are_converted_to_the_crop_and_back():
    observations = changed(walk([0, 1, 3, 4, 5]), [(1, 0), (0, 3)])
    windows = cut_windows(observations, config())
    targets = load_targets(windows, 64)
    assert targets.keypoints_px.shape == (len(windows), 4, K, 2)
    back = crop_to_image(targets.keypoints_px, windows.crop)
    compared = 0
    for w, t in zip(*np.nonzero(windows.present), strict=True):
        n, at = windows.track[w], windows.frame[w, t]
        np.testing.assert_allclose(back[w, t], observations.keypoints_px[n, at], atol=1e-3)
        np.testing.assert_array_equal(targets.confidence[w, t], observations.confidence[n, at])
        assert (targets.keypoints_px[w, t] > 0).all()
        assert (targets.keypoints_px[w, t] < CROP_PX).all()
        assert targets.has_mask[w, t]
        expected = cut_mask(observations.mask(n, at), windows.crop[w, t], 64)
        np.testing.assert_array_equal(targets.mask[w, t], expected)
        compared += 1
    assert compared == 8
    absent = ~windows.present
    assert not targets.confidence[absent].any()
    assert not targets.has_mask[absent].any()
    assert not targets.mask[absent].any()
    assert not targets.keypoints_px[absent].any()
    np.testing.assert_array_equal(targets.present, windows.present)


def test_a_frame_without_a_mask_keeps_its_keypoints():
    observations = walk(range(4))
    masks = {at: rle for at, rle in observations.masks.items() if at != (0, 1)}
    targets = load_targets(cut_windows(dataclasses.replace(observations, masks=masks), config()), 64)
    assert targets.has_mask[0].tolist() == [True, False, True, True]
    assert targets.present[0].all()
    assert targets.confidence[0, 1].all()


def test_masks_shrink_by_area():
    """A pixel of the crop is 1 if the mask covers at least half of the pixel: compared with exact covered areas."""
    for crop in [(10, 20, 96), (-13, 5, 64), (350, 250, 100), (0, 0, 32), (37, 41, 75), (500, 400, 80)]:
        rng = np.random.default_rng(0)
        mask = np.kron(rng.random((30, 40)) < 0.5, np.ones((10, 10))).astype(bool)  # 300 × 400, blocks of ten
        x0, y0, size = crop
        full = np.zeros((size, size))
        for i in range(size):
            for j in range(size):
                y, x = y0 + i, x0 + j
                full[i, j] = 0 <= y < HEIGHT and 0 <= x < WIDTH and mask[y, x]
        edges = np.linspace(0, size, 33)
        pixel = np.arange(size)
        share = np.clip(np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel), 0, None)
        covered = share @ full @ share.T / (size / 32) ** 2
        clear = np.abs(covered - 0.5) > 0.01
        assert clear.mean() > 0.7
        cut = cut_mask(mask, np.array(crop, float), 32)
        assert set(np.unique(cut)) <= {0, 1}
        np.testing.assert_array_equal(cut[clear], covered[clear] > 0.5)


def test_whole_images():
    whole, around = config(crop=CropConfig(mode="image")), config(crop=CropConfig(mode="box"))
    square = dataclasses.replace(walk(range(4)), image_size_px=np.full((4, 2), 400), masks={})
    np.testing.assert_array_equal(cut_windows(square, whole).crop, np.broadcast_to([0, 0, 400], (2, 4, 3)))
    others = walk(range(4))  # 400×300 pixels
    np.testing.assert_array_equal(cut_windows(others, whole).crop, cut_windows(others, around).crop)


@pytest.mark.parametrize("numbers", [range(9), [0, 1, 2, 5, 6, 11, 12, 13, 14], [0, 2, 4, 6, 10, 12]])
def test_the_filter_runs_over_frame_numbers(numbers):
    """Frames with distant frame numbers are not in the same window of the filter."""
    observations = changed(walk(numbers), [(0, 2), (1, 3)])
    step = 1 if 1 in numbers else 2
    line = np.arange(max(numbers) // step + 1) * step
    filtered = filter_observations(observations, 5)
    for n in range(2):
        points, weight = np.zeros((len(line), K, 2), np.float32), np.zeros((len(line), K), np.float32)
        at = np.searchsorted(line, numbers)
        points[at], weight[at] = observations.keypoints_px[n], observations.confidence[n]
        expected = np.asarray(weighted_median_filter(points, weight, 5))[at]
        present = observations.present[n]
        np.testing.assert_array_equal(filtered.keypoints_px[n][present], expected[present])
    np.testing.assert_array_equal(filtered.confidence, observations.confidence)
    assert np.abs(filtered.keypoints_px - observations.keypoints_px).max() > 1
    assert filter_observations(observations, 1) is observations


def test_windows_hold_the_time_between_frames():
    for numbers, times, frame_s in [
        (range(6), {"fps": 50.0}, 0.02),
        (range(0, 12, 2), {"fps": 50.0}, 0.04),
        (range(6), {"timestamp_s": np.arange(6) / 10}, 0.1),
        (range(6), {}, 0.04),
        (range(0, 18, 3), {}, 0.12),  # an unknown rate counts as 25 frames/s, of which the file has every third
    ]:
        windows = cut_windows(dataclasses.replace(walk(numbers), **times), config(window=4))
        assert len(windows) == 4
        targets = load_targets(windows, 0)
        assert targets.frame_s.dtype == np.float32
        np.testing.assert_allclose(targets.frame_s, [frame_s] * 4, rtol=1e-6)
        assert window_content(windows, 0) != window_content(
            dataclasses.replace(windows, frame_s=2 * windows.frame_s), 0
        )


@pytest.mark.parametrize("size", [40, 64, 100])
def test_masks_have_the_scale_of_the_crop(size):
    """A disc in the image is a disc at the scale of the crop, for enlarged and for reduced crops."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    crop, centre, radius = np.array([80.0, 60, size]), np.array([80 + 0.55 * size, 60 + 0.4 * size]), 0.25 * size
    disc = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2
    cut = cut_mask(disc, crop, 256)
    y, x = np.mgrid[:256, :256] + 0.5
    expected = (x - 0.55 * 256) ** 2 + (y - 0.4 * 256) ** 2 < (0.25 * 256) ** 2
    assert (cut & expected).sum() / (cut | expected).sum() > 0.94
    inside = np.argwhere(cut) + 0.5
    np.testing.assert_allclose(inside.mean(0), [0.4 * 256, 0.55 * 256], atol=0.25 * 256 / size)
