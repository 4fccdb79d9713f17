"""Unknown pixels: other birds and the border of the image, in the targets and in the fit."""

import dataclasses

import numpy as np
import pytest
from support.birds import tiny_bird

from jaxfit.config.fit import CropConfig, load_config
from jaxfit.data.masks import encode_mask
from jaxfit.data.observations import Observations
from jaxfit.data.projection import PosedBirds
from jaxfit.evaluation.metrics import iou
from jaxfit.fitting.fit import fit
from jaxfit.fitting.windows import cut_windows, load_targets, window_content
from jaxfit.raster.silhouette_reference import UNKNOWN
from jaxfit.raster.zbuffer import hard_mask
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect

WIDTH, HEIGHT = 400, 300
BACKGROUND, BIRD = 0, 1


def boxes_of(*boxes, own_images=False):
    """Return one frame in which bird n has the mask and the box (x, y, width, height) `boxes[n]`."""
    N = len(boxes)
    masks = {}
    for n, (x, y, width, height) in enumerate(boxes):
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[y : y + height, x : x + width] = True
        masks[n, 0] = encode_mask(mask)
    corner = np.array(boxes, float)[:, None, None, :2]
    return Observations(
        track_id=np.arange(N),
        frame_index=np.arange(1),
        present=np.ones((N, 1), bool),
        keypoints_px=corner + np.arange(5)[:, None],
        confidence=np.ones((N, 1, 5)),
        box_px=np.array(boxes, float)[:, None],
        image_size_px=np.array([[WIDTH, HEIGHT]]),
        file_name=np.array(["0.png"]),
        keypoint_names=tuple("abcde"),
        masks=masks,
        own_images={(n, 0): (f"{n}.png", WIDTH, HEIGHT) for n in range(N)} if own_images else {},
    )


def config(**changes):
    # the crop of a bird of 64 pixels has 128 pixels, like the masks
    changes = {"unknown_pixels": True, "crop": CropConfig(padding=0.5, size_px=128)} | changes
    return dataclasses.replace(load_config("paper"), window=1, filter_window=1, **changes)


def target_of(observations, n=0, **changes):
    settings = config(**changes)
    return load_targets(cut_windows(observations, settings), 128).mask[n, 0]


def test_other_birds_are_unknown_with_a_margin():
    own, other, third = (100, 100, 64, 64), (150, 120, 30, 30), (80, 70, 10, 8)  # the crop begins at (68, 68)
    mask = target_of(boxes_of(own, other, third))
    assert (mask[32:96, 32:96] == BIRD).all()  # also where another mask overlaps
    assert (mask[52:82, 96:112] == UNKNOWN).all()
    assert (mask[60, 112:] == [UNKNOWN] * 2 + [BACKGROUND] * 14).all()  # 3 pixels of 256 are 1.5 pixels of 128
    assert (mask[2:10, 12:22] == UNKNOWN).all()
    assert mask[120, 120] == BACKGROUND
    assert (target_of(boxes_of(own)) != UNKNOWN).all()


def test_beyond_the_border_is_unknown():
    mask = target_of(boxes_of((WIDTH - 40, 0, 40, 64)))  # the crop begins 44 pixels from the right border, at y = -32
    assert (mask[:32] == UNKNOWN).all()
    assert (mask[:, 84:] == UNKNOWN).all()
    assert (mask[32:96, 44:84] == BIRD).all()
    assert (mask[32:, :44] == BACKGROUND).all()


def test_without_the_setting_all_other_pixels_are_background():
    observations = boxes_of((WIDTH - 64, 0, 64, 64), (WIDTH - 100, 20, 60, 60))
    assert set(np.unique(target_of(observations, unknown_pixels=False))) == {BACKGROUND, BIRD}
    assert not load_config("paper").unknown_pixels


def test_birds_of_other_photographs_are_no_neighbours():
    observations = boxes_of((100, 100, 64, 64), (150, 120, 30, 30), own_images=True)
    assert (target_of(observations) != UNKNOWN).all()


def test_the_masks_of_neighbours_belong_to_the_content_of_a_window():
    near, moved, far = (boxes_of((100, 100, 64, 64), (x, 120, 30, 30)) for x in (150, 155, 300))
    for unknown, equal in ((True, False), (False, True)):
        contents = [window_content(cut_windows(each, config(unknown_pixels=unknown)), 0) for each in (near, moved, far)]
        assert (contents[0] == contents[1]) is equal
        assert (contents[0] == contents[2]) is equal


@pytest.mark.extended
def test_a_hidden_half_does_not_shrink_the_bird():
    """The right half of the mask is hidden by a neighbour that has the same box."""
    bird = tiny_bird()
    whole = detect(bird, [smooth_motion(bird, 2, 3)], 0.5, 0.0)
    masks, hidden = {}, {}
    for n, t in whole.masks:
        mask, column = whole.mask(n, t), int(whole.box_px[n, t, 0] + whole.box_px[n, t, 2] / 2)
        half = mask.copy()
        half[:, column:] = False
        masks[0, t], masks[1, t] = encode_mask(half), encode_mask(mask & ~half)
        hidden[t] = mask
    both = {name: np.repeat(getattr(whole, name), 2, axis=0) for name in ("present", "keypoints_px", "box_px")}
    confidence = np.repeat(whole.confidence, 2, axis=0)
    confidence[1] = 0  # the neighbour is only a mask
    unknown = dict.fromkeys(("occluded", "score", "keypoint_origin"))
    pair = dataclasses.replace(whole, **both, **unknown, confidence=confidence, track_id=np.arange(2), masks=masks)
    overlap = {}
    for skips in (False, True):
        short = tuple(dataclasses.replace(stage, steps=15) for stage in load_config("fast").stages)
        settings = dataclasses.replace(config(unknown_pixels=skips), stages=short, window=2)
        result = fit(pair, bird, settings)
        posed = PosedBirds(result, bird)
        drawn = hard_mask(posed.vertices_screen(0, 0), np.asarray(posed.faces), *pair.image_size(0, 0))
        overlap[skips] = iou(drawn, hidden[0])
    assert overlap[True] > max(0.75, overlap[False] + 0.05), overlap
