"""Camera files as other programs write them: projections of those programs, pixel conventions, units, round trips."""

import cv2
import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.camera_files import (
    ANIPOSE,
    FIVE,
    MATRIX,
    OTHER,
    ROTATION,
    RVEC,
    STEREO,
    TRANSL,
    camera_values,
    cell,
    matlab_values,
    write_colmap,
    write_storage,
)

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.files import read_camera_file, read_cameras, write_cameras

POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
ANIPOSE_POINTS_MM = np.array([[0, 0, 0], [100, 50, -200], [-300, 120, 80], [250, -160, 30.0]])
ANIPOSE_PIXELS = {  # aniposelib's `Camera.project` and `FisheyeCamera.project`
    "A": [
        [651.5260950068147, 334.762364591217],
        [797.7804208822165, 391.29876604635524],
        [391.51902788474973, 406.2878870393291],
        [822.4490012641862, 236.3097861100982],
    ],
    "back": [
        [496.4362617861193, 388.35383473264824],
        [494.27330202740086, 407.08955126181814],
        [430.00149048075275, 446.53471614167114],
        [576.3130704923864, 305.3542295943371],
    ],
}


def opencv_pixels(points, R=ROTATION, transl=TRANSL, distortion=FIVE, matrix=MATRIX):
    return cv2.projectPoints(points, cv2.Rodrigues(R)[0], transl, matrix, distortion)[0][:, 0]


# --- OpenCV


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize(
    "names",
    [
        {},
        {"matrix": "K", "distortion": "D"},
        {"matrix": "cameraMatrix", "distortion": "distCoeffs"},
        {"matrix": "intrinsicMatrix", "distortion": "dist_coeffs"},
        {"matrix": "Camera_Matrix", "distortion": "Distortion_Coefficients", "R": "rvec", "T": "tvec"},
    ],
)
def test_a_camera_of_opencv_projects_as_opencv(tmp_path, suffix, names):
    values = camera_values(**names)
    if "rvec" in values:
        values["rvec"] = RVEC
    write_storage(tmp_path / f"left.{suffix}", {"calibration_time": "Thu 1 May", "board_width": 9, **values})
    file = read_camera_file(tmp_path / f"left.{suffix}", "m")
    (camera,) = file.cameras
    assert file[1:] == ("OpenCV", "m", False)
    assert (camera.name, camera.size_px, camera.lens) == ("left", (1280, 720), "perspective")
    np.testing.assert_allclose(camera.project(POINTS), opencv_pixels(POINTS) + 0.5, atol=1e-6)


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
def test_several_cameras_in_one_file_have_the_names_of_their_keys(tmp_path, suffix):
    content = {"nr_of_cameras": 2, "left": camera_values(), "right": camera_values("K", "D", pose=OTHER)}
    write_storage(tmp_path / f"rig.{suffix}", content)
    left, right = read_cameras(tmp_path / f"rig.{suffix}", "m")
    assert (left.name, right.name) == ("left", "right")
    np.testing.assert_allclose(right.project(POINTS), opencv_pixels(POINTS, *OTHER) + 0.5, atol=1e-6)


def test_a_list_of_cameras_in_json(tmp_path):
    cameras = [
        f'{{"name": "c{i}", "K": {MATRIX.tolist()}, "R": {ROTATION.tolist()}, "T": [0, 0, {i}]}}' for i in (1, 2)
    ]
    (tmp_path / "rig.json").write_text(f'{{"unit": "cm", "cameras": [{", ".join(cameras)}]}}')
    file = read_camera_file(tmp_path / "rig.json")
    assert [camera.name for camera in file.cameras] == ["c1", "c2"]
    assert file[2:] == ("cm", False)
    assert file.cameras[1].transl_cam[2] == 0.02
    assert file.cameras[1].size_px is None


def test_a_folder_has_one_camera_in_each_file_in_natural_order(tmp_path):
    for name, pose in {"cam10": OTHER, "cam2": (ROTATION, TRANSL)}.items():
        write_storage(tmp_path / f"{name}.yaml", camera_values(pose=pose))
    cameras = read_cameras(tmp_path, "m")
    assert [camera.name for camera in cameras] == ["cam2", "cam10"]
    np.testing.assert_allclose(cameras[1].project(POINTS), opencv_pixels(POINTS, *OTHER) + 0.5, atol=1e-6)


RECTIFICATION = {"R": OTHER[0], "T": OTHER[1], "R1": np.eye(3), "R2": np.eye(3), "P1": np.eye(3, 4), "Q": np.eye(4)}


@pytest.mark.parametrize("names", ["M", "K", "cameraMatrix"])
def test_a_stereo_pair_of_one_file(tmp_path, names):
    renamed = {key.replace("M", names): value for key, value in STEREO.items()}
    write_storage(tmp_path / "stereo.yml", renamed | RECTIFICATION)
    first, second = read_cameras(tmp_path / "stereo.yml", "m")
    assert (first.name, second.name) == ("camera1", "camera2")
    ahead = POINTS + np.array([0, 0, 3])
    np.testing.assert_allclose(first.project(ahead), opencv_pixels(ahead, np.eye(3), np.zeros(3)) + 0.5, atol=1e-6)
    np.testing.assert_allclose(second.project(ahead), opencv_pixels(ahead, *OTHER) + 0.5, atol=1e-6)


def test_a_stereo_pair_of_two_files_as_in_opencvs_sample_or_with_sides(tmp_path):
    (tmp_path / "sample").mkdir()
    write_storage(tmp_path / "sample" / "intrinsics.yml", STEREO)
    write_storage(tmp_path / "sample" / "extrinsics.yml", RECTIFICATION)
    values = {"K_left": MATRIX, "D_left": FIVE, "K_right": MATRIX, "D_right": FIVE, "R": OTHER[0], "T": OTHER[1]}
    write_storage(tmp_path / "stereo.yml", values | {"image_width": 640, "image_height": 480})
    left, right = read_cameras(tmp_path / "stereo.yml", "m")
    assert (left.name, right.name, right.size_px) == ("left", "right", (640, 480))
    ahead = POINTS + np.array([0, 0, 3])
    for second in (read_cameras(tmp_path / "sample", "m")[1], right):
        np.testing.assert_allclose(second.project(ahead), opencv_pixels(ahead, *OTHER) + 0.5, atol=1e-6)


@pytest.mark.parametrize("flag", [{"fisheye_model": 1}, {"distortion_model": "equidistant"}])
def test_a_fisheye_camera_of_opencv(tmp_path, flag):
    coefficients = np.array([0.05, -0.01, 0.004, -0.001])
    values = {"K": MATRIX, "D": coefficients, "rvec": RVEC, "tvec": TRANSL, **flag}
    write_storage(tmp_path / "wide.yml", values)
    (camera,) = read_cameras(tmp_path / "wide.yml", "m")
    expected = cv2.fisheye.projectPoints(POINTS[:, None], RVEC, TRANSL, MATRIX, coefficients)[0]
    np.testing.assert_allclose(camera.project(POINTS), expected[:, 0] + 0.5, atol=1e-6)


def test_a_camera_info_file_of_ros_has_no_pose_and_needs_no_unit(tmp_path):
    text = "image_width: 800\nimage_height: 600\ncamera_name: narrow\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
    text += "  data: [538.63, 0, 457.698, 0, 539.723, 297.003, 0, 0, 1]\ndistortion_model: plumb_bob\n"
    text += "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-0.30678, 0.0825017, 0.0028784, -0.00015829, 0]\n"
    (tmp_path / "camera.yaml").write_text(text)
    file = read_camera_file(tmp_path / "camera.yaml")
    assert file[1:] == ("OpenCV", None, False)
    (camera,) = file.cameras
    assert (camera.name, camera.size_px) == ("narrow", (800, 600))
    np.testing.assert_allclose(camera.matrix, [[538.63, 0, 458.198], [0, 539.723, 297.503], [0, 0, 1]])
    np.testing.assert_array_equal(camera.R_cam_world, np.eye(3))


# --- JARVIS

JARVIS = """%YAML:1.0
---
intrinsicMatrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 7.6e+02, 0., 0., 0., 7.62e+02,
       0., 6.3e+02, 5.01e+02, 1. ]
distortionCoefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -3.6e-02, 5.0e-02, 0., 0., 0. ]
R: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {} ]
T: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ 1.4e+01, -4.0e+01, 9.35e+02 ]
"""


def jarvis_pixels(points, path):
    """Project as JARVIS-HybridNet (`ReprojectionTool.reprojectPoint`): row vectors, radial distortion only."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    R, T, K, D = (storage.getNode(name).mat() for name in ("R", "T", "intrinsicMatrix", "distortionCoefficients"))
    projection = np.concatenate([R, T.reshape(1, 3)]) @ K
    homogeneous = np.c_[points, np.ones(len(points))] @ projection
    offset = homogeneous[:, :2] / homogeneous[:, 2:] - K[2, :2]
    r2 = ((offset / np.diag(K)[:2]) ** 2).sum(axis=1, keepdims=True)
    return offset * (1 + (D[0, 0] + D[0, 1] * r2) * r2) + K[2, :2]


def test_cameras_of_jarvis_project_as_jarvis(tmp_path):
    for name, R in {"Camera_T": ROTATION, "Camera_LBB": OTHER[0]}.items():
        numbers = ", ".join(map(repr, R.T.ravel().tolist()))
        (tmp_path / f"{name}.yaml").write_text(JARVIS.format(numbers))
    file = read_camera_file(tmp_path)
    assert file[1:] == ("JARVIS", "mm", True)
    assert [camera.name for camera in file.cameras] == ["Camera_LBB", "Camera_T"]
    for camera in file.cameras:
        expected = jarvis_pixels(POINTS * 100, tmp_path / f"{camera.name}.yaml")
        np.testing.assert_allclose(camera.project(POINTS * 0.1), expected + 0.5, atol=1e-6)
    (single,) = read_cameras(tmp_path / "Camera_T.yaml")
    np.testing.assert_array_equal(single.project(POINTS), file.cameras[1].project(POINTS))


# --- anipose


def test_cameras_of_anipose_project_as_aniposelib(tmp_path):
    (tmp_path / "calibration.toml").write_text(ANIPOSE)
    file = read_camera_file(tmp_path / "calibration.toml")
    assert file[1:] == ("anipose", "mm", True)
    assert [(camera.size_px, camera.lens) for camera in file.cameras] == [
        ((1280, 720), "perspective"),
        ((1024, 768), "fisheye"),
    ]
    for camera in file.cameras:
        pixels = camera.project(ANIPOSE_POINTS_MM / 1000)
        np.testing.assert_allclose(pixels, np.array(ANIPOSE_PIXELS[camera.name]) + 0.5, atol=1e-6)
    assert read_camera_file(tmp_path)[1:] == file[1:]  # the folder of the file


def test_pose2sim_uses_metres_and_names_its_sections_by_camera(tmp_path):
    text = '[cam_01]\nname = "cam_01"\nsize = [ 1088.0, 1920.0]\n'
    text += "matrix = [ [ 1681.2, 0.0, 540.4], [ 0.0, 1681.1, 977.9], [ 0.0, 0.0, 1.0]]\n"
    text += "distortions = [ -0.04, 0.03, -0.0008, 0.0004]\nrotation = [ 0.9, -1.0, 1.5]\n"
    text += "translation = [ 0.8, 0.4, 5.5]\nfisheye = false\n\n[metadata]\nadjusted = false\nerror = 0.0\n"
    (tmp_path / "Calib.toml").write_text(text)
    file = read_camera_file(tmp_path / "Calib.toml")
    assert file[1:] == ("Pose2Sim or Caliscope", "m", True)
    assert file.cameras[0].size_px == (1088, 1920)
    np.testing.assert_array_equal(file.cameras[0].transl_cam, [0.8, 0.4, 5.5])


def in_metres(text):
    """The cameras of anipose with the translations in metres."""
    return text.replace("12.5, -30.0, 1500.0", "0.0125, -0.03, 1.5").replace(
        "-40.0, 20.25, 1800.0", "-0.04, 0.02025, 1.8"
    )


def test_exports_of_caliscope_are_in_metres(tmp_path):
    """Caliscope writes `fisheye = false`, or no such line if all cameras are fisheye cameras."""
    mixed = in_metres(ANIPOSE).replace('name = "A"', 'name = "A"\nfisheye = false')
    millimetres = (ANIPOSE, "anipose")
    for text, expected in ((mixed, "Pose2Sim or Caliscope"), (in_metres(ANIPOSE), "anipose"), millimetres):
        (tmp_path / "cameras.toml").write_text(text)
        file = read_camera_file(tmp_path / "cameras.toml")
        assert (file.format, file.unit_assumed) == (expected, True)
        np.testing.assert_allclose(file.cameras[0].transl_cam, [0.0125, -0.03, 1.5])


def test_the_cameras_of_caliscope(tmp_path):
    text = ""
    for number, ignore in ((0, "false"), (1, "true"), (2, "false")):
        text += f"[cameras.{number}]\ncam_id = {number}\nrotation_count = 1\nignore = {ignore}\nsize = [1280, 720]\n"
        text += f"matrix = {MATRIX.tolist()}\ndistortions = {FIVE.tolist()}\n"
        text += f"rotation = {ROTATION.tolist()}\ntranslation = {TRANSL.tolist()}\n\n"
    (tmp_path / "camera_array.toml").write_text(text)
    file = read_camera_file(tmp_path / "camera_array.toml")
    assert file[1:] == ("Caliscope", "m", True)
    assert [camera.name for camera in file.cameras] == ["cam_0", "cam_2"]
    np.testing.assert_allclose(file.cameras[0].project(POINTS), opencv_pixels(POINTS) + 0.5, atol=1e-6)


# --- Kalibr

KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.09, 0.001, -0.0005]
  distortion_model: radtan
  intrinsics: [1200.0, 1180.0, 640.25, 355.5]
  resolution: [1280, 720]
  rostopic: /cam0/image_raw
"""


def chain(key, *poses):
    """Return the camchain of cameras with equal lenses, and their poses under a key."""
    text = ""
    for number, (R, transl) in enumerate(poses):
        pose = np.vstack([np.c_[R, transl], [0, 0, 0, 1]])
        lines = "".join(f"  - {row}\n" for row in pose.tolist())
        text += KALIBR.replace("cam0", f"cam{number}") + (f"  {key}:\n{lines}" if number or key == "T_cam_imu" else "")
    return text


def test_a_camchain_of_kalibr(tmp_path):
    path, rest = tmp_path / "camchain.yaml", (np.eye(3), np.zeros(3))
    first, second = (ROTATION, TRANSL), (OTHER[0] @ ROTATION, OTHER[0] @ TRANSL + OTHER[1])
    for text, truth in (
        (chain("T_cam_imu", first, OTHER), (first, OTHER)),
        (chain("T_cn_cnm1", rest, first, OTHER), (rest, first, second)),
    ):
        path.write_text(text)
        file = read_camera_file(path)
        assert file[1:] == ("Kalibr", "m", True)
        assert [camera.name for camera in file.cameras] == [f"cam{number}" for number in range(len(truth))]
        for camera, (R, transl) in zip(file.cameras, truth, strict=True):
            points = (POINTS + np.array([0, 0, 3]) - transl) @ R  # ahead of the camera
            expected = opencv_pixels(points, R, transl, FIVE[:4])
            np.testing.assert_allclose(camera.project(points), expected + 0.5, atol=1e-6)
    path.write_text(KALIBR.replace("radtan", "equidistant"))
    assert read_cameras(path)[0].lens == "fisheye"


def test_the_aviary_of_the_authors_of_avian_mesh(reference_dir):
    """Eight cameras in two planes 5.3 m apart (`utils/extrinsic_calib_v2.yaml` of avian-mesh)."""
    path = reference_dir / "cases" / "kalibr_camchain_refused" / "extrinsic_calib_v2.yaml"
    cameras = read_cameras(path)
    x, y, z = np.array([camera.position_world for camera in cameras]).T
    assert len(cameras) == 8
    np.testing.assert_allclose(x, 4 * [0.37] + 4 * [5.64], atol=0.04)
    for side in (y, z):
        assert np.ptp(side) == pytest.approx(2.0, abs=0.15)


# --- DANNCE


def matlab_pixels(points_mm, values):
    """Project as DANNCE: row vectors (`camera_matrix`), and the distortion of `distortPoints`."""
    on_plane = np.c_[points_mm, np.ones(len(points_mm))] @ np.concatenate([values["r"], values["t"]])
    x, y = (on_plane[:, :2] / on_plane[:, 2:]).T
    r2 = x**2 + y**2
    k = [*values["RDistort"][0], 0.0][:3]
    p1, p2 = values["TDistort"][0]
    radial = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
    dx, dy = 2 * p1 * x * y + p2 * (r2 + 2 * x**2), p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    homogeneous = np.c_[x * radial + dx, y * radial + dy, np.ones(len(x))] @ values["K"]
    return homogeneous[:, :2]


@pytest.mark.parametrize(("compressed", "radial"), [(False, (-0.28, 0.09)), (True, (-0.28, 0.09, -0.01))])
def test_cameras_of_label3d_project_as_dannce(tmp_path, compressed, radial):
    params = [matlab_values(radial=radial), matlab_values(*OTHER, radial=radial)]
    names = cell(["CameraL", "CameraR"]).T
    sync = cell([{"data_frame": np.arange(50_000.0), "data_sampleID": np.arange(50_000.0)}] * 2)
    content = {"sync": sync, "params": cell(params), "camnames": names, "labelData": cell([{"data_2d": np.eye(3)}] * 2)}
    scipy.io.savemat(tmp_path / "label3d_dannce.mat", content, do_compression=compressed)
    file = read_camera_file(tmp_path / "label3d_dannce.mat")
    assert file[1:] == ("DANNCE", "mm", True)
    assert [(camera.name, camera.size_px) for camera in file.cameras] == [("CameraL", None), ("CameraR", None)]
    for camera, values in zip(file.cameras, params, strict=True):
        expected = matlab_pixels(POINTS * 1000, values) - 0.5
        np.testing.assert_allclose(camera.project(POINTS), expected, atol=1e-6)


def test_a_calibration_folder_of_dannce(tmp_path):
    for number in (10, 2):
        scipy.io.savemat(tmp_path / f"hires_cam{number}_params.mat", matlab_values(transl=TRANSL * number))
    cameras = read_cameras(tmp_path, "cm")
    assert [camera.name for camera in cameras] == ["Camera2", "Camera10"]
    np.testing.assert_allclose(cameras[1].transl_cam, TRANSL * 100)
    scipy.io.savemat(tmp_path / "hires_cam3_params.mat", {"params": cell([matlab_values()])})  # without camnames
    assert read_cameras(tmp_path / "hires_cam3_params.mat")[0].name == "Camera1"


# --- COLMAP

MODELS = {
    "SIMPLE_PINHOLE 1280 720 1200 640.25 355.5": [],
    "PINHOLE 1280 720 1200 1180 640.25 355.5": [],
    "SIMPLE_RADIAL 1280 720 1200 640.25 355.5 -0.28": [-0.28, 0, 0, 0],
    "RADIAL 1280 720 1200 640.25 355.5 -0.28 0.09": [-0.28, 0.09, 0, 0],
    "OPENCV 1280 720 1200 1180 640.25 355.5 -0.28 0.09 0.001 -0.0005": [-0.28, 0.09, 0.001, -0.0005],
    "FULL_OPENCV 1280 720 1200 1180 640.25 355.5 -0.2 0.05 0.001 -0.0005 0.01 0.05 -0.02 0.003": [
        -0.2, 0.05, 0.001, -0.0005, 0.01, 0.05, -0.02, 0.003,
    ],
    "FISHEYE 1280 720 1200 1180 640.25 355.5": [0, 0, 0, 0],
    "SIMPLE_RADIAL_FISHEYE 1280 720 1200 640.25 355.5 0.05": [0.05, 0, 0, 0],
    "RADIAL_FISHEYE 1280 720 1200 640.25 355.5 0.05 -0.01": [0.05, -0.01, 0, 0],
    "OPENCV_FISHEYE 1280 720 1200 1180 640.25 355.5 0.05 -0.01 0.004 -0.001": [0.05, -0.01, 0.004, -0.001],
}  # fmt: skip


@pytest.mark.parametrize("model", MODELS)
def test_models_of_colmap_project_as_their_formulas(tmp_path, model):
    """COLMAP's principal points have pixel centres at i + 0.5, so OpenCV's function gives jaxfit's pixels directly."""
    write_colmap(tmp_path, model)
    file = read_camera_file(tmp_path, "m")
    assert file[1:] == ("COLMAP", "m", False)
    name, *_ = model.split()
    matrix = MATRIX.copy()
    if name.startswith(("SIMPLE", "RADIAL")):
        matrix[1, 1] = matrix[0, 0]
    for camera, (R, transl) in zip(file.cameras, [(ROTATION, TRANSL), OTHER], strict=True):
        if "FISHEYE" in name:
            arguments = cv2.Rodrigues(R)[0], transl, matrix, np.array(MODELS[model], float)
            expected = cv2.fisheye.projectPoints(POINTS[:, None], *arguments)[0][:, 0]
        else:
            expected = opencv_pixels(POINTS, R, transl, np.array(MODELS[model] or [0, 0, 0, 0], float), matrix)
        np.testing.assert_allclose(camera.project(POINTS), expected, atol=1e-6)
        assert camera.size_px == (1280, 720)


@pytest.mark.parametrize(
    ("images", "expected"),
    [
        (("left/0.jpg", "right/0.jpg"), ["left", "right"]),
        (("P1180141.JPG", "P 2.JPG"), ["P1180141", "P 2"]),
        (("rig/left.png", "rig/right.png"), ["rig/left", "rig/right"]),
    ],
)
def test_cameras_of_colmap_have_the_names_of_their_images(tmp_path, images, expected):
    write_colmap(tmp_path, names=images)
    for path in (tmp_path, tmp_path / "cameras.txt", tmp_path / "images.txt"):
        assert [camera.name for camera in read_cameras(path, "m")] == expected


# --- writing


def test_aniposelib_keeps_the_order_of_many_cameras(tmp_path):
    """aniposelib sorts the sections by name."""
    write_cameras([Camera(str(i), MATRIX, FIVE, ROTATION, TRANSL) for i in range(12)], tmp_path / "many.toml")
    sections = [line for line in (tmp_path / "many.toml").read_text().splitlines() if line.startswith("[cam_")]
    assert len(sections) == 12
    assert sorted(sections) == sections
    assert [camera.name for camera in read_cameras(tmp_path / "many.toml")] == [str(i) for i in range(12)]


finite = st.floats(-1e6, 1e6)
sizes = st.none() | st.tuples(st.integers(1, 16_384), st.integers(1, 16_384))
names = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=20)


@st.composite
def any_camera(draw):
    lens, counts = draw(st.sampled_from([("perspective", (0, 4, 5, 8, 12, 14)), ("fisheye", (4,))]))
    fx, fy = draw(st.tuples(st.floats(1, 1e5), st.floats(1, 1e5)))
    skew, cx, cy = draw(st.tuples(*[st.floats(-1e4, 1e4)] * 3))
    count = draw(st.sampled_from(counts))
    distortion = np.array(draw(st.lists(st.floats(-10, 10), min_size=count, max_size=count)))
    rotation = Rotation.from_rotvec(draw(st.lists(st.floats(-4, 4), min_size=3, max_size=3))).as_matrix()
    transl = np.array(draw(st.lists(finite, min_size=3, max_size=3)))
    return Camera(
        draw(names), [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], distortion, rotation, transl, draw(sizes), lens
    )


@settings(max_examples=60, deadline=None)
@given(st.lists(any_camera(), min_size=1, max_size=3, unique_by=lambda camera: camera.name))
def test_any_camera_is_read_back_as_it_was_written(tmp_path_factory, cameras):
    path = tmp_path_factory.mktemp("cameras") / "cameras.toml"
    write_cameras(cameras, path)
    file = read_camera_file(path)
    assert file[1:] == ("anipose", "m", False)
    for before, after in zip(cameras, file.cameras, strict=True):
        assert (before.name, before.size_px, before.lens) == (after.name, after.size_px, after.lens)
        np.testing.assert_array_equal(after.distortion, before.distortion)
        np.testing.assert_array_equal(after.transl_cam, before.transl_cam)
        np.testing.assert_allclose(after.matrix, before.matrix, rtol=0, atol=1e-11)  # ± 0.5 rounds
        np.testing.assert_allclose(after.R_cam_world, before.R_cam_world, rtol=0, atol=1e-14)


def test_cameras_that_no_file_can_hold_are_refused(tmp_path):
    camera = Camera("a", MATRIX, FIVE, ROTATION, TRANSL)
    with pytest.raises(ValueError, match="cameras must hold at least one camera"):
        write_cameras([], tmp_path / "none.toml")
    with pytest.raises(ValueError, match="different names"):
        write_cameras([camera, camera], tmp_path / "two.toml")
    assert not list(tmp_path.iterdir())
