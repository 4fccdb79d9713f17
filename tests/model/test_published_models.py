"""The published models pose as their authors' code does, and are named as their anatomy has it."""

import json

import numpy as np
import pytest

from jaxfit.model.anatomy import AVES_KEYPOINTS, JOINT_NAMES
from jaxfit.model.importers.sources import import_sources


@pytest.fixture(scope="module")
def birds(reference_dir):
    folder = reference_dir / "models"
    return {
        "avian_mesh": import_sources("avian-mesh", [folder / "avian_mesh"]),
        "aves": import_sources("aves", [folder / "aves"]),
    }


def test_sums_that_pytorch_gives(birds):
    """Sums over each tensor of aves.pt as PyTorch 2 loads it, in double precision."""
    aves = birds["aves"]
    for field, expected in (
        ("vertices", -6393.936412902462),
        ("faces", 37681697),
        ("joints", 57.41240182425827),
        ("skin_weights", 3932.0000101413198),
        ("keypoint_weights", 18.0),
        ("pose_mean", 0.24298133309207515),
        ("pose_covariance", 0.4705437438332729),
        ("bone_mean", 24.017544209957123),
        ("bone_covariance", 0.5467710988811156),
    ):
        assert np.asarray(getattr(aves, field), np.float64).sum() == pytest.approx(expected, rel=1e-12), field
    sigma = 1 / np.asarray(aves.shape_variance, np.float64)
    assert sigma.sum() == pytest.approx(419.0014772415161, rel=1e-6)
    assert (aves.shape_basis / sigma[:, None, None]).sum() == pytest.approx(1.5059610030343578, abs=1e-3)
    norms = np.linalg.norm(np.asarray(aves.shape_basis).reshape(15, -1), axis=1)
    np.testing.assert_allclose(norms, sigma, rtol=1e-5)


def rotation_matrix(vector):
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def skin(bird, case):
    """Linear blend skinning joint by joint with 4×4 matrices, in double precision: an oracle of its own."""
    joints = np.asarray(bird.joints, np.float64)
    angles = np.concatenate([case["global_orient"], case["body_pose"]]).reshape(-1, 3)
    bones = np.concatenate([[1], case["bone_length"]])
    rest = np.asarray(bird.vertices, np.float64)
    if "beta" in case:
        rest = rest + np.tensordot(case["beta"].astype(np.float64), np.asarray(bird.shape_basis), axes=1)
    chain, vertices = [], np.zeros_like(rest)
    for j, parent in enumerate(bird.parents):
        local = np.eye(4)
        local[:3, :3] = rotation_matrix(angles[j].astype(np.float64))
        local[:3, 3] = case["scale"] * bones[j] * (joints[j] - (joints[parent] if j else 0))
        chain.append(local if j == 0 else chain[parent] @ local)
        moved = (rest - joints[j]) * case["scale"] @ chain[j][:3, :3].T + chain[j][:3, 3]
        vertices += np.asarray(bird.skin_weights)[:, [j]] * moved
    return vertices


@pytest.mark.parametrize(("model", "scale"), [("avian_mesh", 1.0), ("avian_mesh", 1.3), ("aves", 1.0)])
def test_posed_as_the_authors_code_does(birds, reference_dir, model, scale):
    prefix = f"{model}/scale_{scale}/"
    with np.load(reference_dir / "reference" / "lbs.npz") as stored:
        cases = {name.removeprefix(prefix): stored[name] for name in stored.files if name.startswith(prefix)}
    for i in range(3):
        case = {name: array[i] for name, array in cases.items()} | {"scale": scale}
        vertices = skin(birds[model], case)
        # measured: 6e-6 of a bird 15 to 25 units long
        np.testing.assert_allclose(vertices, case["vertices"], atol=2e-5)
        keypoints = np.asarray(birds[model].keypoint_weights) @ vertices
        np.testing.assert_allclose(keypoints, case["keypoints"], atol=2e-5)


def test_names_agree_with_the_annotations(reference_dir):
    content = json.loads((reference_dir / "cub" / "106.Horned_Puffin.json").read_text())
    assert tuple(content["categories"][0]["keypoints"]) == AVES_KEYPOINTS


@pytest.mark.parametrize("model", ["avian_mesh", "aves"])
def test_left_is_left(birds, model):
    """The bird looks along +y, +z up, so its left is −x; mirrored points mirror."""
    bird = birds[model]
    joints, keypoints = np.asarray(bird.joints), np.asarray(bird.keypoints)
    at = dict(zip(bird.keypoint_names, keypoints, strict=True))
    assert at["bill_tip"][1] > at["left_eye"][1] > at["nape"][1] > at["left_foot"][1] > at["tail_tip"][1]
    assert at["left_eye"][2] > at["tail_tip"][2] > at["left_foot"][2]
    assert len(bird.joint_pairs) == 8
    assert len(bird.keypoint_pairs) == 4
    for left, right in bird.joint_pairs:
        np.testing.assert_allclose(joints[left] * [-1, 1, 1], joints[right], atol=0.02)
        assert joints[left, 0] <= joints[right, 0] + 5e-3  # hips and wing roots lie on the midline
    for left, right in bird.keypoint_pairs:
        np.testing.assert_allclose(keypoints[left] * [-1, 1, 1], keypoints[right], atol=0.3)
        if "wingtip" not in bird.keypoint_names[left]:  # folded wings cross over the tail
            assert keypoints[left, 0] < -0.5 < 0.5 < keypoints[right, 0]
    corners = np.asarray(bird.vertices)[np.asarray(bird.faces)]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert 200 < volume < 350  # faces look outwards


@pytest.mark.parametrize("model", ["avian_mesh", "aves"])
def test_joints_move_what_their_names_say(birds, model):
    bird = birds[model]
    influence = np.asarray(bird.keypoint_weights) @ np.asarray(bird.skin_weights)  # (K, J)
    for j in range(len(JOINT_NAMES) - 1, 0, -1):  # children to parents: what a joint moves in all
        influence[:, bird.parents[j]] += influence[:, j]

    def moved(joint, keypoint):
        return influence[bird.keypoint_names.index(keypoint), JOINT_NAMES.index(joint)]

    for side, other in (("left", "right"), ("right", "left")):
        for joint in ("wing_root", "shoulder", "elbow", "wrist"):
            assert moved(f"{side}_{joint}", f"{side}_wingtip") > 0.8
            assert moved(f"{other}_{joint}", f"{side}_wingtip") < 0.01
        for joint in ("hip", "knee", "ankle"):
            assert moved(f"{side}_{joint}", f"{side}_foot") > 0.99
            assert moved(f"{other}_{joint}", f"{side}_foot") == 0
        assert moved(f"{side}_foot", f"{side}_foot") > 0.4
        assert moved("head", f"{side}_eye") > 0.99
    assert moved("tail", "tail_tip") > 0.99
    assert moved("lower_body", "tail_tip") > 0.99
    assert moved("upper_body", "tail_tip") == 0
    assert moved("neck_root", "bill_tip") == pytest.approx(1)
    # the jaw moves vertices of the bill only, and the lower of them
    vertices, jaw = (
        np.asarray(bird.vertices),
        np.asarray(bird.skin_weights)[:, JOINT_NAMES.index("jaw")] > 0.9,
    )
    upper = np.asarray(bird.skin_weights)[:, JOINT_NAMES.index("head")] > 0.9
    bill = vertices[:, 1] > 6.8
    assert vertices[jaw, 1].min() > 6
    assert vertices[jaw & bill, 2].mean() < vertices[upper & bill, 2].mean() - 0.1
    assert np.all((np.asarray(bird.skin_weights) > 0).sum(axis=1) <= 5)
