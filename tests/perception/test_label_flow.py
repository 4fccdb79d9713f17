"""Labels that optical flow carries to other frames: turning, textured birds before a background that moves otherwise.

The oracle is the known motion of the birds.
"""

import dataclasses
import json

import cv2
import numpy as np
import pytest

from jaxfit.data.formats.coco import read_coco, write_coco
from jaxfit.data.masks import encode_mask
from jaxfit.data.observations import FROM_FLOW, FROM_LABEL, FROM_OUTLINE, Observations
from jaxfit.foundation.errors import InputError
from jaxfit.perception.label_flow import carry_labels, origin_counts, read_few_labels

T, SIZE, LENGTH_PX = 13, (240, 160), 100
NAMES = ("bill_tip", "crown", "back", "breast", "tail_tip")
POINTS = np.array([(48, 0), (25, -15), (0, -20), (20, 18), (-46, 2)], float)
"""Of the resting bird about its middle: on the outline, and inside."""


def pose(t, bird=0):
    """Return the affine map of the resting bird to frame t: it moves and turns."""
    angle = np.deg2rad((3 + bird) * t)
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 75 + 5 * t], [s, c, 45 + 70 * bird + 1.5 * t]])


def where(t, bird=0):
    R = pose(t, bird)
    return POINTS @ R[:, :2].T + R[:, 2]


def texture(seed, shape):
    noise = np.random.default_rng(seed).uniform(0, 255, shape)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A folder of frames of two birds, and their masks."""
    folder, masks = tmp_path_factory.mktemp("film"), {}
    background = texture(0, (SIZE[1] + 60, SIZE[0] + 60))
    body = np.zeros((60, 120), np.uint8)
    cv2.ellipse(body, (60, 30), (LENGTH_PX // 2, 22), 0, 0, 360, 1, -1)
    centre = np.array([[1, 0, -59.5], [0, 1, -29.5], [0, 0, 1]])
    for t in range(T):
        picture = background[3 * t : 3 * t + SIZE[1], 2 * t : 2 * t + SIZE[0]].copy()
        for bird in (0, 1):
            matrix = np.vstack([pose(t, bird), [0, 0, 1]]) @ centre
            matrix[:2, 2] -= 0.5  # pixel centres at i + 0.5
            mask = cv2.warpAffine(body, matrix[:2], SIZE) > 0
            masks[bird, t] = encode_mask(mask)
            picture[mask] = cv2.warpAffine(texture(1 + bird, body.shape), matrix[:2], SIZE)[mask]
        cv2.imwrite(str(folder / f"{t:04d}.png"), cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    return folder, masks


def tracks(masks, present=None):
    """Return both birds as a tracker finds them: masks, and keypoints that are wrong."""
    present = np.ones((2, T), bool) if present is None else present
    kept = {at: mask for at, mask in masks.items() if present[at]}
    K = len(NAMES)
    return Observations(
        track_id=np.array([4, 7]),
        frame_index=np.arange(T),
        present=present,
        keypoints_px=np.full((2, T, K, 2), 3.0) * present[..., None, None],
        confidence=np.full((2, T, K), 0.9) * present[..., None],
        box_px=np.array([60, 40, LENGTH_PX, 60.0]) * present[..., None],
        image_size_px=np.full((T, 2), SIZE),
        file_name=np.array([f"{t:04d}.png" for t in range(T)]),
        keypoint_names=NAMES,
        masks=kept,
    )


def labels(marked, size=SIZE):
    """Return labels: (frame, bird) → positions (K, 2), NaN for a hidden keypoint."""
    frames = sorted({t for t, _ in marked})
    birds = max(bird for _, bird in marked) + 1
    points = np.full((birds, len(frames), len(NAMES), 2), np.nan)
    for (t, bird), positions in marked.items():
        points[bird, frames.index(t)] = positions
    known = np.isfinite(points[..., 0])
    return Observations(
        track_id=np.arange(birds),
        frame_index=np.array(frames),
        present=known.any(-1),
        keypoints_px=np.nan_to_num(points),
        confidence=known.astype(np.float32),
        box_px=np.full((birds, len(frames), 4), 10.0) * known.any(-1)[..., None],
        image_size_px=np.full((len(frames), 2), size),
        file_name=np.array([f"{t:04d}.png" for t in frames]),
        keypoint_names=NAMES,
    )


def shares(carried, n, bird):
    """Return the errors of the keypoints of a track, as shares of the length, (T, K)."""
    truth = np.stack([where(t, bird) for t in range(T)])
    return np.linalg.norm(carried.observations.keypoints_px[n] - truth, axis=-1) / LENGTH_PX


def test_labels_of_two_birds_reach_all_frames_of_their_birds(film):
    folder, masks = film
    marked = {(t, bird): where(t, bird) for t in (2, 10) for bird in (0, 1)}
    carried = carry_labels(tracks(masks), labels(marked), folder)
    assert carried.used == 4
    assert carried.problems == ()
    for n in (0, 1):
        assert (carried.observations.confidence[n] > 0.5).all()
        assert shares(carried, n, n).max() < 0.05
        origin = np.where(np.isin(np.arange(T), (2, 10)), FROM_LABEL, FROM_FLOW)
        np.testing.assert_array_equal(carried.observations.keypoint_origin[n], origin)
    np.testing.assert_allclose(carried.observations.keypoints_px[0, 2], where(2), rtol=1e-6)
    assert (carried.observations.confidence[:, [2, 10]] == 1).all()
    confidence = carried.observations.confidence[0]
    assert (confidence[6] < confidence[3]).all()  # farther from both labels
    assert origin_counts(carried.observations)[7] == {"labels": 2, "flow": 11, "the outline alone": 0}


def test_a_keypoint_is_hidden_near_labels_that_lack_it(film):
    folder, masks = film
    hidden = where(10)
    hidden[3] = np.nan
    carried = carry_labels(tracks(masks), labels({(2, 0): where(2), (10, 0): hidden}), folder)
    known = carried.observations.confidence[0, :, 3] > 0
    np.testing.assert_array_equal(known, np.arange(T) <= 6)


def test_keypoints_of_the_outline_fill_what_no_label_reaches(film):
    folder, masks = film
    hidden = where(10)
    hidden[3] = np.nan
    found = tracks(masks)
    found = dataclasses.replace(found, keypoint_origin=np.full(found.present.shape, FROM_OUTLINE, np.int8))
    carried = carry_labels(found, labels({(2, 0): where(2), (10, 0): hidden}), folder).observations
    filled = (np.arange(T) > 6) & (np.arange(T) != 10)  # a label says what can be seen
    np.testing.assert_array_equal(carried.keypoints_px[0, filled, 3], found.keypoints_px[0, filled, 3])
    assert (carried.confidence[0, filled, 3] > 0).all()
    assert carried.confidence[0, 10, 3] == 0
    assert carried.keypoint_origin[0, 8] == FROM_FLOW


@pytest.mark.parametrize("wrong", [lambda: where(6)[::-1], lambda: where(9)])  # exchanged names; another frame's
def test_a_wrong_label_is_named_and_left_out(film, wrong):
    folder, masks = film
    marked = {(t, 0): where(t) for t in (1, 11)} | {(6, 0): wrong()}
    carried = carry_labels(tracks(masks), labels(marked), folder)
    (problem,) = carried.problems
    assert "frame 6" in problem
    assert "left out" in problem
    assert shares(carried, 0, 0).max() < 0.05


def test_labels_that_miss_each_other_are_named_and_used(film):
    folder, masks = film
    carried = carry_labels(tracks(masks), labels({(2, 0): where(2), (10, 0): where(10)[::-1]}), folder)
    (problem,) = carried.problems
    assert "frame 2 and frame 10" in problem
    assert carried.used == 2
    assert carried.observations.confidence[0, 6, 0] == 0  # half-way between two places that are far apart


def test_a_bird_that_leaves_and_returns_as_another_track(film):
    folder, masks = film
    both = masks | {(1, t): masks[0, t] for t in range(8, T)}
    present = np.zeros((2, T), bool)
    present[0, :6], present[1, 8:] = True, True
    carried = carry_labels(tracks(both, present), labels({(2, 0): where(2)}), folder)
    counts = origin_counts(carried.observations)
    assert counts[4] == {"labels": 1, "flow": 5, "the outline alone": 0}
    assert counts[7] == {"labels": 0, "flow": 0, "the outline alone": 5}
    assert not carried.observations.confidence[1].any()


def test_the_flow_bridges_frames_without_a_mask(film):
    folder, masks = film
    present = np.ones((2, T), bool)
    present[0, 5:7] = False
    carried = carry_labels(tracks(masks, present), labels({(2, 0): where(2)}), folder)
    assert shares(carried, 0, 0)[7:].max() < 0.06
    assert not carried.observations.confidence[0, 5:7].any()


def test_labels_of_no_bird_are_named(film):
    folder, masks = film
    marked = {(2, 0): where(2), (40, 0): where(2), (3, 0): np.full((5, 2), 5.0)}
    problems = carry_labels(tracks(masks), labels(marked), folder).problems
    assert any("frame 40 is not in the tracked frames (0 to 12)" in problem for problem in problems)
    assert any("frame 3: no mask covers" in problem for problem in problems)
    with pytest.raises(InputError, match="no label belongs to a tracked bird: frame 40 is not"):
        carry_labels(tracks(masks), labels({(40, 0): where(2)}), folder)
    with pytest.raises(InputError, match="the sizes of the pictures"):
        carry_labels(tracks(masks), labels({(2, 0): where(2)}, size=(480, 320)), folder)


def test_a_file_says_where_keypoints_come_from(film, tmp_path):
    folder, masks = film
    carried = carry_labels(tracks(masks), labels({(2, 0): where(2)}), folder).observations
    write_coco(carried, tmp_path / "birds.json")
    entries = json.loads((tmp_path / "birds.json").read_text())["annotations"]
    assert [entry.get("keypoint_origin") for entry in entries[1:4]] == ["flow", "label", "flow"]
    assert "keypoint_origin" not in entries[-1]
    read = read_coco(tmp_path / "birds.json")
    np.testing.assert_array_equal(read.keypoint_origin, carried.keypoint_origin)


def test_labels_are_read_with_the_keypoints_of_the_model(film, tmp_path):
    folder, _ = film
    rows = ["scorer,me,me,me,me,me,me", "bodyparts,beak,beak,crown,crown,tail,tail", "coords,x,y,x,y,x,y"]
    (tmp_path / "labels.csv").write_text("\n".join([*rows, "labeled-data/film/img0002.png,1,2,3,4,,", ""]))
    read = read_few_labels(tmp_path / "labels.csv", folder, ("tail_tip", "bill_tip", "crown"))
    assert read.frame_index.tolist() == [2]
    assert read.confidence[0, 0].tolist() == [0, 1, 1]
    assert read.keypoints_px[0, 0, 1].tolist() == [1, 2]
