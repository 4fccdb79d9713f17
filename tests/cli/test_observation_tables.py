"""`jaxfit evaluate` of observations, and its line about matched tracks."""

import json
from types import SimpleNamespace
from typing import Any

from support.cli_files import rejected
from support.rectangles import birds, steady

from jaxfit.cli import main as cli
from jaxfit.cli.observations import matching_line
from jaxfit.cli.tables import evaluation_tables, right_aligned, show, wrong_poses_line
from jaxfit.data.formats.coco import write_coco
from jaxfit.evaluation.evaluate import COLUMNS
from jaxfit.evaluation.truth import Matching

LEFT, RIGHT = (0, 0, 30, 20), (60, 0, 30, 20)


def files(folder):
    """Two birds over four frames; bird 1 is detected in two frames and hidden in the last frame of the truth."""
    truth = {1: steady(LEFT, range(4)), 2: steady(RIGHT, range(4))}
    write_coco(birds(truth, range(4), visible={(1, 3): (0, 0, 2, 2)}), folder / "truth.json")
    found = {5: steady(LEFT, range(2)), 9: steady(RIGHT, range(4))}
    write_coco(birds(found, range(4), names=("bill", "crown")), folder / "found.json")
    return ["evaluate", str(folder / "found.json"), "--truth", str(folder / "truth.json")]


def test_tables(tmp_path, capsys):
    assert cli.main(files(tmp_path)) == 0
    printed = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in printed.splitlines() if line.startswith("│")]
    assert rows == [
        ["4", "7", "6", "0.8515", "0.8515", "1.0000", "0.8571", "1.0000"],  # 86 of 101 recalls
        ["bill", "6", "1.0000", "1.0000", "6", "1.0000", "1.0000"],
        ["all", "6", "1.0000", "1.0000", "6", "1.0000", "1.0000"],
        # 6 matches of 7 birds; association: 4 matches of 4 frames, 2 of 3
        ["0.8729", "0.8571", "0.8889", "0.8571", "0.9231", "0", "0"],
    ]
    assert "not counted: 1 hardly visible bird\n" in printed


def test_json_and_the_tables_that_there_are(tmp_path, capsys):
    """The tables of observations have the keypoints, but no behaviours."""
    assert cli.main([*files(tmp_path), "--by", "keypoint", "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["counts"]["ignored"] == 1
    assert metrics["keypoints"]["bill"]["visible"] == 6
    assert metrics["tracking"]["switches"] == 0
    assert metrics["detection"]["recall"] == 6 / 7
    rejected(capsys, [*files(tmp_path), "--by", "behaviour"], "no tables --by behaviour")


def test_the_line_of_matched_tracks():
    line = matching_line(Matching("overlap", {3: 1, 8: 2}, [4, 5], [6]))
    assert "3 → 1, 8 → 2; tracks that follow no bird: 4, 5; birds that no track follows: 6" in line
    assert matching_line(Matching("overlap", {}, [], [])).endswith(": none")


def test_rows_of_matched_tracks_have_both_numbers_in_the_order_of_the_tracks():
    metrics = dict.fromkeys((*COLUMNS, "frames"), 1.0)
    result: Any = SimpleNamespace(
        tracks={bird: metrics for bird in (1, 2, 7)},
        overall=metrics,
        frames=3,
        points_3d="",
        sums=SimpleNamespace(birds=()),
    )
    for follows, labels in (({8: 1, 3: 2, 4: 6}, ["3 → 2", "8 → 1", "7", "all"]), (None, ["1", "2", "7", "all"])):
        (table,) = evaluation_tables(result, follows)
        assert list(table.columns[0].cells) == labels


def test_the_line_of_the_worst_frames():
    """The line names the tracks of the result, and the five worst of seven."""
    rows = {bird: {"count": 2.0 - bird % 2, "frame": 50.0 + bird, "error": 0.5 / bird} for bird in range(1, 8)}
    result: Any = SimpleNamespace(wrong=rows)
    line = wrong_poses_line(result, {9: 2})
    assert line.startswith("worst frames: track 1 frame 51 (50.0 % of the length; 1 wrong pose), track 9 frame 52 (")
    assert line.endswith("track 5 frame 55 (10.0 % of the length; 1 wrong pose)")
    result.wrong = {}
    assert wrong_poses_line(result) == ""


def test_no_value_is_lost_in_a_narrow_output(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    table = right_aligned("keypoint", *COLUMNS)
    table.add_row("left_wing_elbow", *["0.1234"] * len(COLUMNS))
    show(table)
    printed = capsys.readouterr().out
    assert "…" not in printed
    lines = [[cell.strip() for cell in line.split("│")[1:-1]] for line in printed.splitlines() if "│" in line]
    assert ["".join(parts) for parts in zip(*lines, strict=True)] == ["left_wing_elbow", *["0.1234"] * len(COLUMNS)]
