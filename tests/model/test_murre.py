"""The built-in murre is a closed symmetric mesh with the measurements, postures and colours of a murre."""

from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from support.birds import exp_map

from jaxfit.model.anatomy import JOINT_NAMES, MURRE_KEYPOINTS, MURRE_SKELETON, other_side, skeleton_pairs
from jaxfit.model.bird import ARRAY_FIELDS
from jaxfit.model.files import MURRE_PATH, load_murre
from jaxfit.model.kinematics import Pose, fold_bird, joint_transforms, posed_keypoints, posed_vertices
from jaxfit.model.murre.build import build_murre
from jaxfit.model.murre.postures import POSTURES, mirrored_pose
from jaxfit.model.murre.skeleton import CM_PER_UNIT, spread_rotations
from jaxfit.model.murre.skinning import MEASUREMENTS

BIRD = load_murre()
RIG = fold_bird(BIRD)
VERTICES, FACES = np.asarray(BIRD.vertices, np.float64), np.asarray(BIRD.faces)
WEIGHTS = np.asarray(BIRD.skin_weights, np.float64)
FLIP = np.array([-1.0, 1.0, 1.0])
EDGES = np.unique(np.sort(FACES[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
KEYPOINTS = dict(zip(MURRE_KEYPOINTS, np.asarray(BIRD.keypoints) * CM_PER_UNIT, strict=True))
JOINTS = dict(zip(JOINT_NAMES, np.asarray(BIRD.joints) * CM_PER_UNIT, strict=True))
SWAP = [JOINT_NAMES.index(other_side(name)) for name in JOINT_NAMES]


def mirror_vertices() -> np.ndarray:
    """Index of the mirror image of every vertex."""
    distance = np.linalg.norm(VERTICES[:, None] * FLIP - VERTICES[None], axis=-1)
    assert distance.min(axis=1).max() < 1e-6
    return distance.argmin(axis=1)


MIRROR = mirror_vertices()


def pose_of(body_pose, pitch_rad=0.0, betas=None) -> Pose:
    return Pose(
        global_orient=jnp.array([pitch_rad, 0, 0]),
        body_pose=jnp.asarray(body_pose, jnp.float32),
        transl=jnp.zeros(3),
        scale=jnp.ones(()),
        bone_length=jnp.ones(24),
        betas=jnp.zeros(BIRD.num_shapes) if betas is None else jnp.asarray(betas, jnp.float32),
    )


def posed_cm(body_pose, pitch_rad=0.0, betas=None):
    """Vertices and keypoints in centimetres."""
    pose = pose_of(body_pose, pitch_rad, betas)
    A = joint_transforms(RIG, pose)
    posed = posed_vertices(RIG, A, pose), posed_keypoints(RIG, A, pose)
    return tuple(np.asarray(points, np.float64) * CM_PER_UNIT for points in posed)


def vertices_of(*joints: str, least: float = 0.9) -> np.ndarray:
    """Whether the skinning weights of these joints together exceed `least`, for each vertex."""
    return WEIGHTS[:, [JOINT_NAMES.index(joint) for joint in joints]].sum(axis=1) > least


def distance(a, b) -> float:
    return float(np.linalg.norm(a - b))


def test_the_shipped_file_is_what_the_code_builds():
    built = build_murre()
    for field in ARRAY_FIELDS:
        np.testing.assert_allclose(getattr(BIRD, field), getattr(built, field), atol=1e-6, err_msg=field)
    assert BIRD.parents == built.parents
    assert BIRD.joint_names == JOINT_NAMES
    assert BIRD.keypoint_names == MURRE_KEYPOINTS
    assert BIRD.name == "murre"
    assert MURRE_PATH.stat().st_size <= 500_000


def test_the_mesh_is_one_closed_surface():
    mesh = trimesh.Trimesh(VERTICES, FACES, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert mesh.volume > 0  # the face normals point outwards
    assert 1500 <= len(FACES) <= 3000
    assert mesh.area_faces.min() > 1e-7
    assert 1.0 <= mesh.volume * CM_PER_UNIT**3 / 1000 <= 2.0  # litres: a plumed bird of one kilogram


def test_the_model_is_symmetric():
    np.testing.assert_array_equal(MIRROR[MIRROR], np.arange(len(MIRROR)))
    turned = {tuple(np.roll(face, -np.argmin(face))) for face in MIRROR[FACES][:, ::-1]}
    assert turned == {tuple(np.roll(face, -np.argmin(face))) for face in FACES}
    np.testing.assert_allclose(np.asarray(BIRD.joints)[SWAP] * FLIP, BIRD.joints, atol=1e-6)
    np.testing.assert_allclose(WEIGHTS[MIRROR][:, SWAP], WEIGHTS, atol=1e-6)
    np.testing.assert_allclose(np.asarray(BIRD.shape_basis)[:, MIRROR] * FLIP, BIRD.shape_basis, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(BIRD.vertex_colours)[MIRROR], BIRD.vertex_colours)
    keypoints = [MURRE_KEYPOINTS.index(other_side(name)) for name in MURRE_KEYPOINTS]
    np.testing.assert_allclose(
        np.asarray(BIRD.keypoint_weights)[keypoints][:, MIRROR], BIRD.keypoint_weights, atol=1e-6
    )


def test_at_most_four_joints_move_a_vertex():
    assert (WEIGHTS > 0).sum(axis=1).max() <= 4
    used = {name for name, most in zip(JOINT_NAMES, WEIGHTS.max(axis=0), strict=True) if most > 0}
    assert set(JOINT_NAMES) - used == {"root", "left_hip", "right_hip"}


def test_the_murre_has_the_measurements_of_its_species():
    spine = [JOINTS[name] for name in ("tail", "upper_body", "neck_root", "neck", "head")]
    spine = [KEYPOINTS["tail_tip"], *spine, KEYPOINTS["bill_base"], KEYPOINTS["bill_tip"]]
    spread, _ = posed_cm(spread_pose())
    trunk = VERTICES[vertices_of("upper_body", "lower_body", "chest", least=0.99)] * CM_PER_UNIT
    neck = VERTICES[vertices_of("neck", least=0.9)]
    measured = {
        "total_length": sum(distance(a, b) for a, b in pairwise(spine)),
        "wingspan": np.ptp(spread[:, 0]),
        "wing": distance(JOINTS["left_wrist"], KEYPOINTS["left_wingtip"]),
        "bill": distance(KEYPOINTS["bill_base"], KEYPOINTS["bill_tip"]),
        "tarsus": distance(JOINTS["left_ankle"], JOINTS["left_foot"]),
        "tail": distance(KEYPOINTS["tail_base"], KEYPOINTS["tail_tip"]),
        "middle_toe": VERTICES[vertices_of("left_foot"), 1].max() * CM_PER_UNIT - JOINTS["left_foot"][1],
        "humerus": distance(JOINTS["left_shoulder"], JOINTS["left_elbow"]),
        "forearm": distance(JOINTS["left_elbow"], JOINTS["left_wrist"]),
        "body_width": np.ptp(trunk[:, 0]),
        "body_depth": np.ptp(trunk[np.abs(trunk[:, 1]) < 1.0, 2]),
        "neck_width": np.ptp(neck[:, 0]) * CM_PER_UNIT,
    }
    assert measured.keys() == MEASUREMENTS.keys()
    for name, value in measured.items():
        low, high, used, _ = MEASUREMENTS[name]
        assert low <= value <= high, name
        assert value == pytest.approx(used, rel=0.08), name
    assert 18 <= np.ptp(VERTICES[:, 1]) <= 23  # model units, as long as the published birds


def spread_pose() -> np.ndarray:
    """Body pose with both wings spread horizontally."""
    pose = np.zeros((24, 3))
    for name, R in spread_rotations().items():
        angle = np.arccos((np.trace(R) - 1) / 2)
        axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (2 * np.sin(angle))
        np.testing.assert_allclose(exp_map(angle * axis), R, atol=1e-9)
        pose[JOINT_NAMES.index(name) - 1] = angle * axis
        pose[JOINT_NAMES.index(other_side(name)) - 1] = angle * axis * [1, -1, -1]
    return pose


def test_keypoints_lie_at_their_places():
    for name, point in KEYPOINTS.items():
        assert np.linalg.norm(VERTICES * CM_PER_UNIT - point, axis=1).min() < 1.0, name
        side = np.sign(point[0]) if abs(point[0]) > 1e-5 else 0
        assert side == (-1 if name.startswith("left_") else 1 if name.startswith("right_") else 0), name
    forwards = ["tail_tip", "tail_base", "back", "nape", "crown", "forehead", "bill_base", "bill_tip"]
    assert np.all(np.diff([KEYPOINTS[name][1] for name in forwards]) > 0)
    assert KEYPOINTS["throat"][2] < KEYPOINTS["left_eye"][2] < KEYPOINTS["crown"][2]
    assert KEYPOINTS["left_foot"][2] < KEYPOINTS["left_shin"][2] < KEYPOINTS["breast"][2] < KEYPOINTS["back"][2]
    assert distance(KEYPOINTS["left_wrist"], JOINTS["left_wrist"]) < 2.0
    np.testing.assert_allclose(np.asarray(BIRD.keypoint_weights).sum(axis=1), 1, atol=1e-6)
    assert {name for pair in MURRE_SKELETON for name in pair} == set(MURRE_KEYPOINTS)
    assert len(skeleton_pairs(MURRE_KEYPOINTS)) == len(MURRE_SKELETON)
    assert skeleton_pairs(["crown", "left_eye", "beak", "nape", "back"]) == ((0, 3), (3, 4), (1, 0))


def test_postures_lie_within_the_limits_and_near_the_prior():
    for name in POSTURES:
        body_pose = POSTURES[name].body_pose
        low, high = np.moveaxis(np.asarray(BIRD.joint_limits), -1, 0)
        assert np.all((low + 0.2 < body_pose) & (body_pose < high - 0.2))
        offset = body_pose.ravel() - np.asarray(BIRD.pose_mean, np.float64)
        mahalanobis = np.sqrt(offset @ np.linalg.solve(np.asarray(BIRD.pose_covariance, np.float64), offset))
        assert mahalanobis < 7.5  # a pose drawn from the prior lies near √72 = 8.5


def test_on_the_ground_the_feet_lie_flat_and_are_the_lowest_part():
    for name in [n for n in POSTURES if not n.startswith("wings_") or n == "wings_half"]:
        vertices, _ = posed_cm(*POSTURES[name])
        ground = vertices[:, 2].min()
        for side in ("left", "right"):
            soles = vertices[vertices_of(f"{side}_foot"), 2]
            assert soles.min() - ground < 0.12
            assert np.ptp(soles) < 0.7  # thickness of the toes
            assert vertices[vertices_of(f"{side}_ankle"), 2].min() - ground < 0.15  # murres rest on their tarsi
        assert (
            vertices[~vertices_of("left_foot", "right_foot", "left_ankle", "right_ankle", least=0.4), 2].min()
            > ground + 0.05
        )


def test_no_posture_overstretches_the_mesh():
    for name in POSTURES:
        vertices, _ = posed_cm(*POSTURES[name])
        length = np.linalg.norm(vertices[EDGES[:, 0]] - vertices[EDGES[:, 1]], axis=1)
        rest = np.linalg.norm(VERTICES[EDGES[:, 0]] - VERTICES[EDGES[:, 1]], axis=1) * CM_PER_UNIT
        assert length.max() < 6.5  # the longest edge at rest is about 4 cm
        # The folded wing is a narrow fan, so its innermost edges lengthen many times; other edges stretch as skin does.
        body = ~vertices_of("left_shoulder", "left_elbow", "left_wrist", least=0.01)
        body &= ~vertices_of("right_shoulder", "right_elbow", "right_wrist", least=0.01)
        assert (length / rest)[body[EDGES].all(axis=1)].max() < 3.5
        volume = trimesh.Trimesh(vertices, FACES, process=False).volume
        assert 1400 < volume < 2000
        if name.startswith("wings_"):
            # no wing is turned inside out: nearly the whole upper side points up in the frame of the wing
            assert inverted_share(vertices) < 0.02


def inverted_share(vertices) -> float:
    """Share of the area of the left wing whose face normals point to the other side of the wing."""
    wing = vertices_of("left_shoulder", "left_elbow", "left_wrist", least=0.5)
    faces = FACES[wing[FACES].all(axis=1)]
    joint = WEIGHTS[faces].mean(axis=1).argmax(axis=1)

    def normals(points):
        return np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])

    before, after = normals(VERTICES), normals(vertices)
    share = 0.0
    for j in np.unique(joint):
        which = joint == j
        # the best rotation of the faces of this joint: Kabsch on their normals
        u, _, vt = np.linalg.svd(after[which].T @ before[which])
        R = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
        flipped = np.einsum("fc,fc->f", before[which] @ R.T, after[which]) < 0
        share += np.linalg.norm(after[which][flipped], axis=1).sum()
    return share / np.linalg.norm(after, axis=1).sum()


def test_left_and_right_postures_are_mirror_images():
    for name in ("preening", "walking"):
        left, right = (posed_cm(*POSTURES[f"{name}_{side}"])[0] for side in ("left", "right"))
        np.testing.assert_allclose(left[MIRROR] * FLIP, right, atol=1e-4)
    symmetric = POSTURES.keys() - {f"{name}_{side}" for name in ("preening", "walking") for side in ("left", "right")}
    for name in symmetric:
        np.testing.assert_allclose(mirrored_pose(POSTURES[name].body_pose), POSTURES[name].body_pose, atol=1e-12)


def test_postures_have_the_shape_of_their_names():
    posed = {name: dict(zip(MURRE_KEYPOINTS, posed_cm(*posture)[1], strict=True)) for name, posture in POSTURES.items()}
    bill = {name: points["bill_tip"] for name, points in posed.items()}
    height = {name: points["bill_tip"][2] - points["left_foot"][2] for name, points in posed.items()}
    assert height["alert"] > height["standing"] + 0.5 > height["incubating"] + 3
    assert bill["jab"][1] > bill["standing"][1]
    assert bill["preening_left"][0] < -1 < 1 < bill["preening_right"][0]
    assert bill["preening_left"][1] < posed["preening_left"]["breast"][1] - 5
    body = vertices_of("upper_body", "chest", "left_wing_root", "left_shoulder", "left_elbow", "left_wrist")
    vertices, _ = posed_cm(*POSTURES["preening_left"])
    assert np.linalg.norm(vertices[body] - bill["preening_left"], axis=1).min() < 2.5  # the bill reaches the feathers
    assert posed["walking_left"]["left_foot"][1] > posed["walking_left"]["right_foot"][1] + 3
    for name, sign in (("wings_up", 1), ("wings_down", -1)):
        tip, wrist = posed[name]["left_wingtip"], posed[name]["left_wrist"]
        assert sign * (tip[2] - wrist[2]) > 5
        assert abs(tip[0]) > 24


def test_the_prior_is_positive_definite_and_symmetric():
    covariance = np.asarray(BIRD.pose_covariance, np.float64)
    assert np.linalg.eigvalsh(covariance)[0] > 1e-4
    mean = np.asarray(BIRD.pose_mean, np.float64).reshape(24, 3)
    np.testing.assert_allclose(mirrored_pose(mean), mean, atol=1e-6)
    mirrored = mirrored_pose(mirrored_pose(covariance.reshape(72, 24, 3)).reshape(72, 72).T.reshape(72, 24, 3))
    np.testing.assert_allclose(mirrored.reshape(72, 72).T, covariance, atol=1e-6)
    limits = np.asarray(BIRD.joint_limits)
    low, high = mirrored_pose(limits[..., 0]), mirrored_pose(limits[..., 1])
    np.testing.assert_allclose(np.minimum(low, high), limits[..., 0], atol=1e-6)
    np.testing.assert_allclose(np.maximum(low, high), limits[..., 1], atol=1e-6)
    assert np.linalg.eigvalsh(np.asarray(BIRD.bone_covariance, np.float64))[0] > 1e-5
    np.testing.assert_array_equal(BIRD.bone_mean, 1)


def test_each_shape_direction_changes_its_part():
    rest, _ = posed_cm(np.zeros((24, 3)))
    grown = {
        name: posed_cm(np.zeros((24, 3)), betas=np.eye(BIRD.num_shapes)[i])[0]
        for i, name in enumerate(("girth", "neck", "bill", "wing", "tail"))
    }
    assert np.ptp(grown["girth"][:, 0]) > np.ptp(rest[:, 0]) + 0.3
    assert 0.05 < grown["bill"][:, 1].max() - rest[:, 1].max() < 0.5
    assert 0.05 < rest[:, 1].min() - grown["tail"][:, 1].min() < 0.6
    hand = vertices_of("left_wrist", least=0.8)
    assert grown["wing"][hand, 1].min() < rest[hand, 1].min() - 0.1
    assert trimesh.Trimesh(grown["neck"], FACES).volume > trimesh.Trimesh(rest, FACES).volume


def test_dark_and_white_plumage_lie_at_their_places():
    colours = np.asarray(BIRD.vertex_colours)
    lightness = colours.mean(axis=1)
    keypoints = np.asarray(BIRD.keypoint_weights) @ lightness
    light = dict(zip(MURRE_KEYPOINTS, keypoints, strict=True))
    assert light["breast"] > 0.85
    for name in ("crown", "nape", "back", "throat", "bill_tip", "tail_base", "left_foot", "left_wingtip", "left_eye"):
        assert light[name] < 0.35, name
    belly = vertices_of("upper_body", "lower_body", least=0.99) & (VERTICES[:, 2] * CM_PER_UNIT < -1)
    assert lightness[belly].min() > 0.85
