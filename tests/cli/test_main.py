"""The command line from end to end: fit, evaluate, models, interrupts and the cache."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.cli_files import BIRD, T, arguments, rejected

from jaxfit.cli import fitting
from jaxfit.cli.main import main
from jaxfit.data.solution import load_solution
from jaxfit.model.files import load_bird


@pytest.fixture(scope="module")
def fitted(inputs, tmp_path_factory):
    out = tmp_path_factory.mktemp("results") / "deep" / "out"
    assert main(arguments(inputs, out)) == 0
    return out


def test_fit_writes_a_whole_result(fitted, inputs, capsys):
    assert sorted(p.name for p in fitted.iterdir()) == ["config.yaml", "model.npz", "poses.npz", "summary.json"]
    solution, bird = load_solution(fitted)
    assert solution.track_id.tolist() == [4, 7, 9]
    assert solution.status.tolist() == ["ok", "ok", "no usable frame"]
    assert bird.keypoint_names == BIRD.keypoint_names
    summary = json.loads((fitted / "summary.json").read_text())
    assert summary["status"] == {"ok": 2, "no usable frame": 1}
    assert summary["track_status"]["9"] == "no usable frame"
    assert (summary["tracks"], summary["poses"], summary["model"]["name"]) == (3, 2 * T, "toy")
    assert set(summary["seconds"]) == {"read", "fit"}
    assert {"jaxfit", "jax", "python"} <= set(summary["versions"])
    assert "only" in (fitted / "config.yaml").read_text()


def photographs_of(inputs, tmp_path):
    """Write the first frame of every bird as a photograph of its own."""
    content = json.loads((inputs / "birds.json").read_text())
    first = [row for row in content["annotations"] if row["image_id"] == content["images"][0]["id"]]
    content["images"] = [content["images"][0] | {"id": n, "file_name": f"{n}.png"} for n in range(len(first))]
    content["annotations"] = [row | {"image_id": n} for n, row in enumerate(first)]
    (tmp_path / "photographs.json").write_text(json.dumps(content))
    return tmp_path / "photographs.json"


def test_photographs_are_no_video(inputs, tmp_path, capsys):
    given, out = photographs_of(inputs, tmp_path), tmp_path / "out"
    assert main(["import", str(given), "--model", str(inputs / "toy.npz"), "--out", str(tmp_path / "again.json")]) == 0
    assert "3 birds, 3 photographs, " in capsys.readouterr().out.replace("\n", " ")
    assert main(arguments(inputs, out, obs=str(given))) == 0
    assert "2 poses of 3 birds in 3 photographs (2 ok, " in capsys.readouterr().out
    assert main(["report", str(out)]) == 0
    page = (out / "report.html").read_text()
    assert "in 3 photographs" in page
    assert "contact_sheet" in page
    for absent in (
        "1 frame",
        "Tracks over time",
        "Size in the image",
        "unknown frame rate",
        "jaxfit overlay",
        "--video",
    ):
        assert absent not in page
    video = ["--video", str(inputs)]
    rejected(capsys, ["report", str(out), *video], "holds photographs", "remove --video")
    overlay = ["overlay", str(out), *video, "--out", str(tmp_path / "overlay.mp4")]
    rejected(capsys, overlay, "holds photographs, which are not the frames of one video", "`jaxfit report` says how")
    rejected(capsys, ["view", str(out), *video, "--save", str(tmp_path / "page")], "holds photographs", "leave out")
    assert main(["view", str(out), "--save", str(tmp_path / "page")]) == 0


def test_the_stored_config_reproduces_the_result(fitted, inputs, tmp_path, capsys):
    command = arguments(inputs, tmp_path / "again")
    command[command.index("--config") + 1] = str(fitted / "config.yaml")
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "no usable frame" in said
    assert "12 poses of 3 tracks (2 ok, 1 no usable frame)" in said
    assert str(tmp_path / "again") in said.replace("\n", "")
    a, b = load_solution(fitted)[0], load_solution(tmp_path / "again")[0]
    np.testing.assert_array_equal(a.keypoints.px, b.keypoints.px)


def test_evaluate(fitted, inputs, tmp_path, capsys):
    capsys.readouterr()
    assert main(["evaluate", str(fitted), "--truth", str(inputs / "birds.json"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert {"pck@0.05", "pck@0.10", "iou", "me_p", "me_v"} <= set(result)
    assert result["pck@0.05"] == 1
    assert 0.8 < result["iou"] <= 1
    assert 0 < result["me_p"] < 0.02
    assert 0 < result["me_v"] < 0.02
    assert (result["frames"], result["missing"]) == (2 * T, T)
    assert set(result["tracks"]) == {"4", "7"}
    assert main(["evaluate", str(fitted), "--truth", str(inputs / "birds.json")]) == 0
    table = capsys.readouterr().out
    assert "pck@0.05" in table
    assert f"{result['me_p']:.4f}" in table
    assert f"{T} annotated birds without a pose" in table
    assert "the truth lacks" not in table
    content = json.loads((inputs / "birds.json").read_text())
    content["annotations"] = [a for a in content["annotations"] if a["track_id"] == 4]
    (tmp_path / "one.json").write_text(json.dumps(content))
    assert main(["evaluate", str(fitted), "--truth", str(tmp_path / "one.json")]) == 0
    assert f"{T} poses of tracks or frames that the truth lacks" in capsys.readouterr().out


def test_a_file_without_tracks_is_fitted_as_photographs(inputs, tmp_path, caplog, capsys):
    """Every annotation becomes a bird with one pose, the command says so, and the result fits to its own file."""
    content = json.loads((inputs / "birds.json").read_text())
    for annotation in content["annotations"]:
        del annotation["track_id"]
    (tmp_path / "photographs.json").write_text(json.dumps(content))
    assert main(arguments(inputs, tmp_path / "out", obs=str(tmp_path / "photographs.json"))) == 0
    assert "photographs.json: no annotation has a track_id, so the file is a set of photographs" in caplog.text
    solution, _ = load_solution(tmp_path / "out")
    assert solution.valid.shape == (3 * T, 1)
    assert solution.valid.sum() == 2 * T
    capsys.readouterr()
    command = ["evaluate", str(tmp_path / "out"), "--truth", str(tmp_path / "photographs.json"), "--json"]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["frames"], result["missing"], result["matched_by"]) == (2 * T, T, "ids")
    assert result["pck@0.05"] == 1
    content["annotations"][1]["track_id"] = 4
    (tmp_path / "some.json").write_text(json.dumps(content))
    command = arguments(inputs, tmp_path / "some", obs=str(tmp_path / "some.json"))
    rejected(capsys, command, "some.json: annotations[0] lacks the key track_id")


def test_fit_starts_from_an_earlier_result(fitted, inputs, tmp_path):
    command = [*arguments(inputs, tmp_path / "out"), "--init", str(fitted / "poses.npz")]
    content = (inputs / "birds.json").read_text()
    kept = json.loads(content)
    kept["annotations"] = [a for a in kept["annotations"] if a["track_id"] != 9]  # bird 9 has no starting pose
    command[1] = str(tmp_path / "two.json")
    Path(command[1]).write_text(json.dumps(kept))
    assert main(command) == 0
    a, b = load_solution(fitted)[0], load_solution(tmp_path / "out")[0]
    assert (b.loss["keypoints"] <= a.loss["keypoints"][:2]).all()


def test_import_and_info(reference_dir, tmp_path, capsys):
    out = tmp_path / "aves.npz"
    assert main(["model", "import", "aves", str(reference_dir / "models" / "aves"), "--out", str(out)]) == 0
    assert "18 keypoints" in capsys.readouterr().out
    assert load_bird(out).num_keypoints == 18
    assert main(["model", "info", str(out), "--json"]) == 0
    assert "vertices" in json.loads(capsys.readouterr().out)
    assert main(["model", "info", str(out)]) == 0
    assert "vertices" in capsys.readouterr().out
    sources = str(reference_dir / "models" / "avian_mesh")
    rejected(capsys, ["model", "import", "aves", sources, "--out", str(tmp_path / "x.npz")], "aves.pt")
    assert not (tmp_path / "x.npz").exists()


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir()}


def test_results_are_overwritten_only_on_request(fitted, inputs, tmp_path, capsys, monkeypatch):
    before = contents(fitted)

    def no_work(*_, **__):
        raise AssertionError("the command must reject the folder before it fits")

    with monkeypatch.context() as patch:
        patch.setattr("jaxfit.fitting.fit.fit", no_work)
        rejected(capsys, arguments(inputs, fitted), str(fitted), "overwrite")
        (tmp_path / "thesis").mkdir()
        (tmp_path / "thesis" / "thesis.tex").write_text("precious")
        rejected(capsys, [*arguments(inputs, tmp_path / "thesis"), "--overwrite"], "thesis")
    assert contents(fitted) == before
    assert (tmp_path / "thesis" / "thesis.tex").read_text() == "precious"


def test_a_full_disk_loses_nothing(fitted, inputs, tmp_path, capsys, monkeypatch):
    before = contents(fitted)

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        rejected(capsys, arguments(inputs, tmp_path / "new" / "out"), "No space left", "free some space", alone=False)
        rejected(capsys, [*arguments(inputs, fitted), "--overwrite"], "No space left", alone=False)
    assert contents(fitted) == before
    assert not (tmp_path / "new").exists()
    assert [p.name for p in fitted.parent.iterdir()] == [fitted.name]
    assert main([*arguments(inputs, fitted), "--overwrite"]) == 0


def test_ctrl_c_leaves_no_files(fitted, inputs, tmp_path, capsys, monkeypatch):
    @contextmanager
    def impatient(_name, _total):
        calls = []

        def report_progress(_done, _note):
            calls.append(None)
            if len(calls) == 3:
                raise KeyboardInterrupt

        yield report_progress

    monkeypatch.setattr(fitting, "terminal", impatient)
    before = contents(fitted)
    rejected(capsys, arguments(inputs, tmp_path / "out"), "stopped", code=130, alone=False)
    rejected(capsys, [*arguments(inputs, fitted), "--overwrite"], "stopped", code=130, alone=False)
    assert [p.name for p in tmp_path.iterdir() if p.name != "cache"] == []
    assert contents(fitted) == before


# shells ignore these signals for background jobs, which the tests may be
ENABLE = "import os, signal, sys; signal.signal(int(sys.argv[1]), signal.SIG_DFL); os.execv(sys.argv[2], sys.argv[2:])"


def test_an_interrupted_process_removes_its_files(tmp_path):
    """A real process is interrupted during its work, as by a batch system."""
    script = Path(sys.executable).with_name("jaxfit")
    simulate = [script, "simulate", "--frames", "1000", "--out", "scene"]
    command = [sys.executable, "-c", ENABLE, str(int(signal.SIGTERM)), *simulate]

    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120
        while not list(tmp_path.glob(".scene.*.part")):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.1)
        process.send_signal(signal.SIGTERM)
        errors = process.communicate(timeout=60)[1]
    assert process.returncode == 130, errors
    assert errors.endswith("jaxfit: stopped; no incomplete files are left\n")
    assert not list(tmp_path.glob("*scene*"))


REPLACED = """
import os, signal, time
from jaxfit.cli import main as cli

def main():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)
    except KeyboardInterrupt:
        raise TypeError from None
"""
SWALLOWED = """
import gc, os, signal, time
from jaxfit.cli import main as cli

def lose(phase, info):
    gc.callbacks.remove(lose)
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)

def main():
    gc.callbacks.append(lose)
    try:
        gc.collect()
        time.sleep(60)
    except KeyboardInterrupt:
        return cli._stopped()
"""


@pytest.mark.parametrize("code", [REPLACED, SWALLOWED], ids=["compiled code", "garbage collector"])
def test_no_code_loses_an_interrupt(code):
    """Compiled code may replace an interrupt by an error of its own; the garbage collector swallows it."""
    code = (
        f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n{code}\ncli.main = main\ncli.run()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=50)
    assert (done.returncode, done.stderr) == (130, "jaxfit: stopped; no incomplete files are left\n")


@pytest.mark.parametrize(
    "arguments",
    [
        ["ablate", "o.json", "--truth", "t", "--out", "a", "--allow-import", "a:b"],
        ["prior", "learn", "r", "--motion", "--out", "p.npz"],
    ],
)
def test_an_option_of_earlier_versions_names_what_replaces_it(arguments, capsys):
    assert main(arguments) == 2
    assert "is no option any more (" in capsys.readouterr().err


def test_unusable_truths_of_evaluate(fitted, inputs, tmp_path, capsys):
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "0.png"), np.ones((9, 9), np.uint8))
    rejected(capsys, ["evaluate", str(fitted), "--truth", str(tmp_path / "masks")], "masks but no keypoints")
    content = json.loads((inputs / "birds.json").read_text())
    for annotation in content["annotations"]:
        annotation["track_id"] += 100
    (tmp_path / "others.json").write_text(json.dumps(content))
    others = ["--truth", str(tmp_path / "others.json")]
    rejected(capsys, ["evaluate", str(fitted), *others, "--match", "ids"], "shares no bird")
    assert main(["evaluate", str(fitted), *others]) == 0  # the same birds by other names, in the same places
    assert "4 → 104" in capsys.readouterr().out
