"""`jaxfit import`, and commands that read files of other tracking programs as they are."""

import json
import logging

import cv2
import h5py
import numpy as np
import pytest
from support.cli_files import BIRD, SIZE, arguments, rejected
from support.tracking_files import write_csv

from jaxfit.cli.main import _prepare_logging, main
from jaxfit.data.formats.coco import read_coco
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.solution import load_solution

OTHER = {
    "bill_tip": "beakTip",
    "left_eye": "eyeL",
    "right_eye": "eyeR",
    "nape": "back of head",
    "neck": "neck",
    "left_wingtip": "L_wing",
    "right_wingtip": "R_wing",
    "left_foot": "leftfoot",
    "right_foot": "rightfoot",
    "tail_tip": "tailEnd",
    "left_wrist": "carpal_l",
    "right_wrist": "carpal_r",
}


def write_as_csv(coco, path, names):
    """Write the birds of a COCO file as a CSV of DeepLabCut with other names of the keypoints."""
    observed = read_coco(coco)
    birds = [f"bird{track}" for track in observed.track_id]
    head = [("net", bird, name, c) for bird in birds for name in names for c in ("x", "y", "likelihood")]
    table = np.concatenate([observed.keypoints_px, observed.confidence[..., None]], -1)
    rows = table.transpose(1, 0, 2, 3).reshape(observed.num_frames, -1)
    levels = ("scorer", "individuals", "bodyparts", "coords")
    lines = [",".join([level, *(column[i] for column in head)]) for i, level in enumerate(levels)]
    lines += [",".join([str(t), *map(repr, row.tolist())]) for t, row in enumerate(rows)]
    path.write_text("\n".join(lines))
    return path


@pytest.fixture
def csv_file(inputs, tmp_path):
    names = [OTHER.get(name, name) for name in BIRD.keypoint_names]
    return write_as_csv(inputs / "birds.json", tmp_path / "birds.csv", names)


def test_import_writes_a_coco_file(inputs, tmp_path, csv_file, capsys, caplog):
    (tmp_path / "masks").mkdir()
    for t in range(3):
        cv2.imwrite(str(tmp_path / "masks" / f"{t}.png"), np.full((SIZE, SIZE), 255, np.uint8))
    out = tmp_path / "out.json"
    model = ["--model", str(inputs / "toy.npz"), "--size", f"{SIZE}x{SIZE}"]
    command = ["import", str(csv_file), "--out", str(out), *model]
    assert main([*command, "--masks", str(tmp_path / "masks")]) == 0
    printed = capsys.readouterr().out
    assert "bird4 = 1, bird7 = 2, bird9 = 3" in caplog.text
    assert "beakTip" in printed
    assert "3 tracks, 6 frames" in printed
    imported, original = read_coco(out), read_coco(inputs / "birds.json")
    assert imported.keypoint_names == BIRD.keypoint_names
    assert len(imported.masks) == 3  # one mask in each of three frames
    np.testing.assert_allclose(imported.keypoints_px, original.keypoints_px, atol=1e-4)
    np.testing.assert_allclose(imported.confidence, original.confidence, atol=1e-6)
    rejected(capsys, command, "exists already")
    rejected(capsys, [*command, "--overwrite", "--size", "64"], "--size: is 64")


def test_fit_takes_the_file_as_it_is(inputs, tmp_path, csv_file, capsys, caplog):
    """The poses are those from COCO with a longer stage; `evaluate` and `overlay` take the file too."""
    size = ["--size", f"{SIZE}x{SIZE}"]
    mask = "  - {name: outline, steps: 5, terms: [keypoints, mask]}\n"
    (tmp_path / "masks.yaml").write_text((inputs / "quick.yaml").read_text() + mask)
    assert main([*arguments(inputs, tmp_path / "other", obs=csv_file, config=tmp_path / "masks.yaml"), *size]) == 0
    assert "no masks, so these stages run without the terms that compare masks: outline" in caplog.text
    assert main(arguments(inputs, tmp_path / "coco")) == 0
    poses, _ = load_solution(tmp_path / "other")
    same, _ = load_solution(tmp_path / "coco")
    np.testing.assert_allclose(poses.keypoints.px[poses.valid], same.keypoints.px[same.valid], atol=0.05)
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "other"), "--truth", str(csv_file), *size, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] > 0
    assert main(["evaluate", str(csv_file), "--truth", str(inputs / "birds.json"), *size, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["detection"]["recall"] > 0.6  # the box of three keypoints is small
    (tmp_path / "film").mkdir()
    for t in range(6):
        cv2.imwrite(str(tmp_path / "film" / f"{t}.png"), np.zeros((SIZE, SIZE, 3), np.uint8))
    drawn = ["--video", str(tmp_path / "film"), "--frame", "2", "--out", str(tmp_path / "2.png")]
    assert main(["overlay", str(tmp_path / "other"), "--observations", str(csv_file), *drawn]) == 0
    assert (tmp_path / "2.png").exists()


def test_few_keypoints(inputs, tmp_path, csv_file, capsys):
    """A file with three known keypoints is fitted; a file with two is rejected."""
    for count, code in ((3, 0), (2, 2)):
        lines = [f"{OTHER.get(name, name)}: {name}" for name in BIRD.keypoint_names[:count]]
        (tmp_path / "map.yaml").write_text("\n".join(lines))
        fit = [*arguments(inputs, tmp_path / str(count), obs=csv_file), "--size", f"{SIZE}x{SIZE}"]
        assert main([*fit, "--names", str(tmp_path / "map.yaml")]) == code
    printed = capsys.readouterr()
    assert "min_keypoints is 3 instead of 4" in printed.out
    assert "has 2 keypoints of the model by name; a fit needs 3" in printed.err


def test_names_with_markup_and_no_known_name(inputs, tmp_path, capsys):
    names = [f"[/red]{i}" for i in range(len(BIRD.keypoint_names))]
    path = write_as_csv(inputs / "birds.json", tmp_path / "a.csv", names)
    command = ["import", str(path), "--out", str(tmp_path / "o.json"), "--size", "64x64"]
    model = ["--model", str(inputs / "toy.npz")]
    rejected(capsys, [*command, *model], "has no keypoint of the model by name", "--names", alone=False)
    path = write_as_csv(inputs / "birds.json", tmp_path / "b.csv", [BIRD.keypoint_names[0], *names[1:]])
    assert main(["import", str(path), *command[2:], *model]) == 0
    assert "[/red]1" in capsys.readouterr().out


def test_a_malicious_file_on_the_command_line(tmp_path, capsys):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_group("x").attrs["pandas_type"] = np.bytes_(b"frame_table")
        table = file["x"].create_dataset("table", data=np.zeros(2, [("index", "i8"), ("values_block_0", "f8", (3,))]))
        table.attrs["values_block_0_kind"] = np.bytes_(b"cos\nsystem\n(S'touch /tmp/never'\ntR.")
    command = ["import", str(tmp_path / "a.h5"), "--out", str(tmp_path / "o.json"), "--size", "64x64"]
    rejected(capsys, command, "its pickled names of columns call os.system, so that they are not read")


def test_one_line_says_what_was_read(tmp_path, monkeypatch, capsys):
    """Also without `--verbose`; other messages of this level are not shown."""
    monkeypatch.setattr(logging.root, "handlers", [])
    monkeypatch.setattr(logging.root, "level", logging.WARNING)
    _prepare_logging(verbose=False)
    read_observations(write_csv(tmp_path / "birds.csv"), size_px=(120, 100))
    logging.getLogger("jaxfit.other").info("something else")
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition("birds.csv: ")[2].partition(":")[0] for line in lines] == [
        "a CSV of DeepLabCut of an unknown film, 120×100"
    ]
