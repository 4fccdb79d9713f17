"""Exports of results in a world hold the places of the world, and the ledge is the ground."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from support.gltf_reader import Glb
from support.worlds import BIRD, UNIT, placed_on, write_world

import jaxfit
from jaxfit.cli.main import main
from jaxfit.foundation.errors import InputError
from jaxfit.simulation.scene import stage_scene


@pytest.fixture(scope="module")
def scene():
    return stage_scene(BIRD, birds=2, frames=8, size=(320, 200), seed=3)


@pytest.fixture(scope="module")
def camera(scene):
    return scene.view.camera("cliff", UNIT)


@pytest.fixture(scope="module")
def made(scene, camera):
    """A result without the first pose of the first bird; the probabilities are those of no real bird."""
    placed = placed_on(scene, camera)
    valid = placed.valid.copy()
    valid[0, 0] = False
    points = np.random.default_rng(0).normal(size=placed.keypoints.cam.shape)
    points[1, 2, 3] = np.nan
    placed = placed.with_arrays(keypoints_triangulated_m=points, keypoints_triangulated_sd_m=np.abs(points) / 50)
    return replace(placed, valid=valid, contact=np.linspace(0, 1, valid.size).reshape(valid.shape))


@pytest.fixture(scope="module")
def folder(tmp_path_factory, made, camera):
    folder = tmp_path_factory.mktemp("world") / "result"
    return write_world(folder, made, [camera], {"video": {"file": "/films/clip.mp4"}})


@pytest.fixture(scope="module")
def without_ledge(tmp_path_factory, made, camera):
    return write_world(tmp_path_factory.mktemp("views") / "result", replace(made, contact=None), [camera])


def known(made, values):
    return np.where(made.valid.reshape(*made.valid.shape, *(1,) * (values.ndim - 2)), values, np.nan)


def test_tables(folder, without_ledge, made, tmp_path):
    jaxfit.export_result(folder, "csv", tmp_path / "birds.csv")
    with (tmp_path / "birds.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))

    def column(name):
        return np.array([float(row[name] or "nan") for row in rows]).reshape(made.valid.shape)

    np.testing.assert_array_equal(column("on_ledge").astype(np.float32), known(made, made.contact))
    for i, axis in enumerate("xyz"):
        np.testing.assert_array_equal(column(f"root_{axis}_world_m"), known(made, made.world.transl_world_m[..., i]))
        # the camera frame has the true size, too
        expected = known(made, made.keypoints.cam[:, :, 0, i] * UNIT)
        np.testing.assert_allclose(column(f"{made.keypoint_names[0]}_{axis}_m"), expected, rtol=1e-5, atol=1e-5)
        # without the model, in rows without a pose too
        for end, points in zip(("m", "sd_m"), vars(made.triangulated).values(), strict=True):
            for k in (0, 3):
                name = f"{made.keypoint_names[k]}_{axis}_triangulated_{end}"
                np.testing.assert_array_equal(column(name), points[:, :, k, i])
    jaxfit.export_result(without_ledge, "csv", tmp_path / "views.csv")
    header = (tmp_path / "views.csv").read_text().partition("\n")[0].split(",")
    assert "on_ledge" not in header
    assert "root_x_world_m" in header


def test_the_metadata_of_parquet_say_what_is_known(folder, without_ledge, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    for source, world, ledge in (
        (folder, b"world, z up, metres", True),
        (without_ledge, b"world, as the cameras define it, metres", False),
    ):
        out = tmp_path / f"{ledge}.parquet"
        jaxfit.export_result(source, "parquet", out)
        facts = parquet.read_schema(out).metadata
        assert facts[b"world"] == world
        assert (b"on_ledge" in facts) == ledge
        assert facts[b"focal_length_px"].endswith(b", of the camera")
        assert facts[b"size"].endswith(b"positions are those at the size of the bird")


def test_movement(folder, without_ledge, made, tmp_path):
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    pytest.importorskip("h5netcdf", reason="h5netcdf is not installed")
    jaxfit.export_result(folder, "movement", tmp_path / "ledge.nc", space="world")
    jaxfit.export_result(without_ledge, "movement", tmp_path / "views.nc", space="world", dims="plural")
    with xarray.open_dataset(tmp_path / "ledge.nc", engine="h5netcdf") as data:
        position = data.position.transpose("individual", "time", "keypoint", "space")
        np.testing.assert_array_equal(position.values, known(made, made.world.keypoints_world_m))
        assert data.position.attrs["units"] == "metres"
        assert data.attrs["position_frame"] == "world, z up"
        for name, points in (
            ("position_triangulated", made.triangulated.keypoints_triangulated_m),
            ("position_triangulated_sd", made.triangulated.keypoints_triangulated_sd_m),
        ):
            np.testing.assert_array_equal(data[name].transpose("individual", "time", "keypoint", "space"), points)
        assert data.on_ledge.dims == ("time", "individual")
        np.testing.assert_array_equal(data.on_ledge.values.T, known(made, made.contact))
    with xarray.open_dataset(tmp_path / "views.nc", engine="h5netcdf") as data:
        assert data.attrs["position_frame"] == "world, as the cameras define it"
        assert "on_ledge" not in data


def test_nwb(folder, made, tmp_path):
    pynwb = pytest.importorskip("pynwb", reason="pynwb is not installed")
    pytest.importorskip("ndx_pose", reason="ndx-pose is not installed")
    jaxfit.export_result(folder, "nwb", tmp_path / "nwb")
    for n, track in enumerate(made.track_id):
        path = tmp_path / "nwb" / f"bird_{track}.nwb"
        with pynwb.NWBHDF5IO(path, "r") as io:
            file = io.read()
            behaviour = file.processing["behavior"]
            assert file.intervals is None or "pose_flags" not in file.intervals  # no flags, no error bars
            assert "keypoints_sd" not in behaviour.data_interfaces
            world, on_ledge = behaviour["keypoints_world"], behaviour["on_ledge"]
            np.testing.assert_array_equal(world.data[:], known(made, made.world.keypoints_world_m)[n])
            np.testing.assert_array_equal(on_ledge.data[:], known(made, made.contact)[n])
            points = behaviour["keypoints_triangulated"].data[:]
            np.testing.assert_array_equal(points, made.triangulated.keypoints_triangulated_m[n])
            points = behaviour["keypoints_triangulated_sd"].data[:]
            np.testing.assert_array_equal(points, made.triangulated.keypoints_triangulated_sd_m[n])
            assert (world.unit, world.rate) == ("metres", made.fps)
            assert world.description.endswith("Reference frame: world, z up")
            assert on_ledge.description.startswith("probability that the bird stands")


@pytest.mark.parametrize("ground", [False, True])
def test_the_scene_of_a_ledge_is_its_world(folder, made, scene, camera, tmp_path, ground):
    jaxfit.export_result(folder, "glb", tmp_path / "birds.glb", ground=ground)
    glb = Glb(tmp_path / "birds.glb")
    for n, t in np.argwhere(made.valid):
        x, y, z = np.moveaxis(scene.birds[n].vertices_world[t] * UNIT, -1, 0)
        read = glb.posed(f"bird_{made.track_id[n]}_mesh", t / made.fps)
        np.testing.assert_allclose(read, np.stack([x, z, -y], axis=-1), atol=2e-4)
    nodes = glb.root["nodes"]
    node = next(i for i, each in enumerate(nodes) if "camera" in each)
    x, y, z = camera.position_world
    np.testing.assert_allclose(glb.matrix(node, {})[:3, 3], [x, z, -y], atol=1e-4)
    assert any(each["name"] == "ground" for each in nodes) == ground


def test_a_world_without_a_ledge_keeps_the_camera_frame(without_ledge, tmp_path):
    jaxfit.export_result(without_ledge, "glb", tmp_path / "birds.glb")
    glb = Glb(tmp_path / "birds.glb")
    node = next(i for i, each in enumerate(glb.root["nodes"]) if "camera" in each)
    np.testing.assert_allclose(glb.matrix(node, {}), np.eye(4), atol=1e-6)


def test_wrong_use(folder, made, tmp_path, capsys):
    crops = made.with_arrays(R_world_root=None, transl_world_m=None, keypoints_world_m=None, contact=None)
    jaxfit.save_solution(crops, BIRD, "", {}, tmp_path / "crops")
    out = ["--out", str(tmp_path / "birds.nc")]
    assert main(["export", str(tmp_path / "crops"), "--to", "movement", "--space", "world", *out]) == 2
    assert "crops: is in no world" in (printed := capsys.readouterr().err)
    assert "jaxfit ledge" in printed
    with pytest.raises(InputError, match=r"--metres-per-unit: is given for a result in a world"):
        jaxfit.export_result(folder, "csv", tmp_path / "birds.csv", metres_per_unit=0.02)
