"""The ledge of one camera against simulated truth. The poses are exact, so that only the ledge is tested."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfit.cameras.files import read_cameras, write_cameras
from jaxfit.cli.ledge import _undistorted
from jaxfit.cli.main import main
from jaxfit.data.solution import load_solution, save_solution, select_solution
from jaxfit.fitting.ledge import find_contacts, on_ledge
from jaxfit.fitting.ledge_plane import Distances, estimate_ledge, plane_of, read_distances
from jaxfit.foundation.errors import InputError
from jaxfit.model.files import load_murre
from jaxfit.simulation.scene import stage_scene

BIRD = load_murre()
UNIT = BIRD.metres_per_unit
FRAMES = 50


@pytest.fixture(scope="module")
def scene():
    return stage_scene(BIRD, birds=7, frames=FRAMES, size=(640, 380), seed=3)


@pytest.fixture(scope="module")
def camera(scene):
    return scene.view.camera("cliff", UNIT)


@pytest.fixture(scope="module")
def seen(scene):
    """The true poses as one camera knows them: every bird has the size of the model, at the distance that follows."""
    s = scene.poses
    size = s.poses.scale[..., None]
    return s.with_arrays(
        scale=np.ones_like(s.poses.scale), transl=s.poses.transl / size, keypoints_cam=s.keypoints.cam / size[..., None]
    )


@pytest.fixture(scope="module")
def placed(seen, camera):
    return on_ledge(seen, BIRD, camera)


@pytest.fixture(scope="module")
def flies(scene):
    """Whether a bird is more than 2 cm above the ledge."""
    return height_cm(scene) > 2


def height_cm(scene):
    """Height of the lowest point of each bird, (N, T)."""
    return np.stack([bird.vertices_world[..., 2].min(axis=1) for bird in scene.birds]) * UNIT * 100


def true_places_m(scene):
    root = scene.poses.poses.transl + scene.poses.poses.scale[..., None] * np.asarray(BIRD.joints[0])
    return (scene.view.position_world + root.astype(float) @ scene.view.R_cam_world) * UNIT


def test_birds_that_stand_are_at_their_places_and_have_their_sizes(scene, placed, flies):
    stands = scene.poses.valid & ~flies
    error_m = np.linalg.norm(placed.world.transl_world_m - true_places_m(scene), axis=-1)
    # the lowest point of a bird is not always a foot, and a foot of a walking bird leaves the ledge
    assert np.median(error_m[stands]) < 0.01
    assert np.percentile(error_m[stands], 95) < 0.06
    size = np.array([np.median(placed.poses.scale[n][stands[n]]) for n in range(7)])
    np.testing.assert_allclose(size, scene.poses.poses.scale[:, 0], rtol=0.012)
    np.testing.assert_allclose(placed.keypoints.px[stands], scene.poses.keypoints.px[stands], atol=0.01)


def test_contact_shows_which_birds_fly(scene, placed, flies):
    valid = scene.poses.valid
    assert (flies & valid).any()
    contact = placed.contact > 0.5
    assert contact[valid & ~flies].mean() > 0.98
    high = height_cm(scene) > 5
    assert high.any()
    assert not contact[valid & high].any()
    assert np.isnan(placed.contact[~valid]).all()


def test_a_bird_in_the_air_keeps_its_size(scene, placed):
    high = (height_cm(scene) > 5) & scene.poses.valid
    size = np.broadcast_to(scene.poses.poses.scale, high.shape)
    np.testing.assert_allclose(placed.poses.scale[high], size[high], rtol=0.01)
    error_m = np.linalg.norm(placed.world.transl_world_m - true_places_m(scene), axis=-1)
    assert error_m[high].max() < 0.05  # 1 % of 5 m


def test_the_pose_in_the_camera_is_the_pose_in_the_world(placed, camera):
    valid = placed.valid
    world = placed.world.keypoints_world_m
    np.testing.assert_allclose(camera.to_camera(world)[valid] / UNIT, placed.keypoints.cam[valid], atol=1e-3)
    moved = replace(camera.pinhole(), distortion=np.array([-0.2, 0.02, 0, 0, 0]))
    bent = on_ledge(
        placed.with_arrays(R_world_root=None, transl_world_m=None, keypoints_world_m=None), BIRD, camera, moved
    )
    np.testing.assert_allclose(bent.keypoints.px[valid], moved.project(bent.world.keypoints_world_m)[valid], atol=1e-2)


def test_the_birds_show_the_plane_and_how_uncertain_it_is(seen, scene, camera):
    true = float(camera.position_world[2])
    for given in (camera, None):
        ledge = estimate_ledge(seen, BIRD, given)
        facts = ledge.facts
        assert facts["birds"] == 7
        assert abs(facts["height_m"] - true) < 2.5 * facts["height_sd_m"]
        assert facts["height_sd_m"] > 0.04 * true  # the mean size of the birds is known to 5 %
        normal, expected = ledge.camera.R_cam_world[:, 2], camera.R_cam_world[:, 2]
        assert np.degrees(np.arccos(normal @ expected)) < 2.5 * facts["tilt_sd_deg"] < 12
        own = on_ledge(seen, BIRD, ledge.camera)
        stands = own.contact > 0.9
        assert np.isfinite(own.world.transl_world_m[stands]).all()
        feet = own.world.keypoints_world_m[stands][:, [BIRD.keypoint_names.index("left_foot")], 2]
        assert np.abs(np.median(feet)) < 0.02
    assert facts["focal_sd_px"] > 0.15 * facts["focal_px"]  # one camera from above hardly shows its focal length


def measured(camera, ends_m):
    points = camera.project(np.concatenate([ends_m, np.zeros((*ends_m.shape[:2], 1))], axis=-1))
    return Distances(points, np.linalg.norm(ends_m[:, 0] - ends_m[:, 1], axis=-1))


def test_measured_distances_give_the_height_and_the_size_of_the_birds(seen, scene, camera):
    ends_m = np.array(
        [[[-0.8, 0.1], [0.8, 0.1]], [[-0.8, 0.1], [-0.8, 1.0]], [[-0.8, 1.0], [0.8, 0.1]], [[0, 0], [0.5, 1]]]
    )
    ledge = estimate_ledge(seen, BIRD, camera, measured(camera, ends_m))
    assert ledge.facts["height_m"] == pytest.approx(camera.position_world[2], rel=0.01)
    assert ledge.facts["height_sd_m"] < 0.1
    assert ledge.facts["size"] == pytest.approx(np.mean(scene.poses.poses.scale[:, 0]), rel=0.02)


def test_one_calibrated_camera_does_not_know_the_sizes(seen, camera):
    """A fit of one calibrated camera is in a world, but its birds in crops have the size of the model."""
    side = seen.crops.square_px[..., 2:]
    crop = np.concatenate([seen.crops.square_px[..., :2] + (side - 100) / 2, np.full_like(side, 100)], axis=-1)
    N, T, K, _ = seen.keypoints.cam.shape
    world = {"R_world_root": (N, T, 3, 3), "transl_world_m": (N, T, 3), "keypoints_world_m": (N, T, K, 3)}
    arrays = {name: np.zeros(shape) for name, shape in world.items()}
    cropped = seen.with_arrays(crop=crop, focal_px=seen.crops.focal_px * float(side[0, 0, 0]) / 100, **arrays)
    facts, alone = (estimate_ledge(each, BIRD, camera).facts for each in (cropped, seen))
    assert facts["height_sd_m"] == pytest.approx(alone["height_sd_m"], rel=1e-3)


def test_several_cameras_keep_places_and_sizes(placed, camera):
    ledge = estimate_ledge(placed, BIRD, camera)
    assert ledge.facts["height_m"] == pytest.approx(camera.position_world[2], rel=0.02)
    turned = on_ledge(placed, BIRD, ledge.camera, known_sizes=True)
    np.testing.assert_allclose(turned.keypoints.cam[placed.valid], placed.keypoints.cam[placed.valid], atol=1e-3)
    np.testing.assert_allclose(turned.poses.scale[placed.valid], placed.poses.scale[placed.valid], rtol=1e-5)
    assert (turned.contact > 0.5)[placed.contact > 0.9].mean() > 0.98


def test_a_jump_is_not_a_contact():
    rng = np.random.default_rng(0)
    log_size = 0.03 + 0.004 * rng.normal(size=(2, 200))
    log_size[1, 100:130] += 0.2 * np.sin(np.linspace(0, np.pi, 30))  # seems larger in the air
    log_size[0, 50:60] = np.nan  # no pose
    log_size[0, 150:160] = np.inf  # the ray of the foot does not meet the ledge
    found = find_contacts(log_size, np.full((2, 200), 0.1), 0.04, 0.0)
    np.testing.assert_allclose(found.log_size, 0.03, atol=0.002)
    assert (found.probability[1, 103:127] < 0.1).all()
    assert (found.probability[1, :98] > 0.9).all()
    assert np.isnan(found.probability[0, 50:60]).all()
    assert (found.probability[0, 150:160] < 0.1).all()
    assert (found.probability[0, 60:145] > 0.9).all()


def test_fast_birds_of_unknown_height_fly():
    """Far above the ledge, sizes hardly tell the height, and the speed decides."""
    log_size = np.zeros((1, 100))
    speed = np.where(np.arange(100) < 50, 0.1, 12.0)[None]
    probability = find_contacts(log_size, speed, 0.04, 0.0).probability[0]
    assert (probability[:45] > 0.95).all()
    assert (probability[55:] < probability[:45].min()).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x1_px,y1_px,x2_px,y2_px,distance_m\n1,2,3,4,1\n", "has 1 distances"),
        ("x1_px,y1_px,x2_px,y2_px\n1,2,3,4\n", "line 2 has no five numbers"),
        ("x1_px,y1_px,x2_px,y2_px,distance_m\n1,2,3,4,-1\n", "line 2 has no distance above 0"),
        ("x1_px,y1_px,x2_px,y2_px,distance_m\n1,2,1,2,1\n", "line 2 has no distance above 0 between two points"),
        ("x1_px,y1_px,x2_px,y2_px,distance_m\n1,2,3,nan,1\n", "line 2 has no distance"),
        ("", "has 0 distances"),
    ],
)
def test_unusable_distances_are_named(tmp_path, text, message):
    (tmp_path / "d.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_distances(tmp_path / "d.csv")


@pytest.mark.parametrize("columns", [[0], list(range(0, FRAMES, 7))])
def test_few_frames_are_enough(seen, camera, columns):
    few = select_solution(seen, np.arange(7), np.array(columns))
    ledge = estimate_ledge(few, BIRD, camera)
    assert abs(ledge.facts["height_m"] - camera.position_world[2]) < 3 * ledge.facts["height_sd_m"]
    assert on_ledge(few, BIRD, ledge.camera).contact.shape == few.valid.shape


def test_no_track_is_no_bird(seen, camera):
    no_birds = select_solution(seen, np.zeros(0, int), np.arange(FRAMES))
    assert on_ledge(no_birds, BIRD, camera).contact.shape == (0, FRAMES)


def test_a_camera_below_its_birds_has_no_ledge(seen):
    half_turn = Rotation.from_rotvec([np.pi, 0, 0])  # of each bird about its root, so that its feet are nearest
    orient = (half_turn * Rotation.from_rotvec(seen.poses.global_orient.reshape(-1, 3))).as_rotvec()
    below = seen.with_arrays(global_orient=orient.reshape(seen.poses.global_orient.shape).astype(np.float32))
    with pytest.raises(InputError, match="not below the camera"):
        estimate_ledge(below, BIRD)


def test_distances_in_the_picture_of_a_lens(seen, scene, camera):
    """Ends that were measured in a distorted picture give the same ledge."""
    ends_m = np.array([[[-0.4, 0.2], [0.4, 0.2]], [[-0.4, 0.2], [-0.4, 0.7]], [[-0.4, 0.7], [0.4, 0.2]]])
    lens = replace(camera, distortion=np.array([-0.2, 0.02, 0, 0, 0]))
    in_picture = measured(lens, ends_m)
    moved = replace(camera, matrix=camera.matrix + np.array([[0, 0, 12], [0, 0, 7], [0, 0, 0]]))
    straight = _undistorted(in_picture, lens, moved, "distances.csv")
    np.testing.assert_allclose(straight.points_px, measured(moved, ends_m).points_px, atol=0.05)
    with pytest.raises(InputError, match="outside the picture"):
        _undistorted(in_picture._replace(points_px=in_picture.points_px + 5000), lens, moved, "distances.csv")


def test_no_ledge_without_birds_that_stand(seen, camera):
    no_birds = replace(seen, valid=np.zeros_like(seen.valid))
    with pytest.raises(InputError, match="shows no bird that stands"):
        estimate_ledge(no_birds, BIRD, camera)
    with pytest.raises(InputError, match="no unit of length"):
        estimate_ledge(seen, replace(BIRD, metres_per_unit=None), camera)
    upside_down = camera.moved(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    with pytest.raises(InputError, match="calibrate with z up"):
        plane_of(upside_down, "rig.toml")


def test_the_command_places_a_result(seen, camera, placed, tmp_path, capsys):
    save_solution(seen, BIRD, "base: fast\n", {}, tmp_path / "fit")
    write_cameras((camera,), tmp_path / "camera.toml")
    command = ["ledge", str(tmp_path / "fit"), "--out", str(tmp_path / "out")]
    assert main([*command, "--plane", "world", "--cameras", str(tmp_path / "camera.toml")]) == 0
    printed = capsys.readouterr().out
    assert f"camera {camera.position_world[2]:.2f} m above the ledge" in printed
    assert "on ledge" in printed
    stored, _ = load_solution(tmp_path / "out")
    np.testing.assert_allclose(stored.contact, placed.contact, atol=1e-5)
    np.testing.assert_allclose(stored.world.transl_world_m, placed.world.transl_world_m, atol=1e-5)
    (own,) = read_cameras(tmp_path / "out" / "cameras.toml")
    np.testing.assert_allclose(own.position_world, camera.position_world, atol=1e-9)
    assert main([*command, "--overwrite", "--focal-px", str(camera.matrix[0, 0])]) == 0
    printed = capsys.readouterr().out
    assert "from 7 birds on it" in printed
    assert "(given)" in printed
    assert "5 to 8 % too small" in printed  # the config has the published edge


@pytest.fixture(scope="module")
def files(seen, camera, tmp_path_factory):
    """A result and files of cameras."""
    folder = tmp_path_factory.mktemp("ledge")
    save_solution(seen, BIRD, "base: fast\n", {}, folder / "fit")
    write_cameras((camera,), folder / "camera.toml")
    write_cameras((camera, replace(camera, name="other")), folder / "two.toml")
    write_cameras((replace(camera, distortion=np.array([0.1, 0, 0, 0, 0])),), folder / "bent.toml")
    write_cameras((replace(camera, size_px=(1280, 760)),), folder / "large.toml")
    return folder


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--plane", "world"], "plane of the ledge: is that of a world without --cameras"),
        (["--plane", "nothing.csv"], "plane of the ledge: is nothing.csv, which is no file"),
        (["--focal-px", "0"], "--focal-px: is 0.0"),
        (["--focal-px", "500", "--cameras", "{folder}/camera.toml"], "--focal-px: is given with --cameras"),
        (["--cameras", "{folder}/two.toml"], "has 2 cameras"),
        (["--cameras", "{folder}/bent.toml"], "gives camera cliff a distorted lens"),
        (["--cameras", "{folder}/large.toml"], "has images of"),
    ],
)
def test_wrong_options_of_the_command(files, tmp_path, capsys, options, message):
    command = ["ledge", str(files / "fit"), "--out", str(tmp_path / "out")]
    assert main([*command, *(option.format(folder=files) for option in options)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert not (tmp_path / "out").exists()


def test_a_result_in_a_world_is_not_placed_again(placed, tmp_path, capsys):
    save_solution(placed, BIRD, "base: fast\n", {}, tmp_path / "fit")
    assert main(["ledge", str(tmp_path / "fit"), "--out", str(tmp_path / "out")]) == 2
    assert "is in a world already" in capsys.readouterr().err


def test_the_distances_of_birds_agree_with_the_truth_without_a_camera(seen, scene, flies):
    ledge = estimate_ledge(seen, BIRD)
    placed, true = on_ledge(seen, BIRD, ledge.camera).world.transl_world_m, true_places_m(scene)
    t = 10
    stands = np.flatnonzero(scene.poses.valid[:, t] & ~flies[:, t])
    pairs = [(i, j) for i in stands for j in stands if i < j]
    ratio = [
        np.linalg.norm((placed[i] - placed[j])[t, :2]) / np.linalg.norm((true[i] - true[j])[t, :2]) for i, j in pairs
    ]
    assert abs(np.median(ratio) - 1) < 0.06


def test_unknown_speeds_do_not_exclude_birds(seen, camera):
    every_second = np.broadcast_to(np.arange(FRAMES) % 2 == 0, seen.valid.shape)
    gaps = replace(seen, valid=seen.valid & every_second)
    assert estimate_ledge(gaps, BIRD, camera).facts["birds"] == 7
