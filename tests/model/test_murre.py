"""The built-in murre is a closed symmetric mesh with the measurements, postures and colours of a murre."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.birds import skin_by_hand

from jaxfit.model.anatomy import JOINT_NAMES, MURRE_KEYPOINTS, MURRE_SKELETON, other_side, skeleton_pairs
from jaxfit.model.files import MURRE_PATH, load_murre
from jaxfit.model.kinematics import Pose
from jaxfit.model.murre import POSTURES

BIRD = load_murre()
CM = 100 * BIRD.metres_per_unit
VERTICES, FACES = np.asarray(BIRD.vertices, np.float64), np.asarray(BIRD.faces)
WEIGHTS, COLOURS = np.asarray(BIRD.skin_weights, np.float64), np.asarray(BIRD.vertex_colours)
TO_KEYPOINTS = np.asarray(BIRD.keypoint_weights, np.float64)
FLIP = np.array([-1.0, 1.0, 1.0])
EDGES = np.unique(np.sort(FACES[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
KEYPOINTS = dict(zip(MURRE_KEYPOINTS, TO_KEYPOINTS @ VERTICES * CM, strict=True))
JOINTS = dict(zip(JOINT_NAMES, np.asarray(BIRD.joints) * CM, strict=True))
SWAP = [JOINT_NAMES.index(other_side(name)) for name in JOINT_NAMES]
MIRROR = np.linalg.norm(VERTICES[:, None] * FLIP - VERTICES[None], axis=-1).argmin(axis=1)
MEASUREMENTS_CM = {  # lowest and highest of adults, and the value of the model: docs/guide/models.md
    "total_length": (38.0, 46.0, 42.5),
    "wingspan": (61.0, 73.0, 67.3),
    "wing": (19.0, 21.6, 19.9),
    "bill": (4.2, 5.1, 4.7),
    "tarsus": (3.5, 4.1, 3.8),
    "tail": (4.0, 5.3, 4.8),
    "middle_toe": (4.4, 5.6, 5.0),
    "humerus": (7.4, 9.4, 7.5),
    "forearm": (5.8, 7.4, 6.7),
    "body_width": (10.0, 12.5, 11.4),
    "body_depth": (9.0, 11.5, 9.9),
    "neck_width": (4.0, 5.8, 5.2),
}


def posed_cm(body_pose, pitch_rad=0.0, betas=()):
    """Return the posed vertices in centimetres."""
    betas = np.zeros(BIRD.num_shapes) if len(betas) == 0 else betas
    orient = np.array([pitch_rad, 0, 0])
    return skin_by_hand(BIRD, Pose(orient, body_pose, np.zeros(3), np.ones(()), np.ones(24), betas))[0] * CM


POSED = {name: posed_cm(*posture) for name, posture in POSTURES.items()}


def vertices_of(*joints: str, least: float = 0.9) -> np.ndarray:
    """Whether the skinning weights of these joints together exceed `least`, for each vertex."""
    return WEIGHTS[:, [JOINT_NAMES.index(joint) for joint in joints]].sum(axis=1) > least


def mirrored(body_pose):
    return body_pose[..., [joint - 1 for joint in SWAP[1:]], :] * [1.0, -1.0, -1.0]


def test_the_mesh_is_one_closed_surface():
    mesh = trimesh.Trimesh(VERTICES, FACES, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert 1500 <= len(FACES) <= 3000
    assert mesh.area_faces.min() > 1e-7
    assert 1.0 <= mesh.volume * CM**3 / 1000 <= 2.0  # litres: a plumed bird of one kilogram; normals point outwards
    assert MURRE_PATH.stat().st_size <= 500_000


def test_the_model_is_symmetric():
    np.testing.assert_allclose(VERTICES[MIRROR] * FLIP, VERTICES, atol=1e-6)
    turned = {tuple(np.roll(face, -np.argmin(face))) for face in MIRROR[FACES][:, ::-1]}
    assert turned == {tuple(np.roll(face, -np.argmin(face))) for face in FACES}
    np.testing.assert_allclose(np.asarray(BIRD.joints)[SWAP] * FLIP, BIRD.joints, atol=1e-6)
    np.testing.assert_allclose(WEIGHTS[MIRROR][:, SWAP], WEIGHTS, atol=1e-6)
    np.testing.assert_allclose(np.asarray(BIRD.shape_basis)[:, MIRROR] * FLIP, BIRD.shape_basis, atol=1e-6)
    np.testing.assert_array_equal(COLOURS[MIRROR], COLOURS)
    keypoints = [MURRE_KEYPOINTS.index(other_side(name)) for name in MURRE_KEYPOINTS]
    np.testing.assert_allclose(TO_KEYPOINTS[keypoints][:, MIRROR], TO_KEYPOINTS, atol=1e-6)
    mean, limits = np.asarray(BIRD.pose_mean, np.float64).reshape(24, 3), np.asarray(BIRD.joint_limits)
    np.testing.assert_allclose(mirrored(mean), mean, atol=1e-6)
    np.testing.assert_allclose(
        np.sort([mirrored(limits[..., i]) for i in (0, 1)], axis=0)[0], limits[..., 0], atol=1e-6
    )
    covariance = np.asarray(BIRD.pose_covariance, np.float64)
    flip = np.array([mirrored(row.reshape(24, 3)).ravel() for row in np.eye(72)])
    np.testing.assert_allclose(flip @ covariance @ flip.T, covariance, atol=1e-6)
    assert np.linalg.eigvalsh(covariance)[0] > 1e-4


def test_at_most_four_joints_move_a_vertex():
    assert (WEIGHTS > 0).sum(axis=1).max() <= 4
    used = {name for name, most in zip(JOINT_NAMES, WEIGHTS.max(axis=0), strict=True) if most > 0}
    assert set(JOINT_NAMES) - used == {"root", "left_hip", "right_hip"}


def test_the_murre_has_the_measurements_of_its_species():
    spread = POSTURES["wings_up"].body_pose.copy()  # without the elevation of 19° at the roots and at the shoulders
    for side, sign in (("left", 1), ("right", -1)):
        root, shoulder = (JOINT_NAMES.index(f"{side}_{name}") - 1 for name in ("wing_root", "shoulder"))
        lowered = Rotation.from_euler("y", -sign * 19, degrees=True) * Rotation.from_rotvec(spread[shoulder])
        spread[root], spread[shoulder] = 0, lowered.as_rotvec()
    spine = [JOINTS[name] for name in ("tail", "upper_body", "neck_root", "neck", "head")]
    spine = [KEYPOINTS["tail_tip"], *spine, KEYPOINTS["bill_base"], KEYPOINTS["bill_tip"]]
    trunk = VERTICES[vertices_of("upper_body", "lower_body", "chest", least=0.99)] * CM

    def distance(a, b):
        return float(np.linalg.norm(a - b))

    measured = {
        "total_length": sum(distance(a, b) for a, b in pairwise(spine)),
        "wingspan": np.ptp(posed_cm(spread)[:, 0]),
        "wing": distance(JOINTS["left_wrist"], KEYPOINTS["left_wingtip"]),
        "bill": distance(KEYPOINTS["bill_base"], KEYPOINTS["bill_tip"]),
        "tarsus": distance(JOINTS["left_ankle"], JOINTS["left_foot"]),
        "tail": distance(KEYPOINTS["tail_base"], KEYPOINTS["tail_tip"]),
        "middle_toe": VERTICES[vertices_of("left_foot"), 1].max() * CM - JOINTS["left_foot"][1],
        "humerus": distance(JOINTS["left_shoulder"], JOINTS["left_elbow"]),
        "forearm": distance(JOINTS["left_elbow"], JOINTS["left_wrist"]),
        "body_width": np.ptp(trunk[:, 0]),
        "body_depth": np.ptp(trunk[np.abs(trunk[:, 1]) < 1.0, 2]),
        "neck_width": np.ptp(VERTICES[vertices_of("neck"), 0]) * CM,
    }
    assert measured.keys() == MEASUREMENTS_CM.keys()
    for name, value in measured.items():
        low, high, used = MEASUREMENTS_CM[name]
        assert low <= value <= high, name
        assert value == pytest.approx(used, rel=0.08), name
    assert 18 <= np.ptp(VERTICES[:, 1]) <= 23  # model units, as long as the published birds


def test_keypoints_lie_at_their_places():
    for name, point in KEYPOINTS.items():
        assert np.linalg.norm(VERTICES * CM - point, axis=1).min() < 1.0, name
        side = np.sign(point[0]) if abs(point[0]) > 1e-5 else 0
        assert side == (-1 if name.startswith("left_") else 1 if name.startswith("right_") else 0), name
    forwards = ["tail_tip", "tail_base", "back", "nape", "crown", "forehead", "bill_base", "bill_tip"]
    assert np.all(np.diff([KEYPOINTS[name][1] for name in forwards]) > 0)
    assert KEYPOINTS["throat"][2] < KEYPOINTS["left_eye"][2] < KEYPOINTS["crown"][2]
    assert KEYPOINTS["left_foot"][2] < KEYPOINTS["left_shin"][2] < KEYPOINTS["breast"][2] < KEYPOINTS["back"][2]
    assert {name for pair in MURRE_SKELETON for name in pair} == set(MURRE_KEYPOINTS)
    assert skeleton_pairs(["crown", "left_eye", "beak", "nape", "back"]) == ((0, 3), (3, 4), (1, 0))


def test_postures_lie_within_the_limits_and_near_the_prior():
    low, high = np.moveaxis(np.asarray(BIRD.joint_limits), -1, 0)
    covariance = np.asarray(BIRD.pose_covariance, np.float64)
    for body_pose, _ in POSTURES.values():
        assert np.all((low + 0.2 < body_pose) & (body_pose < high - 0.2))
        offset = body_pose.ravel() - np.asarray(BIRD.pose_mean, np.float64)
        assert np.sqrt(offset @ np.linalg.solve(covariance, offset)) < 7.5  # a drawn pose lies near √72 = 8.5


def test_on_the_ground_the_feet_lie_flat_and_are_the_lowest_part():
    legs = vertices_of("left_foot", "right_foot", "left_ankle", "right_ankle", least=0.4)
    for name in [n for n in POSTURES if not n.startswith("wings_") or n == "wings_half"]:
        height = POSED[name][:, 2] - POSED[name][:, 2].min()
        for side in ("left", "right"):
            soles = height[vertices_of(f"{side}_foot")]
            assert soles.min() < 0.12
            assert np.ptp(soles) < 0.7  # thickness of the toes
            assert height[vertices_of(f"{side}_ankle")].min() < 0.15  # murres rest on their tarsi
        assert height[~legs].min() > 0.05


def test_no_posture_overstretches_the_mesh():
    """The folded wing is a narrow fan, so its innermost edges lengthen many times; other edges stretch as skin does."""
    wings = [f"{side}_{name}" for side in ("left", "right") for name in ("shoulder", "elbow", "wrist")]
    body = ~vertices_of(*wings, least=0.01)[EDGES].any(axis=1)
    rest = np.linalg.norm(VERTICES[EDGES[:, 0]] - VERTICES[EDGES[:, 1]], axis=1) * CM
    for vertices in POSED.values():
        length = np.linalg.norm(vertices[EDGES[:, 0]] - vertices[EDGES[:, 1]], axis=1)
        assert length.max() < 6.5  # the longest edge at rest is about 4 cm
        assert (length / rest)[body].max() < 3.5
        assert 1400 < trimesh.Trimesh(vertices, FACES, process=False).volume < 2000


def test_left_and_right_postures_are_mirror_images():
    for name, (body_pose, _) in POSTURES.items():
        other = name.replace("left", "x").replace("right", "left").replace("x", "right")
        np.testing.assert_allclose(mirrored(body_pose), POSTURES[other].body_pose, atol=1e-12)


def test_postures_have_the_shape_of_their_names():
    posed = {name: dict(zip(MURRE_KEYPOINTS, TO_KEYPOINTS @ POSED[name], strict=True)) for name in POSTURES}
    bill = {name: points["bill_tip"] for name, points in posed.items()}
    height = {name: points["bill_tip"][2] - points["left_foot"][2] for name, points in posed.items()}
    assert height["alert"] > height["standing"] + 0.5 > height["incubating"] + 3
    assert bill["jab"][1] > bill["standing"][1]
    assert bill["preening_left"][0] < -1 < 1 < bill["preening_right"][0]
    assert bill["preening_left"][1] < posed["preening_left"]["breast"][1] - 5
    body = vertices_of("upper_body", "chest", "left_wing_root", "left_shoulder", "left_elbow", "left_wrist")
    distance = np.linalg.norm(POSED["preening_left"][body] - bill["preening_left"], axis=1)
    assert distance.min() < 2.5  # the bill reaches the feathers
    assert posed["walking_left"]["left_foot"][1] > posed["walking_left"]["right_foot"][1] + 3
    for name, sign in (("wings_up", 1), ("wings_down", -1)):
        tip, wrist = posed[name]["left_wingtip"], posed[name]["left_wrist"]
        assert sign * (tip[2] - wrist[2]) > 5
        assert abs(tip[0]) > 24


def test_each_shape_direction_changes_its_part():
    rest, *grown = (posed_cm(np.zeros((24, 3)), betas=betas) for betas in np.eye(6, 5, -1))
    girth, neck, bill, wing, tail = grown
    assert np.ptp(girth[:, 0]) > np.ptp(rest[:, 0]) + 0.3
    assert trimesh.Trimesh(neck, FACES).volume > trimesh.Trimesh(rest, FACES).volume
    assert 0.05 < bill[:, 1].max() - rest[:, 1].max() < 0.5
    hand = vertices_of("left_wrist", least=0.8)
    assert wing[hand, 1].min() < rest[hand, 1].min() - 0.1
    assert 0.05 < rest[:, 1].min() - tail[:, 1].min() < 0.6


def test_dark_and_white_plumage_lie_at_their_places():
    lightness = COLOURS.mean(axis=1)
    light = dict(zip(MURRE_KEYPOINTS, TO_KEYPOINTS @ lightness, strict=True))
    assert light["breast"] > 0.85
    for name in ("crown", "nape", "back", "throat", "bill_tip", "tail_base", "left_foot", "left_wingtip", "left_eye"):
        assert light[name] < 0.35, name
    belly = vertices_of("upper_body", "lower_body", least=0.99) & (VERTICES[:, 2] * CM < -1)
    assert lightness[belly].min() > 0.85
