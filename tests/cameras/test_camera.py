"""Cameras against OpenCV's own functions, which have pixel centres at whole numbers."""

import cv2
import numpy as np
import pytest

from jaxfit.cameras.camera import Camera

RNG = np.random.default_rng(0)
MATRIX = np.array([[1200.0, 0, 640.5], [0, 1180.0, 355.5], [0, 0, 1]])
FIVE = np.array([-0.28, 0.09, 1e-3, -5e-4, -0.01])
EIGHT = np.array([-0.2, 0.05, 1e-3, -5e-4, 0.01, 0.05, -0.02, 0.003])
FISHEYE = np.array([0.05, -0.01, 0.004, -0.001])
ROTATION = cv2.Rodrigues(np.array([0.2, -0.4, 0.1]))[0]
TRANSL = np.array([0.1, -0.2, 2.0])
POINTS = RNG.uniform(-0.5, 0.5, (40, 3))


def camera(distortion=(), lens="perspective", **changes):
    values = {"name": "left", "matrix": MATRIX, "distortion": np.array(distortion, float), "lens": lens}
    return Camera(**(values | {"R_cam_world": ROTATION, "transl_cam": TRANSL, "size_px": (1280, 720)} | changes))


@pytest.mark.parametrize("distortion", [(), FIVE[:4], FIVE, EIGHT])
def test_projection_agrees_with_opencv(distortion):
    opencv_matrix = MATRIX - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    rvec, coefficients = cv2.Rodrigues(ROTATION)[0], np.array(distortion, float)
    expected = cv2.projectPoints(POINTS, rvec, TRANSL, opencv_matrix, coefficients if len(coefficients) else None)[0]
    np.testing.assert_allclose(camera(distortion).project(POINTS), expected[:, 0] + 0.5, atol=1e-6)


def test_fisheye_projection_agrees_with_opencv():
    opencv_matrix = MATRIX - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    rvec = cv2.Rodrigues(ROTATION)[0]
    expected = cv2.fisheye.projectPoints(POINTS[:, None], rvec, TRANSL, opencv_matrix, FISHEYE)[0]
    np.testing.assert_allclose(camera(FISHEYE, "fisheye").project(POINTS), expected[:, 0] + 0.5, atol=1e-6)


@pytest.mark.parametrize(("distortion", "lens"), [((), "perspective"), (FIVE, "perspective"), (FISHEYE, "fisheye")])
def test_undistorted_pixels_are_those_of_the_pinhole_camera(distortion, lens):
    distorted = camera(distortion, lens)
    image_px = distorted.project(POINTS)
    np.testing.assert_allclose(distorted.undistort(image_px), distorted.pinhole().project(POINTS), atol=1e-5)
    np.testing.assert_allclose(distorted.distort(distorted.undistort(image_px)), image_px, atol=1e-5)


def test_pixels_outside_the_range_of_a_lens_are_nan():
    barrel = camera([-0.4, 0, 0, 0])  # r(1 − 0.4 r²) has its maximum at r = 0.91
    assert np.isnan(barrel.undistort(np.array([640.5 + 1200.0, 355.5]))).all()
    assert np.isnan(barrel.undistort(np.array([np.nan, 3.0]))).all()


def test_rays_lead_back_to_the_points():
    distorted = camera(FIVE)
    rays, points_cam = distorted.rays_cam(distorted.project(POINTS)), distorted.to_camera(POINTS)
    np.testing.assert_allclose(rays, points_cam / np.linalg.norm(points_cam, axis=1, keepdims=True), atol=1e-8)


def test_a_skewed_matrix_is_inverted():
    skewed = camera(matrix=MATRIX + np.array([[0, 30.0, 0], [0, 0, 0], [0, 0, 0]]))
    points_px = skewed.project(POINTS)
    rays = skewed.rays_cam(points_px)
    np.testing.assert_allclose(skewed.matrix @ (rays / rays[:, 2:]).T, np.c_[points_px, np.ones(40)].T, atol=1e-8)


def test_points_behind_the_camera_have_no_pixel():
    behind = camera().position_world - camera().R_cam_world[2]
    assert np.isnan(camera().project(behind)).all()
    assert not camera().inside(camera().project(behind))


def test_another_world_frame_and_unit_do_not_change_pixels():
    R, t = cv2.Rodrigues(np.array([1.0, 0.3, -2.0]))[0], np.array([3.0, -1.0, 0.5])
    first = camera(FIVE)
    np.testing.assert_allclose(first.moved(R, t).project(POINTS @ R.T + t), first.project(POINTS), atol=1e-8)
    np.testing.assert_allclose(first.scaled(1000).project(1000 * POINTS), first.project(POINTS), atol=1e-8)


def test_position_and_field_of_view():
    straight = camera(matrix=np.array([[640.0, 0, 640], [0, 640, 360], [0, 0, 1]]))
    np.testing.assert_allclose(straight.to_camera(straight.position_world), 0, atol=1e-12)
    np.testing.assert_allclose(straight.field_of_view_deg, (90, np.degrees(2 * np.arctan(360 / 640))))
    assert camera(size_px=None).field_of_view_deg is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": ""}, "name must not be empty"),
        ({"matrix": np.eye(2)}, "matrix must have the shape"),
        ({"matrix": -np.eye(3)}, "focal lengths above 0"),
        ({"R_cam_world": np.zeros((3, 3))}, "R_cam_world must be a rotation"),
        ({"R_cam_world": np.diag([1.0, 1, -1])}, "R_cam_world must be a rotation"),
        ({"transl_cam": [0, np.nan, 0]}, "transl_cam must be finite"),
        ({"distortion": np.zeros(3)}, "4, 5, 8, 12, 14 coefficients, not 3"),
        ({"lens": "mirror"}, "lens must be one of perspective, fisheye"),
        ({"size_px": (0, 3)}, "size_px must be in 1"),
        ({"matrix": np.array([[900, 0, 6e9], [0, 900, 300], [0, 0, 1]])}, r"matrix holds 6e\+09, more than 1e\+07"),
        ({"transl_cam": [0, 0, 1e33]}, r"transl_cam holds 1e\+33, more than 1e\+12"),
    ],
)
def test_impossible_values_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        camera(**changes)
