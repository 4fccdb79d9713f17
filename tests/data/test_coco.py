"""COCO json: what is read and what comes back after writing."""

import json
import logging

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from support.coco_files import MASK, annotation, compressed, content, saved, uncompressed
from support.observations import assert_same

from jaxfit.data.formats.coco import read_coco, write_coco
from jaxfit.data.masks import encode_mask
from jaxfit.data.observations import Observations


def test_reads_tracks_and_frames_in_order(tmp_path):
    seen = read_coco(saved(tmp_path, content()))
    assert seen.track_id.tolist() == [0, 2]
    assert seen.frame_index.tolist() == [3, 4, 12]
    assert seen.file_name.tolist() == ["a.png", "b.png", "c.png"]
    np.testing.assert_array_equal(seen.image_size_px, [[30, 20]] * 3)
    np.testing.assert_array_equal(seen.present, [[True, True, False], [True, True, True]])
    np.testing.assert_array_equal(seen.box_px[1, 0], [5, 4, 20, 8])
    assert seen.keypoint_names == ("bill", "nape", "tail")
    assert seen.skeleton == ((0, 1), (1, 2))
    assert seen.own_images == {}


def test_confidence_is_the_score_where_the_keypoint_is_there(tmp_path):
    seen = read_coco(saved(tmp_path, content()))
    np.testing.assert_array_equal(seen.confidence[1, 1], [1, 1, 0])
    np.testing.assert_array_equal(seen.confidence[1, 0], [0.75, 0, 0])  # the last has a score but v = 0
    np.testing.assert_array_equal(seen.keypoints_px[1, 1], [[10, 5], [20.5, 6.25], [0, 0]])
    assert seen.usable(1).tolist() == [[True, False, False], [True, True, True]]


def test_a_bird_has_a_score(tmp_path):
    """0.1 is no float32: what is written is what a person gave. Without a score it is 1, and none is written."""
    scored = content()
    scored["annotations"][1]["score"] = 0.1
    seen = read_coco(saved(tmp_path, scored))
    np.testing.assert_array_equal(seen.score, np.float32([[1, 1, 0], [0.1, 1, 1]]))
    write_coco(seen, tmp_path / "again.json")
    written = json.loads((tmp_path / "again.json").read_text())["annotations"]
    assert [annotation.get("score") for annotation in written] == [None, None, 0.1, None, None]
    assert_same(read_coco(tmp_path / "again.json"), seen)


def test_times_of_the_frames(tmp_path):
    """`info` of other programs may be anything; unknown times and rates are not written."""
    timed = content() | {"info": {"fps": 29.97, "year": 2024}}
    timed["images"][1] |= {"timestamp_s": 1.25}
    seen = read_coco(saved(tmp_path, timed))
    assert seen.fps == 29.97
    stamped = seen.frame_index.tolist().index(timed["images"][1]["frame_index"])
    assert seen.timestamp_s[stamped] == 1.25
    assert np.isnan(np.delete(seen.timestamp_s, stamped)).all()
    write_coco(seen, tmp_path / "again.json", {"description": "x"})
    written = json.loads((tmp_path / "again.json").read_text())
    assert written["info"] == {"description": "x", "fps": 29.97}
    assert [image.get("timestamp_s") for image in written["images"]].count(None) == 2
    for info in ("text", None, [1], {"fps": None}, {}):
        unknown = read_coco(saved(tmp_path, content() | {"info": info}))
        assert unknown.fps is None
        assert np.isnan(unknown.timestamp_s).all()
    write_coco(unknown, tmp_path / "again.json")
    assert "info" not in json.loads((tmp_path / "again.json").read_text())


def test_what_is_hidden_keeps_its_place(tmp_path):
    """Visibility 1 is a keypoint that something hides; the whole mask stands beside the visible one."""
    hiding = content()
    part = uncompressed(MASK & (MASK.cumsum(1) < 3))
    changes = {"keypoints": [1, 2, 1, 3, 4, 2, 0, 0, 0], "segmentation": part, "amodal_segmentation": compressed(MASK)}
    hiding["annotations"] = [annotation(1, 6, 2, **changes)]
    seen = read_coco(saved(tmp_path, hiding))
    cell = tuple(np.argwhere(seen.present)[0])
    np.testing.assert_array_equal(seen.occluded[cell], [True, False, False])
    np.testing.assert_array_equal(seen.whole_mask(*cell), MASK)
    assert (seen.mask(*cell) & ~MASK).sum() == 0
    assert seen.mask(*cell).sum() < MASK.sum()
    write_coco(seen, tmp_path / "again.json")
    again = read_coco(tmp_path / "again.json")
    assert_same(seen, again)
    kept = again.select(tracks=[cell[0]], frames=[cell[1]])
    np.testing.assert_array_equal(kept.whole_mask(0, 0), MASK)
    assert kept.occluded.tolist() == [[[True, False, False]]]


def test_masks_of_all_kinds(tmp_path):
    seen = read_coco(saved(tmp_path, content()))
    np.testing.assert_array_equal(seen.mask(1, 0), MASK)  # compressed
    np.testing.assert_array_equal(seen.mask(0, 0), ~MASK)  # uncompressed
    np.testing.assert_array_equal(seen.mask(0, 1), MASK)  # a polygon along pixel edges
    assert seen.mask(1, 2) is None
    assert seen.mask(0, 2) is None


def test_hundreds_of_masks_are_written_with_their_areas(tmp_path):
    """pycocotools fails for lists of more than 255 masks."""
    frames = 300
    masks = {(0, i): encode_mask(np.arange(16).reshape(4, 4) < 1 + i % 16) for i in range(frames)}
    observations = Observations(
        track_id=np.array([1]),
        frame_index=np.arange(frames),
        present=np.ones((1, frames), bool),
        keypoints_px=np.ones((1, frames, 1, 2), np.float32),
        confidence=np.ones((1, frames, 1), np.float32),
        box_px=np.full((1, frames, 4), 2, np.float32),
        image_size_px=np.full((frames, 2), 4),
        file_name=np.array([f"{i}.png" for i in range(frames)]),
        keypoint_names=("bill",),
        masks=masks,
    )
    write_coco(observations, tmp_path / "birds.json")
    annotations = json.loads((tmp_path / "birds.json").read_text())["annotations"]
    assert [a["area"] for a in annotations] == [1 + i % 16 for i in range(frames)]


def test_several_polygons_are_one_mask(tmp_path):
    data = content()
    data["annotations"][0]["segmentation"] = [[0, 0, 4, 0, 4, 4, 0, 4], [10, 10, 12, 10, 12, 15, 10, 15]]
    assert read_coco(saved(tmp_path, data)).mask(1, 1).sum() == 16 + 10
    data["annotations"][0]["segmentation"] = []
    assert read_coco(saved(tmp_path, data)).mask(1, 1) is None


def test_a_crowd_has_no_mask(tmp_path):
    data = content()
    data["annotations"][0] |= {"iscrowd": 1, "segmentation": uncompressed(MASK)}
    seen = read_coco(saved(tmp_path, data))
    assert seen.present[1, 1]
    assert seen.mask(1, 1) is None


def test_other_categories_are_left_out_and_said(tmp_path, caplog):
    data = content()
    bird = data["categories"][0]
    boat, person = {"id": "boat", "name": "boat"}, {"id": 3, "keypoints": ["nose"]}
    data["categories"] = [boat, bird, bird | {"id": 4, "name": "gull"}, person]
    data["annotations"][0]["category_id"] = 4  # the same keypoints: a bird too
    data["annotations"][2] = {"image_id": 7, "category_id": "boat"}
    with caplog.at_level(logging.WARNING):
        seen = read_coco(saved(tmp_path, data))
    assert seen.present.tolist() == [[True, True, False], [True, True, False]]
    assert "skipped 1 annotations" in caplog.text


def test_categories_with_the_same_keypoints_are_species(tmp_path):
    data = content()
    bird = data["categories"][0]
    data["categories"] = [bird | {"name": "murre"}, bird | {"id": 4, "name": "gull"}]
    tracks = sorted({entry["track_id"] for entry in data["annotations"]})
    assert read_coco(saved(tmp_path, data)).species == {}  # all are murres
    for entry in data["annotations"]:
        entry["category_id"] = 4 if entry["track_id"] == tracks[0] else bird["id"]
    seen = read_coco(saved(tmp_path, data))
    assert seen.species == {tracks[0]: "gull", tracks[1]: "murre"}
    write_coco(seen, tmp_path / "again.json")
    assert read_coco(tmp_path / "again.json").species == seen.species
    written = json.loads((tmp_path / "again.json").read_text())
    names = {category["id"]: category["name"] for category in written["categories"]}
    assert {track["id"]: names[track["category_id"]] for track in written["tracks"]} == seen.species


def test_images_that_share_a_frame(tmp_path):
    """Photographs: every bird is frame 0 of an image of its own, of its own size."""
    data = content()
    for image in data["images"]:
        image["frame_index"] = 0
    data["images"][2] |= {"width": 40, "height": 50}
    wide = np.ones((50, 40), bool)
    data["annotations"] = [annotation(1, 7, 1), annotation(2, 6, 2, segmentation=compressed(wide))]
    path = saved(tmp_path, data)
    seen = read_coco(path)
    assert seen.present.tolist() == [[True], [True]]
    assert (seen.image_file(0, 0), seen.image_size(0, 0)) == ("c.png", (30, 20))
    assert (seen.image_file(1, 0), seen.image_size(1, 0)) == ("b.png", (40, 50))
    assert seen.mask(1, 0).shape == (50, 40)
    write_coco(seen, path)
    assert_same(read_coco(path), seen)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_round_trip_of_anything(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    N, T, K = rng.integers(1, 4, 3)
    present = rng.random((N, T)) < 0.7
    present[:, 0] = True
    confidence = rng.random((N, T, K), np.float32) * present[..., None] * (rng.random((N, T, K)) < 0.8)
    sizes = rng.integers(1, 40, (T, 2))
    masks = {
        (n, t): encode_mask(rng.random(sizes[t][::-1]) < rng.random())
        for n in range(N)
        for t in range(T)
        if present[n, t] and rng.random() < 0.8
    }
    seen = Observations(
        track_id=np.sort(rng.choice(100, N, replace=False)) - 50,
        frame_index=np.sort(rng.choice(100, T, replace=False)),
        present=present,
        keypoints_px=rng.normal(scale=1000, size=(N, T, K, 2)),
        confidence=confidence,
        box_px=rng.random((N, T, 4), np.float32) * 100 + 0.1,
        image_size_px=sizes,
        file_name=[f"ü {t}.png" for t in range(T)],
        keypoint_names=[f"k{k}" for k in range(K)],
        masks=masks,
        score=rng.random((N, T), np.float32) * present,
        timestamp_s=np.where(rng.random(T) < 0.8, rng.normal(scale=1e3, size=T), np.nan),
        fps=rng.choice([None, 30000 / 1001]),
    )
    path = tmp_path_factory.mktemp("coco") / "file.json"
    write_coco(seen, path)
    assert_same(read_coco(path), seen)


def test_real_annotations(reference_dir, tmp_path):
    files = sorted((reference_dir / "cub").glob("*.json"))
    assert len(files) == 5
    for path in files:
        seen, raw = read_coco(path), json.loads(path.read_text())["annotations"]
        assert seen.present.shape == (len(raw), 1)
        assert seen.usable(8).all()
        np.testing.assert_array_equal((seen.confidence > 0).sum(-1)[:, 0], [a["num_keypoints"] for a in raw])
        assert [seen.mask(n, 0).sum() for n in range(len(raw))] == [a["area"] for a in raw]
        write_coco(seen, tmp_path / "again.json")
        assert_same(read_coco(tmp_path / "again.json"), seen)
