"""The built-in networks on a scene outside their training data."""

import numpy as np
import pytest

from jaxfit.config.perception import TrackConfig
from jaxfit.data.formats import FOOTAGE
from jaxfit.evaluation.tracking import evaluate_observations
from jaxfit.model.anatomy import MURRE_KEYPOINTS
from jaxfit.model.files import load_murre
from jaxfit.perception.keypoints import BUILTIN_PATH, load_keypoint_detector
from jaxfit.perception.network import OnnxModel
from jaxfit.perception.segmentation import BUILTIN, load_segmenter
from jaxfit.perception.track import run_tracking
from jaxfit.perception.trust import MAX_FRAME_DISTANCE
from jaxfit.simulation.scene import simulate

FILES = BUILTIN, BUILTIN_PATH


def test_files_are_small_and_state_their_training_data():
    assert sum(file.stat().st_size for file in FILES) <= 6e6
    for file in FILES:
        assert "no real footage" in OnnxModel(file).metadata["trained_on"]
    assert load_keypoint_detector().keypoint_names == MURRE_KEYPOINTS


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unseen") / "scene"
    scene = simulate(load_murre(), folder, birds=4, frames=6, size=(1296, 760), seed=1005)
    return run_tracking(folder / FOOTAGE, TrackConfig(min_track_frames=1)), scene.truth


@pytest.fixture(scope="module")
def evaluation(tracked):
    tracking, truth = tracked
    return evaluate_observations(tracking.observations, truth)


def test_detection_and_tracking(evaluation):
    assert evaluation.detection["ap50"] >= 0.9
    assert evaluation.detection["mean_iou"] >= 0.84
    assert evaluation.tracking["idf1"] >= 0.9


def test_visible_keypoints(evaluation):
    assert evaluation.keypoints["all"].visible > 100
    assert evaluation.keypoints["all"].pck_05 >= 0.85


def test_trust_is_high(tracked):
    tracking, _ = tracked
    assert tracking.trust.level == "high"
    assert tracking.trust.signals.frame_distance < 0.6 * MAX_FRAME_DISTANCE
    assert tracking.trust.signals.confidence > 0.7
    assert 0.9 < tracking.observations.confidence.max() <= 1


def test_noise_is_far_from_the_training():
    segmenter = load_segmenter("builtin")
    segmenter(np.random.default_rng(0).integers(0, 256, (640, 960, 3), np.uint8))
    (distance,) = segmenter.activations.take()
    assert distance > MAX_FRAME_DISTANCE
