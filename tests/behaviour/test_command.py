"""`jaxfit describe`: its files as R, pandas, movement and BORIS read them, and its errors."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet
import pytest
import xarray
import yaml
from support.cli_files import rejected
from support.described import BIRD, pair, renamed, result, with_error_bars

from jaxfit.behaviour.registry import own_features
from jaxfit.behaviour.rules import load_behaviour_config
from jaxfit.cli.main import main
from jaxfit.data.solution import load_solution, save_solution

FPS = 25.0


def written(folder, solution=None, bird=BIRD, summary=None, fps=FPS):
    """Write a result of two birds, one of which lacks a pose, and return its folder."""
    if solution is None:
        solution = pair(60)
        solution.valid.flags.writeable = True
        solution.valid[1, 7] = False
    T = len(solution.frame_index)
    times = None if fps is None else np.arange(T) / fps
    save_solution(replace(solution, timestamp_s=times, fps=fps), bird, "", summary or {}, folder)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return written(tmp_path_factory.mktemp("described") / "result")


def rows_of(path):
    return list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))


def described(folder, out, *words):
    assert main(["describe", str(folder), "--out", str(out), *words]) == 0
    return out


@pytest.fixture(scope="module")
def tables(folder, tmp_path_factory):
    return described(folder, tmp_path_factory.mktemp("tables") / "birds.csv").parent


def test_the_table_of_features(folder, tables):
    rows = rows_of(tables / "birds.csv")
    assert len(rows) == 2 * 60
    assert {row["fitted"] for row in rows} == {"TRUE", "FALSE"}
    (without,) = [row for row in rows if row["fitted"] == "FALSE"]
    assert (without["track"], without["frame"]) == ("2", "7")
    assert without["body_pitch_deg"] == ""
    assert without["behaviour"] == without["neighbour"] == "NA"
    first = rows[0]
    assert first["neighbour"] == "2"
    assert first["behaviour"] == "standing"
    solution = load_solution(folder)[0]
    true = np.linalg.norm(solution.world.transl_world_m[0, 0] - solution.world.transl_world_m[1, 0])
    assert float(first["neighbour_distance_m"]) == pytest.approx(true, rel=1e-5)
    expected = [each.column("m") for each in own_features()]
    assert [name for name in first if name in expected] == expected


def test_the_other_files(tables):
    bouts = rows_of(tables / "birds_bouts.csv")
    # the missing pose is bridged
    assert [(row["Subject"], row["Behavior"], row["Start (s)"], row["Stop (s)"]) for row in bouts] == [
        ("bird_1", "standing", "0.0", "2.4"),
        ("bird_2", "standing", "0.0", "2.4"),
    ]
    pitch = float(rows_of(tables / "birds.csv")[0]["body_pitch_deg"])
    assert float(bouts[0]["mean_body_pitch_deg"]) == pytest.approx(pitch)
    budget = rows_of(tables / "birds_budget.csv")
    (standing,) = [row for row in budget if (row["bird"], row["behaviour"]) == ("all", "standing")]
    assert float(standing["share"]) == 1
    assert float(standing["seconds"]) == pytest.approx(119 / FPS)
    project = json.loads((tables / "birds.boris").read_text(encoding="utf-8"))
    (observation,) = project["observations"].values()
    codes = {each["code"] for each in project["behaviors_conf"].values()}
    subjects = {each["name"] for each in project["subjects_conf"].values()}
    assert codes == set(load_behaviour_config().behaviours)
    times = [event[0] for event in observation["events"]]
    assert times == sorted(times)
    for subject in subjects:  # BORIS pairs the events of a state by their order
        own = [event for event in observation["events"] if event[1] == subject]
        assert [event[2] for event in own] == ["standing", "standing"]
    assert "<svg" in (tables / "birds_ethogram.svg").read_text(encoding="utf-8")


def test_parquet_has_units_and_definitions(folder, tmp_path):
    table = pyarrow.parquet.read_table(described(folder, tmp_path / "birds.parquet"))
    fields = {field.name: field.metadata for field in table.schema}
    for feature in own_features():
        metadata = fields[feature.column("m")]
        assert metadata[b"definition"].decode() == feature.definition
        assert metadata[b"unit"].decode() == feature.shown_unit("m")
    assert str(table.schema.field("neighbour").type) == "int64"
    assert str(table.schema.field("fitted").type) == "bool"
    assert table["neighbour"].null_count == 2  # a bird without a pose is no neighbour


def test_movement(folder, tmp_path):
    data = xarray.open_dataset(described(folder, tmp_path / "birds.nc"), engine="h5netcdf")
    assert data.attrs["ds_type"] == "poses"
    assert dict(data.sizes) == {"time": 60, "space": 3, "keypoint": BIRD.num_keypoints, "individual": 2}
    assert data["body_pitch_deg"].dims == data["behaviour"].dims == ("time", "individual")
    assert data["behaviour"].values[0].tolist() == ["standing", "standing"]
    assert data["behaviour"].values[7, 1] == ""
    np.testing.assert_allclose(data["wing_spread"].values[7], [data["wing_spread"].values[6, 0], np.nan], rtol=1e-5)
    tips = (data.position.sel(keypoint=name) for name in ("left_wingtip", "right_wingtip"))
    assert float(np.abs(next(tips) - next(tips)).max()) < 1  # metres


def test_what_is_missing_is_said(tmp_path, capsys):
    one = renamed(left_wingtip="left_wing_end")
    folder = written(tmp_path / "result", result(shape=(1, 3), bird=one), bird=one, fps=None)
    rows = rows_of(described(folder, tmp_path / "birds.csv"))
    said = capsys.readouterr().out
    assert "behaviour" not in rows[0]
    assert not {"wing_spread", "speed_m_s", "neighbour"} & set(rows[0])
    assert float(rows[0]["body_pitch_deg"]) == pytest.approx(0, abs=1e-3)
    assert "the model has no keypoint left_wingtip" in said
    assert "the result has one bird" in said
    assert "give --fps" in said
    assert not (tmp_path / "birds_bouts.csv").exists()
    rows = rows_of(described(folder, tmp_path / "birds.csv", "--fps", "10", "--overwrite"))
    assert (rows[1]["time_s"], rows[1]["behaviour"]) == ("0.1", "standing")
    assert (
        "without 1 behaviour (wing_spread: the model has no keypoint left_wingtip): flapping" in capsys.readouterr().out
    )


def test_photographs_have_postures_only(tmp_path, capsys):
    folder = written(tmp_path / "result", summary={"photographs": 2})
    row = rows_of(described(folder, tmp_path / "birds.csv"))[0]
    assert "photographs" in capsys.readouterr().out
    assert "neck_angle_deg" in row
    assert not {"speed_m_s", "behaviour", "neighbour"} & set(row)


@pytest.fixture(scope="module")
def walking(tmp_path_factory):
    """A result in which one bird walks towards the other and back, and the table of all its frames."""
    place = np.zeros((2, 60, 3)) + np.array([[[0, 0, 0.2]], [[0.6, 0, 0.2]]])
    place[0, :, 0] += 0.2 * np.sin(np.arange(60) / 7)
    solution = with_error_bars(pair(60), orient_sd=0.1, body_sd=0.05)
    folder = tmp_path_factory.mktemp("walking")
    written(folder / "result", solution.with_arrays(transl_world_m=place))
    return folder / "result", described(folder / "result", folder / "whole.csv")


@pytest.mark.parametrize(
    ("words", "tracks", "frames"),
    [(["--tracks", "2"], {"2"}, range(60)), (["--frames", "20:30"], {"1", "2"}, range(20, 30))],
)
def test_a_part_of_a_result_has_the_rows_of_the_whole(walking, tmp_path, words, tracks, frames):
    """Error bars, neighbours, speeds and steps are those of all frames."""
    folder, whole = walking
    part = rows_of(described(folder, tmp_path / "part.csv", *words))
    assert part == [row for row in rows_of(whole) if row["track"] in tracks and int(row["frame"]) in frames]
    assert {"neighbour", "speed_m_s", "body_pitch_sd_deg", "airborne"} <= set(part[0])
    bouts, cut = rows_of(whole.parent / "whole_bouts.csv"), rows_of(tmp_path / "part_bouts.csv")
    assert {row["Subject"] for row in cut} == {f"bird_{track}" for track in tracks}
    for row in cut:
        assert frames[0] / FPS <= float(row["Start (s)"]) < float(row["Stop (s)"]) <= (frames[-1] + 1) / FPS
    if "--tracks" in words:
        kept = [row for row in bouts if row["Subject"] == "bird_2"]
        assert cut == kept
    budget = rows_of(tmp_path / "part_budget.csv")
    seconds = sum(float(row["seconds"]) for row in budget if row["bird"] == "all")
    assert seconds == pytest.approx(len(part) / FPS, rel=1e-5)


def test_files_of_an_earlier_run_are_removed(tmp_path, capsys):
    folder = written(tmp_path / "result", fps=None)
    described(folder, tmp_path / "birds.csv", "--fps", "25")
    (tmp_path / "birds_notes.csv").write_text("mine", encoding="utf-8")
    capsys.readouterr()
    described(folder, tmp_path / "birds.csv", "--overwrite")
    said = capsys.readouterr().out
    for name in ("birds_bouts.csv", "birds_budget.csv", "birds_ethogram.svg", "birds.boris"):
        assert not (tmp_path / name).exists()
        assert f"{name}, a file of an earlier run" in said
    assert (tmp_path / "birds_notes.csv").exists()


def test_large_track_numbers_in_every_format(tmp_path):
    tracks = [2**63 - 1, 2**63 - 2]
    folder = written(tmp_path / "result", pair(4, track_id=np.array(tracks)))
    table = pyarrow.parquet.read_table(described(folder, tmp_path / "birds.PARQUET"))
    assert table["neighbour"].to_pylist() == [tracks[1]] * 4 + [tracks[0]] * 4
    assert rows_of(described(folder, tmp_path / "other.csv"))[0]["neighbour"] == str(tracks[1])
    data = xarray.open_dataset(described(folder, tmp_path / "third.nc"), engine="h5netcdf")
    assert data["neighbour"].values[0].tolist() == [f"bird_{track}" for track in tracks[::-1]]


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0, 0.04, 0.04, 0.08], "the stored times of the frames have gaps or do not increase, so the frame rate"),
        ([0, 0.04, np.nan, 0.08], "the stored times of the frames have gaps or do not increase, so the frame rate"),
        ([-0.08, -0.04, 0, 0.04], "the times begin at -0.08 s; BORIS counts from the start of the film"),
        ([0, 0.04, 0.08, 0.5], "varies from 0.04 to 0.42 s"),
    ],
)
def test_unusual_times_are_said(tmp_path, capsys, times, message):
    solution = replace(pair(4), timestamp_s=np.array(times), fps=25.0)
    save_solution(solution, BIRD, "", {}, tmp_path / "result")
    rows = rows_of(described(tmp_path / "result", tmp_path / "birds.csv"))
    assert message in capsys.readouterr().out
    increase = bool((np.diff(times) > 0).all())
    assert float(rows[3]["time_s"]) == pytest.approx(times[3] if increase else 0.12)


MODULE = '''"""Features of a user."""
from jaxfit.behaviour.registry import feature

@feature(unit="length")
def depth(birds):
    """Position along y."""
    return birds.place[..., 1]

def broken(birds):
    raise KeyError("no such thing")

def flat(birds):
    return birds.place[0, :, 1]
'''


@pytest.fixture
def users_module(tmp_path, monkeypatch):
    (tmp_path / "features_of_a_user.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.usefixtures("users_module")
def test_features_and_rules_of_a_user(tmp_path):
    """A feature of a rule is a column. No text of a table is a formula of a spreadsheet."""
    folder = written(tmp_path / "=result", pair(4))
    rule = {"definition": "=1+1", "begins": {"features_of_a_user:depth": "> -100"}}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({"behaviours": {"near": rule}}), encoding="utf-8")
    row = rows_of(described(folder, tmp_path / "birds.csv", "--config", str(tmp_path / "mine.yaml")))[0]
    assert float(row["depth_m"]) == pytest.approx(load_solution(folder)[0].world.transl_world_m[0, 0, 1], abs=1e-5)
    assert row["behaviour"] == "near"
    bout = rows_of(tmp_path / "birds_bouts.csv")[0]
    assert (bout["Observation id"], bout["Comment start"]) == ("'=result", "'=1+1")
    out = described(folder, tmp_path / "other.csv", "--feature", "features_of_a_user:depth")
    assert "depth_m" in rows_of(out)[0]


@pytest.mark.usefixtures("users_module")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--feature", "features_of_a_user:broken"], "feature 'broken': raised KeyError: 'no such thing'"),
        (["--feature", "features_of_a_user:flat"], "feature 'flat': returned an array of 60 (return a value for each"),
        (["--feature", "features_of_a_user:absent"], "has no function 'absent'"),
        (["--feature", "no_such_module:absent"], "cannot be imported: ModuleNotFoundError"),
        (["--feature", "body_ptich"], "did you mean body_pitch?"),
        (["--config", "fast"], "is not a known key"),
        (["--tracks", "9"], "has no track 9"),
        (["--frames", ""], "--frames: is '', not a range of frames"),
        (["--frames", "5:5"], "--frames: is '5:5': the range is empty"),
        (["--fps", "1e-9"], "--fps: is 1e-09 (give a number within"),
        (["--fps", "0"], "--fps: is 0.0 (give a number within 0.001 and 100,000)"),
    ],
)
def test_errors_write_nothing(folder, tmp_path, capsys, words, message):
    out = tmp_path / "out" / "birds.csv"
    out.parent.mkdir()
    rejected(capsys, ["describe", str(folder), "--out", str(out), *words], message, alone=False)
    assert not list(out.parent.iterdir())


def test_outputs_are_not_replaced(folder, tmp_path, capsys):
    (tmp_path / "birds_bouts.csv").write_text("mine", encoding="utf-8")
    rejected(capsys, ["describe", str(folder), "--out", str(tmp_path / "birds.csv")], "birds_bouts.csv")
    assert (tmp_path / "birds_bouts.csv").read_text(encoding="utf-8") == "mine"
    rejected(capsys, ["describe", str(folder), "--out", str(tmp_path / "birds.xlsx")], "must end with .csv")
    rejected(capsys, ["describe", str(tmp_path), "--out", str(tmp_path / "b.csv")], "poses.npz")


def test_a_result_without_a_pose(tmp_path, capsys):
    folder = written(tmp_path / "result", result(shape=(1, 3), valid=np.zeros((1, 3), bool)))
    rejected(capsys, ["describe", str(folder), "--out", str(tmp_path / "birds.csv")], "holds no pose")
