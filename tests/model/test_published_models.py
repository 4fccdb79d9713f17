"""The published models give the numbers of their authors' code, and their names agree with their anatomy."""

import json

import numpy as np
import pytest
from support.birds import PUBLISHED_CASES, published_poses, skin_by_hand

from jaxfit.model.anatomy import AVES_KEYPOINTS, JOINT_NAMES
from jaxfit.model.published import import_model


@pytest.fixture(scope="module")
def birds(reference_dir):
    folder = reference_dir / "models"
    return {
        "avian_mesh": import_model("avian-mesh", [folder / "avian_mesh"]),
        "aves": import_model("aves", [folder / "aves"]),
    }


def test_tensors_agree_with_pytorch(birds):
    """The expected numbers are sums over each tensor of aves.pt, loaded by PyTorch 2, in double precision."""
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


@pytest.mark.parametrize(("model", "scale"), PUBLISHED_CASES)
def test_the_tests_oracle_agrees_with_the_authors_numbers(birds, reference_dir, model, scale):
    """`skin_by_hand`, against which the library is tested, gives the numbers of the authors' code."""
    bird = birds[model]
    for pose, expected_vertices, expected_keypoints in published_poses(reference_dir, model, scale):
        vertices = skin_by_hand(bird, pose)[0]
        # measured difference: 6e-6 for a bird 15 to 25 units long
        np.testing.assert_allclose(vertices, expected_vertices, atol=2e-5)
        np.testing.assert_allclose(np.asarray(bird.keypoint_weights) @ vertices, expected_keypoints, atol=2e-5)


def test_keypoint_names_agree_with_the_cub_annotations(reference_dir):
    content = json.loads((reference_dir / "cub" / "106.Horned_Puffin.json").read_text())
    assert tuple(content["categories"][0]["keypoints"]) == AVES_KEYPOINTS


@pytest.mark.parametrize("model", ["avian_mesh", "aves"])
def test_left_joints_and_keypoints_lie_on_the_left(birds, model):
    """The bird looks along +y with +z up, so its left is −x; the points of a pair are mirror images."""
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
    assert 200 < volume < 350  # positive: the face normals point outwards


@pytest.mark.parametrize("model", ["avian_mesh", "aves"])
def test_joints_move_the_keypoints_of_their_names(birds, model):
    bird = birds[model]
    influence = np.asarray(bird.keypoint_weights) @ np.asarray(bird.skin_weights)  # (K, J)
    for j in range(len(JOINT_NAMES) - 1, 0, -1):  # a joint also moves everything that its descendants move
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
    # the jaw moves only vertices of the lower bill
    vertices, jaw = (
        np.asarray(bird.vertices),
        np.asarray(bird.skin_weights)[:, JOINT_NAMES.index("jaw")] > 0.9,
    )
    upper = np.asarray(bird.skin_weights)[:, JOINT_NAMES.index("head")] > 0.9
    bill = vertices[:, 1] > 6.8
    assert vertices[jaw, 1].min() > 6
    assert vertices[jaw & bill, 2].mean() < vertices[upper & bill, 2].mean() - 0.1
    assert np.all((np.asarray(bird.skin_weights) > 0).sum(axis=1) <= 5)
