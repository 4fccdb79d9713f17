"""Saved birds load unchanged, wrong files give one clear error, and the hash identifies a model."""

import dataclasses
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import ARRAY_FIELDS, Bird, check_bird, describe_bird, model_hash
from jaxfit.model.files import find_bird, load_bird, save_bird

STATIC = ("parents", "joint_names", "keypoint_names", "joint_pairs", "keypoint_pairs", "name")


def tiny_bird(shapes: int = 2, **changes) -> Bird:
    """A tetrahedron of side 1, 2 and 3 with a root, a body and two wings."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(9, 9))
    fields = {
        "vertices": np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]),
        "faces": np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
        "joints": rng.normal(size=(4, 3)),
        "skin_weights": np.array([[1, 0, 0, 0], [0.5, 0.5, 0, 0], [0, 0.25, 0.75, 0], [0, 0, 0, 1]]),
        "keypoint_weights": np.array([[1, 0, 0, 0], [0, 0.5, 0.5, 0], [0, 0, 0, 1]]),
        "shape_basis": rng.normal(size=(shapes, 4, 3)),
        "shape_variance": np.arange(1, shapes + 1),
        "pose_mean": rng.normal(size=9),
        "pose_covariance": half @ half.T,
        "bone_mean": np.ones(3),
        "bone_covariance": np.diag([0.0, 1.0, 2.0]),
        "vertex_colours": np.array([[0, 0, 0], [1, 1, 1], [0.2, 0.1, 0.1], [0.5, 0.5, 0.5]]),
        "joint_limits": rng.uniform(0.1, 2, size=(3, 3, 2)) * [-1, 1],
        "parents": (-1, 0, 1, 1),
        "joint_names": ("root", "body", "left_wing", "right_wing"),
        "keypoint_names": ("bill_tip", "left_wingtip", "right_wingtip"),
        "joint_pairs": ((2, 3),),
        "keypoint_pairs": ((1, 2),),
        "name": "tiny guillemot",
    } | changes
    for field in ARRAY_FIELDS:
        fields[field] = jnp.asarray(fields[field], jnp.int32 if field == "faces" else jnp.float32)
    return Bird(**fields)


def saved(tmp_path: Path, **changes) -> Path:
    """A file of the tiny bird with some entries replaced, or removed where the value is None."""
    path = tmp_path / "bird.npz"
    save_bird(tiny_bird(), path)
    with np.load(path) as stored:
        content = {name: stored[name] for name in stored.files} | changes
    np.savez(path, **{name: array for name, array in content.items() if array is not None})
    return path


def load_error(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        load_bird(path)
    assert str(caught.value).startswith(str(path))
    return str(caught.value)


@pytest.mark.parametrize("bird", [tiny_bird(), tiny_bird(shapes=0, joint_pairs=(), keypoint_pairs=())])
def test_a_saved_bird_loads_unchanged(tmp_path, bird):
    path = tmp_path / "folder" / "a bird.npz"
    save_bird(bird, path)
    loaded = load_bird(path)
    for field in ARRAY_FIELDS:
        array, expected = getattr(loaded, field), getattr(bird, field)
        assert isinstance(array, jax.Array)
        assert array.dtype == (jnp.int32 if field == "faces" else jnp.float32)
        assert array.shape == expected.shape
        np.testing.assert_array_equal(array, expected)
    for field in STATIC:
        assert getattr(loaded, field) == getattr(bird, field)
    assert jax.tree.structure(loaded) == jax.tree.structure(bird)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    with np.load(path, allow_pickle=False) as stored:
        assert {"format_version", *ARRAY_FIELDS, *STATIC} == set(stored.files)
        assert all(stored[name].dtype.kind in "ifU" for name in stored.files)


def test_a_failed_save_leaves_the_older_file(tmp_path):
    path = saved(tmp_path)
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"tiny guillemot.*faces"):
        save_bird(tiny_bird(faces=[[0, 1, 9]]), path)
    assert path.read_bytes() == before
    with pytest.raises(InputError):
        save_bird(tiny_bird(), tmp_path)


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("vertices", [[0, 0, np.nan]] * 4, "NaN"),
        ("vertices", [[0, 0, 1e33]] * 4, "holds 1e+33, more than 1e+09"),
        ("faces", [[0, 1, 4]], "outside 0…3"),
        ("faces", [[0, 1, -1]], "outside"),
        ("faces", np.zeros((0, 3)), "no entries"),
        ("joints", np.zeros((5, 3)), "J = 4"),
        ("skin_weights", np.full((4, 4), 0.26), "sums to 1.04"),
        ("skin_weights", [[2, -1, 0, 0]] + [[1, 0, 0, 0]] * 3, "negative"),
        ("keypoint_weights", np.full((3, 4), 0.2), "sums to 0.8"),
        ("keypoint_weights", np.full((2, 4), 0.25), "K = 3"),
        ("shape_basis", np.zeros((4, 3)), "expected (S V 3)"),
        ("shape_variance", [1.0, 0.0], "positive"),
        ("shape_variance", [1.0], "S = 2"),
        ("pose_covariance", np.eye(9) - 2 * np.diag([1] + [0] * 8), "semidefinite"),
        ("pose_covariance", np.eye(9) + np.eye(9, k=1), "symmetric"),
        ("pose_covariance", np.zeros((9, 9)), "zero"),
        ("vertex_colours", np.full((4, 3), 1.1), "[0, 1]"),
        ("joint_limits", np.tile([1.0, -1.0], (3, 3, 1)), "minimum angle of body"),
        ("joint_limits", np.tile([-7.0, 7.0], (3, 3, 1)), "full turn"),
        ("parents", (-1, 0, 3, 1), "parent of joint 2"),
        ("parents", (-1, 0, -1, 1), "parent of joint 2"),
        ("parents", (0, 0, 1, 1), "root"),
        ("parents", (), "root"),
        ("joint_names", ("root", "body", "wing", "wing"), "used twice: wing"),
        ("joint_names", ("root", "body"), "2 names for 4"),
        ("joint_names", ("root", "", "a", "b"), "empty"),
        ("joint_pairs", ((2, 4),), "outside 0…3"),
        ("joint_pairs", ((1, 2), (3, 2)), "two pairs"),
        ("keypoint_pairs", ((1, 1),), "one pair twice"),
        ("metres_per_unit", 0.0, "not positive"),
    ],
)
def test_every_field_is_checked(field, value, expected):
    with pytest.raises(InputError, match=f"^somewhere: {field}:") as caught:
        check_bird(tiny_bird(**{field: value}), "somewhere")
    assert expected in str(caught.value)


def test_at_most_eight_joints_move_a_vertex():
    fields = {
        "joints": np.zeros((10, 3)),
        "parents": (-1, *range(9)),
        "joint_names": tuple("abcdefghij"),
        "pose_mean": np.zeros(27),
        "pose_covariance": np.eye(27),
        "bone_mean": np.ones(9),
        "bone_covariance": np.eye(9),
        "joint_limits": np.tile([-1.0, 1.0], (9, 3, 1)),
    }
    check_bird(tiny_bird(**fields, skin_weights=np.repeat([[1 / 8] * 8 + [0] * 2], 4, 0)), "somewhere")
    with pytest.raises(InputError, match="skin_weights: 9 joints"):
        check_bird(tiny_bird(**fields, skin_weights=np.repeat([[1 / 9] * 9 + [0]], 4, 0)), "somewhere")


def test_missing_files_folders_and_other_formats(tmp_path):
    assert "exist" in load_error(tmp_path / "none.npz")
    assert "folder" in load_error(tmp_path)
    path = saved(tmp_path)
    whole = path.read_bytes()
    for content in (b"", b"hello", whole[: len(whole) // 2], whole[:-10], b"PK\x03\x04"):
        path.write_bytes(content)
        assert "npz" in load_error(path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    assert "npz" in load_error(path)


class Canary:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_objects_are_never_loaded(tmp_path):
    canary = tmp_path / "canary"
    path = saved(tmp_path, joints=np.array([Canary(canary)], dtype=object))
    assert "objects" in load_error(path).lower()
    path.write_bytes(pickle.dumps(Canary(canary)))
    load_error(path)
    assert not canary.exists()
    pickle.loads(path.read_bytes())
    assert canary.exists()  # the object would have acted, had it been loaded


@pytest.mark.parametrize("field", ["format_version", "vertices", "faces", "joint_names", "joint_pairs", "name"])
def test_every_field_must_be_there_with_its_dimensions_and_type(tmp_path, field):
    for value in (None, np.zeros((1, 2, 3, 4)), np.array([b"abc"])):
        assert field in load_error(saved(tmp_path, **{field: value}))


def test_colours_and_limits_may_be_missing(tmp_path):
    bird = load_bird(saved(tmp_path, vertex_colours=None, joint_limits=None))
    np.testing.assert_allclose(bird.vertex_colours, 0.7)
    np.testing.assert_allclose(bird.joint_limits, np.broadcast_to([-np.pi, np.pi], (3, 3, 2)))


def test_a_bird_loads_by_name_or_by_path(tmp_path):
    assert find_bird("murre").name == "murre"
    assert find_bird(saved(tmp_path)).name == "tiny guillemot"


def test_versions(tmp_path):
    message = load_error(saved(tmp_path, format_version=np.array(2)))
    assert "needs a newer jaxfit" in message
    assert "format_version" in load_error(saved(tmp_path, format_version=np.array(0)))
    load_bird(saved(tmp_path, added_later=np.zeros(3)))  # further arrays in a file of the same version are ignored


def test_numbers_beyond_32_bits_are_rejected(tmp_path):
    faces = np.array([[0, 1, 2**32 + 2]])  # would be vertex 2 after wrapping to 32 bits
    assert "faces" in load_error(saved(tmp_path, faces=faces))
    assert "faces" in load_error(saved(tmp_path, faces=np.array([[0, 1, 2**64 - 1]], dtype=np.uint64)))
    assert "vertices" in load_error(saved(tmp_path, vertices=np.full((4, 3), 1e300)))
    assert "joint_pairs" in load_error(saved(tmp_path, joint_pairs=np.array([[2, 3, 1]])))


def test_the_hash_depends_on_the_content_only(tmp_path):
    bird, path = tiny_bird(), tmp_path / "bird.npz"
    save_bird(bird, path)
    known = model_hash(bird)
    assert known == model_hash(load_bird(path)) == model_hash(dataclasses.replace(bird, name="other"))
    changed = [
        tiny_bird(joint_names=("root", "body", "left_arm", "right_arm"), joint_pairs=((2, 3),)),
        tiny_bird(parents=(-1, 0, 1, 2)),
        tiny_bird(keypoint_pairs=()),
        tiny_bird(faces=[[0, 2, 1], [0, 1, 3], [0, 3, 2], [2, 3, 1]]),
        tiny_bird(bone_mean=[1, 1, 1 + 1e-6]),
        tiny_bird(joint_limits=np.tile([-1.0, 1.0], (3, 3, 1))),
    ]
    assert len({known, *map(model_hash, changed)}) == len(changed) + 1
    assert model_hash(tiny_bird(vertex_colours=np.zeros((4, 3)))) == known


def test_description():
    facts = describe_bird(tiny_bird())
    counts = {"vertices": 4, "faces": 4, "joints": 4, "keypoints": 3, "shapes": 2, "max_influences": 2}
    assert {key: facts[key] for key in counts} == counts
    assert facts["extents"] == [1, 2, 3]
    assert facts["watertight"]
    assert facts["boundary_edges"] == 0
    assert facts["volume"] == pytest.approx(1.0)
    assert facts["parents"] == [None, "root", "body", "body"]
    assert facts["joint_pairs"] == [["left_wing", "right_wing"]]
    assert facts["keypoint_pairs"] == [["left_wingtip", "right_wingtip"]]
    assert facts["bone_prior_variance"] == pytest.approx([0, 2])
    assert facts["shape_variance"] == [1, 2]
    assert facts["model_hash"] == model_hash(tiny_bird())
    facts = describe_bird(tiny_bird(shapes=0, faces=[[0, 2, 1], [0, 1, 3], [0, 3, 2]]))
    assert not facts["watertight"]
    assert facts["boundary_edges"] == 3
    assert facts["volume"] is None
    assert facts["shape_variance"] is None
