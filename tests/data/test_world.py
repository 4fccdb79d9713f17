"""Results in a world as their cameras see them, against the cameras of the simulator."""

from dataclasses import replace

import numpy as np
import pytest
from support.worlds import BIRD, FRAMES, UNIT, placed_on, write_world

from jaxfit.cameras.camera import Camera
from jaxfit.data.footage import FootageIdentity
from jaxfit.data.projection import PosedBirds
from jaxfit.data.world import as_filmed, in_camera
from jaxfit.foundation.errors import InputError
from jaxfit.simulation.rig import stage_rig


@pytest.fixture(scope="module")
def rig():
    return stage_rig(BIRD, 2, birds=1, frames=FRAMES, size=(320, 200), distorted=True)


@pytest.fixture(scope="module")
def placed(rig):
    return placed_on(rig.scenes[0], rig.cameras[0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory, rig, placed):
    return write_world(tmp_path_factory.mktemp("world") / "result", placed, rig.cameras)


def largest_error_px(solution, lens, rig, v):
    """Largest distance of drawn vertices and of keypoints from the pixels of a camera of the rig."""
    drawn = PosedBirds(solution, BIRD, lens).vertices_screen_window(0)
    vertices_m = rig.scenes[v].birds[0].vertices_world * UNIT
    errors = [
        drawn[..., :2] - rig.cameras[v].project(vertices_m),
        solution.keypoints.px[0] - rig.scenes[v].poses.keypoints.px[0],
    ]
    return max(np.linalg.norm(error, axis=-1).max() for error in errors), drawn


@pytest.mark.parametrize("v", [0, 1])
def test_the_mesh_lies_where_each_camera_films_it(rig, placed, folder, v):
    seen, lens = as_filmed(folder, placed, BIRD, rig.cameras[v].name)
    error_px, drawn = largest_error_px(seen, lens, rig, v)
    assert seen.valid.all()
    assert error_px < 0.05
    depth_m = rig.cameras[v].to_camera(rig.scenes[v].birds[0].vertices_world * UNIT)[..., 2]
    np.testing.assert_allclose(drawn[..., 2] * UNIT, depth_m, atol=1e-3)
    # without the lens, the mesh is beside the bird
    assert largest_error_px(seen, None, rig, v)[0] > 0.3


def test_the_first_camera_draws_the_result_itself(placed, folder, tmp_path):
    assert as_filmed(folder, placed, BIRD)[0] is placed
    assert as_filmed(tmp_path, placed, BIRD) == (placed, None)
    crops = replace(placed, world=None, contact=None)
    assert as_filmed(folder, crops, BIRD) == (crops, None)


def test_a_result_in_crops_comes_into_the_frame_of_its_camera(rig, placed, folder):
    """A fit of one view without a ledge has crops, and birds of the size of the model."""
    s, factor = placed, 1.25
    crop = np.array([0, 0, 100], np.float32)
    cropped = s.with_arrays(
        scale=factor * s.poses.scale,
        transl=factor * s.poses.transl,
        keypoints_cam=factor * s.keypoints.cam,
        crop=0 * s.crops.square_px + crop,
    )
    cropped = replace(cropped, footage=FootageIdentity(frames=7))
    seen, lens = as_filmed(folder, cropped, BIRD)
    assert seen.footage == cropped.footage
    assert lens.name == rig.cameras[0].name
    assert largest_error_px(seen, lens, rig, 0)[0] < 0.05
    np.testing.assert_allclose(seen.poses.scale, placed.poses.scale, rtol=1e-5)
    assert as_filmed(folder, cropped, BIRD, rig.cameras[1].name)[0].footage is None


def test_birds_that_a_camera_cannot_see_have_no_pose(rig, placed):
    camera = rig.cameras[1]
    back = replace(camera, R_cam_world=np.diag([-1.0, 1, -1]) @ camera.R_cam_world, transl_cam=-camera.transl_cam)
    assert not in_camera(placed, BIRD, back).valid.any()
    # beyond its turning point, the lens model folds distant points into the picture
    matrix, aside = np.array([[300.0, 0, 160], [0, 300, 100], [0, 0, 1]]), np.array([-8.0, 0.0, 4.0])
    root = placed.world.transl_world_m[0, 0]
    folding = Camera("wide", matrix, np.array([-0.3, 0, 0, 0]), np.eye(3), aside - root, (320, 200))
    assert (np.abs(folding.project(placed.world.keypoints_world_m[0]) - [160, 100]) < 300).all()
    assert not in_camera(placed, BIRD, folding).valid.any()


@pytest.mark.parametrize(
    ("name", "world", "message"),
    [
        ("north", True, r"--camera: is north, which .*cameras.toml does not hold \(choose one of: cam0, cam1\)"),
        ("cam1", False, r"--camera: is cam1, but the result is in no world .*remove --camera, or fit with --cameras"),
    ],
)
def test_wrong_names_of_cameras(placed, folder, name, world, message):
    none = {"R_world_root": None, "transl_world_m": None, "keypoints_world_m": None, "contact": None}
    with pytest.raises(InputError, match=message):
        as_filmed(folder, placed if world else placed.with_arrays(**none), BIRD, name)


def test_missing_cameras(placed, tmp_path):
    with pytest.raises(InputError, match=r"cameras\.toml: does not exist"):
        as_filmed(tmp_path, placed, BIRD, "cam1")


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("R_world_root", 1e11, "numbers beyond 1.001"),
        ("transl_world_m", np.nan, "NaN or infinite numbers"),
        ("keypoints_world_m", 1e33, r"numbers beyond 1e\+12"),
    ],
)
def test_impossible_places_in_the_world_are_refused(placed, name, value, problem):
    values = placed.arrays()[name].copy()
    values[0, 1] = value
    with pytest.raises(ValueError, match=f"{name} holds {problem} for track 1, frame 1"):
        placed.with_arrays(**{name: values})
    valid = placed.valid.copy()
    valid[0, 1] = False
    placed.with_arrays(**{name: values, "valid": valid})
