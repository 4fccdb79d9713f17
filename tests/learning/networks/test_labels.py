"""Labels of a user: formats, pictures, labels that cannot be right, and the held-out part."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from support.labelled_pictures import SIZE, bird, coco, write_labels

pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

from jaxfit.foundation.errors import InputError
from jaxfit.learning.networks.label_data import GAP_FRAMES, LabelFiles, prepare_data, split_pictures
from jaxfit.learning.networks.labelled_frames import UNKNOWN
from jaxfit.learning.networks.labels import (
    LabelledBird,
    LabelledPicture,
    mixed_up_birds,
    numbered_by_film,
    read_labels,
)
from jaxfit.model.files import load_murre

TIMES = range(0, 400, 50)


def prepared(tmp_path, content, network="segmenter", pictures=TIMES, share=0.25, **files):
    file = write_labels(tmp_path / "labels", content, list(pictures))
    return prepare_data(network, LabelFiles((file,), **files), share, None, tmp_path / "training")


def problems(data):
    return [str(label) for label in data.left_out]


def test_masks_without_keypoints(tmp_path):
    """Polygons of a COCO file without keypoints become the owner of every pixel."""
    data = prepared(tmp_path, coco({t: [bird(40, 30), bird(100, 60, 40)] for t in TIMES}))
    assert not data.left_out
    assert len(data.frames.pictures) == 6
    assert len(data.holdout) == 2
    owner = data.frames.owner[0]
    assert owner.shape == (120, 160)
    assert (owner == 1).sum() == pytest.approx(900, abs=70)
    assert (owner == 2).sum() == pytest.approx(1600, abs=90)
    assert (data.frames.pictures[0][owner > 0] == 250).mean() > 0.9


def without(content, *keys):
    """Return a COCO file without some keys of video: `track_id` of annotations, `frame_index` of images."""
    for table in ("images", "annotations"):
        content[table] = [{k: v for k, v in entry.items() if k not in keys} for entry in content[table]]
    return content


@pytest.mark.parametrize("keys", [("track_id",), ("track_id", "frame_index")])
def test_every_annotation_without_a_track_is_a_bird(tmp_path, caplog, keys):
    """Labels need no tracks; the frames keep their numbers, which the hold-out needs."""
    frames = {t: [bird(40, 30), bird(100, 60, 40)][: 1 + (t > 0)] for t in TIMES}
    frames[50][1] = bird(-30, 30)
    file = write_labels(tmp_path / "labels", without(coco(frames), *keys), list(TIMES))
    pictures = read_labels([file], [], needs_keypoints=False).pictures
    assert [picture.frame for picture in pictures] == list(TIMES)
    assert [len(picture.birds) for picture in pictures] == [1] + [2] * (len(TIMES) - 1)
    data = prepare_data("segmenter", LabelFiles((file,)), 0.25, None, tmp_path / "training")
    assert len(problems(data)) == 1
    assert "frame_0050.png bird 2: the box reaches outside" in problems(data)[0]
    assert not caplog.text


@pytest.mark.parametrize("numbers", [(1, 2), (300, 310)])  # of 8 and of 16 bits
def test_folder_of_masks(tmp_path, numbers):
    masks, images = tmp_path / "masks", tmp_path / "images"
    write_labels(images, coco({t: [bird()] for t in TIMES}), list(TIMES))
    masks.mkdir()
    for t in TIMES:
        mask = np.zeros((SIZE[1], SIZE[0]), np.uint8 if max(numbers) < 256 else np.uint16)
        mask[30:60, 40:70], mask[70:90, 100:130] = numbers
        cv2.imwrite(str(masks / f"frame_{t:04d}.png"), mask)
    data = prepare_data("segmenter", LabelFiles((masks,), (images,)), 0.25, None, tmp_path / "training")
    assert not data.left_out
    assert [(data.frames.owner[0] == n).sum() for n in (1, 2)] == [900, 600]
    for t in TIMES:
        (images / f"frame_{t:04d}.png").rename(tmp_path / f"frame_{t:04d}.png")
    beside = prepare_data("segmenter", LabelFiles((masks,)), 0.25, None, tmp_path / "again")
    assert all((a.pixels() == b.pixels()).all() for a, b in zip(data.pictures, beside.pictures, strict=True))
    with pytest.raises(InputError, match="folder of masks, without keypoints"):
        read_labels([masks], [], needs_keypoints=True)


def test_a_folder_of_frames_with_other_names_is_a_film(tmp_path, caplog):
    """The pictures are found by their frame numbers, as in a video, unless the folder lacks a frame."""
    content = coco({t: [bird(20 + 10 * t, 30)] for t in range(8)})
    film = tmp_path / "film"
    write_labels(film, content, list(range(8)))
    for t in range(8):
        (film / f"frame_{t:04d}.png").rename(film / f"{t + 1}.png")
    file = write_labels(tmp_path / "labels", content, [])
    data = prepare_data("segmenter", LabelFiles((file,), (film,)), 0, None, tmp_path / "training")
    assert not data.left_out
    assert [picture.labels.frame for picture in data.pictures] == list(range(8))
    assert all((picture.pixels()[35, 25 + 10 * t] == 250).all() for t, picture in enumerate(data.pictures))
    assert list(numbered_by_film(data.pictures, film)) == list(range(8))
    assert "read by their frame numbers: frame_0000.png is 1.png" in caplog.text
    (film / "8.png").unlink()
    with pytest.raises(InputError, match=r"no picture of the labels is in .*film, by its name or its frame number"):
        prepare_data("segmenter", LabelFiles((file,), (film,)), 0, None, tmp_path / "training")


def test_wrong_labels_are_named(tmp_path):
    frames = {t: [bird()] for t in range(0, 500, 50)}
    frames[50] = [bird(-30, 30)]
    frames[100] = [bird(40, 30), {"bbox": [90, 30, 30, 30]}]
    two_birds = [[10, 10, 25, 10, 25, 25, 10, 25], [130, 10, 150, 10, 150, 30, 130, 30]]
    frames[150] = [{"bbox": [10, 10, 140, 20], "segmentation": two_birds}]
    content = coco(frames)
    content["images"][4] |= {"width": 80, "height": 60}
    content["annotations"] = [a for a in content["annotations"] if a["image_id"] != 200] + [
        {"id": 99, "image_id": 200, "category_id": 1, "track_id": 1} | bird(10, 10)
    ]
    data = prepared(tmp_path, content, pictures=[t for t in frames if t != 250])
    found = " | ".join(problems(data))
    for expected in (
        r"frame_0050.png bird 1: the box reaches outside the picture",
        "frame_0100.png bird 2: the bird has no mask",
        "frame_0150.png bird 1: one mask covers two birds",
        "frame_0200.png: the picture is 160×120, but the labels say 80×60",
        "frame_0250.png: the picture is missing or cannot be read",
    ):
        assert expected in found
    assert len(data.left_out) == 5
    assert len(data.split.training) + len(data.split.holdout) + len(data.split.gap) == 5


def test_keypoints_without_a_label_do_not_count(tmp_path):
    names = ["beak", "tail", "wingL", "wingR"]
    points = [45, 35, 2, 65, 55, 1, 50, 40, 2, 0, 0, 0]
    frames = {t: [bird(keypoints=points), {"bbox": [90, 60, 40, 40], "keypoints": points}] for t in TIMES}
    far = [45, 35, 2, 65, 55, 2, 500, 40, 2, 0, 0, 0]
    frames[50][0] = bird(keypoints=far)
    data = prepared(tmp_path, coco(frames, names), "keypoints")
    assert problems(data) == ["labels.json: frame_0050.png bird 1: a keypoint lies outside the picture, at x 500, y 40"]
    assert data.frames.visibility[0, 0].tolist() == [2, 1, 2, UNKNOWN]
    assert data.frames.keypoint_names == tuple(names)
    assert (data.frames.owner[0] == 2).sum() == 1600  # a bird without a mask has its box


def test_keypoints_that_are_left_out_are_not_visible(tmp_path):
    """Labels without marks of hidden keypoints leave hidden keypoints out; a keypoint without any label is unknown."""
    shown = [45, 35, 2, 65, 55, 2, 50, 40, 2, 0, 0, 0, 0, 0, 0]
    other = [45, 35, 2, 65, 55, 2, 0, 0, 0, 60, 40, 2, 0, 0, 0]
    frames = {t: [bird(keypoints=other if t else shown)] for t in TIMES}
    data = prepared(tmp_path, coco(frames, ["beak", "tail", "wingL", "wingR", "crown"]), "keypoints")
    assert data.frames.visibility[:2, 0].tolist() == [[2, 2, 2, 0, UNKNOWN], [2, 2, 0, 2, UNKNOWN]]


def test_unusable_label_files(tmp_path):
    content = coco({t: [bird()] for t in TIMES})
    with pytest.raises(InputError, match=r"no picture of the labels is beside the labels.*--images"):
        prepared(tmp_path / "a", content, pictures=[])
    with pytest.raises(InputError, match=r"the hold-out has no bird|training part has no bird"):
        prepared(tmp_path / "b", coco({0: [bird()]}), pictures=[0])
    with pytest.raises(InputError, match=r"holds no usable label.*has no mask"):
        prepared(tmp_path / "d", coco({0: [{"bbox": [9, 9, 9, 9]}]}), pictures=[0])
    with pytest.raises(InputError, match="holds no labelled bird"):
        prepared(tmp_path / "e", coco({0: []}), pictures=[0])
    with pytest.raises(InputError, match="comma"):
        prepared(tmp_path / "f", coco({0: [bird(keypoints=[9, 9, 2])]}, ["a,b"]), "keypoints")
    one = write_labels(tmp_path / "g", coco({0: [bird(keypoints=[9, 9, 2])]}, ["beak"]), [0])
    two = write_labels(tmp_path / "g", coco({0: [bird(keypoints=[9, 9, 2])]}, ["bill"]), [0], "two.json")
    with pytest.raises(InputError, match=r"names other keypoints than labels\.json: beak, bill only"):
        read_labels([one, two], [])


def random_views(count, seed):
    """Keypoints of the murre from random directions above the horizon, with noise."""
    rng = np.random.default_rng(seed)
    points = np.asarray(load_murre().keypoints)
    views = []
    for _ in range(count):
        yaw, pitch = rng.uniform(0, 2 * np.pi), rng.uniform(0.6, 1.4)
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        tilt = np.array([[1, 0, 0], [0, np.sin(pitch), np.cos(pitch)], [0, -np.cos(pitch), np.sin(pitch)]])
        view = (points @ turn.T @ tilt.T)[:, :2]
        views.append(view * rng.uniform(5, 20) + rng.uniform(0, 500, 2) + rng.normal(0, 1, view.shape))
    return np.array(views)


def test_mixed_up_sides_are_detected():
    names = load_murre().keypoint_names
    swap = [names.index(n.replace("left", "*").replace("right", "left").replace("*", "right")) for n in names]
    views, references = random_views(30, 0), random_views(300, 1)
    known, all_known = np.ones(views.shape[:2], bool), np.ones(references.shape[:2], bool)
    labels = views.copy()
    labels[::3] = views[::3][:, swap]
    found = mixed_up_birds(labels, known, references, all_known, names)
    assert found[::3].sum() >= 9
    assert not np.delete(found, np.s_[::3]).any()
    without_sides = mixed_up_birds(labels, known, references, all_known, [f"point{k}" for k in range(len(names))])
    assert not without_sides.any()


ANY_BIRD = LabelledBird("bird 1", np.ones(4), np.ones((1, 2)), np.full(1, 2), None)


def films(*videos):
    return [
        LabelledPicture(Path(f"{v}.json"), f"{t}.png", t, (9, 9), (ANY_BIRD,))
        for v, video in enumerate(videos)
        for t in video
    ]


@pytest.mark.parametrize("times", [range(0, 40, 4), range(200), range(0, 20_000, 100)])
def test_blocks_of_time(times):
    labels = films(times)
    split = split_pictures(labels, 0.2)
    parts = split.training + split.holdout + split.gap
    assert sorted(parts) == list(range(len(labels)))
    assert len(split.holdout) == pytest.approx(0.2 * len(labels), abs=1)
    # held-out pictures are few runs of consecutive labels
    assert (np.diff(split.holdout) > 1).sum() < max(1, len(labels) / 40)
    nearest = min(abs(labels[i].frame - labels[j].frame) for i in split.training for j in split.holdout)
    step = times[1] - times[0]
    assert nearest >= min(GAP_FRAMES, 2 * step)
    assert nearest > step or step >= GAP_FRAMES


def test_whole_videos():
    split = split_pictures(films(range(10), range(30), range(12)), 0.2)
    assert split.holdout == list(range(10))
    assert "by video" in split.rule
    assert not split.gap
    halves = split_pictures(films(range(0, 900, 30), range(0, 900, 30)), 0.2)  # half of the labels is too much
    assert "blocks of time" in halves.rule


def test_too_few_pictures():
    with pytest.raises(InputError, match="--holdout 0"):
        split_pictures(films([5]), 0.2)
    assert split_pictures(films([5]), 0).training == [0]
