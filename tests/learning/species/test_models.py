"""`jaxfit model compare`, `rig` and `keypoints`, and the offsets of vertices."""

import re
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxfit.cli.main import main
from jaxfit.learning.species.models import Placement, compare_birds, rig_mesh
from jaxfit.learning.species.species import mirror_vertices, offset_directions
from jaxfit.learning.species.surface import boundary_faces, closest_points, search_samples, visible_faces
from jaxfit.model.files import load_bird, load_murre, save_bird
from jaxfit.model.kinematics import fold_bird, joint_transforms, posed_vertices
from jaxfit.simulation.species import random_pose

MURRE = load_murre()


def changed(bird, size=1.0, bone=1.0):
    """Return the bird with another size and a longer head bone."""
    bones = np.array(bird.bone_mean)
    bones[bird.joint_names.index("head") - 1] *= bone
    places = {name: jnp.asarray(np.asarray(getattr(bird, name)) * size) for name in ("vertices", "joints")}
    return replace(bird, name="other", bone_mean=jnp.asarray(bones), **places)


def test_equal_models_of_other_size_differ_in_size_only():
    comparison = compare_birds(MURRE, changed(MURRE, size=1.25))
    assert comparison.size == pytest.approx(1.25, rel=1e-4)
    assert list(comparison.bones.values()) == pytest.approx([1] * len(comparison.bones), rel=1e-4)
    assert max(comparison.of_first.max(), comparison.of_second.max()) < 1e-6


def test_models_of_other_meshes_are_aligned_by_the_points_of_their_mean_bones():
    other = changed(MURRE, bone=1.2)
    turned = replace(other, faces=jnp.asarray(np.asarray(other.faces)[::-1]))  # the same mesh
    equal, named = (compare_birds(MURRE, bird) for bird in (other, turned))
    assert named.size == pytest.approx(equal.size, rel=0.01)
    assert named.of_first.mean() < 1.3 * equal.of_first.mean()


def test_the_command_prints_a_longer_bone_and_draws_both(tmp_path, capsys):
    save_bird(changed(MURRE, bone=1.2), tmp_path / "b.npz")
    assert main(["model", "compare", "murre", str(tmp_path / "b.npz"), "--out", str(tmp_path / "c.png")]) == 0
    first = next(line for line in capsys.readouterr().out.splitlines() if "head" in line)
    assert float(re.search(r"[+-][\d.]+", first)[0]) == pytest.approx(20, abs=3)
    assert (tmp_path / "c.png").stat().st_size > 10_000


def test_a_posed_mesh_of_another_topology_gets_a_rig_that_poses_it():
    pose = random_pose(MURRE, np.random.default_rng(1))
    rig = fold_bird(MURRE)
    posed = np.asarray(posed_vertices(rig, joint_transforms(rig, pose), pose), float)
    fine, faces = trimesh.remesh.subdivide(posed, np.asarray(MURRE.faces))
    turn = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))[:3, :3]
    root = np.asarray(MURRE.joints, float)[0]
    place = Placement(turn, 2.5, np.array([3.0, 4.0, 5.0]), np.asarray(pose.body_pose))
    mesh = 2.5 * (fine - root) @ turn.T + place.root
    model, distance = rig_mesh(mesh, faces, MURRE, place)
    assert np.percentile(distance, 90) < 1e-6
    assert distance.max() < 0.005 * np.ptp(posed[:, 1])
    own = fold_bird(model)
    again = np.asarray(posed_vertices(own, joint_transforms(own, pose), pose))
    assert np.abs(again - fine).max() < 1e-3  # in the pose of the mesh, the model is the mesh
    length = np.ptp(np.asarray(MURRE.vertices)[:, 1])
    gap = np.linalg.norm(np.asarray(model.keypoints) - np.asarray(MURRE.keypoints), axis=1)
    assert np.median(gap) < 0.02 * length
    rest = np.asarray(model.vertices)[: len(posed)]  # `subdivide` keeps the vertices at the front
    assert np.median(np.linalg.norm(rest - np.asarray(MURRE.vertices), axis=1)) < 0.01 * length


def test_the_command_rigs_a_mesh_in_the_rest_pose_and_rejects_a_distant_mesh(tmp_path, capsys):
    save_bird(MURRE, tmp_path / "m.npz")
    mesh = trimesh.Trimesh(np.asarray(MURRE.vertices), np.asarray(MURRE.faces), process=False)
    mesh.export(tmp_path / "mesh.ply")
    command = ["model", "rig", str(tmp_path / "mesh.ply"), "--like", str(tmp_path / "m.npz"), "--out"]
    assert main([*command, str(tmp_path / "r.npz")]) == 0
    assert len(load_bird(tmp_path / "r.npz").vertices) == len(mesh.vertices)
    mesh.apply_translation((50, 0, 0)).export(tmp_path / "mesh.ply")
    capsys.readouterr()
    assert main([*command, str(tmp_path / "far.npz")]) == 2
    assert "far from m.npz" in capsys.readouterr().err


def test_the_page_names_every_keypoint_and_needs_no_other_file(tmp_path):
    page = tmp_path / "page.html"
    assert main(["model", "keypoints", "murre", "--out", str(page)]) == 0
    text = page.read_text()
    assert all(text.count(f"<code>{name}</code>") == 1 for name in MURRE.keypoint_names)
    assert text.count("data:image/png;base64,") == 6
    assert not re.search(r'(src|href)="(?!data:)', text)
    rows = dict(re.findall(r"<code>(\w+)</code></td><td>([\w, ]+)</td>", text))
    assert "left" in rows["left_eye"].split(", ")
    assert "right" not in rows["left_eye"].split(", ")


def test_offsets_are_symmetric_and_smooth_offsets_are_probable():
    directions = offset_directions(MURRE, 4, 0.01)
    mirror = mirror_vertices(MURRE)
    assert (mirror != np.arange(len(mirror))).mean() > 0.8
    assert np.abs(directions.basis[:, mirror] * [-1, 1, 1] - directions.basis).max() < 1e-9
    assert (np.diff(directions.variance[:4]) <= 0).all()


def test_closest_points_agree_with_the_distance_from_a_sphere():
    ball = trimesh.creation.icosphere(subdivisions=4)
    points = np.random.default_rng(0).standard_normal((200, 3)) * 2
    faces = np.asarray(ball.faces)
    samples = search_samples(np.asarray(ball.vertices), faces, 20_000)
    found = closest_points(points, np.asarray(ball.vertices), faces, samples)
    assert found.distance == pytest.approx(np.abs(np.linalg.norm(points, axis=1) - 1), abs=0.005)
    again = np.einsum("pk,pkc->pc", found.barycentric, ball.vertices[faces[found.face]])
    assert again == pytest.approx(found.point, abs=1e-6)


def test_faces_inside_are_not_visible_and_faces_at_a_hole_are_at_the_boundary():
    outer, inner = trimesh.creation.icosphere(radius=2), trimesh.creation.icosphere(radius=1)
    both = trimesh.util.concatenate([outer, inner])
    seen = visible_faces(np.asarray(both.vertices), np.asarray(both.faces))
    assert seen[: len(outer.faces)].all()
    assert not seen[len(outer.faces) :].any()
    faces = np.asarray(outer.faces)
    assert not boundary_faces(faces).any()
    assert 0 < boundary_faces(faces[1:]).sum() < 15
