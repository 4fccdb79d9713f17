"""Labels for CVAT, Label Studio, SLEAP and DeepLabCut: written, corrected as by a person, and read again."""

import csv
import json
import xml.etree.ElementTree as ElementTree

import cv2
import h5py
import numpy as np
import pytest
from support.label_files import FRAMES, KINDS, NAMES, SIZE, labelled_birds, write_label_file

from jaxfit.data.formats.cvat import write_cvat_label
from jaxfit.data.formats.recognise import read_observations
from jaxfit.foundation.errors import InputError

WITH_SCORES = ("coco", "label studio", "sleap")


def read(path):
    return read_observations(path, size_px=SIZE)


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_lost(tmp_path, kind):
    birds = labelled_birds()
    seen = read(write_label_file(kind, birds, tmp_path))
    assert seen.keypoint_names == NAMES
    assert seen.frame_index.tolist() == list(FRAMES)
    assert seen.track_id.tolist() == ([4, 7, 9] if kind in ("coco", "cvat") else [1, 2, 3])
    np.testing.assert_array_equal(seen.present, birds.present)
    np.testing.assert_array_equal(seen.keypoints_px, birds.keypoints_px)
    np.testing.assert_array_equal(seen.confidence > 0, birds.confidence > 0)
    np.testing.assert_array_equal(seen.image_size_px, birds.image_size_px)
    if kind in WITH_SCORES:
        np.testing.assert_array_equal(seen.confidence, birds.confidence)
        np.testing.assert_array_equal(seen.score, birds.score)
    else:
        assert set(np.unique(seen.confidence)) == {0, 1}
    if kind in ("coco", "cvat"):
        np.testing.assert_array_equal(seen.occluded, birds.occluded)
        np.testing.assert_array_equal(seen.box_px, birds.box_px)
    if kind in ("coco", "cvat", "sleap"):
        assert seen.skeleton == birds.skeleton


def correct_cvat(path):
    """Move a keypoint of bird 4, remove a keypoint, and add a bird without a number, as CVAT exports them."""
    content = json.loads(path.read_text())
    content["annotations"][0]["keypoints"][:6] = [11.25, 12.5, 2, 0, 0, 0]
    new = {"attributes": {"bird": "", "occluded": False}, "keypoints": [1.5, 2, 2, 3, 4, 2, 5, 6, 2]}
    content["annotations"].append(content["annotations"][-1] | {"id": 90, "image_id": 4} | new)
    path.write_text(json.dumps(content))


def correct_label_studio(path):
    """Correct a prediction into an annotation. A new bird has no track, and its keypoints have no parents."""
    tasks = json.loads(path.read_text())
    for task in tasks:
        task["annotations"] = [{"id": 1, "was_cancelled": False, "result": task.pop("predictions")[0]["result"]}]
    result = tasks[0]["annotations"][0]["result"]
    result[1]["value"] |= {"x": 1125 / SIZE[0], "y": 1250 / SIZE[1]}
    del result[2]
    shape = {"to_name": "image", "original_width": SIZE[0], "original_height": SIZE[1]}
    box = {"x": 0, "y": 0, "width": 50, "height": 50, "rectanglelabels": ["bird"]}
    new = [shape | {"id": "new", "type": "rectanglelabels", "value": box}]
    for k, name in enumerate(NAMES):
        value = {"x": (1.5 + 2 * k - 0.5 * (k > 0)) * 100 / SIZE[0], "y": (2 + 2 * k) * 100 / SIZE[1]}
        new.append(shape | {"id": f"p{k}", "type": "keypointlabels", "value": value | {"keypointlabels": [name]}})
    tasks[3]["annotations"][0]["result"] = new
    path.write_text(json.dumps(tasks))


def correct_sleap(path):
    """Turn a prediction into a label, and add a label without a track."""
    with h5py.File(path, "a") as file:
        instances, frames = file["instances"][()], file["frames"][()]
        points = np.zeros(6, file["points"].dtype)
        points["x"], points["y"] = [11.25, np.nan, 0, 1.5, 3, 5], [12.5, np.nan, 0, 2, 4, 6]
        points["visible"] = [True, False, True, True, True, True]
        predicted = file["pred_points"][2]
        points["x"][2], points["y"][2] = predicted["x"], predicted["y"]
        label, new = instances[0].copy(), instances[0].copy()
        label["instance_id"], label["instance_type"], label["from_predicted"] = 90, 0, 0
        label["point_id_start"], label["point_id_end"] = 0, 3
        new["instance_id"], new["instance_type"], new["track"], new["frame_id"] = 91, 0, -1, 3
        new["point_id_start"], new["point_id_end"] = 3, 6
        first = frames["instance_id_end"][0]
        frames["instance_id_start"][1:] += 1
        frames["instance_id_end"] += 1
        frames["instance_id_end"][3] += 1
        instances = np.concatenate([instances[:first], [label], instances[first:], [new]])
        for name, table in (("points", points), ("instances", instances), ("frames", frames)):
            del file[name]
            file[name] = table


def correct_csv(path):
    """Correct the cells of bird 4, and add an individual."""
    rows = list(csv.reader(path.open()))
    rows[4][3:7] = ["11.25", "12.5", "", ""]
    for i, row in enumerate(rows):
        head = [["jaxfit"] * 6, ["new"] * 6, [name for name in NAMES for _ in "xy"], ["x", "y"] * 3]
        row += head[i] if i < 4 else ["1.5", "2", "3", "4", "5", "6"] if i == 7 else [""] * 6
    path.write_text("\n".join(",".join(row) for row in rows))


CORRECTIONS = {
    "cvat": correct_cvat,
    "label studio": correct_label_studio,
    "sleap": correct_sleap,
    "deeplabcut csv": correct_csv,
}


@pytest.mark.parametrize("kind", CORRECTIONS)
def test_corrections_come_back(tmp_path, kind):
    """A moved keypoint, a removed keypoint and a new bird are read; all other labels are as before."""
    birds = labelled_birds()
    path = write_label_file(kind, birds, tmp_path)
    CORRECTIONS[kind](path)
    seen = read(path)
    assert seen.num_tracks == 4
    np.testing.assert_allclose(seen.keypoints_px[0, 0, 0], [11.25, 12.5], rtol=1e-6)
    assert (seen.confidence[0, 0] > 0).tolist() == [True, False, True]
    assert seen.confidence[0, 0, 0] == 1
    np.testing.assert_allclose(seen.keypoints_px[3, 3], [[1.5, 2], [3, 4], [5, 6]], rtol=1e-6)
    assert seen.present[3].tolist() == [False, False, False, True]
    np.testing.assert_array_equal(seen.keypoints_px[:3, 1:], birds.keypoints_px[:, 1:])
    np.testing.assert_array_equal(seen.keypoints_px[1:3, 0], birds.keypoints_px[1:, 0])


def test_the_table_of_deeplabcut_has_the_layout_of_pandas(tmp_path):
    """Levels, codes and values give the columns of the CSV; no attribute is a pickle."""
    write_label_file("deeplabcut h5", labelled_birds(), tmp_path)
    rows = list(csv.reader((tmp_path / "CollectedData_jaxfit.csv").open()))
    with h5py.File(tmp_path / "CollectedData_jaxfit.h5") as file:
        table = file["df_with_missing"]
        for axis in ("axis0", "block0_items"):
            levels = [table[f"{axis}_level{i}"][()][table[f"{axis}_label{i}"][()]] for i in range(4)]
            assert [[text.decode() for text in level] for level in levels] == [row[3:] for row in rows[:4]]
        values = [[float(cell) if cell else np.nan for cell in row[3:]] for row in rows[4:]]
        np.testing.assert_array_equal(table["block0_values"][()], values)
        assert table.attrs["pandas_type"] == b"frame"


def test_the_label_of_cvat(tmp_path):
    """Every keypoint is a part of the skeleton, and every edge connects two nodes of the drawing."""
    write_cvat_label(labelled_birds(), tmp_path / "label.json")
    (label,) = json.loads((tmp_path / "label.json").read_text())
    assert [part["name"] for part in label["sublabels"]] == list(NAMES)
    drawing = ElementTree.fromstring(f"<svg>{label['svg']}</svg>")
    nodes = {node.get("data-node-id"): node for node in drawing.iter("circle")}
    assert [node.get("data-label-name") for node in nodes.values()] == list(NAMES)
    assert all(0 <= float(node.get(c)) <= 100 for node in nodes.values() for c in ("cx", "cy"))
    assert [(line.get("data-node-from"), line.get("data-node-to")) for line in drawing.iter("line")] == [
        ("1", "2"),
        ("1", "3"),
    ]


def change_task(change):
    def changed(tmp_path):
        path = write_label_file("label studio", labelled_birds(), tmp_path)
        tasks = json.loads(path.read_text())
        change(tasks)
        path.write_text(json.dumps(tasks))
        return path

    return changed


def result(tasks):
    return tasks[0]["predictions"][0]["result"]


BAD = {
    "no task": (lambda tasks: tasks.clear(), "holds no bird"),
    "no data": (lambda tasks: tasks[0].pop("data"), "is not a file of Label Studio that can be read: KeyError: 'data'"),
    "twice": (lambda tasks: result(tasks).append(result(tasks)[1]), "bill_tip of a bird in .*3.png is labelled twice"),
    "track twice": (lambda tasks: result(tasks)[4]["meta"].update(text="track 4"), "holds track 4 twice"),
    "size": (lambda tasks: result(tasks)[0].update(original_width=91), "is 90 pixels wide, but a label says 91"),
    "sizes": (lambda tasks: tasks[3]["data"].update(width=91), "pictures of several sizes"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_tasks(tmp_path, case):
    with pytest.raises(InputError, match=BAD[case][1]):
        read(change_task(BAD[case][0])(tmp_path))


def test_pictures_of_another_size(tmp_path):
    path = write_label_file("sleap", labelled_birds(), tmp_path)
    (tmp_path / "images").mkdir()
    for picture in labelled_birds().file_name:
        cv2.imwrite(str(tmp_path / "images" / picture), np.zeros((60, 80, 3), np.uint8))
    with pytest.raises(InputError, match="says 90×70, but a picture has 80×60"):
        read_observations(path)


def test_a_sleap_frame_outside_the_list_of_pictures(tmp_path):
    path = write_label_file("sleap", labelled_birds(), tmp_path)
    with h5py.File(path, "a") as file:
        frames = file["frames"][()]
        frames["frame_idx"][3] = 4
        file["frames"][...] = frames
    with pytest.raises(InputError, match="has frame 4, but its video is a list of 4 pictures"):
        read(path)


def test_labels_without_birds(tmp_path):
    """The files of a video without birds have the names of the keypoints, or are rejected when they are read."""
    empty = labelled_birds().select(tracks=[])
    for kind in KINDS:
        path = write_label_file(kind, empty, tmp_path)
        if kind in ("coco", "cvat", "deeplabcut csv", "deeplabcut h5"):
            assert read(path).num_tracks == 0
            assert read(path).keypoint_names == NAMES
        else:
            with pytest.raises(InputError):
                read(path)


def test_key_points_without_rectangles_are_one_bird_a_picture(tmp_path):
    def without_rectangles(tasks):
        for task in tasks:
            prediction = task["predictions"][0]
            parts = [part for part in prediction["result"] if part.get("parentID") == prediction["result"][0]["id"]]
            prediction["result"] = parts
            for part in parts:
                del part["parentID"]

    path = change_task(lambda tasks: (tasks.pop(), without_rectangles(tasks)))(tmp_path)
    seen = read(path)
    assert seen.present.sum(0).tolist() == [1, 1, 1]
