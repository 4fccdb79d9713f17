"""Scenes of several cameras: one truth, its cameras, its files."""

import numpy as np
import pytest

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.files import read_cameras
from jaxfit.data.formats.coco import read_coco
from jaxfit.foundation.errors import InputError
from jaxfit.model.files import load_murre
from jaxfit.model.kinematics import fold_bird, window_keypoints, window_transforms
from jaxfit.simulation.rig import simulate_rig, stage_rig
from jaxfit.simulation.scene import mesh_keypoints

BIRD = load_murre()
UNIT = BIRD.metres_per_unit
SMALL = {"birds": 2, "frames": 8, "size": (480, 280), "seed": 4}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("rig") / "scene"


@pytest.fixture(scope="module")
def rig(folder):
    return simulate_rig(BIRD, folder, 3, distorted=True, **SMALL)


def test_every_camera_sees_the_same_birds(rig):
    vertices = [np.stack([bird.vertices_world for bird in scene.birds]) for scene in rig.scenes]
    keypoints_world = mesh_keypoints(BIRD, vertices[0]) * UNIT
    for camera, scene, own in zip(rig.cameras, rig.scenes, vertices, strict=True):
        np.testing.assert_array_equal(own, vertices[0])
        labelled = scene.truth.confidence > 0
        assert labelled.mean() > 0.7  # a bird may stand in part outside of the small picture
        assert np.abs(camera.distortion[0]) > 0.1
        np.testing.assert_allclose(
            camera.project(keypoints_world)[labelled], scene.truth.keypoints_px[labelled], atol=1e-3
        )


def test_true_poses_are_in_the_frame_of_each_camera(rig):
    for camera, scene in zip(rig.cameras, rig.scenes, strict=True):
        for n, bird in enumerate(scene.birds):
            folded = fold_bird(BIRD)
            points_cam = window_keypoints(folded, window_transforms(folded, bird.pose), bird.pose)
            np.testing.assert_allclose(points_cam, scene.poses.keypoints.cam[n], atol=2e-3)
            world = mesh_keypoints(BIRD, bird.vertices_world[:, None])[:, 0] * UNIT
            np.testing.assert_allclose(camera.to_camera(world) / UNIT, points_cam, atol=2e-3)


def test_detections_of_the_cameras_differ_and_have_ids_of_their_own(rig):
    confident = [scene.detections.confidence for scene in rig.scenes]
    assert not np.array_equal(confident[0], confident[1])
    five = stage_rig(BIRD, 3, **SMALL | {"birds": 5})
    boxes = []
    for scene in five.scenes:
        assert scene.detections.track_id.tolist() == scene.truth.track_id.tolist()
        overlap = np.abs(scene.detections.box_px[:, 0, None, :2] - scene.truth.box_px[None, :, 0, :2]).sum(-1)
        boxes.append(overlap.argmin(1).tolist())
    assert any(order != sorted(order) for order in boxes)


def test_cameras_of_a_file_film_the_same_pictures(rig, folder):
    second = stage_rig(BIRD, read_cameras(folder / "cameras.toml"), **SMALL)
    for a, b in zip(rig.scenes, second.scenes, strict=True):
        np.testing.assert_allclose(a.truth.keypoints_px, b.truth.keypoints_px, atol=1e-3)
    names = {path.name for path in (folder / "cam1").iterdir()}
    assert names == {"detections.json", "footage.mp4", "scene.json", "truth", "truth.json"}
    assert read_coco(folder / "cam1" / "truth.json").num_tracks == 2


def test_cameras_that_cannot_be_simulated_are_refused(rig):
    camera = rig.cameras[0]
    fields = {name: getattr(camera, name) for name in ("name", "matrix", "distortion", "R_cam_world", "transl_cam")}
    with pytest.raises(InputError, match="has no image size"):
        stage_rig(BIRD, [Camera(**fields)], **SMALL)
    wide = np.diag([1.1, 1, 1]) @ camera.matrix
    with pytest.raises(InputError, match="pixels that are not square"):
        stage_rig(BIRD, [Camera(**fields | {"matrix": wide, "size_px": (480, 280)})], **SMALL)
    with pytest.raises(InputError, match=r"size: is 481x280 \(give width and height"):
        stage_rig(BIRD, [Camera(**fields | {"size_px": (481, 280)})], **SMALL)
    with pytest.raises(InputError, match="give 1 to 32 cameras"):
        stage_rig(BIRD, 33, **SMALL)
