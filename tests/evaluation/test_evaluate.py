"""The figures of a result: perfect for the truth, what a hand computes for a known error."""

import dataclasses
import math

import numpy as np
import pytest
from support.evaluated import BIRD, HEIGHT, WIDTH, N, T, sides, solution, truth

from jaxfit.data.flags import WRONG_SHARE
from jaxfit.data.masks import encode_mask
from jaxfit.data.projection import PosedBirds
from jaxfit.evaluation.evaluate import COLUMNS, evaluate
from jaxfit.evaluation.truth import Truth
from jaxfit.foundation.errors import InputError


def test_the_truth_is_perfect():
    result = evaluate(solution(), BIRD, truth())
    assert tuple(result.overall) == COLUMNS
    for row in (result.overall, *result.tracks.values()):
        assert row["pck@0.05"] == row["pck@0.10"] == 1
        assert row["me_p"] == pytest.approx(0, abs=1e-6)
        assert row["me_v"] == pytest.approx(0, abs=1e-6)
        assert row["iou"] > 0.999  # but for a pixel whose centre lies on the outline
    assert list(result.tracks) == [5, 3]
    assert [row["frames"] for row in result.tracks.values()] == [T, T]
    assert (result.frames, result.missing) == (N * T, 0)


def test_a_known_error():
    """All keypoints 6, 8 px off: 10 px of each mask's side; steady, so nothing in velocity."""
    off = solution(keypoints_px=solution().keypoints.px + np.float32([6, 8]))
    result = evaluate(off, BIRD, truth()).overall
    own = np.array([[PosedBirds(off, BIRD).vertices_screen(n, t)[:, :2] for t in range(T)] for n in range(N)])
    extent = np.ptp(own, axis=2).max(-1)
    np.testing.assert_allclose(extent, sides(), atol=2)  # the mesh's mask has the annotated one's size
    assert result["me_p"] == pytest.approx(np.sqrt((100 / extent**2).mean()), rel=0.02)
    assert result["me_v"] == pytest.approx(0, abs=1e-6)
    assert result["pck@0.05"] == (0.05 * sides() >= 10).mean()
    assert result["pck@0.10"] == (0.10 * sides() >= 10).mean()


def test_every_second_frame_has_velocity_and_acceleration():
    """Velocity and acceleration are per frame of the file: with twice the frame numbers, all metrics stay the same."""
    points = solution().keypoints.px.copy()
    points[0, 1] += [6, 8]
    moved = solution(keypoints_px=points, body_pose=solution().poses.body_pose[:, ::-1])
    expected = evaluate(moved, BIRD, Truth(truth(), solution())).overall
    every_second = 2 * truth().frame_index
    result, seen, poses = (dataclasses.replace(each, frame_index=every_second) for each in (moved, truth(), solution()))
    assert expected["me_v"] > 0
    assert expected["acceleration"] > 0
    assert evaluate(result, BIRD, Truth(seen, poses)).overall == expected


def test_overlap_of_a_shifted_mesh():
    moved = solution(crop=solution().crops.square_px + np.float32([7, 0, 0]))
    seen, overlap = truth(), []
    for n in range(N):
        for t in range(T):
            mask = seen.mask(n, t)
            others = np.any([seen.mask(other, t) for other in range(N) if other != n], axis=0)
            there = np.roll(mask, 7, axis=1) & (mask | ~others)  # another bird may hide the mesh
            overlap.append((mask & there).sum() / (mask | there).sum())
    assert evaluate(moved, BIRD, seen).overall["iou"] == pytest.approx(np.mean(overlap), abs=1e-3)


def test_pixels_of_other_birds_do_not_count():
    """Bird 1 hides the right half of bird 0. Without the whole mask, only the left half can be compared."""
    seen = truth()
    masks, whole = dict(seen.masks), {}
    for t in range(T):
        whole[0, t], left = seen.masks[0, t], seen.mask(0, t)
        middle = int(seen.box_px[0, t, 0] + seen.box_px[0, t, 2] / 2)
        left[:, middle:] = False
        masks[0, t] = encode_mask(left)
        masks[1, t] = encode_mask(seen.mask(1, t) | (seen.mask(0, t) & ~left))
    hidden = dataclasses.replace(seen, masks=masks)
    track = int(seen.track_id[0])
    assert evaluate(solution(), BIRD, hidden).tracks[track]["iou"] == pytest.approx(1)
    alone = hidden.select(tracks=[0])
    assert evaluate(solution(), BIRD, alone).tracks[track]["iou"] < 0.7
    known = dataclasses.replace(alone, amodal_masks=whole)
    assert evaluate(solution(), BIRD, known).tracks[track]["iou"] == pytest.approx(1)


def test_poses_that_are_missing():
    valid = np.ones((N, T), bool)
    valid[0, 1:3] = valid[1, 0] = False
    points = solution().keypoints.px.copy()
    points[~valid] = np.nan
    result = evaluate(solution(valid=valid, keypoints_px=points), BIRD, truth())
    assert (result.frames, result.missing) == (5, 3)
    assert result.tracks[5]["frames"] == 2
    assert result.overall["pck@0.05"] == 1
    assert math.isnan(result.tracks[5]["me_v"])  # no two frames in a row are left


def test_only_what_both_know_is_measured():
    """Other tracks and frames, in another order."""
    part = truth().select(tracks=[1, 0], frames=[1, 2])
    result = evaluate(solution(), BIRD, part)
    assert (result.frames, result.missing) == (4, 0)
    assert result.overall["me_p"] == pytest.approx(0, abs=1e-6)
    one = evaluate(solution(), BIRD, truth().select(tracks=[1]))
    assert list(one.tracks) == [3]


def test_invisible_keypoints_and_absent_masks_do_not_count():
    seen = truth()
    points, confidence = seen.keypoints_px.copy(), seen.confidence.copy()
    points[:, :, 2] += 50
    confidence[:, :, 2] = 0
    masks = {at: rle for at, rle in seen.masks.items() if at[0] == 1}
    result = evaluate(solution(), BIRD, dataclasses.replace(seen.with_keypoints(points, confidence), masks=masks))
    assert result.overall["pck@0.05"] == 1
    assert math.isnan(result.tracks[5]["iou"])
    assert result.overall["iou"] == result.tracks[3]["iou"] > 0.999


def test_nothing_in_common():
    for changes in ({"track_id": np.array([50, 30])}, {"frame_index": np.arange(4)}):
        with pytest.raises(InputError, match=r"truth\.json: shares no bird with the result: .*annotations"):
            evaluate(solution(), BIRD, Truth(dataclasses.replace(truth(), **changes), source="truth.json"))
    with pytest.raises(InputError, match=r"shares no bird"):
        evaluate(solution(valid=np.zeros((N, T), bool)), BIRD, truth())
    renamed = dataclasses.replace(truth(), keypoint_names=("beak", *BIRD.keypoint_names[1:]))
    with pytest.raises(InputError, match="lack bill_tip"):
        evaluate(solution(), BIRD, renamed)


def test_pictures_of_another_size():
    larger = dataclasses.replace(truth(), image_size_px=np.full((T, 2), [640, 400]), masks={})
    with pytest.raises(InputError, match=r"truth: has track 5, frame 10 in an image of 640×400 pixels, but .* 320×280"):
        evaluate(solution(), BIRD, larger)
    sizes = np.full((N, T, 2), 7)
    sizes[1] = WIDTH, HEIGHT
    one = truth().select(tracks=[1])
    assert evaluate(solution(image_size_px=sizes), BIRD, one).frames == T  # of matched birds alone


def test_poses_that_the_truth_lacks():
    valid = np.ones((N, T), bool)
    valid[1, 0] = False
    result = evaluate(solution(valid=valid), BIRD, truth().select(tracks=[1]))
    assert (result.frames, result.missing, result.unmatched) == (T - 1, 1, T)
    assert evaluate(solution(), BIRD, truth().select(frames=[0, 2])).unmatched == 2 * N
    assert evaluate(solution(), BIRD, truth()).unmatched == 0
    confidence = truth().confidence * valid[..., None]
    away = dataclasses.replace(truth(), present=valid, confidence=confidence, masks={})
    assert evaluate(solution(), BIRD, away).unmatched == 0  # the truth may annotate a frame in part


def test_the_truth_of_another_video_is_reported(caplog):
    evaluate(solution(), BIRD, Truth(truth(), source="t.json"))
    assert not caplog.records
    elsewhere = solution(crop=solution().crops.square_px + np.float32([200, 0, 0]))
    evaluate(elsewhere, BIRD, Truth(truth(), source="t.json"))
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert "hardly overlap the birds of t.json (median IoU 0.00)" in record.message


def test_wrong_poses_are_counted_with_their_flags():
    """Two poses have joints turned far away, and one of them is flagged."""
    body_pose, doubts = solution().poses.body_pose.copy(), np.zeros((N, T), np.int8)
    body_pose[0, 1:3] += 1.5
    doubts[0, 1] = doubts[1, 3] = 1
    exact = Truth(truth(), solution())
    result = evaluate(solution(body_pose=body_pose, doubts=doubts), BIRD, exact)
    assert result.flags == {"wrong": 2, "flagged": 2, "found": 1}
    without_flags = evaluate(solution(body_pose=body_pose), BIRD, exact)
    assert without_flags.flags == {}
    (row,) = without_flags.wrong.values()
    assert without_flags.wrong == result.wrong == {5: {"count": 2, "frame": row["frame"], "error": row["error"]}}
    assert row["frame"] in (11, 12)
    assert row["error"] > WRONG_SHARE
    assert evaluate(solution(), BIRD, exact).wrong == evaluate(solution(body_pose=body_pose), BIRD, truth()).wrong == {}
    assert evaluate(solution(doubts=doubts), BIRD, truth()).flags == {}
