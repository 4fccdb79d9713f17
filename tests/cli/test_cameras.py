"""`cameras show`, `simulate --cameras`, `overlay --camera`."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.overlays import GREY, film
from support.worlds import BIRD, UNIT, placed_on, write_world

from jaxfit.cameras.files import read_cameras, write_cameras
from jaxfit.cli.main import main
from jaxfit.raster.zbuffer import hard_mask
from jaxfit.simulation.rig import stage_rig
from jaxfit.view.camera_plan import PANEL_PX, camera_plan


@pytest.fixture(scope="module")
def rig():
    return stage_rig(BIRD, 3, birds=1, frames=2, size=(320, 200), distorted=True)


@pytest.fixture(scope="module")
def cameras(rig):
    return rig.cameras


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


def test_the_overlay_of_another_camera(rig, tmp_path, capsys):
    """The picture changes where the camera films the bird; the report draws the result as the first camera films it."""
    result = str(write_world(tmp_path / "result", placed_on(rig.scenes[0], rig.cameras[0]), rig.cameras))
    video = ["--video", str(film(tmp_path / "film.mp4"))]
    for name, camera, chosen in (("first", rig.cameras[0], []), ("last", rig.cameras[2], ["--camera", "cam2"])):
        out = tmp_path / f"{name}.png"
        assert main(["overlay", result, *video, "--frame", "1", "--out", str(out), *chosen]) == 0
        vertices_m = rig.scenes[0].birds[0].vertices_world[1] * UNIT
        screen = np.column_stack([camera.project(vertices_m), camera.to_camera(vertices_m)[:, 2]])
        mask = hard_mask(screen.astype(np.float32), np.asarray(BIRD.faces), 320, 200)
        changed = np.abs(cv2.imread(str(out))[:200].astype(int) - GREY).sum(-1) > 24
        assert mask.sum() > 200
        assert changed[mask].mean() > 0.9  # some feathers are as grey as the film
    assert main(["overlay", result, *video, "--out", str(tmp_path / "all.mp4"), "--camera", "cam2"]) == 0
    assert (tmp_path / "all.png").is_file()
    assert main(["report", result, *video, "--out", str(tmp_path / "report.html")]) == 0
    capsys.readouterr()
    assert main(["overlay", result, *video, "--out", str(tmp_path / "x.mp4"), "--camera", "north"]) == 2
    assert "choose one of: cam0, cam1, cam2" in capsys.readouterr().err
