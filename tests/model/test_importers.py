"""Importers copy every field unchanged, find the files of a model, and report wrong files and fields."""

import json

import numpy as np
import pytest
from support.checkpoints import write_legacy, write_zip
from support.cli_files import rejected

from jaxfit.cli.main import main
from jaxfit.foundation.errors import InputError
from jaxfit.model.anatomy import AVES_KEYPOINTS, AVIAN_MESH_KEYPOINTS, mirror_pairs
from jaxfit.model.bird import rest_length
from jaxfit.model.files import load_bird
from jaxfit.model.published import import_aves, import_avian_mesh, import_model

PARENTS = [-1, 0, 1, 0, 3, 3, 5, 6, 7, 3, 9, 10, 11, 3, 13, 14, 15, 3, 17, 18, 19, 3, 21, 22, 23]


def mesh(keypoints: int) -> dict[str, np.ndarray]:
    """A tetrahedron with the published models' skeleton."""
    rng = np.random.default_rng(keypoints)
    return {
        "V": rng.normal(size=(4, 3)).astype(np.float32),
        "F": np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
        "J": rng.normal(size=(25, 3)).astype(np.float32),
        "kintree_table": np.array([PARENTS, range(25)]),
        "weights": np.eye(25, dtype=np.float32)[:4],
        "vert2kpt": np.eye(4, dtype=np.float32)[rng.integers(0, 4, keypoints)],
    }


def prior(pose: str, bone: str) -> dict[str, np.ndarray]:
    """The four arrays of a prior, with these prefixes in their names."""
    means = {pose + "m": np.linspace(-0.1, 0.1, 72), bone + "m": np.linspace(0.9, 1.1, 24)}
    covariances = {pose + "cov": 0.01 * np.eye(72), bone + "cov": 0.02 * np.eye(24)}
    return {name: array.astype(np.float32) for name, array in (means | covariances).items()}


def write_mesh(path, **changes):
    content = {name: array.tolist() for name, array in mesh(12).items()} | changes
    path.write_text(json.dumps({name: value for name, value in content.items() if value is not None}))
    return path


def write_prior(path, **changes):
    return write_legacy(path, prior("p_", "b_") | changes)


def write_aves(path, write=write_legacy, **changes):
    own = {name.replace("_m", "_mean"): array for name, array in prior("pose_", "bone_").items()}
    shapes = {"Beta": np.arange(24, dtype="<f4").reshape(2, 4, 3), "Beta_sigma": np.array([4, 2], "<f4")}
    content = mesh(18) | own | shapes | changes
    return write(path, {name: array for name, array in content.items() if array is not None})


@pytest.fixture
def avian_mesh_files(tmp_path):
    return write_mesh(tmp_path / "bird_eccv.json"), write_prior(tmp_path / "pose_bone_prior.pth")


def test_avian_mesh_fields(avian_mesh_files):
    bird, expected = import_avian_mesh(*avian_mesh_files), mesh(12)
    for field, key in (("vertices", "V"), ("joints", "J"), ("skin_weights", "weights"), ("faces", "F")):
        np.testing.assert_array_equal(getattr(bird, field), expected[key])
    np.testing.assert_array_equal(bird.keypoint_weights, expected["vert2kpt"])
    np.testing.assert_array_equal(bird.pose_mean, prior("p_", "b_")["p_m"])
    np.testing.assert_array_equal(bird.bone_covariance, prior("p_", "b_")["b_cov"])
    assert bird.faces.dtype == np.int32
    assert bird.shape_basis.shape == (0, 4, 3)
    assert bird.shape_variance.shape == (0,)
    assert bird.parents == tuple(PARENTS)
    assert bird.keypoint_names == AVIAN_MESH_KEYPOINTS
    assert bird.name == "avian-mesh"


@pytest.mark.parametrize("write", [write_legacy, write_zip])
def test_aves_fields(tmp_path, write):
    bird = import_aves(write_aves(tmp_path / "aves.pt", write))
    np.testing.assert_array_equal(bird.vertices, mesh(18)["V"])
    directions = np.arange(24).reshape(2, 4, 3)
    np.testing.assert_allclose(bird.shape_basis, directions * np.array([4, 2])[:, None, None])
    np.testing.assert_allclose(bird.shape_variance, [0.25, 0.5])
    np.testing.assert_array_equal(bird.bone_mean, prior("p_", "b_")["b_m"])
    assert bird.keypoint_names == AVES_KEYPOINTS
    assert bird.name == "aves"
    other = write_prior(tmp_path / "prior.pth", p_m=np.full(72, 0.5, "<f4"))
    assert import_aves(tmp_path / "aves.pt", other).pose_mean[0] == 0.5


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"V": None}, "V: missing"),
        ({"V": [[0, 0]] * 4}, r"V must have shape \(V, 3\), not \(4, 2\)"),
        ({"V": [[0, 0, 0], [1, 2]]}, "V: not an array of numbers"),
        ({"V": [[1e300] * 3] * 4}, "vertices: holds NaN or infinite"),
        ({"V": [[10**400] * 3] * 4}, "V: not an array of numbers"),
        ({"F": [[0, 1, 4]]}, "faces: an index outside"),
        ({"F": [[0, 1, 2**32]]}, "faces: an index outside"),
        ({"F": [[0.5, 1, 2]]}, "F: not an array of numbers"),
        ({"vert2kpt": [[1, 0, 0, 0]] * 18}, r"vert2kpt must have shape \(12, V\), not \(18, 4\)"),
        ({"kintree_table": [PARENTS, [0] * 25]}, "kintree_table"),
        ({"kintree_table": [[-1, *range(1, 25)], list(range(25))]}, "parents: the parent of joint 1"),
    ],
)
def test_error_names_the_wrong_field_of_a_mesh(avian_mesh_files, change, expected):
    write_mesh(avian_mesh_files[0], **change)
    with pytest.raises(InputError, match=rf"bird_eccv\.json: {expected}"):
        import_model("avian-mesh", avian_mesh_files)


def test_damaged_json(avian_mesh_files):
    for content, expected in ((b'{"V": [[1, 2,\n', "line 2, column 1"), (b"[1, 2]", "not a JSON object")):
        avian_mesh_files[0].write_bytes(content)
        with pytest.raises(InputError, match=expected):
            import_avian_mesh(*avian_mesh_files)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"Beta": None}, "Beta: missing"),
        ({"Beta": np.zeros((3, 4, 3), "<f4")}, "Beta, Beta_sigma: shapes"),
        ({"Beta": np.zeros((2, 5, 3), "<f4")}, "shape_basis"),
        ({"Beta_sigma": np.array([1, 0], "<f4")}, "Beta_sigma: must be positive"),
        ({"pose_cov": np.eye(71, dtype="<f4")}, "pose_covariance must have shape"),
        ({"pose_mean": None}, "pose_mean: missing"),
    ],
)
def test_error_names_the_wrong_field_of_aves(tmp_path, change, expected):
    with pytest.raises(InputError, match=rf"aves\.pt: {expected}"):
        import_aves(write_aves(tmp_path / "aves.pt", **change))


def test_files_in_any_order_or_in_a_folder(tmp_path, avian_mesh_files):
    mesh_path, prior_path = avian_mesh_files
    write_aves(tmp_path / "aves.pt")
    (tmp_path / "notes.json").write_text("{}")
    for sources in ([prior_path, mesh_path], [tmp_path], [str(mesh_path), tmp_path]):
        assert import_model("avian-mesh", sources).num_keypoints == 12
    for sources in ([tmp_path], [tmp_path / "aves.pt"], [prior_path, tmp_path / "aves.pt"]):
        assert import_model("aves", sources).num_keypoints == 18
    renamed = write_mesh(tmp_path / "mesh of mine.json")
    assert import_model("avian-mesh", [renamed, prior_path]).num_keypoints == 12


def test_files_that_do_not_belong_to_the_model(tmp_path, avian_mesh_files):
    mesh_path, prior_path = avian_mesh_files
    aves_path = write_aves(tmp_path / "aves.pt")
    (tmp_path / "empty").mkdir()
    for kind, sources, expected in (
        ("aves", [mesh_path], "not a file of the aves model"),
        ("avian-mesh", [mesh_path, prior_path, aves_path], "aves.pt: not a file of the avian-mesh model"),
        ("avian-mesh", [prior_path], "holds no bird_eccv.json"),
        ("avian-mesh", [mesh_path], "the prior of pose and bone lengths is missing"),
        ("aves", [], "nothing: holds no aves.pt"),
        ("aves", [tmp_path / "empty"], "holds no aves.pt"),
        ("aves", [tmp_path / "none.pt"], "does not exist"),
        ("avian-mesh", [mesh_path, write_mesh(tmp_path / "b.json")], "a second bird_eccv.json"),
    ):
        with pytest.raises(InputError, match=expected):
            import_model(kind, sources)
    aves_path.write_bytes(aves_path.read_bytes()[:-5])
    with pytest.raises(InputError, match=r"aves\.pt: is not a PyTorch checkpoint"):
        import_model("aves", [tmp_path])
    with pytest.raises(ValueError, match="kind must be one of avian-mesh, aves, not 'crow'"):
        import_model("crow", [])


def test_the_length_of_the_species_sets_the_unit(tmp_path, capsys):
    command = ["model", "import", "aves", str(write_aves(tmp_path / "aves.pt")), "--out", str(tmp_path / "aves.npz")]
    assert main([*command, "--length-cm", "28"]) == 0
    bird = load_bird(tmp_path / "aves.npz")
    assert bird.metres_per_unit * rest_length(bird) == pytest.approx(0.28)
    rejected(capsys, [*command, "--length-cm", "-3"], "--length-cm: is -3.0")


def test_mirror_pairs():
    assert mirror_pairs(["right_eye", "tail", "left_eye", "left_foot"]) == ((2, 0),)
