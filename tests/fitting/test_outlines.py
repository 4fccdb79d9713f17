"""Orientations from outlines: masks of a bird at known orientations, drawn by another rasterizer."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.birds import filled_mask, toy_bird

from jaxfit.config.fit import InitialiseConfig, load_config
from jaxfit.data.masks import box_of_mask, encode_mask
from jaxfit.data.observations import Observations
from jaxfit.fitting.fit import fit
from jaxfit.fitting.initial_poses import candidate_orientations, search_initial_poses
from jaxfit.fitting.outlines import COMPARED_PX, UPRIGHT, drawn_bodies, match_outlines
from jaxfit.model.camera import CropCamera, project
from jaxfit.model.kinematics import fold_bird

BIRD, CAMERA = toy_bird(), CropCamera()
SEARCH = InitialiseConfig(method="so3", turns=24, directions=100, candidates=48, hypotheses=2)
T = 6


def seen_from_the_side(heading_deg, elevation_deg=20.0):
    """Return rotations model → camera of an upright bird, for headings in degrees."""
    upright = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # the bill away from the camera, the back up
    heading = Rotation.from_euler("z", np.reshape(heading_deg, (-1, 1)), degrees=True).as_matrix()
    return Rotation.from_euler("x", elevation_deg, degrees=True).as_matrix() @ upright @ heading


def masks_of(R, shift=(1.0, -2.0), depth=260.0):
    """Return the masks of the resting bird, (T, 256, 256)."""
    points = np.asarray(BIRD.vertices, np.float64) @ np.swapaxes(R, -1, -2) + [*shift, depth]
    return np.stack([filled_mask(np.asarray(project(p, CAMERA)), BIRD.faces, 256) for p in points]).astype(np.uint8)


@pytest.fixture(scope="module")
def bodies():
    return drawn_bodies(BIRD)


def angle_deg(Ra, Rb):
    return np.rad2deg(Rotation.from_matrix(np.swapaxes(Ra, -1, -2) @ Rb).magnitude())


def test_the_true_orientation_is_among_the_nearest(bodies):
    R, candidates = seen_from_the_side(np.arange(0, 360, 30)), candidate_orientations(SEARCH)
    masks = masks_of(R)
    match = match_outlines(masks, np.ones(len(R), bool), bodies, SEARCH)
    for own, distance_px in zip(R, match.distance_px, strict=True):
        nearest = candidates[np.argsort(distance_px)[:10]]
        assert angle_deg(own, nearest).min() < 30
    centre = [np.argwhere(mask).mean(0)[::-1] + 0.5 for mask in masks]
    np.testing.assert_allclose(match.middle_px, centre, atol=0.5)
    near = np.array([angle_deg(own, candidates).argmin() for own in R])
    scale = match.scale_px[np.arange(len(R)), near]
    np.testing.assert_allclose(scale, CAMERA.focal_px / 260, rtol=0.1)  # the candidate is up to 15° from the truth


def test_an_outline_does_not_tell_front_from_back(bodies):
    """The direction (x, −y, −z) differs from (x, y, z) by the cost of a view from below only."""
    search = dataclasses.replace(SEARCH, directions=400)
    candidates = candidate_orientations(search)
    R = seen_from_the_side(40.0)
    twin = np.diag([1.0, 1.0, -1.0]) @ R @ np.diag([-1.0, 1.0, 1.0])  # mirrored in depth, and the bird left to right
    match = match_outlines(masks_of(R), np.ones(1, bool), bodies, search)
    own, other = (match.distance_px[0, angle_deg(each, candidates).argsort()[:3]].min() for each in (R, twin))
    pixel = 4 / COMPARED_PX * np.sqrt(masks_of(R).sum())  # of the compared picture, in crop pixels
    assert own < other
    assert other - own < 1.5 * UPRIGHT * pixel


def test_frames_without_a_mask_are_not_matched(bodies):
    masks = masks_of(seen_from_the_side([0, 30, 60]))
    masks[1] = 0
    match = match_outlines(masks, np.array([True, True, False]), bodies, SEARCH)
    assert match.known.tolist() == [True, False, False]
    assert not match.distance_px[1:].any()


def test_initial_poses_of_a_turning_bird_without_keypoints(bodies):
    R = seen_from_the_side(60 + 8 * np.arange(T))
    masks = masks_of(R)
    match = jax.tree.map(lambda x: x[None], match_outlines(masks, np.ones(T, bool), bodies, SEARCH))
    nothing = np.zeros((1, T, BIRD.num_keypoints, 2), np.float32), np.zeros((1, T, BIRD.num_keypoints), np.float32)
    pose = search_initial_poses(BIRD, fold_bird(BIRD), *nothing, SEARCH, CAMERA, True, match)
    orient = Rotation.from_rotvec(np.asarray(pose.global_orient[0]).reshape(-1, 3)).as_matrix().reshape(2, T, 3, 3)
    assert angle_deg(orient, R).max(1).min() < 45  # one of the two hypotheses, in every frame
    root = BIRD.joints[0]
    for h in range(2):
        posed = (np.asarray(BIRD.vertices) - root) @ np.swapaxes(orient[h], -1, -2) + root
        vertices = posed + np.asarray(pose.transl[0, h])[:, None]
        for t in range(T):
            drawn = filled_mask(np.asarray(project(vertices[t], CAMERA)), BIRD.faces, 256)
            centre, wanted = (np.argwhere(mask).mean(0) for mask in (drawn, masks[t]))
            assert np.abs(centre - wanted).max() < 4
            assert 0.7 < drawn.sum() / masks[t].sum() < 1.4


def test_a_fit_needs_no_keypoint():
    R = seen_from_the_side(60 + 8 * np.arange(T))
    masks = masks_of(R)
    observations = Observations(
        track_id=np.array([1]),
        frame_index=np.arange(T),
        present=np.ones((1, T), bool),
        keypoints_px=np.zeros((1, T, BIRD.num_keypoints, 2)),
        confidence=np.zeros((1, T, BIRD.num_keypoints)),
        box_px=np.array([[box_of_mask(mask > 0) for mask in masks]], float),
        image_size_px=np.full((T, 2), 256),
        file_name=np.array([f"{t}.png" for t in range(T)]),
        keypoint_names=BIRD.keypoint_names,
        masks={(0, t): encode_mask(mask > 0) for t, mask in enumerate(masks)},
    )
    config = load_config("fast")
    stage = dataclasses.replace(config.stages[1], steps=8)
    crop = dataclasses.replace(config.crop, size_px=64)
    changes = {"stages": (stage,), "min_keypoints": 0, "window": T, "overlap": 0, "crop": crop, "initialise": SEARCH}
    solution = fit(observations, BIRD, dataclasses.replace(config, **changes))
    assert solution.valid.all()
    truth = np.asarray(project(np.asarray(BIRD.keypoints) @ np.swapaxes(R, -1, -2) + [1.0, -2.0, 260.0], CAMERA))
    error_px = np.linalg.norm(solution.keypoints.px[0] - truth, axis=-1)
    length_px = observations.box_px[..., 2:].max()
    assert np.median(error_px) < 0.15 * length_px
