"""`jaxfit adapt scan`: recovery of a known species, files of keypoints, and scans that cannot be used."""

import json

import cv2
import numpy as np
import pytest
import trimesh
from support.scans import small_scan, write_scan

from jaxfit.cli.main import main
from jaxfit.foundation.array_files import load_npz
from jaxfit.foundation.errors import InputError
from jaxfit.learning.species.scan_files import MAX_FACES, read_scan, read_scan_keypoints
from jaxfit.learning.species.species import absolute_bones, body_length, mean_keypoints
from jaxfit.learning.species.surface import fit_similarity, is_mirrored
from jaxfit.model.anatomy import other_side
from jaxfit.model.files import load_bird

BOX = trimesh.creation.box((3, 10, 3))


@pytest.fixture(scope="module")
def adapted(tmp_path_factory):
    """The adapted model and the output of the command."""
    folder = tmp_path_factory.mktemp("scan")
    bird, species, scan = small_scan()
    mesh, points = write_scan(folder, scan)
    arguments = ["adapt", "scan", str(mesh), "--keypoints", str(points), "--out", str(folder / "m.npz")]
    assert main([*arguments, "--unit", "cm"]) == 0
    return folder, bird, species, scan


def test_a_scan_gives_the_bones_and_the_surface_of_its_species(adapted):
    folder, bird, species, scan = adapted
    model = load_bird(folder / "m.npz")
    size = float(load_npz(folder / "m.npz", {"scan_size": ""})["scan_size"])
    true = absolute_bones(species) * float(scan.pose.scale)

    def error(other, size):
        return (np.abs(absolute_bones(other) * size - true) / true).mean()

    assert error(model, size) < 0.6 * error(bird, float(scan.pose.scale))
    # the faces of model and species are the same, so vertices correspond
    own = fit_similarity(np.asarray(model.vertices, float), np.asarray(species.vertices, float))
    gap = np.linalg.norm(own.apply(np.asarray(model.vertices, float)) - np.asarray(species.vertices), axis=1)
    assert gap.mean() < 0.015 * body_length(species)


def test_the_model_file_says_how_it_was_made_and_the_picture_shows_six_views(adapted, capsys):
    capsys.readouterr()
    assert main(["model", "info", str(adapted[0] / "m.npz"), "--json"]) == 0
    provenance = json.loads(capsys.readouterr().out)["provenance"]
    assert (provenance["base"], provenance["keypoints"]) == ("murre", "12")
    assert provenance["free"] == "pose, size, bone lengths, shape"
    assert "base_hash" in provenance
    assert main(["model", "info", str(adapted[0] / "m.npz")]) == 0
    assert "how the model was made" in capsys.readouterr().out
    picture = cv2.imread(str(adapted[0] / "m.png"))
    assert picture.shape[1] == 1200
    assert (np.abs(picture.astype(int) - 250).sum(2) > 60).mean() > 0.05


def test_keypoints_may_be_vertex_numbers_or_picked_points(tmp_path):
    vertices = np.arange(30, dtype=float).reshape(10, 3)
    names = ["bill_tip", "tail_tip", "left_eye", "right_eye", "crown"]
    numbers, picked = tmp_path / "k.json", tmp_path / "k.pp"
    numbers.write_text(json.dumps({"Bill tip": 0, "tail_tip": [3, 4, 5], "L_eye": 2, "right_eye": 3, "wheel": 4}))
    points = "".join(f'<point active="1" name="{n}" x="{i}" y="0" z="1"/>' for i, n in enumerate(names))
    points += '<point active="0" name="nape" x="0" y="0" z="0"/>'
    picked.write_text(f"<!DOCTYPE PickedPoints><PickedPoints>{points}</PickedPoints>")
    found, unknown = read_scan_keypoints(numbers, names, vertices)
    assert unknown == ("wheel",)
    assert {name: point.tolist() for name, point in found.items()} == {
        "bill_tip": [0, 1, 2],
        "tail_tip": [3, 4, 5],
        "left_eye": [6, 7, 8],
        "right_eye": [9, 10, 11],
    }
    found, _ = read_scan_keypoints(picked, names, None)
    assert [found[name].tolist() for name in names] == [[i, 0, 1] for i in range(5)]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('{"bill_tip": 1, "tail_tip": 2, "crown": 3}', "3 keypoints of the model"),
        ('{"bill_tip": 99, "tail_tip": 2, "crown": 3, "nape": 1}', "outside 0…9"),
        (
            '{"bill_tip": 18446744073709551616, "tail_tip": 2, "crown": 3, "nape": 1}',
            "vertex 18446744073709551616 is outside",
        ),
        ('{"bill_tip": "a", "tail_tip": 2, "crown": 3, "nape": 1}', "is not a point"),
        ('{"bill_tip": [1, 2, 1e300], "tail_tip": 2, "crown": 3, "nape": 1}', r"bill_tip is a point beyond 1e\+09"),
        ('{"bill_tip": [1, 2, NaN], "tail_tip": 2, "crown": 3, "nape": 1}', "is not a point"),
        ('{"bill_tip": 1, "tail_tip": 1, "crown": 1, "nape": 1}', "one point"),
        ("[1, 2]", "not an object"),
        ("<a/>", "not valid JSON"),
    ],
)
def test_unusable_files_of_keypoints_are_one_line_errors(tmp_path, content, says):
    path = tmp_path / "k.json"
    path.write_text(content)
    with pytest.raises(InputError, match=says):
        read_scan_keypoints(path, ["bill_tip", "tail_tip", "crown", "nape"], np.arange(30.0).reshape(10, 3))


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb"])
def test_scans_of_every_format_have_the_same_surface(tmp_path, suffix):
    path = tmp_path / f"scan{suffix}"
    BOX.export(path)
    scan = read_scan(path)
    assert (scan.numbered_vertices is None) == (suffix == ".stl")
    assert trimesh.Trimesh(scan.vertices, scan.faces).area == pytest.approx(BOX.area)


def test_small_parts_are_skipped_and_large_scans_decimated(tmp_path):
    path = tmp_path / "scan.ply"
    body = trimesh.creation.icosphere(subdivisions=7, radius=5)
    dust = trimesh.creation.icosphere(subdivisions=1, radius=0.1).apply_translation((20, 0, 0))
    trimesh.util.concatenate([body, dust]).export(path)
    scan = read_scan(path)
    assert len(scan.faces) <= MAX_FACES < len(body.faces)
    assert len(scan.remarks) == 2
    assert "decimated" in scan.remarks[0]
    assert "2 parts" in scan.remarks[1]
    assert np.linalg.norm(scan.vertices, axis=1) == pytest.approx(5, rel=0.01)


def test_files_that_are_no_scans_are_one_line_errors(tmp_path):
    files = {"points.ply": trimesh.PointCloud(BOX.vertices).export(file_type="ply"), "empty.stl": b"", "bird.txt": b"a"}
    files["torn.glb"] = BOX.export(file_type="glb")[:90]
    files["flat.ply"] = trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False).export(file_type="ply")
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name):
            read_scan(tmp_path / name)


@pytest.mark.parametrize(
    ("coordinate", "face", "says"),
    [
        ("1", "0 1 -1", "has a face that names vertex -1, not 0…2"),
        ("1", "0 1 9", "has a face that names vertex 9, not 0…2"),
        ("1e33", "0 1 2", "has vertices that are not finite, or beyond"),
    ],
)
def test_impossible_meshes_are_one_line_errors(tmp_path, coordinate, face, says):
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    head += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "scan.ply").write_text(f"{head}0 0 0\n{coordinate} 0 0\n0 1 0\n3 0 1 2\n3 {face}\n")
    with pytest.raises(InputError, match=rf"scan\.ply: {says}"):
        read_scan(tmp_path / "scan.ply")


def test_a_mirrored_scan_and_distant_keypoints_are_rejected(tmp_path, capsys):
    bird, _, scan = small_scan()
    names = list(scan.keypoints)
    own = mean_keypoints(bird)[[bird.keypoint_names.index(name) for name in names]]
    assert not is_mirrored(own, np.stack([scan.keypoints[name] for name in names]))
    mesh, points = write_scan(tmp_path, scan)
    exchanged = {other_side(name): value.tolist() for name, value in scan.keypoints.items()}
    points.write_text(json.dumps(exchanged))
    assert main(["adapt", "scan", str(mesh), "--keypoints", str(points), "--out", str(tmp_path / "m.npz")]) == 2
    assert "mirror image" in capsys.readouterr().err
    far = {name: (np.asarray(value) * 100).tolist() for name, value in scan.keypoints.items()}
    points.write_text(json.dumps(far))
    assert main(["adapt", "scan", str(mesh), "--keypoints", str(points), "--out", str(tmp_path / "m.npz")]) == 2
    assert "far from the surface" in capsys.readouterr().err
    assert not (tmp_path / "m.npz").exists()


@pytest.mark.extended
def test_a_body_with_four_legs_does_not_fit(tmp_path, capsys):
    body = trimesh.creation.capsule(height=60, radius=15)
    upright = trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0))
    legs = [trimesh.creation.cylinder(3, 60).apply_transform(upright) for _ in range(4)]
    for leg, (x, z) in zip(legs, [(-10, -25), (10, -25), (-10, 25), (10, 25)], strict=True):
        leg.apply_translation((x, -35, z))
    head = trimesh.creation.box((20, 20, 50)).apply_translation((0, 30, 45))
    trimesh.util.concatenate([body, *legs, head]).export(tmp_path / "cow.ply")
    points = {"bill_tip": [0, 30, 70], "crown": [0, 40, 40], "tail_tip": [0, 0, -45], "back": [0, 15, 20]}
    points |= {"breast": [0, -15, 25], "left_foot": [10, -65, -25], "right_foot": [-10, -65, -25]}
    (tmp_path / "cow.json").write_text(json.dumps(points))
    command = ["adapt", "scan", str(tmp_path / "cow.ply"), "--keypoints", str(tmp_path / "cow.json"), "--unit", "m"]
    assert main([*command, "--out", str(tmp_path / "m.npz")]) == 0
    output = capsys.readouterr().out
    assert "does not fit this scan" in output
    assert "give the unit of the scan" in output
