"""Masks that optical flow carries from key frames to the other frames of a block."""

import cv2
import numpy as np
import pytest

from jaxfit.perception.carried_masks import BLOCK_FRAMES, VOTES, segment_block
from jaxfit.perception.merging import mask_iou
from jaxfit.perception.network import instance_of

WIDTH, HEIGHT = 320, 200
RNG = np.random.default_rng(0)
BACKGROUND, PLUMAGE = (cv2.GaussianBlur(RNG.integers(0, 256, (600, 800), np.uint8), None, sd) for sd in (3.0, 2.0))
BACKGROUND, PLUMAGE = (
    cv2.normalize(x, None, low, high, cv2.NORM_MINMAX) for x, low, high in ((BACKGROUND, 120, 255), (PLUMAGE, 0, 160))
)


class Scene:
    """Ellipses with a texture of their own before a textured background, and a segmenter that knows the truth."""

    def __init__(self, places, scale=1.0):
        """`places`: frame → centres (x, y) of the birds that are seen."""
        self.places, self.scale = places, scale
        self.wrong = {}
        self.calls = []

    def masks(self, n):
        found = []
        for x, y in self.places[n]:
            mask = np.zeros((HEIGHT, WIDTH), np.uint8)
            cv2.ellipse(mask, (round(x), round(y)), (40, 20), 20, 0, 360, 1, -1)
            found.append(mask.astype(bool))
        return found

    def frame(self, n):
        picture = BACKGROUND[:HEIGHT, :WIDTH].copy()
        for (x, y), mask in zip(self.places[n], self.masks(n), strict=True):
            shift = np.array([[1, 0, round(x) - 400], [0, 1, round(y) - 300]], float)
            picture[mask] = cv2.warpAffine(PLUMAGE, shift, (WIDTH, HEIGHT))[mask]
        picture = cv2.resize(picture, None, fx=self.scale, fy=self.scale, interpolation=cv2.INTER_AREA)
        picture = np.repeat(picture[..., None], 3, -1)
        picture[0, 0] = n
        return picture

    def birds(self, n):
        size = self.frame(n).shape[1::-1]
        masks = (cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) for mask in self.masks(n))
        return [instance_of(mask.astype(bool), 0.9 - 0.1 * i, "bird") for i, mask in enumerate(masks)]

    def __call__(self, frame, known):
        n = int(frame[0, 0, 0])
        self.calls.append((n, len(known)))
        birds = self.wrong.get(n, self.birds(n))
        return [bird for bird in birds if all(mask_iou(bird, other) < 0.5 for other in known)]

    def segment(self):
        return segment_block(self, [self.frame(n) for n in range(len(self.places))])


def walk(start, step, frames=BLOCK_FRAMES):
    return [(start[0] + step[0] * n, start[1] + step[1] * n) for n in range(frames)]


def assert_masks(found, scene, least):
    for n, birds in enumerate(found):
        truth = scene.birds(n)
        assert len(birds) == len(truth), n
        assert all(max(mask_iou(bird, true) for bird in birds) > least for true in truth), n


@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0])
def test_three_frames_are_segmented_of_birds_that_walk(scale):
    scene = Scene(list(zip(walk((80, 60), (3, 1)), walk((240, 140), (-2, 0)), strict=True)), scale)
    found = scene.segment()
    assert [n for n, _ in scene.calls] == [2, 7, 12]
    assert_masks(found, scene, 0.9)
    for birds in found:
        assert [bird.score for bird in birds] == [0.9, 0.8]


def test_masks_have_the_pixels_of_most_votes():
    scene = Scene([[place] for place in walk((80, 60), (0, 0))])
    for key in (2, 7, 12):
        (bird,) = scene.birds(key)
        mask = bird.whole((WIDTH, HEIGHT))
        mask[60:70, 20 + 2 * key : 30 + 2 * key] ^= True  # another part in each key frame
        scene.wrong[key] = [instance_of(mask, 0.9, "bird")]
    found = scene.segment()
    (truth,) = scene.birds(0)
    assert all((mask_iou(found[n][0], truth) > 0.99) == (n not in (2, 7, 12)) for n in range(BLOCK_FRAMES))


@pytest.mark.parametrize("key", [2, 7, 12])
@pytest.mark.parametrize("error", ["half", "nothing", "other"])
def test_an_error_in_one_key_frame_stays_there(key, error):
    scene = Scene([[place] for place in walk((80, 60), (3, 1))])
    (bird,) = scene.birds(key)
    half = bird.mask.copy()
    half[:, half.shape[1] // 2 :] = False
    elsewhere = np.zeros((HEIGHT, WIDTH), bool)
    elsewhere[150:180, 250:300] = True
    scene.wrong[key] = {
        "half": [instance_of(half, 0.9, "bird", bird.x0, bird.y0)],
        "nothing": [],
        "other": [bird, instance_of(elsewhere, 0.5, "bird")],
    }[error]
    found = scene.segment()
    for n, birds in enumerate(found):
        best = max(birds, key=lambda one: one.score)
        assert mask_iou(best, scene.birds(n)[0]) > (0.4 if error == "half" and n == key else 0.9)
        assert len(birds) == 1 + (error == "other" and n == key)


def test_a_bird_that_flow_cannot_follow_is_segmented_in_every_frame_and_others_are_not():
    jumps = [(50 + 200 * (n * 7 % BLOCK_FRAMES) / BLOCK_FRAMES, 50) for n in range(BLOCK_FRAMES)]
    scene = Scene(list(zip(jumps, walk((240, 150), (-2, 0)), strict=True)))
    found = scene.segment()
    assert sorted(n for n, _ in scene.calls) == list(range(BLOCK_FRAMES))
    known = np.array([known for _, known in scene.calls])
    assert (known[:VOTES] == 0).all()
    assert (known[VOTES:] >= 1).all()
    assert_masks(found, scene, 0.9)


def test_a_bird_that_jumps_once_is_sought_in_the_middle_between_key_frames():
    scene = Scene([[(80, 60)] if n < 10 else [(240, 140)] for n in range(BLOCK_FRAMES)])
    assert_masks(scene.segment(), scene, 0.9)
    asked = {n for n, _ in scene.calls}
    assert 9 in asked
    assert 8 not in asked  # votes of 7 and 9 agree


def test_a_bird_that_comes_and_a_bird_that_leaves():
    places = [[(80, 60)] * (n < 6) + [(240, 140)] * (n >= 9) for n in range(BLOCK_FRAMES)]
    scene = Scene(places)
    assert_masks(scene.segment(), scene, 0.9)
    assert len(scene.calls) < BLOCK_FRAMES


@pytest.mark.parametrize("num_frames", [1, BLOCK_FRAMES])
def test_a_small_bird_inside_the_mask_of_a_large_bird_stays(num_frames):
    frame = np.repeat(BACKGROUND[:HEIGHT, :WIDTH, None], 3, -1)
    birds = [
        instance_of(np.ones(size, bool), 0.9, "bird", x0, y0)
        for size, x0, y0 in (((90, 140), 50, 40), ((40, 30), 90, 70))
    ]
    for found in segment_block(lambda frame, known: birds, [frame] * num_frames):
        assert [max(mask_iou(bird, one) for one in found) for bird in birds] == [1, 1]
        assert len(found) == 2


@pytest.mark.parametrize(("frames", "keys"), [(1, [0]), (2, [0, 1]), (3, [0, 1, 2]), (8, [1, 4, 6])])
def test_short_blocks(frames, keys):
    scene = Scene([[place] for place in walk((80, 60), (3, 1), frames)])
    assert_masks(scene.segment(), scene, 0.9)
    assert [n for n, _ in scene.calls] == keys


def test_no_bird_and_a_bird_at_the_border():
    assert Scene([[]] * BLOCK_FRAMES).segment() == [[]] * BLOCK_FRAMES
    scene = Scene([[place] for place in walk((0, 190), (2, 0))])
    assert_masks(scene.segment(), scene, 0.85)


@pytest.mark.parametrize("size_px", [(24, 16), (2000, 40), (16, 900)])
@pytest.mark.parametrize("bird_px", [(1, 1), (3, 14), (12, 2), (200, 2)])
def test_birds_of_few_pixels_and_narrow_frames(size_px, bird_px):
    """Nothing moves, so the masks stay."""
    width, height = size_px
    frames = [np.repeat(cv2.resize(BACKGROUND, (width, height))[..., None], 3, -1)] * BLOCK_FRAMES
    size = min(bird_px[1], height - 2), min(bird_px[0], width - 2)
    bird = instance_of(np.ones(size, bool), 0.9, "bird", 1, 1)
    for (found,) in segment_block(lambda frame, known: [] if known else [bird], frames):
        assert mask_iou(found, bird) > 0.9
