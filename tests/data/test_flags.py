"""Flags of poses follow from their detections."""

import dataclasses

import numpy as np
from scipy.ndimage import distance_transform_edt
from support.evaluated import BIRD, N, T, solution, truth

from jaxfit.data.flags import (
    DOUBTS,
    contradict_masks,
    doubt_texts,
    flag_counts,
    flagged_ranges,
    flags,
    is_outlier,
    keypoint_distances,
    with_doubts,
    with_doubts_of_views,
)
from jaxfit.data.masks import encode_mask

FAR, UNLIKE, SECOND, WIDE, WEAK, OUTSIDE = (1 << i for i in range(len(DOUBTS)))


def test_the_truth_has_no_doubts():
    judged = with_doubts(solution(), truth(), BIRD)
    assert not judged.flags.doubts.any()
    assert flag_counts(judged.flags.doubts) == {"ok": N * T, "unsure": 0, "contradicted": 0}
    assert flagged_ranges(judged) == {}


def test_every_doubt_has_its_cause():
    seen = truth()
    keypoints, confidence = seen.keypoints_px.copy(), seen.confidence.copy()
    keypoints[0, 1] += 0.2 * seen.box_px[0, 1, 2:].max()
    confidence[0, 2] = 0.4
    masks = {**seen.masks, (1, 0): seen.masks[0, 0]}  # the mask of another bird, which lies elsewhere
    ambiguity_deg = np.zeros((N, T))
    ambiguity_deg[1, 1] = 170
    valid = np.ones((N, T), bool)
    valid[1, 3] = False
    seen = dataclasses.replace(seen, keypoints_px=keypoints, confidence=confidence, masks=masks)
    judged = with_doubts(solution(ambiguity_deg=ambiguity_deg, valid=valid), seen, BIRD)
    np.testing.assert_array_equal(judged.flags.doubts, [[0, FAR + OUTSIDE, WEAK, 0], [UNLIKE + OUTSIDE, SECOND, 0, -1]])
    words = [["ok", "contradicted", "unsure", "ok"], ["contradicted", "unsure", "ok", ""]]
    np.testing.assert_array_equal(flags(judged.flags.doubts), words)
    assert flagged_ranges(judged) == {
        5: (
            "frame 11 contradicted: keypoints far from the pose; keypoints outside the mask",
            "frame 12 unsure: keypoints with low confidence",
        ),
        3: (
            "frame 10 contradicted: mask unlike the mesh; keypoints outside the mask",
            "frame 11 unsure: a second pose fits almost as well",
        ),
    }
    assert np.isnan(keypoint_distances(seen, judged)[1, 3])


def test_one_wrong_view_of_three_condemns_no_pose():
    """Frame 0: keypoints are wrong in one view of three; frame 1: in two; frame 2: a mask in one; frame 3: in two."""
    seen, posed = truth(), solution()
    side = seen.box_px[..., 2:].max(-1)[..., None, None]

    def wrong(keypoint_frames, mask_frames):
        keypoints, masks = seen.keypoints_px.copy(), dict(seen.masks)
        keypoints[:, keypoint_frames] += 0.3 * side[:, keypoint_frames]
        for t in mask_frames:
            masks[1, t] = masks[0, t]
        return dataclasses.replace(seen, keypoints_px=keypoints, masks=masks)

    views = [wrong([0, 1], [2, 3]), wrong([1], [3]), seen]
    alone = with_doubts(posed, views[0], BIRD).flags.doubts
    assert (alone[1] > 0).all()
    doubts = with_doubts_of_views(posed, [(posed, own) for own in views], BIRD).flags.doubts
    np.testing.assert_array_equal(doubts, [[0, FAR + OUTSIDE, 0, 0], [0, FAR + OUTSIDE, 0, UNLIKE + OUTSIDE]])
    # a view without a bird does not count: one of two views contradicts, so the median is the mean of both
    absent = dataclasses.replace(seen, present=np.zeros((N, T), bool), confidence=seen.confidence * 0, masks={})
    pair = with_doubts_of_views(posed, [(posed, own) for own in (views[0], absent, seen)], BIRD).flags.doubts
    np.testing.assert_array_equal(pair[:, :2], [[FAR, FAR]] * 2)
    # keypoints need two views: the second-best confidence counts
    once = with_doubts_of_views(posed, [(posed, own) for own in (absent, seen, absent)], BIRD).flags.doubts
    np.testing.assert_array_equal(once, [[WEAK] * T] * 2)


def test_keypoints_outside_the_mask():
    """The mask is a square of 40 pixels, so the limit is a distance of 4 pixels; one of five keypoints lies outside."""
    seen = truth()
    K = len(seen.keypoint_names)
    mask = np.zeros((280, 320), bool)
    mask[20:60, 30:70] = True
    keypoints, confidence = np.full((N, T, K, 2), 50.0, np.float32), np.zeros((N, T, K), np.float32)
    confidence[..., :5] = 0.5
    keypoints[0, :, 0] = [[74.5, 30.5], [72.5, 30.5], [119.5, 0.5], [10.5, 30.5]]  # 5, 3, far and 20 pixels outside
    confidence[0, 3, 0] = 0.49
    seen = dataclasses.replace(
        seen,
        keypoints_px=keypoints,
        confidence=confidence,
        box_px=np.full((N, T, 4), [30, 20, 40, 40], np.float32),
        masks={(0, t): encode_mask(mask) for t in range(T)},
    )
    cells = np.argwhere(np.ones((N, T), bool))
    np.testing.assert_array_equal(contradict_masks(seen, cells), [[True, False, True, False], [False] * T])
    assert not contradict_masks(seen, cells[1:2]).any()


def test_keypoints_outside_any_mask():
    """SciPy's distances of all pixels; keypoints beyond the image, masks that touch its border, and an empty mask."""
    rng, seen = np.random.default_rng(0), truth()
    K, margin = len(seen.keypoint_names), 60
    masks = np.zeros((N, T, 280, 320), bool)
    for mask in masks.reshape(-1, 280, 320)[1:]:
        low = rng.integers(0, 200, 2)
        part = mask[low[0] : low[0] + rng.integers(1, 200), low[1] : low[1] + rng.integers(1, 200)]
        part[:] = rng.random(part.shape) < rng.choice([0.001, 0.5, 1])
    points = rng.uniform(-margin, [320 + margin, 280 + margin], (N, T, K, 2)).astype(np.float32)
    sure, side = rng.random((N, T, K)) < 0.7, rng.uniform(20, 3000, (N, T)).astype(np.float32)
    seen = dataclasses.replace(
        seen,
        keypoints_px=np.where(sure[..., None], points, 0),
        confidence=sure.astype(np.float32),
        box_px=np.stack([0 * side, 0 * side, side, side / 2], axis=-1),
        masks={(n, t): encode_mask(masks[n, t]) for n in range(N) for t in range(T)},
    )
    expected = np.zeros((N, T), bool)
    for n, t in np.argwhere(masks.any((2, 3))):
        away = distance_transform_edt(~np.pad(masks[n, t], margin))
        column, row = np.floor(points[n, t, sure[n, t]]).astype(int).T + margin
        expected[n, t] = (away[row, column] > 0.1 * side[n, t]).mean() > 0.1
    assert 0 < expected.sum() < masks.any((2, 3)).sum()
    np.testing.assert_array_equal(contradict_masks(seen, np.argwhere(seen.present)), expected)


def test_wide_error_bars_are_a_doubt():
    cells = solution().cells(error_bars=True)
    bars = {name: np.zeros_like(values) for name, values in cells.items() if name.endswith(("_sd", "_cov"))}
    length = np.linalg.norm(
        np.subtract(*(BIRD.keypoints[BIRD.keypoint_names.index(k)] for k in ("bill_tip", "tail_tip")))
    )
    for axis in range(3):
        bars["keypoints_centred_cov"][0, :, :, axis, axis] = (0.11 * length) ** 2 / 3
        bars["keypoints_centred_cov"][1, :, :, axis, axis] = (0.09 * length) ** 2 / 3
    judged = with_doubts(solution(**bars, misfit=np.ones((N, T))), truth(), BIRD)
    np.testing.assert_array_equal(judged.flags.doubts, [[WIDE] * T, [0] * T])


def test_outliers_have_a_large_modified_z_score():
    rng = np.random.default_rng(0)
    values = np.abs(rng.normal(1, 0.1, (10, 100)))
    values[3, 4], values[5, 6] = 1.6, np.nan
    known = values[np.isfinite(values)]
    deviation = np.median(np.abs(known - np.median(known)))
    score = 0.6745 * (values - np.median(known)) / deviation
    np.testing.assert_array_equal(is_outlier(values), score > 3.5)
    assert is_outlier(values)[3, 4]
    assert is_outlier(values).sum() < 5
    assert not is_outlier(np.array([[0.01] * 18 + [9.0]])).any()  # too few values
    assert not is_outlier(np.full((3, 50), 0.2)).any()


def test_codes():
    assert doubt_texts(0) == doubt_texts(-1) == ()
    assert doubt_texts(FAR + WIDE) == ("keypoints far from the pose", "error bars above 10 % of the length")
    assert flag_counts(np.array([[-1, -1]])) == {}
    np.testing.assert_array_equal(flags(np.array([[FAR + WIDE, WIDE, 0, -1]])), [["contradicted", "unsure", "ok", ""]])


def test_frames_without_a_pose_have_no_flag():
    """Also where arrays of other results are put together, and the rest is filled with 0."""
    valid = np.ones((N, T), bool)
    valid[0, 2:] = False
    assert flag_counts(solution(valid=valid, doubts=np.zeros((N, T), np.int8)).flags.doubts)["ok"] == N * T - 2


def test_frames_with_the_same_flag_are_one_range():
    doubts = np.array([[FAR, FAR + UNLIKE, 0, FAR], [WIDE, -1, WIDE, WIDE]])
    first = "frames 10 to 11 contradicted: keypoints far from the pose; mask unlike the mesh"
    wide = "unsure: error bars above 10 % of the length"
    assert flagged_ranges(solution(doubts=doubts)) == {
        5: (first, "frame 14 contradicted: keypoints far from the pose"),
        3: (f"frame 10 {wide}", f"frames 12 to 14 {wide}"),
    }


def test_without_masks_only_keypoints_are_compared():
    seen = dataclasses.replace(truth(), masks={})
    assert not with_doubts(solution(), seen, BIRD).flags.doubts.any()
