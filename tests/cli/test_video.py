"""`track` and `reconstruct` from end to end, with replaced networks, and their unusable inputs."""

import json
import os
import shutil

import numpy as np
import pytest
from support.cli_files import rejected
from support.onnx_graphs import write_constant
from support.toy_footage import BIRD, BIRDS, FRAMES, SIDE, Footage, TrueKeypoints, TrueSegmenter

from jaxfit import load_reconstruct_config, load_solution, pipeline, read_coco
from jaxfit.cli.main import main
from jaxfit.data.footage import read_footage
from jaxfit.model.anatomy import MURRE_KEYPOINTS
from jaxfit.perception import track
from jaxfit.video.reader import probe_video

FOOTAGE = Footage()
EVERYONE = [(t, n) for t in range(FRAMES) for n in range(BIRDS)]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    FOOTAGE.write_inputs(folder)
    (folder / "notes.txt").write_text("no video")
    return folder


@pytest.fixture
def networks(monkeypatch):
    """Replace the networks of a config; return the list of (frame, bird) pairs that the segmenter misses."""
    missed = []
    monkeypatch.setattr(track, "open_segmenter", lambda *_: TrueSegmenter(FOOTAGE, missed))
    monkeypatch.setattr(pipeline, "check_segmenter", lambda _: None)
    for module in (track, pipeline):
        monkeypatch.setattr(module, "open_keypoint_detector", lambda _: TrueKeypoints(FOOTAGE))
        # the choice of the segmenter has tests of its own
        monkeypatch.setattr(module, "with_chosen_segmenter", lambda _, config, *__: (config, None))
    monkeypatch.setattr(pipeline, "network_files", lambda _: {})
    return missed


def command(inputs, name, out, *more):
    at = [str(inputs / "frames"), "--config", str(inputs / "quick.yaml"), "--out", str(out)]
    return [name, *at, *(["--model", str(inputs / "toy.npz")] if name == "reconstruct" else []), *more]


@pytest.mark.usefixtures("networks")
def test_track_writes_the_truth(inputs, tmp_path, capsys):
    out = tmp_path / "deep" / "obs.json"
    assert main(command(inputs, "track", out, "--start", "2", "--stop", "11", "--step", "2")) == 0
    found = read_coco(out)
    assert found.frame_index.tolist() == [2, 4, 6, 8, 10]
    assert found.present.all()
    columns = (found.keypoints_px[:, 0, 0, 0] // SIDE).astype(int)
    truth = np.moveaxis(FOOTAGE.keypoints_px, 1, 0)[columns][:, 2:11:2]
    np.testing.assert_array_equal(found.keypoints_px, truth.astype(np.float32))
    said = capsys.readouterr().out
    assert "3 tracks over 5 frames" in said.replace("\n", "")
    assert said.index("trust is high") < said.index("coverage")
    assert json.loads(out.read_text())["info"]["trust"] == "high"
    assert "bird" not in said
    for heading in ("track", "coverage", "confidence", "jitter"):
        assert heading in said


@pytest.mark.usefixtures("networks")
def test_a_folder_with_a_name_that_is_not_utf8(inputs, tmp_path):
    frames = tmp_path / os.fsdecode(b"\xc5land")
    shutil.copytree(inputs / "frames", frames)
    out = tmp_path / "obs.json"
    assert main(["track", str(frames), "--config", str(inputs / "quick.yaml"), "--out", str(out)]) == 0
    assert read_coco(out).file_name[0] == "\\udcc5land#0"


@pytest.mark.usefixtures("networks")
def test_track_replaces_a_file_only_on_request(inputs, tmp_path, capsys):
    out = tmp_path / "obs.json"
    out.write_text("precious")
    rejected(capsys, command(inputs, "track", out), "obs.json", "exists already", "--overwrite")
    rejected(capsys, command(inputs, "track", inputs / "frames" / "o.json"), "among the video's images")
    assert out.read_text() == "precious"
    assert main(command(inputs, "track", out, "--overwrite")) == 0
    assert read_coco(out).num_tracks == BIRDS


def test_short_tracks_are_reported(inputs, tmp_path, networks, capsys):
    networks += [(t, 2) for t in range(2, FRAMES)]
    assert main(command(inputs, "track", tmp_path / "obs.json")) == 0
    assert "1 track with fewer than 3 frames skipped: 1 (2)" in capsys.readouterr().out


def test_no_bird_at_all(inputs, tmp_path, networks, capsys):
    """Without a bird, `track` writes a valid file without tracks, says why, and fails as `reconstruct` does."""
    networks += EVERYONE
    out = tmp_path / "obs.json"
    assert main(command(inputs, "track", out)) == 2
    said, message = capsys.readouterr()
    message = message.splitlines()[-1]
    assert "no bird was detected in 12 frames" in message
    assert "look whether birds are visible in the film; if so, label frames (jaxfit suggest)" in message
    assert "--min-score" in message
    content = json.loads(out.read_text())
    assert (len(content["images"]), content["annotations"]) == (FRAMES, [])
    assert "0 tracks over 12 frames" in said.replace("\n", "")
    assert "trust is low: no bird was tracked" in said
    assert {**content["info"], "footage": None} == {
        "trust": "low",
        "trust_reasons": "no bird was tracked",
        "footage": None,
    }
    words = "no bird was detected in 12 frames", "--min-score"
    rejected(capsys, command(inputs, "reconstruct", tmp_path / "result"), *words, alone=False)
    assert not (tmp_path / "result").exists()


@pytest.mark.parametrize("name", ["track", "reconstruct"])
def test_only_low_scores_end_with_what_to_do_next(inputs, tmp_path, networks, capsys, caplog, name):
    """`track` and `reconstruct` give the same advice; its options exist, and the stored frames serve them."""
    assert main(command(inputs, name, tmp_path / "out", "--min-track-score", "0.95")) == 2
    said = capsys.readouterr()
    assert "trust is high" in said.out
    assert "3 tracks with low scores skipped (--min-track-score, --min-score)" in said.out
    others, last = caplog.messages, said.err.splitlines()[-1]
    assert "the highest of 3 tracks is 0.900 (lower --min-track-score, label frames (jaxfit suggest), " in last
    stored = [f"{tmp_path}/out.unfinished holds the frames for a lower --min-track-score or --min-track-frames"]
    assert [message.partition(";")[0] for message in others] == (stored if name == "reconstruct" else [])
    if name == "reconstruct":
        networks += EVERYONE  # the stored frames hold the birds
        again = command(inputs, name, tmp_path / "out", "--min-track-score", "0.92")
        rejected(capsys, again, "mean score of 0.92: the highest of 3 tracks is 0.900", alone=False)
    else:
        assert main(command(inputs, name, tmp_path / "out", "--min-track-score", "0.75", "--overwrite")) == 0


def test_low_trust_recommends_other_networks_before_lower_limits(inputs, tmp_path, networks, capsys):
    networks += [(t, n) for t, n in EVERYONE if t % 3 == n]
    assert main(command(inputs, "track", tmp_path / "obs.json", "--min-track-frames", "13")) == 2
    said = capsys.readouterr()
    assert said.out.startswith("trust is low: 3 of 3 tracks are too short")
    assert "jaxfit suggest" not in said.out.splitlines()[0]
    assert said.err.rstrip().endswith(
        "(label frames (jaxfit suggest), use other networks (--segmenter), or lower --min-track-frames)"
    )


@pytest.mark.extended
def test_a_reconstruction(inputs, tmp_path, networks, capsys):
    """All files exist and can be read; a short track is reported."""
    networks += [(t, 2) for t in range(2, FRAMES)]
    out = tmp_path / "result"
    assert main(command(inputs, "reconstruct", out, "--stop", "10", "--classes", "bird,duck")) == 0
    solution, bird = load_solution(out)
    found = read_coco(out / "observations.json")
    assert bird.keypoint_names == BIRD.keypoint_names
    assert (found.num_tracks, found.num_frames) == (2, 10)
    assert solution.valid.all()
    assert solution.track_id.tolist() == found.track_id.tolist()
    assert probe_video(out / "overlay.mp4").frames == 10
    assert (out / "overlay.png").read_bytes().startswith(b"\x89PNG")
    config = load_reconstruct_config(out / "config.yaml")
    assert config.track.frames.stop == 10
    assert config.track.segmenter.classes == ("bird", "duck")
    assert (config.track.min_track_frames, config.fit.window) == (3, 12)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["short_tracks"] == {"1": 2}
    assert (summary["trust"], summary["trust_reasons"]) == ("high", [])
    assert summary["trust_signals"]["tracks"] == 3
    assert set(summary["seconds"]) == {"load", "track", "fit", "overlay"}
    assert summary["quality"][str(found.track_id[0])]["coverage"] == 1
    assert summary["video"]["frames"] == FRAMES
    assert solution.footage == found.footage == read_footage(inputs / "frames", FRAMES)
    assert "onnxruntime" in summary["versions"]
    said = capsys.readouterr().out
    assert "1 track with fewer than 3 frames skipped" in said
    for name in ("overlay.mp4", "overlay.png", "observations.json", "poses.npz"):
        assert str(out / name) in said.replace("\n", "")
    again = command(inputs, "reconstruct", out)
    rejected(capsys, again, "holds results already", "--overwrite")
    assert main(["evaluate", str(out), "--truth", str(out / "observations.json")]) == 0


@pytest.mark.usefixtures("networks")
def test_an_interrupt_leaves_no_incomplete_result(inputs, tmp_path, monkeypatch, capsys):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "overlay", stopped)
    assert main(command(inputs, "reconstruct", tmp_path / "result")) == 130
    assert "no incomplete files" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir() if path.name != "cache"] == ["result.unfinished"]
    assert sorted(path.name for path in (tmp_path / "result.unfinished").iterdir()) == ["frames", "lock", "windows"]


@pytest.mark.usefixtures("networks")
def test_the_footage_is_not_replaced(inputs, capsys):
    rejected(capsys, command(inputs, "reconstruct", inputs, "--overwrite"), "holds the video", "another --out")
    assert (inputs / "frames" / "0.png").is_file()


class NamedKeypoints(TrueKeypoints):
    """The true keypoints under other names."""

    keypoint_names = (
        "Beak",
        "eyeL",
        "R_eye",
        "crown",
        "nape",
        "back",
        "chest",
        "tail",
        "wingL",
        "wingR",
        "knee",
        "spot",
    )


@pytest.mark.usefixtures("networks")
def test_keypoints_of_another_model(inputs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(NamedKeypoints, "keypoint_names", tuple("abcdefghijkl"))
    monkeypatch.setattr(pipeline, "open_keypoint_detector", lambda _: NamedKeypoints(FOOTAGE))
    rejected(capsys, command(inputs, "reconstruct", tmp_path / "result"), "keypoints lack bill_tip", "another model")
    assert not (tmp_path / "result").exists()


@pytest.mark.usefixtures("networks")
def test_keypoints_with_names_of_their_own(inputs, tmp_path, monkeypatch, capsys):
    """A network that `jaxfit train` trained on labels of DeepLabCut has the names of the labels."""
    for module in (track, pipeline):
        monkeypatch.setattr(module, "open_keypoint_detector", lambda _: NamedKeypoints(FOOTAGE))
    out = tmp_path / "result"
    assert main(command(inputs, "reconstruct", out, "--stop", "4")) == 0
    said = capsys.readouterr().out
    assert "Beak" in said
    assert "jaxfit fit --names" in said
    found = read_coco(out / "observations.json")
    assert found.keypoint_names == BIRD.keypoint_names
    columns = (found.keypoints_px[:, 0, 0, 0] // SIDE).astype(int)
    np.testing.assert_allclose(found.keypoints_px[:, 0, :10], FOOTAGE.keypoints_px[0, columns, :10], atol=0.01)
    assert (found.confidence[:, :, :10] > 0).all()
    assert not found.confidence[:, :, 10:].any()  # the feet: the network knows a knee and a spot instead
    assert json.loads((out / "summary.json").read_text())["keypoint_names"]["wingL"] == "left_wingtip"
    solution, _ = load_solution(out)
    assert solution.valid.all()


@pytest.mark.parametrize("name", ["track", "reconstruct"])
def test_unusable_networks_of_track_and_reconstruct(name, inputs, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"

    def expect(*words, more):
        rejected(capsys, [name, str(inputs / "frames"), "--out", str(out), *map(str, more)], *words)

    expect("notes.txt", "ONNX", more=["--keypoints", inputs / "notes.txt"])
    keypoints = TrueKeypoints(FOOTAGE)
    keypoints.keypoint_names = MURRE_KEYPOINTS
    for module in (track, pipeline):
        monkeypatch.setattr(module, "open_keypoint_detector", lambda _: keypoints)
    expect("notes.txt", "ONNX", more=["--segmenter", inputs / "notes.txt"])
    strange = write_constant(tmp_path / "strange.onnx", (1, 3, 8, 8), {"logits": np.zeros(9)})
    expect(
        "strange.onnx: has an unknown layout",
        "logits (1, 9)",
        "yolo",
        "docs/guide/networks.md",
        more=["--segmenter", strange],
    )
    layout = {"output0": np.zeros((116, 84)), "output1": np.zeros((32, 16, 16))}
    coco = write_constant(tmp_path / "coco.onnx", (1, 3, 64, 64), layout)
    expect("lacks duck", "its classes are person", more=["--segmenter", coco, "--classes", "bird,duck"])
    assert not out.exists()
