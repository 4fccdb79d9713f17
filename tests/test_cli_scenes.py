"""The commands around simulated scenes, from end to end."""

import json
from pathlib import Path

import cv2
import pytest
from cli_files import refused

from jaxfit import demo, load_config
from jaxfit.cli import main
from jaxfit.frames import probe_video

pytestmark = pytest.mark.usefixtures("own_cache")
SMALL = ["--birds", "2", "--frames", "5", "--size", "480x280"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "scene"
    assert main(["simulate", *SMALL, "--out", str(folder)]) == 0
    return folder


def test_a_scene_measured_against_itself(scene, capsys):
    assert main(["evaluate", str(scene / "truth"), "--truth", str(scene), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["me_p"] == 0
    assert result["mpjpe"] < 1e-4
    assert result["frames_3d"] == 10
    assert main(["evaluate", str(scene / "truth"), "--truth", str(scene)]) == 0
    tables = capsys.readouterr().out
    for heading in ("me_v", "MPJPE", "PA-MPJPE", "orient. °", "size %"):
        assert heading in tables


def test_an_overlay_of_the_truth(scene, tmp_path, capsys):
    out = tmp_path / "overlay.mp4"
    command = ["overlay", str(scene / "truth"), "--video", str(scene / "footage.mp4"), "--out", str(out)]
    assert main([*command, "--side-views", "--observations", str(scene / "detections.json")]) == 0
    assert probe_video(out).frames == 5
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out.replace("\n", "")
    refused(capsys, command, "overlay.mp4", "exists already", "--overwrite")
    assert main([*command, "--overwrite"]) == 0
    assert str(out) in said
    assert str(out.with_suffix(".png")) in said


def test_a_frame_of_the_overlay(scene, tmp_path, capsys):
    out = tmp_path / "frame.png"
    command = ["overlay", str(scene / "truth"), "--video", str(scene / "footage.mp4"), "--out", str(out), "--frame"]
    assert main([*command, "3"]) == 0
    picture = cv2.imread(str(out))
    assert picture.shape[1] == 480
    refused(capsys, [*command, "3"], "frame.png", "--overwrite")
    refused(capsys, [*command, "5", "--overwrite"], "no frame 5")
    command[command.index(str(out))] = str(tmp_path / "frame.tiff")
    refused(capsys, [*command, "3"], "frame.tiff", ".png")


def test_overlays_that_cannot_be_drawn(scene, tmp_path, capsys):
    def command(video: Path) -> list[str]:
        return ["overlay", str(scene / "truth"), "--video", str(video), "--out", str(tmp_path / "o.mp4")]

    refused(capsys, command(tmp_path / "none.mp4"), "none.mp4", alone=False)
    refused(capsys, command(scene / "truth.json"), "truth.json", alone=False)
    assert main(["simulate", *SMALL[:2], "--frames", "3", "--size", "480x280", "--out", str(tmp_path / "short")]) == 0
    refused(capsys, command(tmp_path / "short" / "footage.mp4"), "footage.mp4", alone=False)
    assert not (tmp_path / "o.mp4").exists()


def test_a_scene_is_not_overwritten_unasked(scene, tmp_path, capsys):
    before = (scene / "truth.json").read_bytes()
    refused(capsys, ["simulate", *SMALL, "--seed", "8", "--out", str(scene)], "overwrite", alone=False)
    assert (scene / "truth.json").read_bytes() == before
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").write_text("precious")
    refused(capsys, ["simulate", *SMALL, "--out", str(tmp_path / "thesis"), "--overwrite"], "thesis", alone=False)


@pytest.mark.parametrize(
    ("option", "value", "word"),
    [("--birds", "0", "birds"), ("--size", "wide", "size"), ("--size", "12x8", "size"), ("--seed", "-3", "seed")],
)
def test_scenes_that_make_no_sense(option, value, word, tmp_path, capsys):
    refused(capsys, ["simulate", "--out", str(tmp_path / "s"), option, value], word)
    assert not (tmp_path / "s").exists()


def test_the_murre_has_six_sides(tmp_path, capsys):
    out = tmp_path / "views.png"
    assert main(["model", "view", "murre", "--posture", "standing", "--out", str(out)]) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    refused(capsys, ["model", "view", "murre", "--posture", "dancing", "--out", str(out)], "dancing", "standing")
    assert main(["model", "info", "murre"]) == 0


def test_the_demo_leaves_other_folders_alone(tmp_path, capsys):
    (tmp_path / "overlay.mp4").write_text("precious")
    refused(capsys, ["demo", "--out", str(tmp_path)], "no earlier demo")
    refused(capsys, ["demo", "--out", str(tmp_path / "overlay.mp4")], "is a file")
    assert [path.name for path in tmp_path.iterdir() if path.name != "cache"] == ["overlay.mp4"]


def test_one_bird_is_singular(tmp_path, capsys):
    size = ["--size", "480x280"]
    assert main(["simulate", "--birds", "1", "--frames", "2", *size, "--out", str(tmp_path / "one")]) == 0
    assert "1 bird over 2 frames: " in capsys.readouterr().out


def test_the_demo_leaves_what_it_names(tmp_path, monkeypatch, capsys):
    (tmp_path / "quick.yaml").write_text(
        "base: paper\nstages:\n"
        "  - {name: only, steps: 30, terms: [keypoints, pose_prior], step_scale: {transl: [1, 1, 0]}}\n"
    )
    monkeypatch.setattr(demo, "load_config", lambda _: load_config(str(tmp_path / "quick.yaml")))
    monkeypatch.setattr(demo, "BIRDS", 2)
    monkeypatch.setattr(demo, "FRAMES", 5)
    monkeypatch.setattr(demo, "SIZE", (480, 280))
    for _ in range(2):  # a second demo replaces the first
        assert main(["demo", "--out", str(tmp_path / "demo")]) == 0
    said = capsys.readouterr().out.replace("\n", "")
    for name in ("overlay.mp4", "overlay.png", "result", "scene"):
        assert (tmp_path / "demo" / name).exists()
        assert str(tmp_path / "demo" / name) in said
    assert "PA-MPJPE" in said
    metrics = json.loads((tmp_path / "demo" / "result" / "summary.json").read_text())["metrics"]
    assert metrics["mpjpe"] > 0
