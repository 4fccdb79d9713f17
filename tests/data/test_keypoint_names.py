"""Names of keypoints: proposals by words, maps from a user, and observations with the names of a model."""

import numpy as np
import pytest
from support.coco_files import content, saved

from jaxfit.data.formats.coco import read_coco
from jaxfit.data.keypoint_names import checked_map, map_keypoints, opposite_keypoints, propose_names
from jaxfit.foundation.errors import InputError
from jaxfit.model.anatomy import AVIAN_MESH_KEYPOINTS, MURRE_KEYPOINTS

SPELLINGS = {
    "bill_tip": "bill-tip billTip BeakTip tipOfBill beak Bill bill_end",
    "bill_base": "beak_base baseOfBeak BillRoot",
    "crown": "head topOfHead head_top Crown",
    "nape": "neck hind_neck backOfHead Nape",
    "throat": "chin Throat",
    "breast": "chest Breast",
    "back": "mantle mid_back BACK",
    "tail_tip": "tail tailEnd TailTip tailtip",
    "tail_base": "tailbase rump tail_root BaseOfTail",
    "left_eye": "eyeL L_eye leftEye lefteye Left.Eye eye_left",
    "left_wingtip": "wingL left_wing leftwingtip LWingTip wing_tip_left",
    "right_wrist": "RWrist carpal_r right_carpal_joint rightWrist",
    "right_foot": "footR rightfoot right_toes",
    "left_shin": "left_tarsus ankleL lshin left_ankle_joint",
}
PAIRS = [(name, model) for model, names in SPELLINGS.items() for name in names.split()]


def test_spellings():
    found = {name: propose_names([name], MURRE_KEYPOINTS).mapped for name, _ in PAIRS}
    assert found == {name: {name: model} for name, model in PAIRS}


def test_unknown_names_are_not_mapped():
    others = ["snout", "leftear", "eye", "wing", "forelegL4", "belly", "left_leg", "ear_r", "x"]
    middles = ["tail_mid", "mid_wing_left", "tail_center", "wing_midpoint_left", "head_centre"]
    joints = ["wing_joint_left", "LWingJoint", "tail_joint", "bill_joint", "neck_joint"]
    names = propose_names([*others, *middles, *joints], MURRE_KEYPOINTS)
    assert not names.mapped
    assert names.missing == MURRE_KEYPOINTS


def test_the_best_name_wins():
    names = propose_names(["head", "crown", "bill", "beak_tip", "tail"], MURRE_KEYPOINTS)
    assert names.mapped == {"crown": "crown", "beak_tip": "bill_tip", "tail": "tail_tip"}
    assert names.unmapped == ("head", "bill")
    own = propose_names(MURRE_KEYPOINTS, MURRE_KEYPOINTS)
    assert own.mapped == {name: name for name in MURRE_KEYPOINTS}
    assert not own.changes_names
    assert propose_names(AVIAN_MESH_KEYPOINTS, AVIAN_MESH_KEYPOINTS).missing == ()


def test_observations_with_the_names_of_a_model(tmp_path):
    observed = read_coco(saved(tmp_path, content()))
    names = propose_names(observed.keypoint_names, MURRE_KEYPOINTS)
    mapped = map_keypoints(observed, names, MURRE_KEYPOINTS)
    assert names.mapped == {"bill": "bill_tip", "nape": "nape", "tail": "tail_tip"}
    places = [MURRE_KEYPOINTS.index(name) for name in names.mapped.values()]
    np.testing.assert_array_equal(mapped.keypoints_px[:, :, places], observed.keypoints_px)
    np.testing.assert_array_equal(mapped.occluded[:, :, places], observed.occluded)
    assert mapped.confidence.sum() == observed.confidence.sum()
    assert mapped.skeleton == ((places[0], places[1]), (places[1], places[2]))
    assert mapped.masks.keys() == observed.masks.keys()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"paw": "crown"}, "maps paw, which the file of keypoints lacks"),
        ({"a": "knee"}, "maps a to knee, which the model lacks"),
        ({"a": "crown", "b": "crown"}, "maps both a and b to crown"),
    ],
)
def test_unusable_maps(given, message):
    with pytest.raises(InputError, match=message):
        checked_map(given, ["a", "b"], MURRE_KEYPOINTS, "map.yaml")


def test_a_map_replaces_the_proposal():
    names = checked_map({"crown": "nape", "beak": None}, ["crown", "beak", "tail"], MURRE_KEYPOINTS, "map.yaml")
    assert names.mapped == {"crown": "nape"}
    assert names.unmapped == ("beak", "tail")


def test_opposite_keypoints():
    names = ("beak", "wingL", "R_wing", "left_eye", "tail")
    assert opposite_keypoints(names) == (0, 2, 1, -1, 4)
