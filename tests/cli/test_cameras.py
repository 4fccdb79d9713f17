"""`cameras show`, `simulate --cameras`."""

from dataclasses import replace

import pytest

from jaxfit.cameras.files import read_cameras, write_cameras
from jaxfit.cli.main import main
from jaxfit.model.files import load_murre
from jaxfit.simulation.rig import stage_rig
from jaxfit.view.camera_plan import PANEL_PX, camera_plan


@pytest.fixture(scope="module")
def cameras():
    return stage_rig(load_murre(), 3, birds=1, frames=2, size=(320, 200), distorted=True).cameras


def test_show_prints_a_table_and_draws_a_plan(cameras, tmp_path, capsys):
    write_cameras(cameras, tmp_path / "rig.toml")
    assert main(["cameras", "show", str(tmp_path / "rig.toml"), "--out", str(tmp_path / "plan.png")]) == 0
    printed = capsys.readouterr().out
    assert "3 cameras of anipose; unit of the file: m (stated)" in printed
    positions = [", ".join(f"{x:.2f}" for x in camera.position_world) for camera in cameras]
    assert all(position in printed for position in positions)
    assert max(map(len, printed.splitlines())) <= 100
    assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG")
    assert main(["cameras", "show", str(tmp_path / "rig.toml"), "--out", str(tmp_path / "plan.png")]) == 2


def test_a_plan_shows_every_camera(cameras):
    picture = camera_plan(cameras)
    assert picture.shape[1] == 2 * PANEL_PX
    one = camera_plan(cameras[:1])
    assert (picture != one).any()
    # without an image size, a camera has its viewing axis only
    axes = camera_plan([replace(camera, size_px=None) for camera in cameras])
    assert (axes != picture).any()
    # a plan twice as large has another grid, but the same shape
    assert camera_plan([camera.scaled(2.0) for camera in cameras]).shape == picture.shape


def test_simulate_films_with_several_cameras(tmp_path, capsys):
    scene = str(tmp_path / "scene")
    command = ["simulate", "--birds", "1", "--frames", "2", "--size", "320x200", "--out", scene]
    assert main([*command, "--cameras", "2", "--distortion"]) == 0
    assert "by 2 cameras" in capsys.readouterr().out
    assert [camera.name for camera in read_cameras(tmp_path / "scene" / "cameras.toml")] == ["cam0", "cam1"]
    again = [*command, "--overwrite", "--cameras", str(tmp_path / "missing.toml")]
    assert main(again) == 2
    assert main([*command, "--overwrite", "--distortion"]) == 2
    assert "give the number of cameras" in capsys.readouterr().err
