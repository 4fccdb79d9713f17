"""Errors in space: an exact crop-camera oracle, every figure by loops in NumPy, and what must change nothing."""

import dataclasses
import functools
import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.birds import pose_window, skin_by_hand, solution_of, toy_bird

from jaxfit.evaluation.evaluate import metrics_of
from jaxfit.evaluation.spatial import COLUMNS_3D, SpatialErrors
from jaxfit.foundation.errors import InputError
from jaxfit.model.kinematics import Pose

OFFSET = np.float32([1, -2, 3])  # the root does not lie in the model's origin
TOY = toy_bird()
BIRD = dataclasses.replace(TOY, vertices=TOY.vertices + OFFSET, joints=TOY.joints + OFFSET)
N, T, J, K = 2, 6, BIRD.num_joints, BIRD.num_keypoints
FRAMES = [3, 4, 5, 6, 8, 9]
FOCAL, CENTRE = 1500.0, np.array([960.0, 540.0])
SCENE = 256 * FOCAL / 2167
WHOLE = [*(CENTRE - SCENE / 2), SCENE]
"""The square whose crop camera is the real camera."""


def build(poses, crop=WHOLE, **changes):
    """A solution of N poses, each of T frames."""
    numbered = {"track_id": np.array([5, 3]), "frame_index": np.array(FRAMES)}
    return solution_of(BIRD, poses, crop).with_arrays(**numbered | changes)


def random_poses(seed, scale=1.2):
    rng = np.random.default_rng(seed)

    def some(*shape, spread=0.3):
        return jnp.asarray(spread * rng.normal(size=shape), jnp.float32)

    return [
        Pose(
            some(T, 3) + jnp.array([1.0, -0.5, 0.7]),
            some(T, J - 1, 3),
            some(T, 3, spread=5.0) + jnp.array([90.0, -40.0, 160.0]),
            jnp.asarray(scale * rng.uniform(0.9, 1.1, T), jnp.float32),
            1 + some(J - 1, spread=0.1),
            some(2),
        )
        for _ in range(N)
    ]


@functools.cache
def true_poses():
    return random_poses(0)


def root_rest(pose):
    return np.asarray(pose.scale)[:, None] * np.asarray(BIRD.joints[0])


def in_crop_cameras(poses, factor=1.0):
    """The same birds as cameras see them that look straight at each: the oracle, with scipy's rotations."""
    turned, crops = [], []
    for pose in poses:
        root = root_rest(pose) + np.asarray(pose.transl, float)
        ray = root / np.linalg.norm(root, axis=1, keepdims=True)
        axis = np.cross([0, 0, 1], ray)
        angle = np.arccos(ray[:, 2])
        back = Rotation.from_rotvec(axis / np.linalg.norm(axis, axis=1, keepdims=True) * angle[:, None]).inv()
        changed = dataclasses.replace(
            pose,
            global_orient=jnp.asarray((back * Rotation.from_rotvec(pose.global_orient)).as_rotvec(), jnp.float32),
            scale=factor * pose.scale,
            transl=jnp.asarray(factor * (back.apply(root) - root_rest(pose)), jnp.float32),
        )
        # exact: every vertex is where turning the camera puts it
        np.testing.assert_allclose(
            pose_window(BIRD, changed)[1],
            factor * np.einsum("tij,tvj->tvi", back.as_matrix(), pose_window(BIRD, pose)[1]),
            atol=1e-3 * factor,
        )
        centre = FOCAL * root[:, :2] / root[:, 2:] + CENTRE
        size = SCENE / ray[:, 2]  # as many pixels a model unit as the tilted picture shows
        turned.append(changed)
        crops.append(np.column_stack([centre - size[:, None] / 2, size]))
    return build(turned, np.array(crops))


def errors(solution, truth=None, **models):
    return SpatialErrors(solution, models.get("bird", BIRD), truth or build(true_poses()), models.get("truth", BIRD))


def row_of(errors, where=None):
    return metrics_of(errors.errors(), where)


@pytest.mark.parametrize("factor", [1.0, 0.4, 7.0])
def test_a_crop_camera_is_undone(factor):
    """Far off the axis, at any size and distance: no error at all."""
    found = errors(in_crop_cameras(true_poses(), factor))
    assert found.points == "joints"
    row = row_of(found)
    assert tuple(row) == COLUMNS_3D
    for name, bound in zip(COLUMNS_3D, (1e-3, 1e-4, 1e-3, 1e-4, 0.01, 0.01, 2e-3, 1e-4, 1e-4, 1e-6), strict=False):
        assert abs(row[name]) < bound, name
    assert 0.05 < row["bone_error_mean_bird"] < 0.15  # 10 % of each length


def joints_by_hand(pose):
    def one(t):
        now = {f: getattr(pose, f)[t] for f in ("global_orient", "body_pose", "transl", "scale")}
        return skin_by_hand(BIRD, dataclasses.replace(pose, **now))[1]

    return np.array([one(t) for t in range(T)])


def aligned_distance(p, q):
    """Mean distance after the best similarity, by scipy's alignment."""
    p, q = p - p.mean(0), q - q.mean(0)
    turned = Rotation.align_vectors(q, p)[0].apply(p)
    return np.linalg.norm((turned * q).sum() / (p * p).sum() * turned - q, axis=1).mean()


def oracle(predicted, truth, valid):
    """Every figure by its definition, bird by bird and frame by frame; both in the real camera already."""
    bill, tail = (BIRD.keypoint_names.index(name) for name in ("bill_tip", "tail_tip"))
    rest = np.linalg.norm(np.asarray(BIRD.keypoints[bill] - BIRD.keypoints[tail]))
    figures = {name: [] for name in COLUMNS_3D}
    for a, b, ok in zip(predicted, truth, valid, strict=True):
        p, q = joints_by_hand(a), joints_by_hand(b)
        p_root, q_root = p - p[:, :1], q - q[:, :1]
        p_root = p_root * (p_root[ok] * q_root[ok]).sum() / (p_root[ok] ** 2).sum()
        for t in np.flatnonzero(ok):
            length = rest * float(b.scale[t])
            distance = np.linalg.norm(p_root[t] - q_root[t], axis=1)
            figures["mpjpe"] += list(distance)
            figures["mpjpe/length"] += list(distance / length)
            figures["pa_mpjpe"].append(aligned_distance(p[t], q[t]))
            figures["pa_mpjpe/length"].append(aligned_distance(p[t], q[t]) / length)
            turn = Rotation.from_rotvec(a.global_orient[t]).inv() * Rotation.from_rotvec(b.global_orient[t])
            figures["orientation_deg"].append(np.rad2deg(turn.magnitude()))
            ratio = float(a.scale[t]) / p[t, 0, 2] / (float(b.scale[t]) / q[t, 0, 2])
            figures["size_error"].append(abs(ratio - 1))
            figures["size_bias"].append(ratio - 1)
            rest_bones = [math.dist(BIRD.joints[j], BIRD.joints[BIRD.parents[j]]) for j in range(1, J)]
            true = np.multiply(rest_bones, b.bone_length)
            for name, length in (("bone_error", a.bone_length), ("bone_error_mean_bird", BIRD.bone_mean)):
                own = np.multiply(rest_bones, length)
                factor = np.linalg.lstsq(own[:, None], true, rcond=None)[0]
                figures[name] += list(np.abs(factor * own - true) / true)
            if ok[t - 1 : t + 2].sum() == 3 and t and FRAMES[t - 1 : t + 2] == [FRAMES[t] + i for i in (-1, 0, 1)]:
                twice = [x[t - 1] - 2 * x[t] + x[t + 1] for x in (p_root, q_root)]
                figures["acceleration"] += list(np.linalg.norm(twice[0] - twice[1], axis=1))
    figures["orientation_median_deg"] = [np.median(figures["orientation_deg"])]
    return {name: np.mean(values) for name, values in figures.items()}


def test_every_figure_by_hand():
    """Another bird altogether, with holes; what stands in the holes is NaN."""
    valid = np.ones((N, T), bool)
    valid[0, 1] = valid[1, 5] = False
    predicted = random_poses(1, scale=0.8)
    solution = build(predicted, valid=valid)
    holes = {name: np.array(solution.arrays()[name]) for name in ("transl", "scale", "keypoints_cam", "crop")}
    for array in holes.values():
        array[~valid] = np.nan
    found = errors(solution.with_arrays(**holes))
    expected = oracle(predicted, true_poses(), valid)
    assert row_of(found) == pytest.approx(expected, rel=2e-4)
    alone = oracle(predicted[1:], true_poses()[1:], valid[1:])
    assert row_of(found, np.array([[False], [True]]) & found.measured) == pytest.approx(alone, rel=2e-4)
    np.testing.assert_array_equal(found.measured, valid)


def test_tracks_and_frames_are_matched_by_name():
    """The truth has more of both, in another order, and knows nothing of one frame."""
    some = build(true_poses())
    valid = np.array([[True] * T, [True, False, *[True] * (T - 2)]])
    other = some.with_arrays(
        valid=valid,
        **{
            name: np.array(some.arrays()[name])[::-1]
            for name in ("track_id", "global_orient", "body_pose", "transl", "scale", "bone_length", "betas")
        },
    )
    solution = dataclasses.replace(in_crop_cameras(true_poses()), frame_index=np.array([1, 4, 5, 6, 8, 9]))
    found = errors(solution, other)
    expected = np.ones((N, T), bool)
    expected[:, 0] = expected[0, 1] = False  # track 5 stands second in the truth
    np.testing.assert_array_equal(found.measured, expected)
    assert row_of(found)["mpjpe"] < 1e-3
    for changes in ({"track_id": np.array([50, 30])}, {"frame_index": np.arange(20, 26)}):
        with pytest.raises(InputError, match="share no track and frame"):
            errors(solution.with_arrays(**changes), other)


def test_nothing_to_measure_is_nan():
    found = errors(build(true_poses(), valid=np.zeros((N, T), bool)))
    assert not found.measured.any()
    assert all(math.isnan(value) for value in row_of(found).values())
    two = np.zeros((N, T), bool)
    two[0, :2] = two[1, 3:5] = True  # frames 6 and 8 are no neighbours
    row = row_of(errors(build(true_poses(), valid=two)))
    assert math.isnan(row["acceleration"])
    assert row["mpjpe"] < 1e-3


def test_another_model_is_compared_by_keypoints():
    """Other joints: the keypoints about their mean; orientations of other rest poses mean nothing."""
    turned = tuple(f"bone {i}" for i in range(J))
    bird = dataclasses.replace(BIRD, joint_names=turned)
    predicted = random_poses(1)
    solution = build(predicted, joint_names=turned)
    found = errors(solution, bird=bird)
    assert found.points == "keypoints"
    row = row_of(found)
    assert math.isnan(row["orientation_deg"])
    assert math.isnan(row["bone_error"])
    p, q = (np.asarray(s.keypoints.cam, float) for s in (solution, build(true_poses())))
    p, q = p - p.mean(2, keepdims=True), q - q.mean(2, keepdims=True)
    scale = (p * q).sum((1, 2, 3)) / (p * p).sum((1, 2, 3))
    expected = np.linalg.norm(scale[:, None, None, None] * p - q, axis=-1).mean()
    assert row["mpjpe"] == pytest.approx(expected, rel=1e-4)
    # a model twice as large at rest, at half the scale: the same apparent size
    twice = dataclasses.replace(bird, vertices=2 * bird.vertices, joints=2 * bird.joints)
    half = solution.with_arrays(scale=solution.poses.scale / 2)
    assert row_of(errors(half, bird=twice))["size_error"] == pytest.approx(row["size_error"], rel=1e-4)


def test_joints_are_compared_by_name():
    """The same joints in another order."""
    order = [0, 4, 1, 2, 3, 5, 6, 7]
    names = tuple(BIRD.joint_names[j] for j in order)
    parents = tuple(-1 if BIRD.parents[j] < 0 else order.index(BIRD.parents[j]) for j in order)
    bird = dataclasses.replace(BIRD, joints=BIRD.joints[np.array(order)], joint_names=names, parents=parents)
    solution, bones = in_crop_cameras(true_poses()), np.array(order[1:]) - 1
    moved = {name: solution.arrays()[name][:, :, bones] for name in ("body_pose", "bone_length")}
    found = errors(solution.with_arrays(joint_names=names, **moved), bird=bird)
    assert found.points == "joints"
    assert row_of(found)["mpjpe"] < 1e-3
    assert row_of(found)["bone_error"] < 1e-6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"crop": in_crop_cameras(true_poses()).crops.square_px},
            "follow the birds, not in one camera .*a fit is no truth",
        ),
        ({"valid": np.zeros((N, T), bool)}, "are all invalid"),
        ({"keypoint_names": ("beak", *BIRD.keypoint_names[1:])}, "other keypoints"),
    ],
    ids=["crops", "empty", "keypoints"],
)
def test_a_truth_that_is_none(changes, message):
    with pytest.raises(InputError, match=rf"^scene: .*{message}"):
        SpatialErrors(build(true_poses()), BIRD, build(true_poses(), **changes), BIRD, "scene")
