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
    triangulation_sd,
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


def staged(noise_px, draws=400, views=(0, 1, 2, 3), seed=1):
    """Triangulate ten keypoints of one bird in many frames, whose pixels have independent errors."""
    rig = [RIG[v] for v in views]
    pixels = np.stack([camera.project(POINTS[:10]) for camera in rig])[:, None, None]
    errors = np.random.default_rng(seed).normal(size=(len(rig), 1, draws, 10, 2)) * noise_px
    weight = np.broadcast_to([1, 0.5, 1, 0.7], (1, 1, 1, 4)).T[list(views)] * np.ones(errors.shape[:-1])
    return rig, triangulate_robustly(rig, pixels + errors, weight, np.full(weight.shape, 60.0)), weight


@pytest.mark.parametrize("views", [(0, 1), (0, 1, 2, 3)])
def test_standard_deviations_are_those_of_repeated_measurements(views):
    """Keypoints differ in their noise, views in their weights and distances."""
    noise_px = np.linspace(1, 4, 10)[:, None]
    rig, found, weight = staged(noise_px, views=views)
    sd = triangulation_sd(rig, found, weight)
    np.testing.assert_allclose(sd.mean(axis=1), found.points_world.std(axis=1), rtol=0.12)


def test_points_of_one_view_have_no_standard_deviation_and_change_no_other():
    rig, found, weight = staged(1.0, draws=5)
    expected = triangulation_sd(rig, found, weight)
    assert (triangulation_sd(rig, staged(0.0, draws=5)[1], weight) < 1e-9).all()
    alone = weight.copy()
    alone[1:, 0, 2, 3] = 0  # one camera sees a keypoint
    pixels = np.stack([camera.project(found.points_world) for camera in rig]) + 0.0
    lost = triangulate_robustly(rig, pixels, alone, np.full(weight.shape, 60.0))
    sd = triangulation_sd(rig, lost, alone)
    assert np.isnan(sd[0, 2, 3]).all()
    assert np.isfinite(sd).all(-1).sum() == 49
    # in a frame of two views, errors are larger
    agrees = found.agrees.copy()
    agrees[2:, 0, 0] = False
    fewer = triangulation_sd(rig, found._replace(agrees=agrees), weight)
    assert (np.linalg.norm(fewer[0, 0], axis=-1) > np.linalg.norm(expected[0, 0], axis=-1)).all()
