"""Ablations from end to end: table and report, continuation after a kill, and rejected input."""

import csv
import json
import re
import shutil
import sys
from importlib import import_module

import pytest
from support.cli_files import rejected

from jaxfit.cli.main import main
from jaxfit.evaluation.ablation import runs
from jaxfit.foundation.errors import InputError

GRID = """
config: {folder}/quick.yaml
crosses:
  - set: {{terms.velocity: 1}}
    cross: {{filter_window: [3]}}
  - cross: {{filter_window: [3, 1], terms.velocity: [0.1, 5]}}
claims:
  - {{claim: the filter helps, better: {{filter_window: 3}}, worse: {{filter_window: 1}}}}
"""


@pytest.fixture(scope="module", autouse=True)
def small_batches():
    """Fit two runs at once, with one program."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "FRAMES_AT_ONCE", 40)
        yield


@pytest.fixture(scope="module")
def grid(inputs, tmp_path_factory):
    path = tmp_path_factory.mktemp("grid") / "grid.yaml"
    path.write_text(GRID.format(folder=inputs))
    return path


def command(inputs, grid, out, **changes):
    given = {"obs": inputs / "birds.json", "truth": inputs / "birds.json"} | changes
    model = ["--model", str(inputs / "toy.npz"), "--grid", str(grid), "--out", str(out)]
    return ["ablate", str(given["obs"]), "--truth", str(given["truth"]), *model]


@pytest.fixture(scope="module")
def done(inputs, grid, tmp_path_factory):
    out = tmp_path_factory.mktemp("ablation") / "out"
    assert main(command(inputs, grid, out)) == 0
    return out


def rows(folder):
    with (folder / "table.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_table_is_that_of_its_runs(done):
    table = rows(done)
    assert len(table) == 5
    errors = [float(row["me_p"]) for row in table]
    assert errors == sorted(errors)
    levels = {(row["terms.velocity"], row["filter_window"]) for row in table}
    assert levels == {("1", "3"), ("0.1", "3"), ("5", "3"), ("0.1", "1"), ("5", "1")}


def test_metrics_are_those_of_evaluate(done, inputs, capsys):
    row = rows(done)[0]
    folder = done / "runs" / row["run"]
    capsys.readouterr()
    assert main(["evaluate", str(folder), "--truth", str(inputs / "birds.json"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    for metric in ("me_p", "me_v", "iou"):
        assert float(row[metric]) == pytest.approx(found[metric], rel=1e-5)
    assert float(row["me_p_low"]) == pytest.approx(found["intervals"]["me_p"][0], rel=1e-5)


def test_every_form_holds_every_run(done):
    names = [row["run"].partition("_")[0] for row in rows(done)]
    for form, cell in (("table.txt", r"^\s*{} "), ("table.md", r"^\|\s*{} \|"), ("table.tex", r"^\s*{} &")):
        text = (done / form).read_text()
        found = [re.search(cell.format(name), text, re.MULTILINE) for name in names]
        assert all(found), form
        places = [match.start() for match in found if match]
        assert places == sorted(places), "the best first"
    assert r"\lambda_{\mathrm{vel}}" in (done / "table.tex").read_text()
    assert (done / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_the_report_stands_alone(done):
    page = (done / "report.html").read_text()
    assert "data:image/png;base64," in page
    assert not re.search(r"(src|href)=(?![\"']data:)", page)
    assert "the filter helps" in page
    assert "$" not in re.sub(r"base64,[^\"]*", "", page), "nothing is left to fill in"


def test_the_same_again_does_nothing(done, inputs, grid):
    before = {path: path.stat().st_mtime_ns for path in (done / "runs").rglob("*")}
    table = (done / "table.csv").read_bytes()
    assert main(command(inputs, grid, done)) == 0
    assert {path: path.stat().st_mtime_ns for path in (done / "runs").rglob("*")} == before
    assert (done / "table.csv").read_bytes() == table


@pytest.mark.extended
def test_an_interruption_loses_nothing_and_changes_nothing(done, inputs, grid, tmp_path, monkeypatch):
    out, fit_batches = tmp_path / "out", runs.fit_batches

    def interrupted(*arguments):
        yield next(fit_batches(*arguments))
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(runs, "fit_batches", interrupted)
        assert main(command(inputs, grid, out)) == 130
    first = {path: path.stat().st_mtime_ns for path in (out / "runs").rglob("poses.npz")}
    assert first
    assert main(command(inputs, grid, out)) == 0
    assert (out / "table.csv").read_bytes() == (done / "table.csv").read_bytes()
    assert {path: path.stat().st_mtime_ns for path in first} == first
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


def test_a_kill_between_two_moves(done, inputs, grid, tmp_path):
    """Some of a batch's runs are in place, the others still to one side."""
    out = tmp_path / "out"
    shutil.copytree(done, out)
    (out / ".ready-1").mkdir()
    last = sorted((out / "runs").iterdir())[-1]
    shutil.move(last, out / ".ready-1" / last.name)
    before = (out / ".ready-1" / last.name / "poses.npz").stat().st_mtime_ns
    assert main(command(inputs, grid, out)) == 0
    assert (last / "poses.npz").stat().st_mtime_ns == before
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


def test_another_grid_or_other_inputs_are_refused(done, inputs, grid, tmp_path, capsys):
    other = tmp_path / "other.yaml"
    other.write_text(grid.read_text().replace("5]", "6]"))
    rejected(capsys, command(inputs, other, done), str(done), "another grid", "another --out")
    moved = tmp_path / "moved.json"
    moved.write_text((inputs / "birds.json").read_text() + " ")
    rejected(capsys, command(inputs, grid, done, obs=moved), "another observations")


def test_a_truth_of_other_tracks_is_refused_before_the_work(inputs, grid, tmp_path, capsys):
    content = json.loads((inputs / "birds.json").read_text())
    for annotation in content["annotations"]:
        annotation["track_id"] += 100
    path = tmp_path / "truth.json"
    path.write_text(json.dumps(content))
    words = ("shares no track", "104, 107, 109", "4, 7, 9", "--match overlap")
    rejected(capsys, command(inputs, grid, tmp_path / "out", truth=path), str(path), *words)
    assert not (tmp_path / "out").exists()


def test_a_missing_extra_is_one_input_error(inputs, monkeypatch, tmp_path):
    monkeypatch.setattr("jaxfit.foundation.extras.find_spec", lambda name: None)
    for module in ("matplotlib", "matplotlib.figure", "tabulate"):
        monkeypatch.setitem(sys.modules, module, None)  # importing it raises ModuleNotFoundError
    for module in ("ablate", "report", "plot", "table"):
        monkeypatch.delitem(sys.modules, f"jaxfit.evaluation.ablation.{module}", raising=False)
    ablate = import_module("jaxfit.evaluation.ablation.ablate").ablate
    with pytest.raises(InputError, match=r"^ablate: needs matplotlib and tabulate.*pip install \"\.\[report\]\""):
        ablate(inputs / "birds.json", inputs / "birds.json", tmp_path / "out")
    assert not (tmp_path / "out").exists()
