"""The commands for simulated scenes from end to end."""

import json
import re

import cv2
import numpy as np
import pytest
from support.cli_files import rejected

from jaxfit import Observations, load_reconstruct_config, pipeline, read_coco
from jaxfit.cli import demo
from jaxfit.cli.main import main
from jaxfit.model.anatomy import MURRE_KEYPOINTS
from jaxfit.perception import track
from jaxfit.perception.network import instance_of
from jaxfit.video.reader import probe_video

SMALL = ["--birds", "2", "--frames", "5", "--size", "480x280"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "scene"
    assert main(["simulate", *SMALL, "--out", str(folder)]) == 0
    return folder


def test_a_scene_evaluated_against_its_own_truth(scene, tmp_path, capsys):
    assert main(["evaluate", str(scene / "truth"), "--truth", str(scene), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["me_p"] == 0
    assert result["mpjpe"] < 1e-4
    assert result["frames_3d"] == 10
    assert main(["evaluate", str(scene / "truth"), "--truth", str(scene)]) == 0
    tables = capsys.readouterr().out
    for heading in ("me_v", "MPJPE", "PA-MPJPE", "orient. °", "size %", "bone lengths 0.0 %"):
        assert heading in tables
    assert [line.split()[1] for line in tables.splitlines() if " from " in line or " to " in line][:2] == ["from", "to"]
    assert "stand" not in tables
    assert "no metrics in space" not in tables
    assert main(["evaluate", str(scene / "truth"), "--truth", str(scene / "truth.json")]) == 0
    line = f"no metrics in space: the true poses are in {scene / 'truth'}: give --truth {scene}\n"
    assert line in capsys.readouterr().out
    (tmp_path / "truth.json").write_bytes((scene / "truth.json").read_bytes())
    assert main(["evaluate", str(scene / "truth"), "--truth", str(tmp_path / "truth.json")]) == 0
    assert "there is no folder truth with the true poses beside" in capsys.readouterr().out
    assert result["intervals"]["me_p"] == [0, 0]
    assert sum(row["frames"] for row in result["behaviours"].values()) == result["frames"]


def test_metrics_by_behaviour_and_keypoint(scene, capsys):
    command = ["evaluate", str(scene / "truth"), "--truth", str(scene), "--by"]
    assert main([*command, "keypoint"]) == 0
    tables = capsys.readouterr().out
    assert all(name in tables for name in MURRE_KEYPOINTS)
    assert main([*command, "behaviour"]) == 0
    assert "stand" in capsys.readouterr().out
    command[3] = str(scene / "truth.json")
    rejected(capsys, [*command, "behaviour"], "truth.json", "holds no behaviours of the birds", "--by behaviour")
    command[1] = str(scene / "detections.json")
    rejected(capsys, [*command, "behaviour"], "detections.json", "holds observations")


def test_an_overlay_of_the_truth(scene, tmp_path, capsys):
    out = tmp_path / "overlay.mp4"
    command = ["overlay", str(scene / "truth"), "--video", str(scene / "footage.mp4"), "--out", str(out)]
    assert main([*command, "--side-views", "--observations", str(scene / "detections.json")]) == 0
    assert probe_video(out).frames == 5
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out.replace("\n", "")
    rejected(capsys, command, "overlay.mp4", "exists already", "--overwrite")
    assert main([*command, "--overwrite"]) == 0
    assert str(out) in said
    assert str(out.with_suffix(".png")) in said


def test_one_frame_of_the_overlay(scene, tmp_path, capsys):
    out = tmp_path / "frame.png"
    command = ["overlay", str(scene / "truth"), "--video", str(scene / "footage.mp4"), "--out", str(out), "--frame"]
    assert main([*command, "3"]) == 0
    picture = cv2.imread(str(out))
    assert picture.shape[1] == 480
    rejected(capsys, [*command, "3"], "frame.png", "--overwrite")
    rejected(capsys, [*command, "5", "--overwrite"], "no frame 5")
    command[command.index(str(out))] = str(tmp_path / "frame.tiff")
    rejected(capsys, [*command, "3"], "frame.tiff", ".png")


def test_a_scene_is_overwritten_only_on_request(scene, tmp_path, capsys):
    before = (scene / "truth.json").read_bytes()
    rejected(capsys, ["simulate", *SMALL, "--seed", "8", "--out", str(scene)], "overwrite", alone=False)
    assert (scene / "truth.json").read_bytes() == before
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").write_text("precious")
    rejected(capsys, ["simulate", *SMALL, "--out", str(tmp_path / "thesis"), "--overwrite"], "thesis", alone=False)


class TruthOfTheScene:
    """Replaces both networks by the truth of a demo's scene, frame after frame."""

    class_names, keypoint_names = ("bird",), MURRE_KEYPOINTS

    def __init__(self, folder):
        self.truth, self.t = folder / "scene" / "truth.json", -1
        self.found = {}  # of all frames: a thread segments the next frame while the keypoints of a frame are detected

    def __call__(self, frame, instances=None):
        if instances is None:
            self.truth = self.truth if isinstance(self.truth, Observations) else read_coco(self.truth)
            self.t += 1
            masks = {n: self.truth.mask(n, self.t) for n in range(self.truth.num_tracks)}
            new = {(n, self.t): instance_of(mask, 0.9, "bird") for n, mask in masks.items() if mask is not None}
            self.found |= new
            return list(new.values())
        at = [next(at for at, bird in self.found.items() if bird is instance) for instance in instances]
        rows, columns = np.array(at, int).reshape(-1, 2).T
        return self.truth.keypoints_px[rows, columns], self.truth.confidence[rows, columns]


@pytest.mark.extended
def test_the_demo_writes_the_files_that_it_names(tmp_path, monkeypatch, capsys):
    (tmp_path / "quick.yaml").write_text(
        "base: reconstruct\ntrack: {min_track_frames: 2}\nfit:\n  base: paper\n  window: 5\n  stages:\n"
        "    - {name: only, steps: 200, terms: [keypoints, pose_prior], step_scale: {transl: [1, 1, 0]}}\n"
    )

    def open_one(_):
        opened.append(TruthOfTheScene(tmp_path / "demo"))
        return opened[-1]

    opened = []
    monkeypatch.setattr(demo, "load_reconstruct_config", lambda: load_reconstruct_config(tmp_path / "quick.yaml"))
    monkeypatch.setattr(pipeline, "open_keypoint_detector", open_one)
    monkeypatch.setattr(track, "open_segmenter", lambda _: opened[-1])
    monkeypatch.setattr(pipeline, "check_segmenter", lambda _: None)
    monkeypatch.setattr(pipeline, "network_files", lambda _: {})
    monkeypatch.setattr(demo, "BIRDS", 2)
    monkeypatch.setattr(demo, "FRAMES", 5)
    monkeypatch.setattr(demo, "SIZE", (480, 280))
    said = []
    for options in ([], ["--verbose"]):  # a second demo replaces the first
        assert main(["demo", "--out", str(tmp_path / "demo"), *options]) == 0
        said.append(capsys.readouterr().out)
    for name in ("result/overlay.mp4", "result/overlay.png", "result", "scene", "evaluation.json", "birds.glb"):
        assert (tmp_path / "demo" / name).exists()
    lines = said[0].splitlines()
    assert len(lines) == 10
    assert max(map(len, lines[:5])) <= 110
    assert lines[1] == "tracks: 2 for 2 birds over 5 frames, identities exchanged 0 times, trust is high"
    assert lines[2].startswith(
        "detections: 100 % of the birds in all frames, 100 % are right, mean IoU of the masks 1.00"
    )
    assert re.match(r"poses: joints \d+\.\d % of the body length from the truth, worst track \d \(", lines[4])
    for name, line in zip(("result/report.html", "result/overlay.mp4", "birds.glb"), lines[6:9], strict=True):
        assert line.startswith(f"  {tmp_path / 'demo' / name}: ")
    page = (tmp_path / "demo" / "result" / "report.html").read_text()
    for metric in ("PA-MPJPE", "HOTA", "AP50-95", "bill_tip", "me_v", "renamed to the ids of the truth"):
        assert metric in page
        assert metric in said[1]
        assert metric not in said[0]
    metrics = json.loads((tmp_path / "demo" / "evaluation.json").read_text())
    assert metrics["mpjpe"] > 0
    assert metrics["detection"]["mean_iou"] == 1
    assert metrics["tracking"]["idf1"] == 1
