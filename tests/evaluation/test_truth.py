"""Reading what a result is measured against: a COCO file, or a scene's folder."""

import dataclasses

import cv2
import numpy as np
import pytest
from support.evaluated import BIRD, solution, truth

from jaxfit.data.formats.coco import write_coco
from jaxfit.data.solution import save_solution
from jaxfit.evaluation.evaluate import COLUMNS, COLUMNS_3D, evaluate
from jaxfit.evaluation.tracking import evaluate_observations
from jaxfit.evaluation.truth import Truth, read_truth
from jaxfit.foundation.errors import InputError


@pytest.fixture
def scene(tmp_path):
    write_coco(truth(), tmp_path / "truth.json")
    save_solution(solution(crop=one_camera()), BIRD, "", {}, tmp_path / "truth")
    return tmp_path


def one_camera():
    return np.array(solution().crops.square_px)


def test_a_coco_file(scene):
    known = read_truth(scene / "truth.json")
    np.testing.assert_array_equal(known.observations.track_id, [3, 5])
    assert (known.solution, known.bird, known.behaviours) == (None, None, None)
    assert known.source == scene / "truth.json"


def test_a_folder_of_masks(tmp_path):
    for frame in (0, 1):
        picture = np.zeros((20, 30), np.uint8)
        picture[2:9, 3 + frame : 12 + frame] = 5
        cv2.imwrite(str(tmp_path / f"{frame}.png"), picture)
    known = read_truth(tmp_path)
    result = evaluate_observations(known.observations, known)
    assert (result.compared, result.counts["true"], result.keypoints) == ("masks", 2, {})
    assert (result.detection["ap50"], result.tracking["hota"]) == (pytest.approx(1), pytest.approx(1))


def test_a_scene(scene):
    known = read_truth(scene)
    assert known.observations.num_tracks == 2
    result = evaluate(solution(), BIRD, known)
    assert tuple(result.overall) == (*COLUMNS, *COLUMNS_3D)
    assert (result.frames, result.frames_3d, result.points_3d) == (8, 8, "joints")
    for row in (result.overall, *result.tracks.values()):
        assert row["mpjpe"] == pytest.approx(0, abs=1e-4)
        assert row["orientation_deg"] == pytest.approx(0, abs=0.05)
        assert row["size_error"] == pytest.approx(0, abs=1e-6)


def test_poses_count_where_nothing_is_annotated(scene):
    """A bird that the annotations lack has errors in space alone; one model serves for both."""
    poses = read_truth(scene).solution
    result = evaluate(solution(), BIRD, Truth(truth().select(tracks=[1]), poses))
    assert (result.frames, result.frames_3d) == (4, 8)
    assert set(result.tracks) == {3, 5}
    assert result.tracks[5]["frames"] == 0
    assert np.isnan(result.tracks[5]["me_p"])
    assert result.tracks[5]["mpjpe"] == pytest.approx(0, abs=1e-4)
    one = dataclasses.replace(poses, valid=poses.valid & [[True], [False]])
    result = evaluate(solution(), BIRD, Truth(truth(), one))
    assert (result.frames, result.frames_3d) == (8, 4)
    assert np.isnan(result.tracks[3]["mpjpe"])


def test_folders_without_truth(scene, tmp_path_factory):
    with pytest.raises(InputError, match=r"a folder without truth\.json and without pictures of masks \(give a file"):
        read_truth(tmp_path_factory.mktemp("empty"))
    with pytest.raises(InputError, match=r"absent: does not exist .*`jaxfit track` and `jaxfit import` write"):
        read_truth(scene / "absent")
    (scene / "truth" / "poses.npz").unlink()
    with pytest.raises(InputError, match=r"poses\.npz: does not exist \(.*`jaxfit fit` and `jaxfit reconstruct` write"):
        read_truth(scene)
    (scene / "truth").rename(scene / "elsewhere")
    with pytest.raises(InputError, match=r"holds no true poses .*give .*truth\.json to compare in the image alone"):
        read_truth(scene)
