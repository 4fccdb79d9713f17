"""Camera files that jaxfit refuses: each is one InputError with file, field and remedy, without a crash or a hang."""

import numpy as np
import pytest
from support.camera_files import (
    ANIPOSE,
    MATRIX,
    ROTATION,
    STEREO,
    camera_values,
    matlab_values,
    write_colmap,
    write_storage,
)

from jaxfit.cameras.files import read_camera_file, read_cameras
from jaxfit.cameras.formats import dannce
from jaxfit.foundation.errors import InputError


def refused(path, message, unit="m"):
    with pytest.raises(InputError, match=message) as error:
        read_cameras(path, unit)
    assert "(" in str(error.value)  # the remedy


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.toml", b"", "is empty"),
        ("a.yaml", b" \n\n", "is empty"),
        ("a.txt", b"hello cameras\n", "is of no known format"),
        ("a.pickle", b"\x80\x04\x95\x00\x00cnumpy\n", "is of no known format"),
        ("a.npz", b"PK\x03\x04\x00\x00", "is of no known format"),
        ("a.toml", b"[cam_0]\nname = 'x", "is not a TOML file of cameras that can be read"),
        ("a.toml", b"nesting = 1\n[calibration]\nboard = 'x'\n", "nesting is not the table of a camera"),
        ("a.toml", b"[metadata]\nunit = 'm'\n", "holds no camera"),
        ("a.toml", b"metadata = 3\n", "metadata must be a table"),
        ("a.toml", b"\xff\xfe[cam]", "is not UTF-8 text"),
        ("a.json", b"[1, 2]", "is of no known format"),
        ("a.json", b'{"images": [], "annotations": []}', "holds no camera"),
        ("a.yaml", b"%YAML:1.0\n---\na: [1, 2", "can be read: line 2: expected"),
        ("a.yaml", b"%YAML:1.0\n---\n- 1\n", "holds no keys"),
        ("a.yaml", b"%YAML:1.0\n---\na: 1\na: 2\n", "line 3: found duplicate key"),
        ("a.yaml", b"%YAML:1.0\n---\na: &x [1]\nb: *x\n", "holds an alias"),
        ("a.xml", b'<?xml version="1.0"?>\n<opencv_storage><K>', "can be read: no element found"),
        ("a.mat", b"MATLAB 5.0 MAT-file", "is not a .mat file of MATLAB 5 to 7 that can be read"),
        ("a.mat", b"MATLAB 7.3 MAT-file, Platform: x" + bytes(600), "version 7.3.*-v7"),
        ("a.mat", b"\x89HDF\r\n\x1a\n" + bytes(600), "version 7.3.*-v7"),
        ("cameras.bin", b"\x01\x00\x00", "binary model of COLMAP.*model_converter"),
    ],
)
def test_a_file_of_another_kind_is_refused(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    refused(tmp_path / name, message)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("[ 1280, 720,]", "[ 0, 720,]", r"\[cam_0\]: size_px must be in 1"),
        ("[ 1280, 720,]", "[ 1280.5, 720,]", "cam_0.size must hold two whole numbers"),
        ("[ 1280, 720,]", "[ 1280, 720, 3]", "cam_0.size must have the shape 2, not 3"),
        ('"A"', '"back"', 'two cameras with the name "back"'),
        ('"A"', '""', "name must not be empty"),
        ('"A"', "[1]", "cam_0.name must be text"),
        ("-0.4, 0.1,", "nan, 0.1,", "cam_0.rotation holds a value that is not finite"),
        ("-0.4, 0.1,", "1e11, 0.1,", r"cam_0.rotation is a rotation of 1e\+11 radians, more than 100"),
        ("641.5", "6e9", r"\[cam_0\]: matrix holds 6e\+09, more than 1e\+07"),
        ("-30.0,", "inf,", "cam_0.translation holds a value that is not finite"),
        ("-30.0,", "1e300,", r"transl_cam holds 1e\+300, more than 1e\+12"),
        ("-30.0,", "", "cam_0.translation must have the shape 3, not 2"),
        ("-30.0,", "'x',", "cam_0.translation must hold numbers"),
        ("-30.0,", f"1{'0' * 400},", "cam_0.translation must hold numbers"),
        ("0.0, 1199.5", "1199.5", "cam_0.matrix has rows of different lengths"),
        ("1203.25", "-1203.25", r"\[cam_0\]: matrix must be .* focal lengths above 0"),
        ("0.08, 0.0, 0.0, 0.0,", "0.08,", r"\[cam_0\]: distortion of a perspective lens must have"),
        ("translation = [ 12", "translatio = [ 12", r"\[cam_0\] lacks translation"),
        ("fisheye = true", "fisheye = 'yes'", "cam_1.fisheye must be true or false"),
        ("error = 0.41", "unit = 'inch'", "metadata.unit must be m, cm or mm"),
        ("error = 0.41", "unit = 'mm'", "states the unit mm, not m"),
    ],
)
def test_an_impossible_value_of_anipose_is_refused(tmp_path, before, after, message):
    assert before in ANIPOSE
    (tmp_path / "a.toml").write_text(ANIPOSE.replace(before, after, 1))
    refused(tmp_path / "a.toml", message)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"R": np.zeros((3, 3))}, "camera a: R_cam_world must be a rotation"),
        ({"R": np.diag([1.0, 1, -1])}, "camera a: R_cam_world must be a rotation"),
        ({"R": ROTATION[:2]}, "r must have the shape 3×3 or 3, not 2×3"),
        ({"R": None}, "t is only half of a pose"),
        ({"T": np.array([0, np.nan, 0])}, "t must hold numbers"),
        ({"camera_matrix": np.eye(2)}, "cameramatrix must have the shape 3×3, not 2×2"),
        ({"camera_matrix": MATRIX.T}, "camera a: matrix must be"),
        ({"camera_matrix": None}, "holds no camera.*camera_matrix, K"),
        ({"distortion_coefficients": np.zeros(3)}, "must have 0, 4, 5, 8, 12, 14 coefficients, not 3"),
        ({"image_width": 0}, "camera a: size_px must be in 1"),
        ({"distortion_model": "omnidirectional"}, "distortion_model is 'omnidirectional'"),
        ({"unit": "inch"}, "unit must be m, cm or mm"),
    ],
)
@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_an_impossible_value_of_opencv_is_refused(tmp_path, changes, message, suffix):
    values = {key: value for key, value in (camera_values() | changes).items() if value is not None}
    write_storage(tmp_path / f"a.{suffix}", values)
    if suffix == "json" and "nan" in str(changes):  # OpenCV writes `.Nan`, which is no JSON
        message = "is not valid JSON"
    refused(tmp_path / f"a.{suffix}", message)


def test_a_matrix_that_states_another_size_is_refused(tmp_path):
    write_storage(tmp_path / "a.yml", camera_values())
    text = (tmp_path / "a.yml").read_text()
    for rows in ("4", "1000000000000", "x"):
        (tmp_path / "a.yml").write_text(text.replace("rows: 3", f"rows: {rows}", 1))
        refused(tmp_path / "a.yml", "cameramatrix has another number of values than rows × cols")


def test_cameras_without_poses_or_with_different_units_are_refused(tmp_path):
    write_storage(tmp_path / "rig.yml", {"left": {"K": MATRIX}, "right": {"K": MATRIX}})
    refused(tmp_path / "rig.yml", "lacks the poses of 2 cameras, such as left")
    write_storage(tmp_path / "rig.yml", STEREO)
    refused(tmp_path / "rig.yml", "holds two cameras without R and T")
    write_storage(tmp_path / "rig.yml", {"left": camera_values() | {"unit": "m"}, "right": camera_values()})
    refused(tmp_path / "rig.yml", "cameras with different units")


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("pinhole", "omni", "cam0.camera_model is 'omni', a model of Kalibr that is not read"),
        ("radtan", "fov", "cam0.distortion_model is 'fov', a model of Kalibr that is not read"),
        ("100, 100, 50, 50", "100, 100, 50", "cam0.intrinsics must have the shape 4, not 3"),
        ("cam2", "cam1", "cam1 lacks its pose, T_cn_cnm1"),
    ],
)
def test_an_impossible_value_of_kalibr_is_refused(tmp_path, before, after, message):
    section = "{}:\n  camera_model: pinhole\n  distortion_model: radtan\n  intrinsics: [100, 100, 50, 50]\n"
    text = section.format("cam0") + (section.format("cam2") if before == "cam2" else "")
    (tmp_path / "camchain.yaml").write_text(text.replace(before, after))
    refused(tmp_path / "camchain.yaml", message)


def test_an_unknown_unit_of_length_is_refused(tmp_path):
    write_storage(tmp_path / "a.yml", camera_values())
    refused(tmp_path / "a.yml", "is a file of OpenCV, which does not state its unit .*give the unit", unit=None)
    (tmp_path / "model").mkdir()
    write_colmap(tmp_path / "model")
    refused(tmp_path / "model", "is a file of COLMAP, which does not state its unit", unit=None)
    with pytest.raises(ValueError, match="unit must be one of m, cm, mm or None, not 'inch'"):
        read_camera_file(tmp_path / "a.yml", "inch")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"K": MATRIX}, "K must be MATLAB's IntrinsicMatrix"),
        ({"r": np.zeros((3, 3))}, "must be a rotation"),
        ({"t": np.zeros(2)}, "t must have the shape 3, not 2"),
        ({"t": np.array([0, np.inf, 0])}, "t holds a value that is not finite"),
        ({"RDistort": np.zeros(6)}, "RDistort and TDistort have 6 and 2 numbers"),
        ({"K": "text"}, "K must hold numbers"),
        ({"m": 1.0}, "m marks the image of a mirror"),
        ({"K": None}, "lacks K"),
    ],
)
def test_an_impossible_value_of_dannce_is_refused(tmp_path, monkeypatch, changes, message):
    values = {key: value for key, value in (matlab_values() | changes).items() if value is not None}
    monkeypatch.setattr(dannce, "read_variables", lambda *_: {"params": [matlab_values(), values]})
    (tmp_path / "rig.mat").write_bytes(b"MATLAB")
    refused(tmp_path / "rig.mat", rf"params\{{2\}}.*{message}")


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"x": 1.0}, "the file lacks K, R, t"),
        ({"params": [1.0]}, r"params\{1\} is not a struct"),
        ({"params": [matlab_values()] * 2, "camnames": ["a", "b", "c"]}, "holds 2 cameras and 3 camnames"),
        ({"params": [matlab_values()] * 2, "camnames": ["a", "a"]}, 'two cameras with the name "a"'),
    ],
)
def test_another_structure_of_a_mat_file_is_refused(tmp_path, monkeypatch, variables, message):
    monkeypatch.setattr(dannce, "read_variables", lambda *_: variables)
    (tmp_path / "a.mat").write_bytes(b"MATLAB")
    refused(tmp_path / "a.mat", message)


@pytest.mark.parametrize(
    ("file", "before", "after", "message"),
    [
        ("cameras.txt", "PINHOLE 1280", "FOV 1280", "camera model FOV is not supported"),
        ("cameras.txt", "1180 640", "640", "line 4 has 3 parameters; PINHOLE has 4"),
        ("cameras.txt", "1280 720", "0 720", "size_px must be in 1"),
        ("cameras.txt", "1180", "nan", "matrix must be finite"),
        ("cameras.txt", "1180", "x", "line 4 holds text where numbers are expected"),
        ("cameras.txt", "7 PINHOLE", "7.5 PINHOLE", "line 4 holds text where numbers are expected"),
        ("cameras.txt", "7 PINHOLE", "8 PINHOLE", "names camera 7, which cameras.txt lacks"),
        ("images.txt", "left/0.jpg", "right/0.jpg", 'two cameras with the name "right/0"'),
        ("images.txt", " 7 left/0.jpg", "", "line 5 has fewer than 10 entries"),
    ],
)
def test_an_impossible_value_of_colmap_is_refused(tmp_path, file, before, after, message):
    write_colmap(tmp_path)
    text = (tmp_path / file).read_text()
    assert before in text
    (tmp_path / file).write_text(text.replace(before, after, 1))
    refused(tmp_path, message)


def test_a_zero_quaternion_and_a_missing_file_of_colmap_are_refused(tmp_path):
    write_colmap(tmp_path)
    (tmp_path / "images.txt").write_text("1 0 0 0 0 0 0 1 7 a.jpg\n\n")
    refused(tmp_path, "line 1 has a quaternion that is no rotation")
    (tmp_path / "images.txt").unlink()
    refused(tmp_path / "cameras.txt", "images.txt: does not exist")


def test_folders_without_a_clear_file_of_cameras_are_refused(tmp_path):
    refused(tmp_path / "none", "does not exist .*`jaxfit cameras calibrate` writes cameras")
    refused(tmp_path, "holds no file of cameras")
    (tmp_path / "a.toml").write_text(ANIPOSE)
    (tmp_path / "b.toml").write_text(ANIPOSE)
    refused(tmp_path, "holds 2 TOML files")
    (tmp_path / "c.yaml").write_text("a: 1")
    refused(tmp_path, "holds TOML files and YAML or XML files")
    (tmp_path / "bin").mkdir()
    for name in ("cameras.bin", "images.bin"):
        (tmp_path / "bin" / name).write_bytes(b"\1")
    refused(tmp_path / "bin", "is a binary model of COLMAP")
