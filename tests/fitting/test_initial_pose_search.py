"""Search for initial poses: it recovers known orientations, and chooses all frames of a window together."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.birds import exp_map, pose_window, tiny_bird

from jaxfit.config.fit import InitialiseConfig
from jaxfit.fitting.initial_poses import (
    MIN_SEPARATION_RAD,
    MIN_SPAN,
    candidate_orientations,
    choose_sequence,
    match_candidates,
    search_initial_poses,
)
from jaxfit.model.camera import CropCamera, project
from jaxfit.model.kinematics import fold_bird
from jaxfit.model.rotation import viewing_axis_rotations

BIRD, CAMERA = tiny_bird(), CropCamera()
FROM_ABOVE = np.diag([1.0, -1.0, -1.0])
ABOVE, AROUND = InitialiseConfig(), InitialiseConfig(method="so3", turns=16, directions=60, candidates=48)


def angle(Ra, Rb):
    return Rotation.from_matrix(np.swapaxes(Ra, -1, -2) @ Rb).magnitude()


def projected(R, scale=1.0, depth=200.0, shift=(1.0, -2.0)):
    """Return the keypoints of the resting bird after rotation by R (…, 3, 3), in pixels."""
    keypoints = np.asarray(BIRD.keypoints, np.float64)
    return np.array(project(scale * keypoints @ np.swapaxes(R, -1, -2) + [*shift, depth], CAMERA))


def search(keypoints_px, config, confidence=None, common_size=True, bird=BIRD):
    """Return the initial poses of one window, with leading axes H, T."""
    confidence = np.ones(keypoints_px.shape[:2]) if confidence is None else confidence
    one = np.float32(keypoints_px)[None], np.float32(confidence)[None]
    found = search_initial_poses(bird, fold_bird(bird), *one, config, CAMERA, common_size)
    return jax.tree.map(lambda x: np.asarray(x)[0], found)


def turns(rng, frames):
    """Return orientations of a bird, seen from above, that rotates by about 10° per frame."""
    heading = rng.uniform(-np.pi, np.pi) + np.cumsum(rng.normal(scale=0.17, size=frames))
    return exp_map(heading[:, None] * [0, 0, 1]) @ FROM_ABOVE


def test_keypoints_that_match_no_orientation_give_a_moderate_depth():
    """All keypoints in one point: the scale of every candidate is almost 0."""
    keypoints_px = np.full((3, BIRD.num_keypoints, 2), 100.0)
    pose = search(keypoints_px, ABOVE)
    span = np.ptp(np.asarray(BIRD.keypoints), axis=0).max()
    assert np.all(pose.transl[..., 2] < 1.1 * CAMERA.focal_px * span / (MIN_SPAN * CAMERA.size_px))


def test_the_papers_candidates():
    R = candidate_orientations(ABOVE)
    assert R.shape == (30, 3, 3)
    np.testing.assert_allclose(R, viewing_axis_rotations(30) @ FROM_ABOVE)
    np.testing.assert_allclose(
        R @ [0, 0, 1], np.broadcast_to([0, 0, -1], (30, 3)), atol=1e-12
    )  # the back points to the camera


def test_the_match_recovers_scale_and_shift():
    """The true candidate has cost 0 and the true scale. With an outlier, it still has the lowest cost and the scale."""
    candidates, matched = candidate_orientations(ABOVE), jax.jit(match_candidates)
    flat = np.asarray(BIRD.keypoints, np.float64) @ candidates[7, :2].T
    points = 9.5 * flat + [100, 140]
    confidence = np.linspace(0.5, 1, len(points))
    with_outlier = points.copy()
    with_outlier[3] += [90, -70]
    for detected in (points, with_outlier):
        match = matched(*map(np.float32, (candidates, BIRD.keypoints, detected, confidence)))
        assert int(np.argmin(match.cost)) == 7
        assert float(match.scale_px[7]) == pytest.approx(9.5, rel=0.01)
        assert (np.asarray(match.scale_px) > 0).all()
    clean = matched(*map(np.float32, (candidates, BIRD.keypoints, points, confidence)))
    assert float(clean.cost[7]) == pytest.approx(0, abs=1e-3)
    missing = matched(*map(np.float32, (candidates, BIRD.keypoints, points, 0 * confidence)))
    np.testing.assert_array_equal(missing.cost, 0)


def test_orientations_seen_from_above_are_recovered():
    planted = turns(np.random.default_rng(0), 6)
    pose = search(projected(planted), ABOVE)
    recovered = exp_map(pose.global_orient[0].astype(np.float64))
    assert angle(recovered, planted).max() < np.deg2rad(6.5)  # half a step of 12°


def test_orientations_seen_from_any_direction_are_recovered():
    rng = np.random.default_rng(1)
    resolution = 1.5 * np.sqrt(4 * np.pi / 60 / 2) + np.pi / 16  # as in the grid's own test
    planted = Rotation.random(6, rng=rng).as_matrix()
    for R in planted:
        turned = exp_map(np.cumsum(rng.normal(scale=0.05, size=(6, 3)), axis=0)) @ R
        pose = search(projected(turned), AROUND)
        recovered = exp_map(pose.global_orient[0].astype(np.float64))
        assert angle(recovered, turned).max() < resolution


@pytest.mark.parametrize("common_size", [True, False])
def test_the_initial_pose_matches_the_keypoints(common_size):
    sizes = np.array([0.9, 1.0, 1.2, 1.0, 1.0, 1.0])
    planted = np.broadcast_to(FROM_ABOVE, (6, 3, 3))
    points = np.stack([projected(R, s, 150.0) for R, s in zip(planted, sizes, strict=True)])
    pose = search(points, ABOVE, common_size=common_size)
    assert pose.scale.shape == ((1, 1) if common_size else (1, 6))
    assert pose.body_pose.shape == (1, 6, 3, 3)
    np.testing.assert_array_equal(pose.body_pose[0, 0], np.asarray(BIRD.pose_mean).reshape(3, 3))
    posed = project(pose_window(BIRD, jax.tree.map(lambda x: x[0], pose))[0], CAMERA)
    apart = np.linalg.norm(np.asarray(posed) - points, axis=-1)
    # the means agree; perspective and the common size leave errors of a few pixels on a bird of 200 pixels
    np.testing.assert_allclose(np.asarray(posed).mean(1), points.mean(1), atol=3)
    assert apart[3:].max() < 5
    np.testing.assert_allclose(pose.transl[0, :, 2], 150, rtol=0.03)
    if not common_size:
        np.testing.assert_allclose(pose.scale[0], sizes, rtol=0.03)


def test_the_bird_rotates_about_its_root():
    """The initial pose also matches the keypoints if the root of the model is far from the origin."""
    shift = np.float32([4.0, -7.0, 3.0])
    moved = {name: np.asarray(getattr(BIRD, name)) + shift for name in ("vertices", "joints")}
    points = projected(np.broadcast_to(FROM_ABOVE, (6, 3, 3)), depth=150.0)
    posed = []
    for bird in (BIRD, dataclasses.replace(BIRD, **jax.device_put(moved))):
        window = jax.tree.map(lambda x: x[0], search(points, ABOVE, bird=bird))
        posed.append(project(pose_window(bird, window)[0], CAMERA))
    np.testing.assert_allclose(posed[1], posed[0], atol=0.01)


def cost_of(path, cost, R, smoothness):
    turned = sum(angle(R[t, path[t]], R[t + 1, path[t + 1]]) for t in range(len(path) - 1))
    return sum(cost[t, m] for t, m in enumerate(path)) + smoothness * turned


choose = jax.jit(choose_sequence)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([(1, 3), (2, 3), (5, 3)]), st.sampled_from([0.0, 1.0, 100.0]))
def test_dynamic_programming_is_exact(seed, size, smoothness):
    rng = np.random.default_rng(seed)
    cost, R = 3 * rng.random(size), Rotation.random(size[0] * size[1], rng=rng).as_matrix().reshape(*size, 3, 3)
    path = np.asarray(choose(jnp.asarray(cost), jnp.asarray(R), smoothness))
    best = min(cost_of(p, cost, R, smoothness) for p in itertools.product(range(size[1]), repeat=size[0]))
    assert cost_of(path, cost, R, smoothness) == pytest.approx(best, rel=1e-4, abs=1e-4)


def flipping_window():
    """Return a bird that rotates steadily. Two frames have few keypoints, from a bird that is rotated by 180°."""
    heading = np.linspace(0, 1.5, 6)
    planted = exp_map(heading[:, None] * [0, 0, 1]) @ FROM_ABOVE
    points, confidence = projected(planted), np.ones((6, BIRD.num_keypoints))
    for t in (2, 4):
        few = [BIRD.keypoint_names.index(name) for name in ("breast", "nape", "left_foot", "right_foot")]
        confidence[t] = 0
        confidence[t, few] = 0.1
        points[t] = projected(exp_map([0, 0, np.pi]) @ planted[t])
    return planted, points, confidence


def test_no_frame_is_flipped_against_its_neighbours():
    planted, points, confidence = flipping_window()
    alone = [search(points[[t] * 6], ABOVE, confidence[[t] * 6]).global_orient[0, 0] for t in range(6)]
    apart = angle(exp_map(np.array(alone, np.float64)), planted)
    assert (apart[[2, 4]] > np.deg2rad(150)).all(), "frames that are chosen independently are flipped"
    assert (apart[[0, 1, 3, 5]] < np.deg2rad(7)).all()
    together = search(points, ABOVE, confidence).global_orient[0]
    # the worst case is the orientation of the previous frame: 17° per frame, and 6° from the grid
    assert angle(exp_map(together.astype(np.float64)), planted).max() < np.deg2rad(24)
    assert np.linalg.norm(np.diff(together, axis=0), axis=1).max() < 1, "the axis-angles must be continuous"


def test_frames_without_keypoints_follow_their_neighbours():
    planted = turns(np.random.default_rng(3), 6)
    points, confidence = projected(planted), np.ones((6, BIRD.num_keypoints))
    confidence[[0, 3, 4]] = 0
    points[[0, 3, 4]] = 0
    pose = search(points, ABOVE, confidence)
    recovered = exp_map(pose.global_orient[0].astype(np.float64))
    detected = [1, 2, 5]
    assert angle(recovered[detected], planted[detected]).max() < np.deg2rad(6.5)
    assert angle(recovered[0], recovered[1]) < 1e-3
    # between two frames with keypoints, only rotation has a cost, so the sequence takes the shortest way
    way = angle(recovered[2], recovered[3]) + angle(recovered[3], recovered[4]) + angle(recovered[4], recovered[5])
    assert way < angle(recovered[2], recovered[5]) + np.deg2rad(1)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(pose))


@pytest.mark.parametrize("method", ["viewing_axis", "so3"])
def test_hypotheses_differ(method):
    base = ABOVE if method == "viewing_axis" else AROUND
    config = InitialiseConfig(**{**vars(base), "hypotheses": 3})
    planted = turns(np.random.default_rng(4), 6)
    pose = search(projected(planted), config)
    assert pose.global_orient.shape == (3, 6, 3)
    R = exp_map(pose.global_orient.reshape(-1, 3).astype(np.float64)).reshape(3, 6, 3, 3)
    for a, b in itertools.combinations(range(3), 2):
        assert angle(R[a], R[b]).min() > MIN_SEPARATION_RAD - 1e-3
    best = search(projected(planted), base)
    np.testing.assert_allclose(pose.global_orient[0], best.global_orient[0], atol=1e-5)


def test_windows_are_independent():
    rng = np.random.default_rng(5)
    points = np.stack([projected(turns(rng, 6)) for _ in range(3)]).astype(np.float32)
    ones = np.ones(points.shape[:3], np.float32)
    together = search_initial_poses(BIRD, fold_bird(BIRD), points, ones, ABOVE, CAMERA, True)
    for w in range(3):
        alone = search(points[w], ABOVE)
        np.testing.assert_allclose(np.asarray(together.global_orient)[w], alone.global_orient, atol=1e-5)
        np.testing.assert_allclose(np.asarray(together.transl)[w], alone.transl, rtol=1e-4, atol=1e-4)
