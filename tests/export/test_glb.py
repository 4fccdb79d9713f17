"""Animated glTF: an independent reader poses the meshes as the model does, gaps are hidden, the camera fits."""

import dataclasses
import json

import numpy as np
import pytest
from support.exported import BIRD, FPS, FRAMES, TRACKS, solution, write_result
from support.gltf_reader import Glb

import jaxfit
from jaxfit.data.projection import PosedBirds
from jaxfit.foundation.errors import InputError

LENGTH = float(np.ptp(np.asarray(BIRD.vertices), axis=0).max()) * 0.02
"""Body length in metres."""
TIMES = (np.array(FRAMES) - FRAMES[0]) / FPS


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("glb") / "result"
    write_result(folder, with_detections=True, betas=betas())
    return folder


def betas():
    """Track 3 has constant shape coefficients, those of track 7 change."""
    values = solution().poses.betas.copy()
    values[0], values[1, 3:] = [0.5, -0.3], [0.2, 1.0]
    return values


@pytest.fixture(scope="module")
def glb(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("glb") / "birds.glb"
    jaxfit.export_result(folder, "glb", out)
    return Glb(out)


def rigid_difference(a, b):
    """Largest distance between two meshes after the best rotation and translation of the first (Kabsch)."""
    a, b = a - a.mean(0), b - b.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = (u * [1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return np.linalg.norm(a @ turn - b, axis=1).max()


def test_a_reader_poses_the_meshes_as_the_model(folder, glb):
    made, bird = jaxfit.load_solution(folder)
    posed = PosedBirds(made, bird)
    for n in (0, 1):
        ours = posed.vertices_cam_window(n) * 0.02 / made.poses.scale[n][:, None, None]
        for t in np.flatnonzero(made.valid[n]):
            read = glb.posed(f"bird_{TRACKS[n]}_mesh", TIMES[t])
            assert rigid_difference(read, ours[t]) < 1e-3 * LENGTH


def test_the_camera_sees_the_birds_where_the_footage_shows_them(folder, glb):
    made, bird = jaxfit.load_solution(folder)
    posed = PosedBirds(made, bird)
    camera = glb.root["cameras"][0]["perspective"]
    focal = made.crops.image_size_px[0, 0, 1] / 2 / np.tan(camera["yfov"] / 2)
    node = next(i for i, each in enumerate(glb.root["nodes"]) if "camera" in each)
    assert np.allclose(glb.matrix(node, {}), np.eye(4), atol=1e-6)
    for t in (0, 2, 4):
        read = glb.posed("bird_3_mesh", TIMES[t])
        pixels = focal * read[:, :2] * [1, -1] / -read[:, 2:] + made.crops.image_size_px[0, 0] / 2
        expected = posed.vertices_screen(0, t)[:, :2]
        assert np.linalg.norm(pixels - expected, axis=1).max() < 0.02 * np.ptp(expected, axis=0).max()


def test_gaps_are_hidden_and_status_travels_along(glb):
    for time in (TIMES[1], TIMES[2], TIMES[2] + 0.079):
        assert np.ptp(glb.posed("bird_7_mesh", time), axis=0).max() < 1e-5
    assert np.ptp(glb.posed("bird_3_mesh", TIMES[2] + 0.08), axis=0).max() < 1e-5  # frame 16 is not in the result
    names = [node["name"] for node in glb.root["nodes"]]
    assert "bird_8" not in names
    tracks = glb.root["asset"]["extras"]["tracks"]
    assert [tracks[str(track)]["status"] for track in TRACKS] == ["ok", "partly diverged", "diverged"]
    assert tracks["3"]["quality"]["frames"] == len(FRAMES)
    assert glb.root["asset"]["extras"]["unit_of_lengths"] == "m"


def test_ground_is_level_and_below_the_feet(folder, tmp_path):
    jaxfit.export_result(folder, "glb", tmp_path / "birds", ground=True)
    assert sorted(path.name for path in (tmp_path / "birds").iterdir()) == ["bird_3.glb", "bird_7.glb", "export.json"]
    facts = json.loads((tmp_path / "birds" / "export.json").read_text())
    assert facts["tracks"]["3"]["file"] == "bird_3.glb"
    assert facts["tracks"]["8"] == {"poses": 0, "status": "diverged"} | {"quality": facts["tracks"]["8"]["quality"]}
    glb = Glb(tmp_path / "birds" / "bird_3.glb")
    ground = next(mesh for mesh in glb.root["meshes"] if mesh["name"] == "ground")
    corners = glb.array(ground["primitives"][0]["attributes"]["POSITION"])
    assert (corners[:, 1] == 0).all()
    turn = glb.matrix(next(i for i, node in enumerate(glb.root["nodes"]) if node["name"] == "camera_frame"), {})
    assert np.allclose(turn[:3, :3] @ turn[:3, :3].T, np.eye(3), atol=1e-6)
    with pytest.raises(InputError, match=r"birds: holds results already"):
        jaxfit.export_result(folder, "glb", tmp_path / "birds")


def test_the_error_of_fewer_weights_is_reported(tmp_path):
    weights = np.asarray(BIRD.skin_weights).copy()
    weights[0] = [0.3, 0.2, 0.15, 0.15, 0.1, 0.1, 0, 0]
    bird = dataclasses.replace(BIRD, skin_weights=weights)
    made = write_result(tmp_path / "result", bird=bird)
    done = jaxfit.export_result(tmp_path / "result", "glb", tmp_path / "birds.glb")
    assert "vertices move by up to" in done.notes[0]
    glb = Glb(tmp_path / "birds.glb")
    error = glb.root["asset"]["extras"]["largest_error_of_four_weights"]
    four = np.array([0.3, 0.2, 0.15, 0.15, 0, 0, 0, 0]) / 0.8
    pose = made.poses
    difference = []
    for n, t in np.argwhere(made.valid):
        frame = [np.asarray(getattr(pose, name))[n, t] for name in ("global_orient", "body_pose", "transl", "scale")]
        one = type(pose)(*frame, pose.bone_length[n, t], pose.betas[n, t])
        both = [vertex_by_hand(bird, one, row) for row in (weights[0], four)]
        difference.append(np.linalg.norm(both[0] - both[1]) / one.scale)
    assert error == pytest.approx(max(difference) / (LENGTH / 0.02), rel=1e-3)


def vertex_by_hand(bird, pose, row):
    from support.birds import skin_by_hand

    weights = np.asarray(bird.skin_weights).copy()
    weights[0] = row
    return skin_by_hand(dataclasses.replace(bird, skin_weights=weights), pose)[0][0]


def test_no_pose_and_no_frame_rate(folder, tmp_path):
    with pytest.raises(InputError, match="holds no pose in the chosen tracks"):
        jaxfit.export_result(folder, "glb", tmp_path / "birds.glb", tracks=[8])
    write_result(tmp_path / "result", fps=None, timestamp_s=None)
    with pytest.raises(InputError, match="does not hold the frame rate"):
        jaxfit.export_result(tmp_path / "result", "glb", tmp_path / "birds", tracks=[3])
    assert not (tmp_path / "birds").exists()


@pytest.mark.parametrize(("to", "name"), [("glb", "birds.csv"), ("nwb", "birds.nwb"), ("nwb", "birds.glb")])
def test_the_name_of_a_file_never_becomes_a_folder(folder, tmp_path, to, name):
    with pytest.raises(InputError, match=f"{name}: is the name of a file, but {to} writes a folder"):
        jaxfit.export_result(folder, to, tmp_path / name)
    assert not (tmp_path / name).exists()
