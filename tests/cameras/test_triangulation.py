"""Triangulation against known points, and against OpenCV's two-view triangulation."""

import cv2
import numpy as np
import pytest

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.triangulation import (
    epipolar_error_px,
    fundamental_matrix,
    reprojection_error_px,
    triangulate,
    triangulate_robustly,
)

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-0.5, 0.5, (30, 3)) + np.array(
    [100.0, 0, 0]
)  # far from the origin of the world, as in a national grid


def looking_at(position, name="cam", focal_px=1500.0):
    forward = np.array([100.0, 0, 0]) - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    matrix = np.array([[focal_px, 0, 640], [0, focal_px, 360], [0, 0, 1]])
    return Camera(name, matrix, np.zeros(0), R, -R @ position, (1280, 720))


RIG = [
    looking_at(np.array([100 + 4 * np.cos(a), 4 * np.sin(a), 2.0]), f"cam{i}") for i, a in enumerate([0, 0.8, 1.7, 3])
]
PIXELS = np.stack([camera.project(POINTS) for camera in RIG])
WEIGHT = np.ones(PIXELS.shape[:2])


def test_exact_pixels_give_the_points():
    np.testing.assert_allclose(triangulate(RIG, PIXELS, WEIGHT), POINTS, atol=1e-8)


def test_two_views_agree_with_opencv():
    noisy = PIXELS[:2] + RNG.normal(size=(2, 30, 2))
    P = [
        camera.matrix @ np.c_[camera.R_cam_world, camera.transl_cam + camera.R_cam_world @ [100.0, 0, 0]]
        for camera in RIG[:2]
    ]
    X = cv2.triangulatePoints(*P, *(px.T for px in noisy))
    expected = (X[:3] / X[3]).T + np.array([100.0, 0, 0])
    # the scale of the equations differs, so the points agree to a part of the noise
    assert np.abs(triangulate(RIG[:2], noisy, WEIGHT[:2]) - expected).max() < 5e-4


def test_weights_decide_between_views_that_disagree():
    wrong = PIXELS.copy()
    wrong[3] += 40
    light, none = WEIGHT.copy(), WEIGHT.copy()
    light[3], none[3] = 0.1, 0
    errors = [np.abs(triangulate(RIG, wrong, weight) - POINTS).max() for weight in (WEIGHT, light, none)]
    assert errors[0] > 5 * errors[1] > errors[2]
    assert errors[2] < 1e-8


def test_a_point_needs_two_views():
    weight = WEIGHT.copy()
    weight[1:, 0] = 0
    points = triangulate(RIG, PIXELS, weight)
    assert np.isnan(points[0]).all()
    assert np.isfinite(points[1:]).all()


def test_one_wrong_view_is_left_out():
    wrong = PIXELS.copy()
    views = RNG.integers(4, size=30)
    wrong[views, np.arange(30)] += RNG.choice([-1, 1], (30, 2)) * RNG.uniform(60, 200, (30, 2))
    found = triangulate_robustly(RIG, wrong, WEIGHT, np.full(WEIGHT.shape, 5.0))
    assert (~found.agrees[views, np.arange(30)]).all()
    assert found.agrees.sum() == 3 * 30
    np.testing.assert_allclose(found.points_world, POINTS, atol=1e-8)
    assert (found.error_px[views, np.arange(30)] > 20).all()


def test_views_that_disagree_altogether_give_no_point():
    wrong = RNG.uniform(0, 1280, PIXELS.shape)
    found = triangulate_robustly(RIG, wrong, WEIGHT, np.full(WEIGHT.shape, 1e-3))
    assert np.isnan(found.points_world).all()
    assert not found.agrees.any()


def test_parallel_rays_give_no_point():
    twin = [RIG[0], looking_at(np.array([104.0, 0.001, 2.0]), "twin")]
    pixels = np.stack([camera.project(POINTS) for camera in twin]) + RNG.normal(size=(2, 30, 2))
    found = triangulate_robustly(twin, pixels, WEIGHT[:2], np.full(WEIGHT[:2].shape, 5.0))
    assert np.isnan(found.points_world).all()


def test_epipolar_error_is_the_reprojection_error_of_the_best_point():
    F = fundamental_matrix(RIG[0], RIG[1])
    np.testing.assert_allclose(epipolar_error_px(F, PIXELS[0], PIXELS[1]), 0, atol=1e-6)
    noisy = PIXELS[:2] + RNG.normal(size=(2, 30, 2))
    points = triangulate(RIG[:2], noisy, WEIGHT[:2])
    expected = np.sqrt((reprojection_error_px(RIG[:2], points, noisy) ** 2).sum(0))
    assert epipolar_error_px(F, noisy[0], noisy[1]) == pytest.approx(expected, rel=0.05, abs=0.02)
