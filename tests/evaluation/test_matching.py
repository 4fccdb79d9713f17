"""Whose track is whose, when a tracker named the tracks."""

import dataclasses

import numpy as np
import pytest
from support.rectangles import HEIGHT, WIDTH, birds, steady

from jaxfit.data.solution import Solution
from jaxfit.evaluation.truth import Truth, match_by_overlap, match_tracks
from jaxfit.foundation.errors import InputError

NAMES = ("bill", "back", "wing", "tail")
LEFT, RIGHT, BELOW = (0, 0, 30, 20), (60, 0, 30, 20), (0, 60, 30, 20)
FRAMES = range(4)


def truth(tracks, frames=FRAMES, **changes):
    return birds(tracks, frames, names=NAMES, **changes)


def result(tracks, frames=FRAMES):
    """Poses whose keypoints span the rectangles; NaN where there is no pose."""
    seen = truth(tracks, frames)
    N, T = seen.present.shape
    K = len(NAMES)
    return Solution.from_arrays(
        track_id=seen.track_id,
        frame_index=seen.frame_index,
        valid=seen.present,
        global_orient=np.zeros((N, T, 3)),
        body_pose=np.zeros((N, T, 0, 3)),
        transl=np.zeros((N, T, 3)),
        scale=np.ones((N, T)),
        bone_length=np.ones((N, T, 0)),
        betas=np.zeros((N, T, 0)),
        keypoints_cam=np.zeros((N, T, K, 3)),
        keypoints_px=np.where(seen.present[..., None, None], seen.keypoints_px, np.nan),
        crop=np.ones((N, T, 3)),
        image_size_px=np.full((N, T, 2), [WIDTH, HEIGHT]),
        focal_px=100.0,
        keypoint_names=NAMES,
        joint_names=("root",),
        crop_px=64,
        loss={},
        status=["ok"] * N,
    )


TWO = {1: steady(LEFT, FRAMES), 2: steady(RIGHT, FRAMES)}


def test_ids_are_believed_where_they_are_right():
    own = result({2: steady(RIGHT, FRAMES), 1: steady(LEFT, FRAMES)})
    same, matching = match_tracks(own, truth(TWO))
    assert same is own
    assert matching == ("ids", {1: 1, 2: 2}, [], [])


def test_ids_are_believed_of_a_bird_that_was_fitted_badly():
    """It lies nowhere near its own bird nor another: leaving it out would flatter the result."""
    own = result({1: steady(LEFT, FRAMES), 2: steady(BELOW, FRAMES)})
    assert match_by_overlap(own, truth(TWO)) == {1: 1}
    assert match_tracks(own, truth(TWO))[1] == ("ids", {1: 1, 2: 2}, [], [])
    assert match_tracks(own, truth(TWO), "overlap")[1] == ("overlap", {1: 1}, [2], [2])


@pytest.mark.parametrize("ids", [(2, 1), (7, 9), (2, 5)])
def test_a_tracker_has_ids_of_its_own(ids):
    own = result(dict(zip(ids, TWO.values(), strict=True)))
    renamed, matching = match_tracks(own, truth(TWO))
    assert matching == ("overlap", dict(zip(ids, (1, 2), strict=True)), [], [])
    assert renamed.track_id.tolist() == [1, 2]
    np.testing.assert_array_equal(renamed.keypoints.px, own.keypoints.px)
    assert match_tracks(own, truth(TWO), "ids")[1].by == "ids"


def test_strays_and_birds_that_nobody_follows():
    """A stray whose id is a bird's gets another, so that nothing is compared with that bird."""
    own = result({2: steady(LEFT, FRAMES), 1: steady(BELOW, FRAMES), 3: steady(BELOW, FRAMES)})
    renamed, matching = match_tracks(own, truth(TWO))
    assert matching == ("overlap", {2: 1}, [1, 3], [2])
    assert renamed.track_id.tolist() == [1, 3, 4]


def beside(shift):
    x, y, w, h = LEFT
    return x + shift, y, w, h


@pytest.mark.parametrize(
    ("own", "true", "followed"),
    [
        # one-to-one: track 8 is near both birds and nearer to 1, but track 9 can only have 1
        (
            {8: steady((0, 0, 33, 20), FRAMES), 9: steady((0, 0, 20, 20), FRAMES)},
            {1: steady(LEFT, FRAMES), 2: steady((3, 0, 33, 20), FRAMES)},
            {8: 2, 9: 1},
        ),
        # half of the frames must agree
        ({5: steady(LEFT, FRAMES) | steady(BELOW, range(2))}, TWO, {5: 1}),
        ({5: steady(LEFT, FRAMES) | steady(BELOW, range(3))}, TWO, {}),
        # boxes of 30 px, 10 px apart: 20 shared of 40
        ({5: steady(beside(10), FRAMES)}, TWO, {5: 1}),
        ({5: steady(beside(11), FRAMES)}, TWO, {}),
        # frames go by number, and poses that are missing do not count
        ({5: {4: LEFT, 5: LEFT}, 6: {3: RIGHT, 9: LEFT}}, {1: {3: LEFT, 5: LEFT, 6: LEFT}}, {5: 1}),
        ({5: {9: LEFT}}, {1: {3: LEFT, 5: LEFT, 6: LEFT}}, {}),
    ],
)
def test_which_track_follows_which_bird(own, true, followed):
    own, true = (
        make(tracks, sorted({frame for boxes in tracks.values() for frame in boxes}))
        for make, tracks in ((result, own), (truth, true))
    )
    assert match_by_overlap(own, true) == followed


def test_boxes_are_of_what_is_annotated():
    """Half of a bird is annotated: its box is that of the same keypoints. Two keypoints are too few for one."""
    there = truth(TWO)
    confidence = there.confidence.copy()
    confidence[0, :, 3:] = 0
    part = dataclasses.replace(there, confidence=confidence)
    own = result({5: steady(LEFT, FRAMES)})
    assert match_by_overlap(own, part) == {5: 1}
    confidence[0, :, 2:] = 0
    assert match_by_overlap(own, dataclasses.replace(there, confidence=confidence)) == {}


def test_photographs_go_by_id():
    there = truth({1: {0: LEFT}, 2: {0: LEFT}}, [0], own_images={(1, 0): ("b.png", WIDTH, HEIGHT)})
    own = result({2: {0: LEFT}, 1: {0: LEFT}}, [0])
    assert match_tracks(own, there)[1].by == "ids"
    with pytest.raises(InputError, match=r"t\.json: holds photographs"):
        match_tracks(own, Truth(there, source="t.json"), "overlap")


@pytest.mark.parametrize("seed", range(5))
def test_any_naming_is_found_out(seed):
    rng = np.random.default_rng(seed)
    boxes = {1 + i: {t: (*rng.integers(0, 60, 2), 30, 30) for t in range(12)} for i in range(6)}
    ids = rng.permutation(20)[:6].tolist()
    own = result(dict(zip(ids, boxes.values(), strict=True)), range(12))
    assert match_by_overlap(own, truth(boxes, range(12))) == dict(zip(ids, boxes, strict=True))
