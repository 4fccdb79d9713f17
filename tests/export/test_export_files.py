"""Exported tables, netCDF and keypoint files hold the numbers of the result; wrong use is one clear error."""

import csv
import dataclasses
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from support.birds import error_bars
from support.exported import BIRD, FPS, FRAMES, TRACKS, solution, write_result

import jaxfit
from jaxfit.cli.main import main
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import OPTIONAL_PACKAGES

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "result"
    write_result(folder, with_detections=True, video="/films/a\nb.mp4")
    return folder


@pytest.fixture(scope="module")
def made(folder):
    return jaxfit.load_solution(folder)[0]


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def column(rows, name):
    return np.array([float(row[name] or "nan") for row in rows], np.float32).reshape(3, len(FRAMES))


def test_tables_hold_the_lengths_of_the_bodies(folder, tmp_path):
    made, bird = jaxfit.load_solution(folder)
    birds, bones, shapes = len(made.track_id), bird.num_joints - 1, bird.num_shapes
    sizes = {"bone_length": bones, "bone_length_sd": bones, "betas": shapes, "betas_sd": shapes}
    arrays = {name: np.zeros((birds, size)) for name, size in sizes.items()}
    arrays |= {"bone_length": np.outer([1, 1.1, np.nan], np.ones(bones)), "keypoint_scale": np.ones(birds)}
    arrays |= {"frames": np.array([5, 5, np.nan]), "determined": np.array([3, 3, np.nan])}
    arrays |= {"keypoint_offsets": np.zeros((birds, bird.num_keypoints, 3)), "outline_offset": np.zeros(birds)}
    bodies = made.with_arrays(**{f"body_{name}": np.float32(values) for name, values in arrays.items()})
    jaxfit.save_solution(bodies, bird, "", {}, tmp_path / "result")
    jaxfit.export_result(tmp_path / "result", "csv", tmp_path / "birds.csv", metres_per_unit=0.02)
    found = column(rows_of(tmp_path / "birds.csv"), "body_length")
    np.testing.assert_allclose(found[0], 1, rtol=1e-6)
    assert (found[1] > 1.02).all()
    assert np.isnan(found[2]).all()


def test_tables_hold_a_row_for_every_bird_and_frame(folder, made, tmp_path):
    jaxfit.export_result(folder, "csv", tmp_path / "birds.csv")
    rows, angles = rows_of(tmp_path / "birds.csv"), rows_of(tmp_path / "birds_angles.csv")
    assert [(row["track"], row["frame"]) for row in rows] == [(str(n), str(t)) for n in TRACKS for t in FRAMES]
    assert [row["status"] for row in rows[:: len(FRAMES)]] == ["ok", "partly diverged", "diverged"]
    valid = made.valid
    assert [row["fitted"] for row in rows] == ["TRUE" if fitted else "FALSE" for fitted in valid.ravel()]
    assert float(rows[3]["time_s"]) == pytest.approx(FRAMES[3] / FPS)
    assert 0 < float(rows[0]["track_mean_confidence"]) < 1
    for k, name in enumerate(made.keypoint_names):
        expected = np.where(valid, made.keypoints.px[:, :, k, 1], np.nan)
        np.testing.assert_array_equal(column(rows, f"{name}_y_px"), expected)
        expected = np.where(valid, made.keypoints.cam[:, :, k, 2] / made.poses.scale * 0.02, np.nan)
        np.testing.assert_allclose(column(rows, f"{name}_z_m"), expected, rtol=1e-6)
    for j, name in enumerate(made.joint_names[1:]):
        np.testing.assert_array_equal(
            column(angles, f"{name}_x_rad"), np.where(valid, made.poses.body_pose[:, :, j, 0], np.nan)
        )


def test_lengths_stay_in_model_units_where_the_unit_is_unknown(tmp_path, capsys):
    write_result(tmp_path / "result", bird=dataclasses.replace(BIRD, metres_per_unit=None))
    arguments = ["export", str(tmp_path / "result"), "--to", "csv"]
    assert main([*arguments, "--out", str(tmp_path / "a.csv")]) == 0
    assert "lengths are in model units" in capsys.readouterr().out
    assert main([*arguments, "--out", str(tmp_path / "b.csv"), "--metres-per-unit", "0.5"]) == 0
    in_units, in_metres = rows_of(tmp_path / "a.csv"), rows_of(tmp_path / "b.csv")
    np.testing.assert_allclose(column(in_metres, "root_z_m"), column(in_units, "root_z_unit") / 2, rtol=1e-6)


def test_parquet_equals_csv_and_names_units(folder, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    for to in ("csv", "parquet"):
        jaxfit.export_result(folder, to, tmp_path / f"birds.{to}", tracks=[7], frames=(12, 20))
    rows, table = rows_of(tmp_path / "birds.csv"), parquet.read_table(tmp_path / "birds.parquet")
    assert table.column_names == list(rows[0])
    for name in ("track", "time_s", "size", "crown_x_px", "crown_confidence"):
        values = table.column(name).to_pylist()
        assert [None if row[name] == "" else np.float32(row[name]) for row in rows] == [
            None if value is None else np.float32(value) for value in values
        ]
    assert [row["frame"] for row in rows] == ["12", "14", "18"]
    assert table.schema.field("crown_x_m").metadata == {b"unit": b"m"}


@pytest.mark.parametrize(
    ("dims", "names"), [("singular", ("keypoint", "individual")), ("plural", ("keypoints", "individuals"))]
)
def test_netcdf_for_movement(folder, made, tmp_path, dims, names):
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    pytest.importorskip("h5netcdf", reason="h5netcdf is not installed")
    out = tmp_path / "birds.nc"
    done = jaxfit.export_result(folder, "movement", out, dims=dims, space="3d")
    readers = {"singular": "movement 0.17 or newer reads this file", "plural": "movement 0.16 or older reads this file"}
    assert [note.partition(";")[0] for note in done.notes] == [readers[dims]]
    assert "--dims plural" in done.notes[0]
    with xarray.open_dataset(out, engine="h5netcdf") as data:
        assert data.position.dims == ("time", "space", *names)
        assert data.confidence.dims == ("time", *names)
        assert data.attrs["ds_type"] == "poses"
        assert data.attrs["source_software"] == "jaxfit"
        assert (data.attrs["fps"], data.attrs["time_unit"]) == (FPS / 2, "seconds")
        np.testing.assert_allclose(data.time, np.arange(10, 21, 2) / FPS)  # frame 16 is added
        assert data[names[1]].values.tolist() == ["bird_3", "bird_7", "bird_8"]
        assert data.status.values.tolist() == ["ok", "partly diverged", "diverged"]
        position = data.position.transpose(names[1], "time", names[0], "space").values
        assert np.isnan(position[:, 3]).all()
        expected = np.where(
            made.valid[..., None, None], made.keypoints.cam / made.poses.scale[..., None, None] * 0.02, np.nan
        )
        np.testing.assert_allclose(np.delete(position, 3, axis=1), expected, rtol=1e-6)


def test_error_bars(tmp_path):
    """Columns and a variable of standard deviations, in the units of their values."""
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    pytest.importorskip("h5netcdf", reason="h5netcdf is not installed")
    made = write_result(tmp_path / "result", **error_bars(solution(), 4.0))
    jaxfit.export_result(tmp_path / "result", "csv", tmp_path / "birds.csv")
    rows, angles = rows_of(tmp_path / "birds.csv"), rows_of(tmp_path / "birds_angles.csv")
    expected = np.where(made.valid, 2.0, np.nan)
    np.testing.assert_allclose(column(rows, "bill_tip_y_sd_px"), expected)
    np.testing.assert_allclose(column(rows, "orientation_z_sd_rad"), 2 * expected)
    np.testing.assert_allclose(column(angles, "neck_x_sd_rad"), 2 * expected)
    variance = sum(column(rows, f"bill_tip_{axis}_sd_m") ** 2 for axis in "xyz")  # rotations keep the trace
    np.testing.assert_allclose(variance, 12 * (expected / 2 * 0.02 / made.poses.scale) ** 2, rtol=1e-5)
    jaxfit.export_result(tmp_path / "result", "movement", tmp_path / "birds.nc")
    with xarray.open_dataset(tmp_path / "birds.nc", engine="h5netcdf") as data:
        assert data.position_sd.dims == data.position.dims
        assert np.nanmax(data.position_sd) == 2
        assert (np.isnan(data.position_sd) == np.isnan(data.position)).all()


@pytest.mark.parametrize(
    ("to", "name"), [("coco", "birds.json"), ("dlc", "birds.csv"), ("dlc", "birds.h5"), ("slp", "birds.slp")]
)
def test_keypoint_files_come_back_by_import(folder, made, tmp_path, to, name):
    jaxfit.export_result(folder, to, tmp_path / name)
    read = jaxfit.read_observations(tmp_path / name, size_px=None if to != "dlc" else (256, 256))
    poses = made.valid.any(1)
    at = np.searchsorted(read.frame_index, made.frame_index)
    assert read.keypoint_names == made.keypoint_names
    np.testing.assert_array_equal(read.present[:, at], made.valid[poses])
    points = np.where(read.present[..., None, None], read.keypoints_px, 0)[:, at]
    np.testing.assert_array_equal(points, np.where(made.valid[..., None, None], made.keypoints.px, 0)[poses])
    if to == "coco":
        assert read.track_id.tolist() == [3, 7]
        info = json.loads((tmp_path / name).read_text())["info"]
        assert json.loads(info["track_status"])["8"] == "diverged"


WRONG = {
    "unknown track": (["--to", "csv", "--tracks", "3,99"], "has no track 99 (its tracks are 3, 7, 8)"),
    "no list of tracks": (["--to", "csv", "--tracks", "3;4"], "--tracks: is '3;4', not a list of track ids"),
    "frames outside": (["--to", "csv", "--frames", "10:99"], "lacks the frames 10:99 (its frames are 10:21)"),
    "no range": (["--to", "csv", "--frames", "20:10"], "--frames: is '20:10': the range is empty"),
    "no numbers": (["--to", "csv", "--frames", "a:b"], "--frames: is 'a:b', not a range of frames"),
    "no rate": (["--to", "csv", "--fps", "0"], "--fps: is 0.0 (give a number within 0.001 and 100,000)"),
    "foreign option": (["--to", "csv", "--ground"], "--ground: does not belong to the format csv"),
    "no pose": (["--to", "coco", "--tracks", "8"], "holds no pose in the chosen tracks and frames"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_use_is_one_line(folder, tmp_path, capsys, case):
    arguments, message = WRONG[case]
    out = tmp_path / ("birds.json" if "coco" in arguments else "birds.csv")
    assert main(["export", str(folder), "--out", str(out), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_existing_output_is_kept(folder, tmp_path):
    (tmp_path / "birds_angles.csv").write_text("mine")
    with pytest.raises(InputError, match=r"birds_angles.csv: exists already"):
        jaxfit.export_result(folder, "csv", tmp_path / "birds.csv")
    with pytest.raises(InputError, match=r"must end with .csv"):
        jaxfit.export_result(folder, "csv", tmp_path / "birds.txt")
    jaxfit.export_result(folder, "csv", tmp_path / "birds.csv", overwrite=True)
    assert (tmp_path / "birds_angles.csv").read_text() != "mine"


def test_unknown_footage_and_frame_rate_are_required(tmp_path):
    write_result(tmp_path / "result", fps=None, timestamp_s=None)
    pytest.importorskip("h5netcdf", reason="h5netcdf is not installed")
    with pytest.raises(InputError, match=r"does not hold the frame rate of the footage .give --fps, or --video"):
        jaxfit.export_result(tmp_path / "result", "movement", tmp_path / "birds.nc")
    with pytest.raises(InputError, match=r"does not name its footage, which this format links .give --video"):
        jaxfit.export_result(tmp_path / "result", "slp", tmp_path / "birds.slp")
    assert jaxfit.export_result(tmp_path / "result", "movement", tmp_path / "birds.nc", fps=50).files
    jaxfit.export_result(tmp_path / "result", "csv", tmp_path / "birds.csv")
    assert rows_of(tmp_path / "birds.csv")[0]["time_s"] == ""


@pytest.mark.parametrize(
    ("to", "package", "out"), [("parquet", "pyarrow", "a.parquet"), ("movement", "xarray", "a.nc")]
)
def test_missing_and_old_packages_are_named(folder, tmp_path, monkeypatch, to, package, out):
    monkeypatch.setattr("jaxfit.foundation.extras.find_spec", lambda name: None)
    with pytest.raises(InputError, match=f"needs {package}, which this installation lacks .*formats"):
        jaxfit.export_result(folder, to, tmp_path / out)
    monkeypatch.setattr("jaxfit.foundation.extras.find_spec", lambda name: name)
    monkeypatch.setattr("jaxfit.foundation.extras.metadata.version", lambda name: "0.3.1+cpu")
    with pytest.raises(InputError, match=f"needs {package} .* or newer, but version 0.3.1.cpu is installed"):
        jaxfit.export_result(folder, to, tmp_path / out)


def test_versions_of_optional_packages_are_those_of_the_installation():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for name, package in OPTIONAL_PACKAGES.items():
        assert any(line.split(",")[0] == f"{name}>={package.lowest}" for line in extras[package.extra]), name
