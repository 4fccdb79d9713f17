"""Fitted windows as a solution: the size of a bird is the same in all windows, and the picture does not change."""

import dataclasses

import numpy as np
import pytest
from support.corrected import BIRD, CONFIG, observations

from jaxfit.fitting.collect import FittedWindow, _keypoints, collect_windows
from jaxfit.fitting.solve import fit_model
from jaxfit.fitting.windows import cut_windows
from jaxfit.model.camera import crop_to_image
from jaxfit.model.kinematics import Pose
from jaxfit.simulation.flock import smooth_motion

MODEL = fit_model(BIRD, CONFIG)
SIZES = np.float32([0.6, 1.7])


@pytest.fixture(scope="module")
def windows():
    """Two windows of one track."""
    return cut_windows(observations().select(tracks=[0], frames=slice(0, 12)), CONFIG)


def results(common_size):
    """Poses of two windows with factors on size and position; without a common size, each frame has a size."""
    found, motion = [], smooth_motion(BIRD, 6, 0)
    for size in SIZES:
        sizes = np.full(1 if common_size else 6, size) * np.linspace(1, 1.1, 1 if common_size else 6)
        changed = dataclasses.replace(motion, scale=sizes, transl=np.asarray(motion.transl) * size)
        pose = Pose(**{name: np.asarray(value, np.float32) for name, value in vars(changed).items()})
        points_cam, points_px = (np.asarray(each) for each in _keypoints(MODEL.rig, MODEL.camera, pose))
        found.append(FittedWindow(pose, {"keypoints": 1.0}, points_cam, points_px, "", np.zeros(6, np.float32)))
    return found


def collected(windows, common_size):
    observed = observations().select(tracks=[0], frames=slice(0, 12))
    return collect_windows(observed, windows, results(common_size), BIRD, MODEL.camera, common_size, {})


def test_a_bird_has_the_size_of_the_model_in_all_windows(windows):
    solution = collected(windows, True)
    np.testing.assert_array_equal(solution.poses.scale[0], 1)
    for w, result in enumerate(results(True)):
        own = slice(6 * w, 6 * w + 6)
        pose = dataclasses.replace(
            result.pose, transl=solution.poses.transl[0, own], scale=solution.poses.scale[0, own]
        )
        points_cam, points_px = _keypoints(MODEL.rig, MODEL.camera, pose)
        np.testing.assert_allclose(solution.keypoints.cam[0, own], points_cam, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(points_px, result.keypoints_px, atol=1e-2)  # the picture of the fitted pose
        expected = crop_to_image(result.keypoints_px, windows.crop[w].astype(np.float32), MODEL.camera.size_px)
        np.testing.assert_array_equal(solution.keypoints.px[0, own], expected)


def test_sizes_of_frames_are_not_changed(windows):
    """A config without a common size asks for the size of every frame."""
    solution = collected(windows, False)
    for w, result in enumerate(results(False)):
        own = slice(6 * w, 6 * w + 6)
        np.testing.assert_array_equal(solution.poses.scale[0, own], result.pose.scale)
        np.testing.assert_array_equal(solution.poses.transl[0, own], result.pose.transl)
        np.testing.assert_array_equal(solution.keypoints.cam[0, own], result.keypoints_cam)
