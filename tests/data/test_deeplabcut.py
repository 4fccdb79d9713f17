"""Files of DeepLabCut and Lightning Pose: predictions and labels, `.csv` and `.h5`; nothing is unpickled."""

import os
import pickle

import cv2
import numpy as np
import pytest
from support.tracking_files import LIKELIHOOD, NAMES, XY, T, write_csv, write_fixed, write_table

from jaxfit.data.formats.recognise import read_observations
from jaxfit.foundation.errors import InputError

SIZE = (120, 100)
PICTURES = [f"labeled-data/clip/img{i:03d}.png" for i in (30, 7, 8, 11)]


def check_predictions(observed, birds):
    assert observed.keypoint_names == NAMES
    assert observed.track_id.tolist() == list(range(1, birds + 1))
    assert observed.frame_index.tolist() == list(range(T))
    np.testing.assert_allclose(observed.keypoints_px, XY[:birds], atol=1e-5)
    np.testing.assert_allclose(observed.confidence, LIKELIHOOD[:birds], atol=1e-6)
    assert observed.present.all()
    np.testing.assert_allclose(observed.box_px[..., :2], XY[:birds].min(2), atol=1e-4)


@pytest.mark.parametrize("birds", [("",), ("b1", "b2")])
def test_predictions_of_one_and_several_animals(tmp_path, birds):
    for path in (write_csv(tmp_path / "a.csv", birds), write_table(tmp_path / "a.h5", birds)):
        check_predictions(read_observations(path, size_px=SIZE), len(birds))


def test_labels_take_frame_numbers_and_sizes_from_their_pictures(tmp_path):
    folder = tmp_path / "labeled-data" / "clip"
    folder.mkdir(parents=True)
    for picture in PICTURES:
        cv2.imwrite(str(tmp_path / picture), np.zeros((100, 120), np.uint8))
    files = [
        write_csv(folder / "CollectedData_me.csv", coords=("x", "y"), rows=PICTURES),
        write_csv(folder / "new.csv", coords=("x", "y"), rows=PICTURES, index_cells=3),
        write_fixed(folder / "CollectedData_me.h5", PICTURES),
    ]
    for path in files:
        observed = read_observations(path)
        assert observed.frame_index.tolist() == [7, 8, 11, 30]
        assert observed.image_size_px.tolist() == [list(SIZE)] * T
        assert observed.file_name[0] == PICTURES[1]
        np.testing.assert_allclose(observed.keypoints_px[0], XY[0][[1, 2, 3, 0]], atol=1e-5)
        assert (observed.confidence == 1).all()


def test_pictures_of_several_videos_are_photographs(tmp_path):
    rows = ["a/img1.png", "b/img1.png", "b/img2.png", "c/x.png"]
    observed = read_observations(write_csv(tmp_path / "a.csv", ("b1", "b2"), ("x", "y"), rows), size_px=SIZE)
    assert observed.num_tracks == 2 * T
    assert observed.frame_index.tolist() == [0]
    assert observed.image_file(5, 0) == "b/img1.png"
    np.testing.assert_allclose(observed.keypoints_px[5, 0], XY[1, 1], atol=1e-5)


def test_columns_of_lightning_pose_and_the_scene_are_skipped(tmp_path):
    path = write_csv(tmp_path / "a.csv")
    lines = path.read_text().splitlines()
    for i, extra in enumerate(["net,set", "beak,", "x_ens_var,", *["0.5,train"] * T]):
        lines[i] += "," + extra
    path.write_text("\n".join(["", *lines[:3], "level_0" + "," * 11, *lines[3:], ""]))
    check_predictions(read_observations(path, size_px=SIZE), 1)
    scene = write_csv(tmp_path / "b.csv", ("b1", "b2"))
    scene.write_text(scene.read_text().replace("b2", "single"))
    check_predictions(read_observations(scene, size_px=SIZE), 1)


def test_missing_keypoints(tmp_path):
    path = write_csv(tmp_path / "a.csv", coords=("x", "y"))
    lines = path.read_text().splitlines()
    lines[3] = "0,,,nan,5,7,"
    lines[4] = "1,1,2,,,,"
    path.write_text("\n".join(lines))
    observed = read_observations(path, size_px=SIZE)
    assert observed.present[0].tolist() == [False, True, True, True]
    assert observed.confidence[0, 1].tolist() == [1, 0, 0]
    assert observed.box_px[0, 1].tolist() == [0.5, 1.5, 1, 1]


def test_a_pickled_attribute_is_never_run(tmp_path):
    class Hostile:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'run'}",)

    for protocol in (0, 2, 4):
        path = write_table(tmp_path / "a.h5", names=pickle.dumps(Hostile(), protocol))
        with pytest.raises(InputError, match=r"pickled names of columns call .*system, so that they are not read"):
            read_observations(path, size_px=SIZE)
    assert not (tmp_path / "run").exists()


def without_scorer(text):
    return text.split("\n", 1)[1]


BAD_CSV = {
    "no scorer row": (without_scorer, "has no scorer row: its first line begins with 'bodyparts'"),
    "empty": (lambda text: "", "has no scorer row: its first line begins with ''"),
    "no coords": (lambda text: text.replace("coords", "0", 1), "begins with the rows scorer, bodyparts, not with"),
    "text": (lambda text: text.replace("\n1,", "\n1,a", 1), "line 5: could not convert string to float: 'a"),
    "cut": (lambda text: text[:-30], r"line 7 has \d cells, not 10 .*may end midway"),
    "twice": (lambda text: text.replace("tailTip", "beak"), "holds the column x of beak twice"),
    "no y": (lambda text: text.replace(",y,", ",z,", 1), "has no column y of beak"),
    "mixed rows": (lambda text: text.replace("\n3,", "\nimg.png,"), "names its row 1 by a number, and row 4 otherwise"),
    "no rows": (lambda text: "\n".join(text.split("\n")[:3]), "holds no frames"),
    "position": (
        lambda text: text.replace("\n1,", "\n1,99999999", 1),
        "keypoints_px holds 1e.*, which is no position in an image",
    ),
    "space": (lambda text: text.replace("likelihood", "z"), "holds positions in space .*, not positions in an image"),
}


@pytest.mark.parametrize("case", BAD_CSV)
def test_bad_csv(tmp_path, case):
    change, message = BAD_CSV[case]
    path = write_csv(tmp_path / "a.csv")
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=message):
        read_observations(path, size_px=SIZE)


def test_likelihoods_of_another_scale(tmp_path):
    path = write_csv(tmp_path / "a.csv")
    path.write_text(path.read_text().replace(",0.", ",87."))
    with pytest.raises(InputError, match=r"holds a confidence of 87.*scale the scores"):
        read_observations(path, size_px=SIZE)
