"""Birds in the camera frame of the image: a bird that walks across, pixels of two cameras, assumed focal length."""

import dataclasses

import numpy as np
import pytest
from support.birds import solution_of, toy_bird
from support.exported import BIRD

import jaxfit
from jaxfit.data.projection import PosedBirds, in_image
from jaxfit.simulation.flock import smooth_motion

FRAMES, FOCAL_PX = 12, 5000.0
SIZE_PX = np.array([1600, 900])


def walking_bird(bird, step_px=40.0):
    """A bird whose pose and depth stay, and whose crop moves by `step_px` to the right in every frame."""
    pose = smooth_motion(bird, FRAMES, 0)
    still = {name: getattr(pose, name)[:1] for name in ("global_orient", "body_pose", "transl")}
    pose = dataclasses.replace(pose, **{name: np.repeat(value, FRAMES, 0) for name, value in still.items()})
    crop = np.stack([50 + step_px * np.arange(FRAMES), np.full(FRAMES, 300.0), np.full(FRAMES, 220.0)], -1)
    solution = solution_of(bird, [pose], crop[None])
    return solution.with_arrays(image_size_px=np.broadcast_to(SIZE_PX, (1, FRAMES, 2)))


def test_a_bird_that_walks_across_moves_in_metres_as_in_pixels(tmp_path):
    """Its crop moves with it, so in the frame of the crop it stays; every format gave that position."""
    solution = walking_bird(BIRD)
    image = in_image(solution, BIRD, FOCAL_PX)
    root = image.root[0]
    assert np.ptp(solution.poses.transl[0], axis=0).max() < 1e-6
    assert np.ptp(root[:, 2]) < 1e-4 * root[0, 2]  # constant depth
    walked_px = 40 * (FRAMES - 1)
    assert np.ptp(root[:, 0]) == pytest.approx(walked_px * root[0, 2] / FOCAL_PX, rel=1e-4)
    crop_focal_px = solution.crops.focal_px * 220 / solution.crops.crop_px
    depth = (solution.poses.transl[0, 0, 2] / solution.poses.scale[0, 0] + BIRD.joints[0][2]) * FOCAL_PX / crop_focal_px
    assert root[0, 2] == pytest.approx(float(depth), rel=1e-5)

    jaxfit.save_solution(solution, BIRD, "", {}, tmp_path / "walk")
    jaxfit.export_result(tmp_path / "walk", "csv", tmp_path / "birds.csv")
    rows = [line.split(",") for line in (tmp_path / "birds.csv").read_text().splitlines()]
    x_m = np.array([float(row[rows[0].index("root_x_m")]) for row in rows[1:]])
    z_m = float(rows[1][rows[0].index("root_z_m")])
    assert np.ptp(x_m) == pytest.approx(walked_px * z_m / crop_focal_px, rel=1e-4)


def test_both_cameras_see_the_bird_at_the_same_pixels():
    bird = toy_bird()
    solution = walking_bird(bird)
    image = in_image(solution, bird, FOCAL_PX)
    posed = PosedBirds(solution, bird)
    vertices = image.points(posed.vertices_cam_window(0)[None], solution.poses.scale)[0]
    pixels = FOCAL_PX * vertices[..., :2] / vertices[..., 2:] + SIZE_PX / 2
    expected = posed.vertices_screen_window(0)[..., :2]
    side = np.ptp(expected, axis=1).max()
    # a rigid bird under another focal length has another perspective; its root joint is exact
    assert np.abs(pixels - expected).max() < 0.02 * side
    keypoints = image.points(solution.keypoints.cam, solution.poses.scale)
    at_model_size = solution.keypoints.cam / solution.poses.scale[..., None, None]
    lengths = (np.linalg.norm(np.diff(points, axis=2), axis=-1) for points in (keypoints, at_model_size))
    np.testing.assert_allclose(*lengths, rtol=1e-4)


def test_a_wrong_focal_length_changes_depths_only():
    solution = walking_bird(BIRD)
    near, far = (in_image(solution, BIRD, focal).root for focal in (FOCAL_PX, 2 * FOCAL_PX))
    np.testing.assert_allclose(far, near * [1, 1, 2], rtol=1e-6)


def test_gaps_are_unknown_and_orientations_do_not_jump():
    turning = walking_bird(BIRD)
    angles = np.linspace(2.5, 4.5, FRAMES)  # through half a turn
    valid = np.ones((1, FRAMES), bool)
    valid[0, [0, 5, 6]] = False
    turning = turning.with_arrays(global_orient=angles[None, :, None] * [0, 0, 1.0], valid=valid)
    image = in_image(turning, BIRD)
    np.testing.assert_array_equal(np.isfinite(image.root).all(-1), valid)
    np.testing.assert_array_equal(np.isfinite(image.orientation).all(-1), valid)
    steps = np.linalg.norm(np.diff(image.orientation[0, valid[0]], axis=0), axis=-1)
    assert steps.max() < 1.0  # a whole turn is 6.3
    assert np.isnan(in_image(dataclasses.replace(turning, valid=~valid & False), BIRD).root).all()
