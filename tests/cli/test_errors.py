"""Unusable command lines and files: one line of explanation, exit code 2, no written files."""

import json
import os
import pickle
import re

import cv2
import numpy as np
import pytest
from support.cli_files import arguments, rejected, write_inputs

from jaxfit.cli.main import main
from jaxfit.config.fit import load_config, shipped_fit_configs
from jaxfit.config.reconstruct import load_reconstruct_config
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.foundation.errors import MAX_MESSAGE_CHARACTERS


class Evil:
    """An object that makes a folder when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The inputs of the command line, and damaged ones."""
    folder = tmp_path_factory.mktemp("damaged")
    write_inputs(folder)
    content = json.loads((folder / "birds.json").read_text())

    def write(name, change):
        changed = json.loads(json.dumps(content))
        change(changed)
        (folder / name).write_text(json.dumps(changed))

    write("score.json", lambda c: c["annotations"][0].update(keypoint_scores=[1.5] * 12))
    write("names.json", lambda c: c["categories"][0].update(keypoints=[f"point {i}" for i in range(12)]))
    write("twice.json", lambda c: c["annotations"].append(c["annotations"][0] | {"id": 999}))
    write("nobody.json", lambda c: [row.update(keypoint_scores=[0.0] * 12) for row in c["annotations"]])
    with np.load(folder / "toy.npz") as arrays:
        kept = dict(arrays)
    np.savez(folder / "newer.npz", **(kept | {"format_version": np.int32(99)}))
    np.savez(folder / "objects.npz", **(kept | {"name": np.array([Evil(folder / "it ran")], dtype=object)}))
    for name in ("evil.npz", "evil.pt"):
        (folder / name).write_bytes(pickle.dumps(Evil(folder / "it ran")))
    (folder / "cut.npz").write_bytes((folder / "toy.npz").read_bytes()[:200])
    (folder / "bad.yaml").write_text("base: paper\nwindows: 3\n")
    (folder / "names.yaml").write_text("a: 3\n")
    (folder / "empty.yaml").write_text("{}\n")
    (folder / "unknown.yaml").write_text("paw: crown\n")
    (folder / "notes.txt").write_text("precious")
    (folder / "masks").mkdir()
    (folder / "loop").symlink_to("loop")
    cv2.imwrite(str(folder / "masks" / "0.png"), np.ones((9, 9), np.uint8))
    return folder


FIT = "fit {}/birds.json --model {}/toy.npz --config {}/quick.yaml --out {}/out"
BAD = [
    ("bench silhouette --json", "bench: was removed (in a checkout of jaxfit, `make bench`"),
    ("fit {}/absent.json --out {}/out", "absent.json: does not exist"),
    (f"{FIT} --unit m", "--unit: is given without --cameras"),
    (f"{FIT} --offsets 0,1", "--offsets: is given without --cameras"),
    (f"{FIT} --focal-px 900", "--focal-px: is given without --ledge"),
    (FIT.replace("birds", "score"), "score.json: the content: confidence must lie in [0, 1]"),
    (FIT.replace("birds", "names"), "has no keypoint of the model by name"),
    (FIT.replace("birds", "twice"), "twice"),
    (FIT.replace("birds", "nobody"), "no track has a frame"),
    (FIT.replace("toy", "newer"), "newer jaxfit"),
    (FIT.replace("toy", "objects"), "Object arrays cannot be loaded"),
    (FIT.replace("quick", "bad"), "line 2: `windows` is not a known key (did you mean window?"),
    (FIT.replace("{}/quick.yaml", "papr"), "papr: does not exist (give a YAML file or one of ablation, aves, "),
    (f"{FIT} --init {{}}/cut.npz", "cut.npz"),
    (f"{FIT} --names {{}}/names.yaml", "maps 'a' to '3', which is not a name"),
    (f"{FIT} --names {{}}/empty.yaml", "holds no map of names"),
    (f"{FIT} --names {{}}/unknown.yaml", "maps paw"),
    ("model info {}/absent.npz", "absent.npz: does not exist"),
    ("model info {}/evil.npz", "evil.npz"),
    ("model import aves {}/evil.pt --out {}/out", "evil.pt"),
    ("model view murre --posture dancing --out {}/out", "--posture: 'dancing' is not a known posture (known: standing"),
    ("evaluate {}/absent --truth {}/birds.json", "absent: does not exist (check the path; `jaxfit fit` and"),
    ("evaluate {} --truth {}/birds.json", "poses.npz"),
    ("evaluate {}/birds.json --truth {}/masks --plot {}/out", "--plot: is given without --calibration"),
    ("config show papr", "papr: is not a shipped config (give one of ablation, aves, "),
    ("simulate --out {}/out --birds 0", "birds"),
    ("simulate --out {}/out --size wide", "--size: is wide"),
    ("simulate --out {}/out --size 12x8", "size"),
    ("simulate --out {}/out --seed -3", "seed"),
    ("simulate --out {}/out --distortion", "--distortion: is given without --cameras"),
    ("track {}/none.mp4 --out {}/out", "none.mp4: does not exist"),
    ("track {}/notes.txt --out {}/out", "notes.txt: is not a readable video"),
    ("track {}/masks --config paper --out {}/out", "paper: is the config of a fit"),
    ("track {}/masks --start 4 --stop 3 --out {}/out", "`track.frames.stop` is 3, and `start` is 4"),
    ("track {}/masks --out {}/loop", "leads back to itself"),
    ("demo --out {}", "holds files that are not an earlier demo"),
    ("demo --out {}/notes.txt", "is a file"),
    ("export {} --to glb --frames 3 --out {}/out", "--frames: is '3', not a range of frames"),
]


@pytest.mark.parametrize(("command", "words"), BAD, ids=[command.replace("{}/", "")[:50] for command, _ in BAD])
def test_a_bad_command_is_one_line(folder, capsys, command, words):
    before = sorted(folder.iterdir())
    rejected(capsys, command.replace("{}", str(folder)).split(), words)
    assert sorted(path for path in folder.iterdir() if path.name != "cache") == before
    assert not (folder / "it ran").exists(), "code from the file has run"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "COMMAND (see `jaxfit --help`)"),
        (["frobnicate" * 99], "(see `jaxfit --help`)"),
        (["fit"], "fit: the following arguments are required: OBS, --out (see `jaxfit fit --help`)"),
        (["cameras"], "cameras: the following arguments are required: ACTION (see `jaxfit cameras --help`)"),
        (["track", "v", "--out", "o", "--step", "9" * 5000], "--step: invalid int value: '9999"),
        (["fit", "o", "--out", "x", "--workers", "2", "--scheduler", "a"], "not allowed with argument --workers"),
        (["model", "info", "m", "\udcc5\n" * 300], "(see `jaxfit --help`)"),
    ],
)
def test_wrong_arguments(capsys, arguments, expected):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    said = capsys.readouterr()
    assert (stopped.value.code, said.out) == (2, "")
    line = said.err.removesuffix("\n")
    assert line.startswith("jaxfit: ")
    assert expected in line
    assert line.isprintable()
    assert len(line) <= MAX_MESSAGE_CHARACTERS


def test_help_lists_the_commands_by_group_and_the_arguments_of_one(capsys):
    for command, expected in (
        (["--help"], ["start:\n  demo ", "  cameras      calibrate, describe and check cameras\n"]),
        (["cameras", "--help"], ["show ", "check ", "calibrate "]),
        (["track", "--help"], ["--min-score SCORE", "VIDEO", "(default 10)"]),
        (["fit", "--help"], ["calibrated cameras:\n  --cameras", "the ledge:\n  --ledge"]),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(command)
        assert stopped.value.code == 0
        said = capsys.readouterr().out
        assert all(text in said for text in expected)
    options = re.findall(r"^  (--[\w-]+)", said, re.MULTILINE)
    assert options[:5] == ["--out", "--overwrite", "--model", "--config", "--names"]


def test_config_show(tmp_path, capsys):
    assert main(["config", "show", "reconstruct"]) == 0
    (tmp_path / "all.yaml").write_text(capsys.readouterr().out, encoding="utf-8")
    assert load_reconstruct_config(tmp_path / "all.yaml") == load_reconstruct_config()
    for name in (*shipped_fit_configs(), "ablation"):
        assert main(["config", "show", name]) == 0
        assert "# " in capsys.readouterr().out


@pytest.mark.parametrize("option", ["observations", "--model", "--init", "--config", "--truth", "--segmenter", "video"])
def test_paths_that_are_no_files(inputs, tmp_path, capsys, option):
    os.mkfifo(tmp_path / "pipe")  # a reader that opens the pipe never returns
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "file").write_text("")
    names = "pipe", "loop", "loop/a.mp4", "file/a.mp4", "n" * 300, "/dev/zero"
    for path in (tmp_path / name for name in names):
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
