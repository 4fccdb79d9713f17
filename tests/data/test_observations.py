"""The container: its checks, its selections, its masks."""

import dataclasses

import numpy as np
import pytest

from jaxfit.data.masks import encode_mask
from jaxfit.data.observations import Observations, check_keypoints, mean_confidence, reorder_keypoints
from jaxfit.foundation.errors import InputError

MASK = np.zeros((6, 8), bool)
MASK[1:4, 2:7] = True


def make(**changes):
    """Two tracks over three frames, three keypoints; the second track is missing in the first frame."""
    confidence = np.array([[[1, 0.5, 0.25], [1, 1, 0], [0, 0, 0]], [[0, 0, 0], [1, 1, 1], [0.1, 0.1, 0.1]]])
    present = np.array([[1, 1, 1], [0, 1, 1]], bool)
    return Observations(
        **{
            "track_id": [4, 9],
            "frame_index": [10, 11, 13],
            "present": present,
            "keypoints_px": np.arange(36).reshape(2, 3, 3, 2) + 1,
            "confidence": confidence,
            "box_px": np.full((2, 3, 4), 2.0),
            "image_size_px": [[8, 6]] * 3,
            "file_name": ["a.png", "b.png", "c.png"],
            "keypoint_names": ("bill", "nape", "tail"),
            "skeleton": ((0, 1), (1, 2)),
            "masks": {(0, 1): encode_mask(MASK), (1, 2): encode_mask(~MASK)},
        }
        | changes
    )


def test_what_is_missing_is_zero():
    keypoints = np.full((2, 3, 3, 2), np.nan)
    keypoints[make().confidence > 0] = 7
    boxes = np.full((2, 3, 4), 2.0)
    boxes[1, 0] = np.inf
    seen = make(keypoints_px=keypoints, box_px=boxes)
    np.testing.assert_array_equal(seen.keypoints_px[seen.confidence == 0], 0)
    np.testing.assert_array_equal(seen.box_px[1, 0], 0)


def test_times_of_the_frames():
    assert np.isnan(make().timestamp_s).all()
    assert make().fps is None
    timed = make(timestamp_s=[0.5, np.nan, 2], fps=25)
    np.testing.assert_array_equal(timed.select(frames=[1, 2]).timestamp_s, [np.nan, 2])
    moved = timed.select([0]).with_keypoints(timed.keypoints_px[:1], timed.confidence[:1])
    np.testing.assert_array_equal(moved.timestamp_s, [0.5, np.nan, 2])
    assert moved.fps == 25
    assert timed.timestamp_s.dtype == np.float64
    for wrong in ({"timestamp_s": [0, 1, np.inf]}, {"timestamp_s": [0, 1]}, {"fps": 0}, {"fps": np.nan}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} must"):
            make(**wrong)


def test_a_score_goes_with_its_bird():
    np.testing.assert_array_equal(make().score, make().present)  # full trust where nobody says otherwise
    scored = make(score=[[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    assert scored.score[1, 0] == 0  # there is no bird
    np.testing.assert_array_equal(scored.select([1], [1, 2]).score, np.float32([[0.5, 0.6]]))


def test_nothing_can_be_changed():
    seen = make()
    with pytest.raises(ValueError, match="read-only"):
        seen.keypoints_px[0, 0, 0, 0] = 5
    with pytest.raises(dataclasses.FrozenInstanceError):
        seen.track_id = np.array([1, 2])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"present": np.ones((2, 4), bool)}, r"present must have shape \(N, T\).* T is 3 in frame_index"),
        ({"keypoints_px": np.zeros((2, 3, 3, 3))}, "keypoints_px must have shape .* axis 3 should be 2"),
        ({"keypoint_names": ("bill", "nape")}, "keypoint_names"),
        ({"skeleton": ((0, 1), (1, -1))}, "skeleton names keypoints outside 0…2"),
        ({"skeleton": ((0, 3),)}, "skeleton names keypoints outside 0…2"),
        ({"track_id": [4.5, 9]}, "track_id must be of type int64"),
        ({"track_id": [4, 4]}, "each track once"),
        ({"frame_index": [10, 13, 11]}, "frame_index must increase"),
        ({"confidence": np.full((2, 3, 3), 1.5)}, r"in \[0, 1\]"),
        ({"confidence": np.ones((2, 3, 3))}, "0 where present is False"),
        ({"score": np.full((2, 3), 1.5)}, r"score must lie in \[0, 1\]"),
        ({"keypoints_px": np.full((2, 3, 3, 2), np.nan)}, "keypoints_px must be finite"),
        ({"box_px": np.full((2, 3, 4), np.inf)}, "box_px must be finite"),
        ({"masks": {(0, 0): encode_mask(MASK.T)}}, r"masks\[0, 0\]"),
    ],
)
def test_contradictions_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make(**changes)


def test_masks():
    seen = make()
    np.testing.assert_array_equal(seen.mask(0, 1), MASK)
    np.testing.assert_array_equal(seen.mask(-1, -1), ~MASK)
    assert seen.mask(0, 1).dtype == bool
    assert seen.mask(0, 0) is None
    with pytest.raises(IndexError):
        seen.mask(2, 0)
    with pytest.raises(ValueError, match=r"\(H, W\)"):
        encode_mask(MASK[0])


def test_usable():
    np.testing.assert_array_equal(make().usable(), [[True, False, False], [False, True, True]])
    np.testing.assert_array_equal(make().usable(min_keypoints=2), [[True, True, False], [False, True, True]])


def test_a_mask_is_enough_beside_frames_with_keypoints():
    confidence = np.zeros((2, 3, 3))
    confidence[1, 1] = 1
    seen = make(confidence=confidence, masks={(0, 1): encode_mask(MASK), (1, 2): encode_mask(MASK)})
    np.testing.assert_array_equal(seen.usable(0), [[False] * 3, [False, True, True]])


def test_keypoints_that_no_bird_has_do_not_count():
    confidence = np.array([[[0.5, 0, 1.0], [0, 0, 0.5]], [[0, 0, 0], [1.0, 0, 1.0]]], np.float32)
    np.testing.assert_array_equal(mean_confidence(confidence), [[0.75, 0.25], [0, 1]])
    np.testing.assert_array_equal(mean_confidence(np.zeros((2, 3, 0), np.float32)), np.zeros((2, 3)))


def test_select_moves_everything_along():
    seen = make(own_images={(1, 2): ("own.png", 8, 6)})
    picked = seen.select(tracks=[1], frames=slice(1, None))
    assert picked.track_id.tolist() == [9]
    assert picked.frame_index.tolist() == [11, 13]
    assert picked.file_name.tolist() == ["b.png", "c.png"]
    np.testing.assert_array_equal(picked.keypoints_px, seen.keypoints_px[1:, 1:])
    np.testing.assert_array_equal(picked.present, [[True, True]])
    assert picked.mask(0, 0) is None
    np.testing.assert_array_equal(picked.mask(0, 1), ~MASK)
    assert picked.image_file(0, 1) == "own.png"
    assert picked.image_file(0, 0) == "b.png"
    assert seen.select(tracks=seen.usable().any(1)).num_tracks == 2
    swapped = seen.select(tracks=[1, 0])
    assert swapped.track_id.tolist() == [9, 4]
    np.testing.assert_array_equal(swapped.mask(1, 1), MASK)
    assert seen.select(tracks=[], frames=[]).present.shape == (0, 0)
    with pytest.raises(ValueError, match="frame_index must increase"):
        seen.select(frames=[2, 0])


def test_own_images():
    tall = encode_mask(MASK.T)
    seen = make(own_images={(0, 0): ("tall.png", 6, 8)}, masks={(0, 0): tall})
    assert seen.image_size(0, 0) == (6, 8)
    assert seen.image_size(1, 0) == (8, 6)
    assert seen.image_file(0, 0) == "tall.png"
    np.testing.assert_array_equal(seen.mask(0, 0), MASK.T)


def test_with_keypoints():
    seen = make()
    other = seen.with_keypoints(seen.keypoints_px + 1, seen.confidence / 2)
    np.testing.assert_array_equal(other.confidence, seen.confidence / 2)
    np.testing.assert_array_equal(other.keypoints_px[0, 0], seen.keypoints_px[0, 0] + 1)
    np.testing.assert_array_equal(other.keypoints_px[0, 2], 0)
    np.testing.assert_array_equal(other.mask(0, 1), MASK)
    with pytest.raises(ValueError, match="confidence"):
        seen.with_keypoints(seen.keypoints_px, seen.confidence[:1])


def test_reordering_goes_by_name():
    seen = make()
    other = reorder_keypoints(seen, ["tail", "bill", "nape"])
    assert other.keypoint_names == ("tail", "bill", "nape")
    np.testing.assert_array_equal(other.keypoints_px[:, :, 0], seen.keypoints_px[:, :, 2])
    np.testing.assert_array_equal(other.confidence[:, :, 1], seen.confidence[:, :, 0])
    assert other.skeleton == ((1, 2), (2, 0))
    back = check_keypoints(other, seen.keypoint_names, "file.json")
    np.testing.assert_array_equal(back.keypoints_px, seen.keypoints_px)
    assert back.skeleton == seen.skeleton
    with pytest.raises(ValueError, match="permutation"):
        reorder_keypoints(seen, ["tail", "bill"])


def test_foreign_keypoints_are_named():
    with pytest.raises(InputError, match=r"file\.json: keypoints lack crown, toe and have nape, unknown"):
        check_keypoints(make(), ["bill", "crown", "toe", "tail"], "file.json")
    with pytest.raises(InputError, match=r"keypoints have nape, tail, unknown"):
        check_keypoints(make(), ["bill"], "file.json")
