"""From frames to observations, what is dropped, how good it is, and how the filter takes it."""

import dataclasses
import json

import numpy as np
import pytest
from support.observations import assert_same

from jaxfit.config.fit import load_config
from jaxfit.data.formats.coco import read_coco, write_coco
from jaxfit.data.masks import encode_mask, encode_patch
from jaxfit.data.observations import Observations
from jaxfit.data.tracks import track_quality
from jaxfit.fitting.fit import fit
from jaxfit.fitting.windows import filter_observations
from jaxfit.foundation.errors import InputError
from jaxfit.perception.network import instance_of
from jaxfit.perception.tracking import observations_of, record_frame

NAMES, SIZE = ("bill", "left_eye", "right_eye"), (60, 40)


def blob(x, y, score=0.9):
    mask = np.zeros((SIZE[1], SIZE[0]), bool)
    mask[y : y + 6, x : x + 10] = True
    mask[y, x] = False
    return instance_of(mask, score, "bird")


def record(frames, names=NAMES):
    """frames: number → list of (identity, column)."""
    recorded = []
    for t, birds in frames.items():
        points = np.array([[[x + k, t] for k in range(len(names))] for _, x in birds], np.float32)
        confidence = np.array([np.linspace(0, 1 - x / 100, len(names)) for _, x in birds]).reshape(-1, len(names))
        instances = [blob(x, 5, 0.5 + x / 100) for _, x in birds]
        identities = [one for one, _ in birds]
        points = points.reshape(-1, len(names), 2)
        recorded.append(record_frame(t, f"v.mp4#{t}", SIZE, instances, identities, points, confidence))
    return observations_of(recorded, names, [(0, 1)])


def test_run_lengths_of_a_patch_are_those_of_the_whole_image():
    rng = np.random.default_rng(0)
    for _ in range(600):
        height, width = rng.integers(1, 9, 2).tolist()
        h, w = int(rng.integers(0, height + 1)), int(rng.integers(0, width + 1))
        x0, y0 = int(rng.integers(0, width - w + 1)), int(rng.integers(0, height - h + 1))
        patch = rng.random((h, w)) < rng.choice([0, 0.3, 0.7, 1])
        whole = np.zeros((height, width), bool)
        whole[y0 : y0 + h, x0 : x0 + w] = patch
        assert encode_patch(patch, x0, y0, width, height) == encode_mask(whole)
    with pytest.raises(ValueError, match=r"4×3 pixels at \(-1, 0\) reaches beyond an image of 9×9"):
        encode_patch(np.ones((3, 4)), -1, 0, 9, 9)


def test_frames_become_observations(tmp_path):
    """Frame 5 is damaged and left out, 6 shows no bird, and one bird of 7 is not tracked yet."""
    seen = record({3: [(9, 30), (2, 0)], 4: [(2, 4)], 6: [], 7: [(None, 50), (9, 40)]})
    assert seen.track_id.tolist() == [2, 9]
    assert seen.frame_index.tolist() == [3, 4, 6, 7]
    assert seen.present.tolist() == [[True, True, False, False], [True, False, False, True]]
    assert seen.file_name.tolist() == ["v.mp4#3", "v.mp4#4", "v.mp4#6", "v.mp4#7"]
    assert seen.skeleton == ((0, 1),)
    np.testing.assert_array_equal(seen.box_px[1, 3], [40, 5, 10, 6])
    np.testing.assert_array_equal(seen.keypoints_px[1, 3], [[0, 0], [41, 7], [42, 7]])  # the first was not found
    np.testing.assert_allclose(seen.confidence[1, 3], [0, 0.3, 0.6])
    np.testing.assert_allclose(seen.score, [[0.5, 0.54, 0, 0], [0.8, 0, 0, 0.9]])
    assert seen.mask(1, 3).sum() == 59
    assert not seen.mask(1, 3)[5, 40]
    write_coco(seen, tmp_path / "seen.json")
    assert_same(read_coco(tmp_path / "seen.json"), seen)


def test_a_video_without_birds_is_a_file_like_any_other(tmp_path):
    seen = record({0: [], 2: []})
    assert (seen.num_tracks, seen.num_frames, seen.num_keypoints) == (0, 2, 3)
    write_coco(seen, tmp_path / "none.json")
    assert_same(read_coco(tmp_path / "none.json"), seen)
    assert track_quality(seen) == []
    assert filter_observations(seen, 5).num_tracks == 0
    with pytest.raises(InputError, match=r"none\.json: holds no bird"):
        fit(seen, None, load_config("paper"), source="none.json")


def test_a_frame_that_contradicts_itself_is_refused():
    """A tracker or a network of the caller may err."""
    one, points = [blob(0, 0)], np.zeros((1, 3, 2))
    with pytest.raises(ValueError, match=r"each bird once, not \[1, 1\]"):
        record_frame(5, "a", SIZE, one * 2, [1, 1], np.zeros((2, 3, 2)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"must have 2 instances, not \(1, 1\)"):
        record_frame(5, "a", SIZE, one * 2, [1, 2], points, points[..., 0])


def moving(points, numbers, confidence=None, side=10.0):
    """One bird, one keypoint, at the given columns; missed where NaN."""
    points = np.array(points, float)
    present = np.isfinite(points)
    trust = np.where(present, 1.0 if confidence is None else confidence, 0)[None, :, None]
    return Observations(
        track_id=np.array([7]),
        frame_index=np.array(numbers),
        present=present[None],
        keypoints_px=np.stack([np.nan_to_num(points), np.zeros(len(points))], -1)[None, :, None],
        confidence=trust,
        box_px=np.tile([0.0, 0, side / 2, side], (1, len(points), 1)),
        image_size_px=np.tile(SIZE, (len(points), 1)),
        file_name=np.array([str(t) for t in numbers]),
        keypoint_names=("bill",),
    )


def test_quality_by_hand(tmp_path):
    nan = np.nan
    # seen in 6 of the 9 frames from 10 to 18; 14 is missing from the file, 13 and 16 from the track
    seen = moving([nan, 0, 1, 4, nan, 8, nan, 3, 5], [9, 10, 11, 12, 13, 15, 16, 17, 18], 0.75)
    (quality,) = track_quality(seen)
    assert quality[:5] == (7, 10, 18, 6, 2)
    assert quality.coverage == pytest.approx(6 / 9)
    assert quality.mean_confidence == pytest.approx(0.75)
    assert quality.jitter == pytest.approx(abs(0 - 2 * 1 + 4) / 10)  # 10, 11, 12 are the only three in a row
    assert track_quality(moving([0, 1, 4], range(3), 0.4))[0].jitter is None
    assert track_quality(moving([0, 5, 10], range(3)))[0].jitter == 0
    every_fourth = track_quality(moving([0, 1, 4], [0, 4, 8]))[0]
    assert (every_fourth.coverage, every_fourth.gaps) == (1, 0)
    assert every_fourth.jitter == pytest.approx(0.2)
    noise = np.random.default_rng(0).normal(scale=0.1, size=(1, 4000, 1, 2))
    white = dataclasses.replace(moving(np.zeros(4000), range(4000)), keypoints_px=noise)
    assert track_quality(white)[0].jitter == pytest.approx(2.884 * 0.01, rel=0.03)

    path = tmp_path / "seen.json"
    write_coco(seen, path)
    content = json.loads(path.read_text())
    figures = {"first_frame": 10, "last_frame": 18, "frames": 6, "gaps": 2, "coverage": 0.666667}
    assert content["tracks"] == [{"id": 7, "category_id": 1, **figures, "mean_confidence": 0.75, "jitter": 0.2}]
    for others in ([{"video_id": "x"}], {"a": 1}, None):
        path.write_text(json.dumps(content | {"tracks": others}))
        assert_same(read_coco(path), seen)


def test_the_filter_stays_within_a_track():
    """Nothing is made up where the bird was not seen, and nothing comes from beyond a gap of half the window."""
    nan = np.nan
    seen = moving([nan, nan, 0, 1, 90, 3, 4, nan, nan, 50, 51, 52, nan], range(13))
    smooth = filter_observations(seen, 5)
    np.testing.assert_array_equal(smooth.present, seen.present)
    np.testing.assert_array_equal(smooth.confidence, seen.confidence)
    # at births, deaths and gaps the window holds fewer frames; of an even number the lower middle one is taken
    expected = [0, 0, 1, 1, 3, 3, 4, 0, 0, 51, 51, 51, 0]
    np.testing.assert_array_equal(smooth.keypoints_px[0, :, 0, 0], expected)
    # where the file itself lacks those frames it is the same
    there = [t for t in range(13) if t not in (7, 8)]
    np.testing.assert_array_equal(
        filter_observations(seen.select(frames=there), 5).keypoints_px, smooth.keypoints_px[:, there]
    )
