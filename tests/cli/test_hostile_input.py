"""Hostile input through the command line: exit code 2 and one line, within bounds on memory and time."""

import json

import cv2
import numpy as np
import pytest
from support import hostile_files as files
from support.hostile import Isolated

from jaxfit.config.fit import load_config
from jaxfit.config.yaml_file import config_to_yaml

QUICK = "base: paper\nwindow: 6\nterms: {keypoints: 1}\nstages: [{name: only, steps: 1, terms: [keypoints]}]\n"


def fit(inputs, out, obs="birds.json", model="toy.npz", config="quick.yaml", *more):
    """Return the arguments of `fit`; a file that is not an absolute path is one of the test's own inputs."""
    return ["fit", inputs / obs, "--model", inputs / model, "--config", inputs / config, "--out", out, *more]


def with_config(text):
    return lambda inputs, folder: fit(inputs, folder / "out", config=files.yaml_file(folder, text))


def with_observations(make):
    return lambda inputs, folder: fit(inputs, folder / "out", obs=make(folder))


def with_config_of(make):
    return lambda inputs, folder: fit(inputs, folder / "out", config=make(folder))


def with_grid(make):
    return lambda inputs, folder: ablate(inputs, folder / "out", make(folder))


def ablate(inputs, out, grid):
    known = ["--truth", inputs / "birds.json", "--model", inputs / "toy.npz"]
    return ["ablate", inputs / "birds.json", *known, "--grid", grid, "--out", out]


def calibrate(folder, detections, labels):
    return ["calibrate", detections, "--truth", labels, "--out", folder / "noise.yaml"]


def small_grid(folder):
    quick = files.yaml_file(folder, QUICK).rename(folder / "fit.yaml")
    return files.yaml_file(folder, f"config: {quick}\ncrosses: [{{cross: {{terms.keypoints: [1, 2]}}}}]\n")


def stored_ablation(text):
    def arguments(inputs, folder):
        (folder / "out").mkdir()
        (folder / "out" / "ablation.json").write_text(text)
        return ablate(inputs, folder / "out", small_grid(folder))

    return arguments


def pictures(folder):
    """A folder of two small pictures."""
    (folder / "frames").mkdir()
    for name in ("000.png", "001.png"):
        cv2.imwrite(str(folder / "frames" / name), np.zeros((32, 32, 3), np.uint8))
    return folder / "frames"


def result(make):
    """Return a folder whose poses.npz is a hostile file, drawn on a video that does not matter."""

    def arguments(inputs, folder):
        (folder / "result").mkdir()
        make(folder).rename(folder / "result" / "poses.npz")
        return ["overlay", folder / "result", "--video", inputs / "birds.json", "--out", folder / "o.mp4"]

    return arguments


# An option → the command whose option is the given file.
OPTIONS = {
    "--out": lambda i, f, file: fit(i, file),
    "--model": lambda i, f, file: fit(i, f / "out", model=file),
    "--init": lambda i, f, file: [*fit(i, f / "out"), "--init", file],
    "--config": lambda i, f, file: fit(i, f / "out", config=file),
    "--truth": lambda i, f, file: ["evaluate", i / "birds.json", "--truth", file],
    "--truth of calibrate": lambda i, f, file: calibrate(f, i / "birds.json", file),
    "detections": lambda i, f, file: calibrate(f, file, i / "birds.json"),
    "--segmenter": lambda i, f, file: ["track", pictures(f), "--segmenter", file, "--out", f / "o.json"],
    "--keypoints": lambda i, f, file: ["track", pictures(f), "--keypoints", file, "--out", f / "o.json"],
    "observations": lambda i, f, file: fit(i, f / "out", obs=file),
    "video": lambda i, f, file: ["track", file, "--out", f / "o.json"],
}
# A file that cannot be read → (function that makes it in a folder, words of the message).
UNREADABLE = {
    "long name": (lambda f: f / files.LONG, ["nnn"]),
    "loop of links": (files.loop, ["loop"]),
    "pipe": (files.pipe, ["pipe"]),
    "/dev/zero": (lambda f: "/dev/zero", ["/dev/zero"]),
}


def unreadable(option, kind):
    make, words = UNREADABLE[kind]
    return lambda inputs, folder: OPTIONS[option](inputs, folder, make(folder)), words


# Name → (function of the inputs' folder and an empty folder that returns the command, words of the message).
CASES = {
    "3,600 tracks over 3,600 frames": (with_observations(files.sparse_tracks), ["observations.json", "GB"]),
    "zigzag polygon": (with_observations(files.zigzag_polygon), ["observations.json", "segmentation"]),
    "deep json": (with_observations(files.deep_json), ["deep.json"]),
    "number of 5,000 digits in json": (with_observations(files.many_digits), ["digits.json"]),
    "npz bomb as a model": (lambda i, f: fit(i, f / "out", model=files.npz_bomb(f)), ["bomb.npz"]),
    "npz bomb as a result": (result(files.npz_bomb), ["poses.npz"]),
    "npz bomb as initial poses": (
        lambda i, f: [*fit(i, f / "out"), "--init", files.npz_bomb(f)],
        ["bomb.npz"],
    ),
    "npz that declares terabytes": (result(files.npz_claim), ["poses.npz"]),
    "window of 10⁹ frames": (with_config("base: paper\nwindow: 1000000000\n"), ["window", "1000000000"]),
    "crop of 10⁶ px": (with_config("base: paper\ncrop: {size_px: 1000000}\n"), ["crop.size_px", "1000000"]),
    "bad date": (with_config("base: paper\nwindow: 2021-99-99\n"), ["config.yaml"]),
    "tag without a number": (with_config("base: paper\nwindow: !!int foo\n"), ["config.yaml", "line 2"]),
    "number of 5,000 digits in yaml": (with_config("base: paper\nwindow: " + "1" * 5000), ["config.yaml", "line 2"]),
    "2,000 levels": (with_config("base: " + "[" * 2000 + "]" * 2000), ["config.yaml"]),
    "key that is not text": (with_config("base: paper\n1: 1\n"), ["config.yaml", "1"]),
    "NUL in the base": (with_config('base: "a\\0b"\n'), ["config.yaml", "line 1"]),
    "circle of bases": (with_config_of(files.circle_through_folder), ["c.yaml", "base"]),
    "1,500 bases": (with_config_of(files.many_bases), [".yaml", "base"]),
    "anchor bomb": (with_config_of(files.anchors), ["config.yaml"]),
    "merge bomb": (with_config_of(files.merges), ["config.yaml"]),
    "grid of 10¹² runs": (with_grid(files.wide_grid), ["config.yaml", "runs"]),
    "ablation.json holds a list": (stored_ablation("[]"), ["ablation.json"]),
    "ablation.json holds a number": (stored_ablation("3"), ["ablation.json"]),
    "ablation.json is deep": (stored_ablation("[" * 100_000), ["ablation.json"]),
} | {f"{kind} as {option}": unreadable(option, kind) for option in OPTIONS for kind in UNREADABLE}


@pytest.fixture(scope="module")
def command_line():
    with Isolated("support.hostile_commands:run_command", memory_mb=300, seconds=10) as call:
        yield call


@pytest.fixture(scope="module")
def prepared(inputs):
    (inputs / "quick.yaml").write_text(QUICK)
    return inputs


@pytest.mark.parametrize("name", CASES)
def test_hostile_input_ends_in_one_line(command_line, prepared, tmp_path, name):
    arguments, words = CASES[name]
    outcome = command_line(*arguments(prepared, tmp_path))
    assert outcome.kind == "InputError", outcome
    assert outcome.acceptable, outcome
    for word in words:
        assert word in outcome.message, outcome
    assert not (tmp_path / "out" / "poses.npz").exists()


def test_a_stored_ablation_runs_no_code(prepared, tmp_path):
    """A term `module:function` that only a stored ablation.json names is not imported."""
    (tmp_path / "spy.py").write_text(f"open({str(tmp_path / 'it ran')!r}, 'w')\nraise SystemExit\n")
    config = config_to_yaml(load_config("paper")).replace("acceleration", "spy:term")
    stored = {"format_version": 1, "runs": {"keypoints=1": config}, "model": "", "observations": "", "truth": ""}
    arguments = stored_ablation(json.dumps(stored))(prepared, tmp_path)
    with Isolated("support.hostile_commands:run_command_beside") as command:
        outcome = command(tmp_path, *arguments)
    assert outcome.kind == "InputError", outcome
    assert not (tmp_path / "it ran").exists()


def test_a_far_keypoint_costs_its_frame_only(prepared, tmp_path):
    """A keypoint and a box 300,000 px outside the image are skipped; all birds are fitted."""
    content = json.loads((prepared / "birds.json").read_text())
    far = content["annotations"][0]
    far["keypoints"][:2], far["bbox"] = [3e5, 3e5], [3e5, 3e5, 10, 10]
    (tmp_path / "far.json").write_text(json.dumps(content))
    with Isolated("support.hostile_commands:run_command", memory_mb=600, seconds=60) as command:
        outcome = command(*fit(prepared, tmp_path / "out", obs=tmp_path / "far.json"))
    assert outcome.kind == "success", outcome
    with np.load(tmp_path / "out" / "poses.npz") as poses:
        assert poses["valid"].sum() == len(content["annotations"]) - 1 - 6  # the third bird has three keypoints
