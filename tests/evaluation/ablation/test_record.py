"""The record of an ablation and stored metrics: any damage is one error."""

import dataclasses
import json

import pytest
from support.birds import toy_bird

from jaxfit.config.build import describes, plain_config
from jaxfit.config.fit import load_config
from jaxfit.evaluation.ablation.ablate import claim_folder
from jaxfit.evaluation.ablation.grid import load_grid
from jaxfit.evaluation.ablation.measure import read_metrics
from jaxfit.evaluation.bootstrap import BirdSums, Interval
from jaxfit.evaluation.evaluate import Evaluation
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import json_text

GRID = """
crosses: [{cross: {filter_window: [5, 1], terms.velocity: [1, 100]}}]
claims: [{claim: it helps, better: {filter_window: 5}, worse: {filter_window: 1}}]
"""
BIRD = toy_bird(shapes=0)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "grid.yaml").write_text(GRID)
    return tmp_path


def claim(folder, out):
    claim_folder(out, load_grid(folder / "grid.yaml")[0], {"truth": folder / "grid.yaml"}, BIRD)
    return out / "ablation.json"


def changed(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_the_record_of_the_same_ablation_is_accepted(folder):
    path = claim(folder, folder / "out")
    before = path.read_bytes()
    claim(folder, folder / "out")
    assert path.read_bytes() == before
    (folder / "empty").mkdir()
    claim(folder, folder / "empty")
    # a later version has keys that this record lacks
    changed(path, lambda content: [run.pop("memory_gb") for run in content["runs"].values()])
    claim(folder, folder / "out")
    (run, *_) = json.loads(path.read_text())["runs"]
    changed(path, lambda content: content["runs"][run].pop("filter_window"))  # 5, the default, in this run only
    claim(folder, folder / "out")
    for change in ({"window": 3}, {"terms": {"no_module:f": 1}}):  # no term of a record is imported
        changed(path, lambda content, change=change: content["runs"][run].update(change))
        with pytest.raises(InputError, match="another grid"):
            claim(folder, folder / "out")


def test_describes():
    paper = load_config("paper")
    plain = plain_config(paper)
    assert describes(plain, paper)
    assert describes(json.loads(json.dumps(plain)), paper)
    for key, value in (("window", True), ("window", 99), ("stages", []), ("terms", []), ("crop", {}), ("more", 1)):
        assert describes({**plain, key: value}, paper) == (key == "crop")  # all keys of `crop` have their defaults
    assert not describes({**plain, "window": True}, dataclasses.replace(paper, window=1))
    assert not describes([], paper)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("3", "does not describe an ablation"),
        ('{"runs": []}', "does not describe an ablation"),
        ('{"runs": {}}', "another grid, format_version, model, truth"),
        ('{"runs": {"a": 3, "b": {"terms": 3, "stages": [3, {"terms": [3]}]}}}', "another grid"),
    ],
)
def test_records_of_something_else(folder, content, words):
    (folder / "out").mkdir()
    (folder / "out" / "ablation.json").write_text(content)
    with pytest.raises(InputError, match=words):
        claim(folder, folder / "out")


def test_what_is_no_folder(folder):
    (folder / "file").touch()
    (folder / "full").mkdir()
    (folder / "full" / "x").touch()
    for name, words in {"file": "is a file", "full": "no ablation.json"}.items():
        with pytest.raises(InputError, match=words):
            claim(folder, folder / name)


def store_metrics(folder):
    overall, interval = {"pck@0.05": 0.9, "iou": None, "me_p": 0.1, "me_v": 0.01}, Interval(0.05, 0.2)
    sums = BirdSums(("4", "7"), {m: (0.1, 0.2) for m in ("me_p", "me_v")}, {m: (3, 4) for m in ("me_p", "me_v")})
    row = {"me_p": 0.1, "frames": 3}
    intervals = {"me_p": interval, "me_v": interval}
    evaluation = Evaluation(overall, {4: row, 7: row}, 6, 0, intervals=intervals, keypoints={"bill": row}, sums=sums)
    (folder / "evaluation.json").write_text(json_text(evaluation.to_dict()))
    (folder / "summary.json").write_text('{"seconds": {"fit": 1.5}, "runs_at_once": 2}')


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("evaluation.json", "[]"),
        ("evaluation.json", "{}"),
        ("summary.json", '{"seconds": 3, "runs_at_once": 2}'),
    ],
)
def test_damaged_metrics(folder, name, content):
    store_metrics(folder)
    assert read_metrics(folder)[1:] == (1.5, 2)
    (folder / name).write_text(content)
    with pytest.raises(InputError):
        read_metrics(folder)
