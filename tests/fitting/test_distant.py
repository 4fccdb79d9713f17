"""Boxes and keypoints far outside the image: bounded crops, and frames that are skipped and reported."""

import dataclasses
import itertools
import logging

import cv2
import numpy as np
import pytest
from support.fits import config

from jaxfit.config.fit import CropConfig
from jaxfit.data.masks import encode_mask
from jaxfit.data.observations import Observations
from jaxfit.fitting.crops import MAX_CROP_IMAGE_SIDES, cut_mask
from jaxfit.fitting.fit import windows_of
from jaxfit.fitting.windows import (
    MAX_DISTANCE_IMAGE_SIDES,
    cut_windows,
    distant_birds,
    load_targets,
    report_distant_birds,
    without_distant_birds,
)
from jaxfit.foundation.errors import InputError

T, WIDTH, HEIGHT = 4, 40, 30
FAR = 300_000.0


def observed(birds=2, boxes=True):
    """Return birds that fill most of a small image."""
    rng = np.random.default_rng(0)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[5:25, 10:30] = True
    return Observations(
        track_id=np.arange(birds) + 7,
        frame_index=np.arange(T) + 100,
        present=np.ones((birds, T), bool),
        keypoints_px=rng.uniform(8, 22, (birds, T, 5, 2)),
        confidence=np.ones((birds, T, 5)),
        box_px=np.broadcast_to([10, 5, 20, 20] if boxes else [0, 0, 0, 0], (birds, T, 4)),
        image_size_px=np.full((T, 2), [WIDTH, HEIGHT]),
        file_name=np.array([f"{t}.png" for t in range(T)]),
        keypoint_names=tuple("abcde"),
        masks={(n, t): encode_mask(mask) for n in range(birds) for t in range(T)},
    )


def damaged(observations, at, keypoint=None, box=None):
    points, boxes = observations.keypoints_px.copy(), observations.box_px.copy()
    points[at][2] = points[at][2] if keypoint is None else keypoint
    boxes[at] = boxes[at] if box is None else box
    return dataclasses.replace(observations, keypoints_px=points, box_px=boxes)


def padded_square(mask, crop, mask_px):
    """The definition: copy the crop into a square of its size, with zeros outside the image, and resize the square."""
    x0, y0, size = map(int, crop)
    padded = np.zeros((size, size), np.uint8)
    for row in range(size):
        for column in range(size):
            y, x = y0 + row, x0 + column
            if 0 <= y < mask.shape[0] and 0 <= x < mask.shape[1]:
                padded[row, column] = 255 * mask[y, x]
    if size == mask_px:
        return padded // 255
    method = cv2.INTER_AREA if size > mask_px else cv2.INTER_LINEAR
    return (cv2.resize(padded, (mask_px, mask_px), interpolation=method) >= 128).astype(np.uint8)


def test_masks_equal_the_resized_square():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(150):
        mask = np.kron(rng.random(rng.integers(1, 8, 2)) < 0.6, np.ones(rng.integers(1, 7, 2))).astype(bool)
        crop = np.array([*rng.integers(-40, 50, 2), rng.integers(16, 90)], float)
        mask_px = int(rng.choice([16, 32, 33]))
        cut = cut_mask(mask, crop, mask_px)
        assert cut.dtype == np.uint8
        np.testing.assert_array_equal(cut, padded_square(mask, crop, mask_px))
        covered += cut.any()
    assert covered > 30


@pytest.mark.parametrize("corner", [(-8_000, -8_000), (5, 5), (10**6, 0)])
def test_the_largest_crop_is_cheap(corner):
    """Only the pages of the part inside the image take memory."""
    assert cut_mask(np.ones((20, 20), bool), np.array([*corner, 8_000.0]), 64).shape == (64, 64)


@pytest.mark.parametrize("edge", [(-MAX_DISTANCE_IMAGE_SIDES, 0), (0, -MAX_DISTANCE_IMAGE_SIDES), (2, 0), (0, 1.75)])
def test_distance_is_measured_from_the_image_in_longer_sides(edge):
    """The image has 40 × 30 pixels, so that its far edges are at 1 and 0.75 sides."""
    at_limit = np.array(edge) * WIDTH
    beyond = at_limit + np.sign(at_limit) * 0.01
    assert not distant_birds(damaged(observed(), (0, 1), keypoint=at_limit)).any()
    assert distant_birds(damaged(observed(), (0, 1), keypoint=beyond)).sum() == 1
    assert distant_birds(damaged(observed(), (0, 1), box=[*beyond, 5, 5]))[0, 1]


def test_missing_keypoints_and_own_images_are_no_distant_birds():
    far = damaged(observed(), (0, 1), keypoint=FAR)
    confidence = far.confidence.copy()
    confidence[0, 1, 2] = 0
    assert not distant_birds(dataclasses.replace(far, confidence=confidence)).any()
    apart = dataclasses.replace(
        damaged(observed(), (1, 2), keypoint=450),
        masks={},
        own_images={(1, 2): ("b.png", 500, 9), (0, 0): ("c.png", 2, 3)},
    )
    assert np.argwhere(distant_birds(apart)).tolist() == [[0, 0]]
    plain = observed()
    assert without_distant_birds(plain) is plain


def test_one_distant_frame_is_skipped():
    """The windows equal those of observations that lack the bird in this frame."""
    cases = itertools.product(("keypoint", "box"), (True, False), ("box", "image"), (1, 3))
    for wrong, boxes, mode, filter_window in cases:
        plain = observed(boxes=boxes)
        if mode == "image":
            plain = dataclasses.replace(plain, image_size_px=np.full((T, 2), WIDTH), masks={})
        far = damaged(plain, (0, 1), **{wrong: FAR if wrong == "keypoint" else [3, 4, FAR, 5]})
        present, confidence = plain.present.copy(), plain.confidence.copy()
        present[0, 1], confidence[0, 1] = False, 0
        lacking = dataclasses.replace(plain, present=present, confidence=confidence)
        settings = config(T, mode=mode, min_keypoints=3)
        settings = dataclasses.replace(settings, filter_window=filter_window)
        windows, expected = cut_windows(far, settings), cut_windows(lacking, settings)
        assert windows.present.sum() == 2 * T - 1
        for name in vars(windows):
            if name != "masks":
                np.testing.assert_array_equal(getattr(windows, name), getattr(expected, name), err_msg=name)
        np.testing.assert_array_equal(load_targets(windows, 16).mask, load_targets(expected, 16).mask)


def test_crops_are_not_larger_than_the_image_with_a_margin():
    longer = damaged(observed(boxes=False), (0, 1), keypoint=[2 * WIDTH, 3])
    windows = cut_windows(longer, config(T, mode="box", min_keypoints=3))
    assert windows.present.all()
    assert windows.crop[0, :, 2].tolist() == [MAX_CROP_IMAGE_SIDES * WIDTH] * T
    assert windows.crop[1, 0, 2] < WIDTH
    padded = dataclasses.replace(config(T), crop=CropConfig(padding=2.0))
    assert (cut_windows(observed(), padded).crop[..., 2] == MAX_CROP_IMAGE_SIDES * WIDTH).all()


def test_no_frame_without_a_distant_box():
    far = dataclasses.replace(observed(), box_px=np.broadcast_to([FAR, 0, 9, 9], (2, T, 4)))
    with pytest.raises(InputError, match=r"birds\.json: no track has a usable frame: .*far outside.*image pixels"):
        windows_of(far, config(T, mode="box"), "birds.json")
    assert not distant_birds(far.select(tracks=[])).size


def test_the_report_names_tracks_and_frames(caplog):
    far = damaged(damaged(observed(), (0, 1), keypoint=FAR), (0, 3), box=[-FAR, 0, 9, 9])
    with caplog.at_level(logging.WARNING, "jaxfit"):
        reports = report_distant_birds(damaged(far, (1, 0), keypoint=FAR), "birds.json")
    assert list(reports) == [7, 8]
    assert reports[7][0].startswith("frames 101, 103 skipped: a box or a keypoint lies more than 1 × the image")
    assert reports[8][0].startswith("frame 100 skipped: ")
    (record,) = caplog.records
    assert record.getMessage() == f"birds.json: track 7, {reports[7][0]} (and 1 more track)"
    assert not report_distant_birds(observed(), "birds.json")
