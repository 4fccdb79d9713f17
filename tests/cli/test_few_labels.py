"""`reconstruct --labels --masks` from end to end: labels of one bird in a few frames, masks of all birds."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.cli_files import rejected
from support.toy_footage import BIRD, BIRDS, FRAMES, QUICK, SIDE, Footage

from jaxfit import load_solution, pipeline, read_coco
from jaxfit.cli.main import main
from jaxfit.config.fit import load_config
from jaxfit.config.reconstruct import load_reconstruct_config
from jaxfit.model.files import find_bird

FOOTAGE, LABELLED = Footage(), (0, 5, 11)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    FOOTAGE.write_inputs(folder)
    (folder / "masks").mkdir()
    for t, masks in enumerate(FOOTAGE.masks):
        numbered = [mask.astype(np.uint8) * (n + 1) for n, mask in enumerate(masks)]
        cv2.imwrite(str(folder / "masks" / f"{t}.png"), np.concatenate(numbered, axis=1))
    write_labels(folder / "labels.csv", {t: FOOTAGE.keypoints_px[t, 1] for t in LABELLED})
    return folder


def write_labels(path, marked):
    """Write a table of DeepLabCut."""
    parts = [name for name in BIRD.keypoint_names for _ in "xy"]
    rows = [["scorer", *["me"] * len(parts)], ["bodyparts", *parts], ["coords", *"xy" * BIRD.num_keypoints]]
    rows += [[f"labeled-data/film/img{t:03d}.png", *map(str, points.ravel())] for t, points in marked.items()]
    path.write_text("\n".join(map(",".join, rows)) + "\n")


def command(inputs, out, labels="labels.csv"):
    options = {"--labels": labels, "--masks": "masks", "--model": "toy.npz", "--config": "quick.yaml"}
    given = [text for option, name in options.items() for text in (option, str(inputs / name))]
    return ["reconstruct", str(inputs / "frames"), *given, "--out", str(out)]


def test_a_few_labels_and_masks_become_poses(inputs, tmp_path, capsys):
    out = tmp_path / "result"
    assert main(command(inputs, out)) == 0
    frames = {"labels": 3, "flow": FRAMES - 3, "the outline alone": 0}
    assert "poses of track 2: 3 frames on labels; 9 frames on flow" in capsys.readouterr().out
    summary = json.loads((out / "summary.json").read_text())
    assert summary["labels"]["used"] == 3
    assert summary["pose_sources"]["2"] == frames
    assert summary["pose_sources"]["1"] == {"labels": 0, "flow": 0, "the outline alone": FRAMES}
    assert "poses of track 2" in (out / "report.html").read_text()
    seen = read_coco(out / "observations.json")
    assert np.flatnonzero(seen.keypoint_origin[1] == 1).tolist() == list(LABELLED)
    assert seen.num_tracks == BIRDS
    solution, _ = load_solution(out)
    assert solution.valid[1].all()
    error_px = np.linalg.norm(
        solution.keypoints.px[1, list(LABELLED)] - FOOTAGE.keypoints_px[list(LABELLED), 1], axis=-1
    )
    assert np.median(error_px) < 0.1 * SIDE


def test_masks_alone_become_poses(inputs, tmp_path, capsys):
    search = "  min_keypoints: 0\n  initialise: {method: so3, directions: 20, turns: 8}\n"
    (inputs / "outlines.yaml").write_text(QUICK.replace("  base: paper\n", "  base: paper\n" + search))
    given = ["--masks", str(inputs / "masks"), "--model", str(inputs / "toy.npz"), "--out", str(tmp_path / "result")]
    config = ["--config", str(inputs / "outlines.yaml")]
    assert main(["reconstruct", str(inputs / "frames"), *given, *config]) == 0
    assert f"poses of track 3: {FRAMES} frames on the outline alone" in capsys.readouterr().out
    solution, _ = load_solution(tmp_path / "result")
    assert solution.valid.all()
    centre = np.array([np.argwhere(mask).mean(0)[::-1] + 0.5 for mask in (masks[0] for masks in FOOTAGE.masks)])
    middle = solution.keypoints.px[0].mean(1)
    assert np.linalg.norm(middle - centre, axis=-1).max() < 0.2 * SIDE


def test_points_beside_those_of_the_model_are_learnt_from_labels_and_not_from_outlines(inputs, tmp_path, monkeypatch):
    asked = []

    def nothing(_model, config, *_others):
        asked.append(config.learn_weights)
        return {}, ()

    monkeypatch.setattr("jaxfit.fitting.fit.learn", nothing)
    config = load_reconstruct_config(inputs / "quick.yaml")
    others = replace(config.fit, learn_weights=load_config("few_labels").learn_weights)
    for labels in (inputs / "labels.csv", None):
        out = tmp_path / ("labels" if labels else "masks")
        given = {"labels": labels, "masks": inputs / "masks", "fit_of_others": others}
        pipeline.reconstruct(inputs / "frames", out, find_bird(inputs / "toy.npz"), config, **given)
        assert ("# no keypoint_offsets are learnt" in (out / "learnt.yaml").read_text()) == (labels is None)
    assert asked == [("keypoint_offsets",)]


def test_labels_of_another_film(inputs, tmp_path, capsys):
    write_labels(inputs / "late.csv", {FRAMES + 5: FOOTAGE.keypoints_px[0, 1]})
    rejected(capsys, command(inputs, tmp_path / "result", "late.csv"), "late.csv", alone=False)
    write_labels(inputs / "beside.csv", {3: FOOTAGE.keypoints_px[0, 1] * [1, 0] + [0, 1]})
    reason = "no label belongs to a tracked bird: frame 3: no mask covers"
    rejected(capsys, command(inputs, tmp_path / "result", "beside.csv"), reason, alone=False)
    assert not (tmp_path / "result").exists()
