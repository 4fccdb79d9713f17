"""`jaxfit calibrate` from end to end: the table, the config, and the input that it rejects."""

import json

import numpy as np
import pytest
from support.cli_files import rejected
from support.noisy_discs import BIRDS, RADIUS, K, detected, labelled, student_t

from jaxfit.cli.main import main
from jaxfit.config.fit import load_config
from jaxfit.config.reconstruct import load_reconstruct_config
from jaxfit.data.formats.coco import write_coco
from jaxfit.evaluation import detection_noise


@pytest.fixture(autouse=True)
def _few_resamples(monkeypatch):
    monkeypatch.setattr(detection_noise, "RESAMPLES", 5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Detections of ten frames and labels of two of them, with and without masks."""
    folder, rng = tmp_path_factory.mktemp("discs"), np.random.default_rng(0)
    shape = BIRDS, 10, K
    found = detected(range(10), student_t(rng, shape, 4), rng.uniform(0.1, 1, shape), RADIUS - 2)
    write_coco(found, folder / "birds.json")
    write_coco(labelled([2, 7]), folder / "labels.json")
    write_coco(labelled([2, 7], masks=False), folder / "points.json")
    return folder


def command(folder, out, labels="labels.json", *more):
    return ["calibrate", str(folder / "birds.json"), "--truth", str(folder / labels), "--out", str(out), *more]


def test_the_config_of_a_fit(folder, tmp_path, capsys):
    out = tmp_path / "new" / "noise.yaml"
    assert main(command(folder, out)) == 0
    printed = capsys.readouterr().out
    for words in (
        "terms.keypoint_likelihood.dof",
        "terms.mask_smooth_l1",
        "2 frames, 6 birds, 240 keypoints, 12 masks",
    ):
        assert words in printed
    config = load_config(out)
    assert config.terms["mask_smooth_l1"] != load_config("map").terms["mask_smooth_l1"]
    assert not config.learn_weights
    (tmp_path / "mine.yaml").write_text(f"base: reconstruct\nfit: {out}\n")
    assert load_reconstruct_config(tmp_path / "mine.yaml").fit == config
    rejected(capsys, command(folder, out), str(out), "exists already", "--overwrite")
    assert main(command(folder, out, "labels.json", "--overwrite")) == 0


def test_labels_without_masks(folder, tmp_path, capsys):
    assert main(command(folder, tmp_path / "noise.yaml", "points.json")) == 0
    assert "the config leaves out mask_smooth_l1" in capsys.readouterr().out
    config, base = load_config(tmp_path / "noise.yaml"), load_config("map")
    assert config.terms["mask_smooth_l1"] == base.terms["mask_smooth_l1"]


def test_labels_with_other_names(folder, tmp_path, capsys):
    """A map of the names of the labels; keypoints that the labels lack do not count."""
    content = json.loads((folder / "labels.json").read_text())
    content["categories"][0]["keypoints"][0] = "knee"
    (tmp_path / "labels.json").write_text(json.dumps(content))
    names = {name: name for name in content["categories"][0]["keypoints"][1:]}
    (tmp_path / "map.yaml").write_text(json.dumps(names | {"knee": None}))
    more = ["--names", str(tmp_path / "map.yaml")]
    assert main(command(folder, tmp_path / "noise.yaml", tmp_path / "labels.json", *more)) == 0
    assert f"{12 * (K - 1)} keypoints" in capsys.readouterr().out


def test_unusable_input(folder, tmp_path, capsys):
    out = tmp_path / "noise.yaml"
    write_coco(labelled([90]), tmp_path / "late.json")
    write_coco(labelled([2]).select(tracks=[0]), tmp_path / "few.json")
    rejected(capsys, command(folder, out, tmp_path / "late.json"), "late.json", "shares no frame")
    rejected(capsys, command(folder, out, tmp_path / "few.json"), "few.json", "labels 20 of", "label more frames")
    rejected(capsys, command(folder, out, "absent.json"), "absent.json")
    rejected(capsys, ["calibrate", str(folder / "no.json"), *command(folder, out)[2:]], "no.json")
    rejected(capsys, command(folder, folder), "is a folder")
    rejected(capsys, command(folder, out, "labels.json", "--size", "3"), "--size")
    assert not out.exists()
