"""Unusable input of the command line: one line of explanation, exit code 2, no written files."""

import json
import os
import pickle

import numpy as np
import pytest
from support.cli_files import arguments, rejected

from jaxfit.cli.main import main
from jaxfit.config.fit import load_config, shipped_fit_configs
from jaxfit.config.reconstruct import load_reconstruct_config
from jaxfit.config.yaml_file import config_to_yaml


def first_annotation(**changes):
    def change(content):
        content["annotations"][0] |= changes
        return content

    return change


def keypoints_with(value):
    def change(content):
        content["annotations"][0]["keypoints"][0] = value
        return content

    return change


def renamed(content):
    names = content["categories"][0]["keypoints"]
    names[:] = [f"point {i}" for i in range(len(names))]
    return content


def doubled(content):
    content["annotations"].append(content["annotations"][0] | {"id": 999})
    return content


def other_size(content):
    content["images"][0]["width"] += 7
    return content


def nobody(content):
    for annotation in content["annotations"]:
        annotation["keypoint_scores"] = [0.0] * 12
    return content


BAD_OBSERVATIONS = {
    "malformed": (lambda content: "{'images': []}", ["JSON"]),
    "truncated": (lambda content: json.dumps(content)[:-200], ["JSON"]),
    "nan": (keypoints_with(float("nan")), ["annotations[0].keypoints", "nan"]),
    "infinite": (keypoints_with(float("inf")), ["annotations[0].keypoints", "inf"]),
    "score": (first_annotation(keypoint_scores=[1.5] * 12), ["keypoint_scores", "1.5"]),
    "count": (first_annotation(keypoints=[1, 2, 2]), ["keypoints", "3 numbers, not 36"]),
    "names": (renamed, ["has no keypoint of the model by name", "point 0", "--names"]),
    "mask size": (other_size, ["segmentation", "size"]),
    "duplicate": (doubled, ["track_id 4", "twice"]),
    "no usable frame": (nobody, ["no track has a frame"]),
}


@pytest.mark.parametrize("name", BAD_OBSERVATIONS)
def test_unusable_observations(inputs, tmp_path, capsys, name):
    change, words = BAD_OBSERVATIONS[name]
    content = change(json.loads((inputs / "birds.json").read_text()))
    path = tmp_path / "bad.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    rejected(capsys, arguments(inputs, tmp_path / "out", obs=path), str(path), *words)
    assert not (tmp_path / "out").exists()


class Evil:
    """An object that makes a folder when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


def test_unusable_models(inputs, tmp_path, capsys):
    whole = (inputs / "toy.npz").read_bytes()
    mark = tmp_path / "it ran"
    with np.load(inputs / "toy.npz") as arrays:
        kept = dict(arrays)
    np.savez(tmp_path / "newer.npz", **(kept | {"format_version": np.int32(99)}))
    np.savez(tmp_path / "objects.npz", **(kept | {"name": np.array([Evil(mark)], dtype=object)}))
    (tmp_path / "truncated.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "evil.npz").write_bytes(pickle.dumps(Evil(mark)))
    (tmp_path / "evil.pt").write_bytes(pickle.dumps(Evil(mark)))
    (tmp_path / "empty.npz").write_bytes(b"")
    for name, words in (
        ("newer", ["99", "newer jaxfit"]),
        ("objects", ["Object arrays cannot be loaded"]),
        ("truncated", []),
        ("evil", []),
        ("empty", []),
        ("absent", []),
    ):
        path = tmp_path / f"{name}.npz"
        rejected(capsys, arguments(inputs, tmp_path / "out", model=path), str(path), *words)
        rejected(capsys, ["model", "info", str(path)], str(path), *words)
    rejected(
        capsys, ["model", "import", "aves", str(tmp_path / "evil.pt"), "--out", str(tmp_path / "m.npz")], "evil.pt"
    )
    assert not mark.exists(), "code from the file has run"
    assert not (tmp_path / "m.npz").exists()
    assert not (tmp_path / "out").exists()


def test_unusable_configs_and_starting_poses(inputs, tmp_path, capsys):
    bad = tmp_path / "bad.yaml"
    bad.write_text("base: paper\nwindows: 3\n")
    rejected(capsys, arguments(inputs, tmp_path / "out", config=bad), str(bad), "`windows`", "window")
    (tmp_path / "cut.npz").write_bytes(b"PK\x03\x04")
    command = [*arguments(inputs, tmp_path / "out"), "--init", str(tmp_path / "cut.npz")]
    rejected(capsys, command, "cut.npz")
    assert not (tmp_path / "out").exists()


def test_config_show(tmp_path, capsys):
    assert main(["config", "show", "reconstruct"]) == 0
    (tmp_path / "all.yaml").write_text(capsys.readouterr().out, encoding="utf-8")
    assert load_reconstruct_config(tmp_path / "all.yaml") == load_reconstruct_config()
    for name in (*shipped_fit_configs(), "ablation"):
        assert main(["config", "show", name]) == 0
        assert "# " in capsys.readouterr().out
    rejected(capsys, ["config", "show", "papr"], "papr", "paper")


@pytest.mark.parametrize("option", ["observations", "--model", "--init", "--config", "--truth", "--segmenter", "video"])
def test_paths_that_are_no_files(inputs, tmp_path, capsys, option):
    os.mkfifo(tmp_path / "pipe")  # a reader that opens the pipe never returns
    (tmp_path / "loop").symlink_to("loop")
    for path in (tmp_path / "pipe", tmp_path / "loop", tmp_path / ("n" * 300), "/dev/zero"):
        command = {
            "observations": ["fit", str(path), "--out", "out"],
            "--truth": ["evaluate", str(inputs / "birds.json"), "--truth", str(path)],
            "--segmenter": ["track", str(tmp_path), "--segmenter", str(path), "--out", "o.json"],
            "video": ["track", str(path), "--out", "o.json"],
        }.get(option, [*arguments(inputs, tmp_path / "out"), option, str(path)])
        rejected(capsys, command)


def test_a_stored_ablation_runs_no_code(inputs, tmp_path, capsys, monkeypatch):
    """A term `module:function` that only a stored ablation.json names is not imported."""
    (tmp_path / "spy.py").write_text(f"open({str(tmp_path / 'it ran')!r}, 'w')\n")
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "grid.yaml").write_text("config: paper\ncrosses: [{cross: {terms.keypoints: [1, 2]}}]\n")
    config = config_to_yaml(load_config("paper")).replace("acceleration", "spy:term")
    stored = {"format_version": 1, "runs": {"keypoints=1": config}, "model": "", "observations": "", "truth": ""}
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "ablation.json").write_text(json.dumps(stored))
    known = ["--truth", str(inputs / "birds.json"), "--model", str(inputs / "toy.npz")]
    grid = ["--grid", str(tmp_path / "grid.yaml"), "--out", str(tmp_path / "out")]
    rejected(capsys, ["ablate", str(inputs / "birds.json"), *known, *grid], "another")
    assert not (tmp_path / "it ran").exists()
