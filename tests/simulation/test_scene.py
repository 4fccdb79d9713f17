"""Simulated scenes: agreement of truth and footage, and plausible behaviour."""

import filecmp
import json

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfit import load_murre
from jaxfit.data.formats.coco import read_coco
from jaxfit.data.projection import PosedBirds
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.evaluation.truth import Truth, read_truth
from jaxfit.foundation.errors import InputError
from jaxfit.raster.zbuffer import hard_mask
from jaxfit.simulation.behaviour import BEHAVIOURS
from jaxfit.simulation.flock import simulate_flock
from jaxfit.simulation.footage import Footage, random_light
from jaxfit.simulation.scene import LEDGE_DEPTH, mesh_keypoints, simulate, stage_scene
from jaxfit.simulation.viewpoint import random_viewpoint
from jaxfit.video.reader import read_frames

MURRE = load_murre()
SIZE, FRAMES = (480, 280), 8


@pytest.fixture(scope="module")
def scene():
    return stage_scene(MURRE, birds=4, frames=FRAMES, size=SIZE, fps=5, seed=3)


@pytest.fixture(scope="module")
def flock():
    """Seven birds for four seconds, without footage."""
    view = random_viewpoint(np.random.default_rng(0), *SIZE, LEDGE_DEPTH)
    return simulate_flock(MURRE, 7, 100, 25.0, LEDGE_DEPTH, view, 1), view


def test_projection_inverts_the_rays():
    view = random_viewpoint(np.random.default_rng(1), *SIZE, LEDGE_DEPTH)
    rays = view.rays()
    points = view.position_world + 130.0 * rays[[0, 100, 279], [5, 200, 479]]
    np.testing.assert_allclose(view.to_screen(points)[:, :2], [[5.5, 0.5], [200.5, 100.5], [479.5, 279.5]], atol=1e-2)
    np.testing.assert_allclose(view.R_cam_world @ view.R_cam_world.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view.R_cam_world) == pytest.approx(1)


def test_true_poses_agree_with_masks_and_keypoints(scene):
    posed = PosedBirds(scene.poses, MURRE)
    faces = np.asarray(posed.faces)
    for n, t in np.argwhere(scene.truth.present)[::5].tolist():
        screen = posed.vertices_screen(n, t)
        own, true = hard_mask(screen, faces, *SIZE), scene.truth.whole_mask(n, t)
        assert (own != true).sum() <= 0.01 * true.sum() + 2
        points = np.asarray(MURRE.keypoint_weights) @ np.asarray(screen)
        labelled = scene.truth.confidence[n, t] > 0
        # a keypoint is a mean of vertices, so its projection is nearly the mean of their projections
        np.testing.assert_allclose(points[labelled, :2], scene.truth.keypoints_px[n, t][labelled], atol=0.2)
    np.testing.assert_allclose(
        scene.poses.keypoints.px[scene.truth.confidence > 0], scene.truth.keypoints_px[scene.truth.confidence > 0]
    )


def test_metrics_of_the_truth_are_perfect(scene):
    overall = evaluate(scene.poses, MURRE, Truth(scene.truth, scene.poses)).overall
    assert overall["pck@0.05"] == 1
    assert overall["iou"] > 0.99
    assert overall["me_p"] == overall["me_v"] == 0
    assert overall["mpjpe"] < 1e-4
    assert overall["size_error"] < 1e-6


def test_visible_masks_partition_the_union_of_amodal_masks(scene):
    for t in range(scene.truth.num_frames):
        visible, amodal = np.zeros(SIZE[::-1], int), np.zeros(SIZE[::-1], bool)
        for n in np.flatnonzero(scene.truth.present[:, t]).tolist():
            own, own_amodal = scene.truth.mask(n, t), scene.truth.whole_mask(n, t)
            amodal |= own_amodal
            if own is not None:
                assert not (own & ~own_amodal).any()
                visible += own
        assert visible.max() <= 1
        np.testing.assert_array_equal(visible > 0, amodal)


def test_visible_keypoints_lie_on_the_bird_and_others_are_occluded(scene):
    truth = scene.truth
    assert 0.05 < truth.occluded[truth.confidence > 0].mean() < 0.7
    for n, t in np.argwhere(truth.present)[::7].tolist():
        visible = (truth.confidence[n, t] > 0) & ~truth.occluded[n, t]
        rows, columns = np.nonzero(truth.whole_mask(n, t))  # the tip of a bill is thinner than a pixel
        for x, y in truth.keypoints_px[n, t][visible]:
            assert np.min(np.hypot(columns + 0.5 - x, rows + 0.5 - y)) < 3.5


def test_birds_stand_on_the_ledge_before_they_fly(flock):
    actors, _ = flock
    fly_off = BEHAVIOURS.index("fly_off")
    for actor in actors:
        lowest = actor.vertices_world[..., 2].min(1)
        standing = actor.behaviour != fly_off
        np.testing.assert_allclose(lowest[standing], 0, atol=1e-4)
    flown = next(a for a in actors if fly_off in a.behaviour)
    assert flown.vertices_world[-1, :, 2].min() > 5
    assert flown.vertices_world[-1, :, 1].max() < -20


def test_seven_birds_show_all_behaviours_within_the_limits_of_their_joints(flock):
    assert {BEHAVIOURS[b] for actor in flock[0] for b in actor.behaviour} == set(BEHAVIOURS)
    low, high = np.moveaxis(np.asarray(MURRE.joint_limits), -1, 0)
    poses = np.stack([np.asarray(actor.pose.body_pose) for actor in flock[0]])
    assert ((poses >= low - 1e-5) & (poses <= high + 1e-5)).all()


def test_bodies_do_not_overlap(flock):
    """No vertex of a trunk lies near the centre of the trunk of another bird."""
    actors, _ = flock
    weights = np.asarray(MURRE.skin_weights)
    names = MURRE.joint_names
    trunk = weights[:, [names.index(j) for j in ("lower_body", "upper_body", "chest")]].sum(1) > 0.8
    for i, a in enumerate(actors):
        for b in actors[:i]:
            for t in range(0, 100, 5):
                mine, theirs = a.vertices_world[t][trunk], b.vertices_world[t][trunk]
                core, spread = theirs.mean(0), theirs.std(0).min()
                assert np.linalg.norm(mine - core, axis=1).min() > 0.8 * spread


def test_motion_is_smooth_and_continuous(flock):
    for actor in flock[0]:
        orient = np.asarray(actor.pose.global_orient, np.float64)
        turned = Rotation.from_rotvec(orient[1:]) * Rotation.from_rotvec(orient[:-1]).inv()
        assert turned.magnitude().max() < 0.45
        assert np.linalg.norm(np.diff(orient, axis=0), axis=-1).max() < 2  # unwrapped along the track
        pace = np.abs(np.diff(np.asarray(actor.pose.body_pose), axis=0)).max()
        assert pace < 1.7
        assert jnp.isfinite(actor.pose.transl).all()


def test_pictures_change_only_near_birds(scene):
    footage = Footage(MURRE, scene.birds, scene.view, LEDGE_DEPTH, random_light(np.random.default_rng(0)), 3)
    first, later = footage.frame(0).astype(int), footage.frame(FRAMES - 1).astype(int)
    assert first.shape == (*SIZE[::-1], 3)
    changed = np.abs(later - first).max(-1) > 40
    near = np.zeros(SIZE[::-1], bool)
    for n in range(4):
        for t in range(FRAMES):
            if (mask := scene.truth.whole_mask(n, t)) is not None:
                near |= mask
    assert changed.any()
    rows, columns = np.nonzero(changed)
    close = [near[max(r - 9, 0) : r + 10, max(c - 9, 0) : c + 10].any() for r, c in zip(rows, columns, strict=True)]
    assert np.mean(close) > 0.97  # shadows lie beside the birds


@pytest.mark.extended
def test_same_seed_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        simulate(MURRE, tmp_path / name, birds=2, frames=FRAMES, size=SIZE, seed=5)
    files = [p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file()]
    assert {str(f) for f in files} >= {"footage.mp4", "truth.json", "detections.json", "scene.json", "truth/poses.npz"}
    match, mismatch, errors = filecmp.cmpfiles(tmp_path / "a", tmp_path / "b", map(str, files), shallow=False)
    assert (mismatch, errors) == ([], [])
    assert len(match) == len(files)


def test_written_scene_is_read_back(tmp_path):
    scene = simulate(MURRE, tmp_path / "s", birds=2, frames=FRAMES, size=SIZE, seed=6)
    frames = list(read_frames(tmp_path / "s" / "footage.mp4"))
    assert len(frames) == FRAMES
    assert frames[0].picture.shape == (*SIZE[::-1], 3)
    truth = read_truth(tmp_path / "s")
    seen = truth.observations
    np.testing.assert_array_equal(seen.occluded, scene.truth.occluded)
    np.testing.assert_allclose(seen.keypoints_px, scene.truth.keypoints_px, atol=1e-3)
    np.testing.assert_array_equal(seen.whole_mask(0, 2), scene.truth.whole_mask(0, 2))
    np.testing.assert_array_equal(truth.solution.poses.body_pose, scene.poses.poses.body_pose)
    assert truth.bird.keypoint_names == MURRE.keypoint_names
    assert set(truth.behaviours) == {1, 2}
    detections = read_coco(tmp_path / "s" / "detections.json")
    np.testing.assert_array_equal(detections.present, scene.detections.present)
    description = json.loads((tmp_path / "s" / "scene.json").read_text())
    assert "simulated" in description["made_by"]
    assert description["arguments"]["seed"] == 6
    assert set(description["behaviour"]) == {"1", "2"}


@pytest.mark.parametrize(
    "wrong",
    [
        {"birds": 0},
        {"birds": 61},
        {"frames": 1},
        {"size": (2592, 0)},
        {"size": (641, 480)},
        {"size": (2000, 400)},
        {"frames": 20_000},
        {"size": (100_000, 1520)},
        {"seed": -1},
        {"fps": 0.0},
        {"fps": float("nan")},
        {"bone_sd": 0.5},
        {"keypoint_offset": -0.01},
    ],
)
def test_invalid_arguments_are_rejected(wrong, tmp_path):
    with pytest.raises(InputError, match=next(iter(wrong))):
        simulate(MURRE, tmp_path / "s", **({"frames": 2, "size": SIZE} | wrong))
    assert list(tmp_path.iterdir()) == []


def test_flock_with_wings(flock):
    """With `wings`, most birds spread their wings in the first two seconds; else few do."""
    actors, view = flock
    tips = [MURRE.keypoint_names.index(f"{side}_wingtip") for side in ("left", "right")]

    def share(birds):
        points = mesh_keypoints(MURRE, np.stack([bird.vertices_world[:50] for bird in birds], axis=1))
        span = np.linalg.norm(points[:, :, tips[0]] - points[:, :, tips[1]], axis=-1)
        return (span > 20).any(0).mean()

    assert share(actors) < 0.5 < share(simulate_flock(MURRE, 7, 100, 25.0, LEDGE_DEPTH, view, 3, wings=True))
