"""The networks that the package brings along, on a scene that they never saw: from footage to tracks."""

import pytest

from jaxfit.config.perception import TrackConfig
from jaxfit.data.formats.scene_folder import FOOTAGE
from jaxfit.evaluation.observed import evaluate_observations
from jaxfit.model.anatomy import MURRE_KEYPOINTS
from jaxfit.model.files import load_murre
from jaxfit.perception.keypoints import load_keypoint_detector
from jaxfit.perception.keypoints.detector import BUILTIN_PATH
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.load import BUILTIN
from jaxfit.perception.track import track_video
from jaxfit.simulation.scene import simulate

FILES = BUILTIN, BUILTIN_PATH


def test_they_are_small_and_say_where_they_come_from():
    assert sum(file.stat().st_size for file in FILES) <= 8e6
    for file in FILES:
        assert "no real footage" in OnnxModel(file).metadata["trained_on"]
    assert load_keypoint_detector().keypoint_names == MURRE_KEYPOINTS


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unseen") / "scene"
    scene = simulate(load_murre(), folder, birds=4, frames=8, size=(1296, 760), seed=1005)
    found = track_video(folder / FOOTAGE, TrackConfig(min_track_frames=1))
    return evaluate_observations(found, scene.truth)


def test_birds_are_found_and_followed(seen):
    assert seen.detection["ap50"] >= 0.9
    assert seen.detection["mean_iou"] >= 0.85
    assert seen.tracking["idf1"] >= 0.9


def test_visible_keypoints_are_found(seen):
    assert seen.keypoints["all"].visible > 100
    assert seen.keypoints["all"].pck_05 >= 0.85
