"""Offsets of keypoints: known offsets are found, mirrored, shrunk without data, and part of the fit and its result."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.birds import skin_by_hand
from support.fits import BIRD, CAMERA, config, truths

from jaxfit.config.fit import StageConfig, load_config
from jaxfit.data.observations import FROM_LABEL, FROM_OUTLINE
from jaxfit.fitting.fit import fit, learn_weights
from jaxfit.fitting.keypoint_offsets import PRIOR_SHARE, first_offsets, learn_offsets
from jaxfit.fitting.learn import without_offsets_of_outlines
from jaxfit.fitting.solve import fit_model
from jaxfit.foundation.errors import InputError
from jaxfit.model.camera import project
from jaxfit.model.kinematics import fold_bird, move_keypoints, window_keypoints, window_transforms
from jaxfit.objective.posed_window import Targets
from jaxfit.simulation.noise import detect

NAMES = BIRD.keypoint_names
SCALE = {"sd_sure_px": 1.0, "sd_unsure_px": 2.0, "dof": 30.0}
TRUE = {
    "nape": (0, 0.4, 0.5),
    "left_wingtip": (0.3, -0.2, 0.1),
    "right_wingtip": (-0.3, -0.2, 0.1),
    "tail_tip": (0, -0.6, 0),
}
PLACED = np.float32([TRUE.get(name, (0, 0, 0)) for name in NAMES])
FRAMES = 20
ONLY_KEYPOINTS = StageConfig("only", 12, ("keypoint_likelihood", "pose_prior"), solver="levenberg_marquardt")
PLAIN = dataclasses.replace(
    config(1),
    common_size=False,
    initialise=load_config("aves").initialise,
    stages=(ONLY_KEYPOINTS,),
    terms={"keypoint_likelihood": SCALE | {"weight": 1}, "pose_prior": 0.5},
)


def turned(pose, seed=0):
    """Return a window of birds seen from all sides."""
    turns = Rotation.random(pose.transl.shape[0], rng=np.random.default_rng(seed)).as_rotvec()
    return dataclasses.replace(pose, global_orient=np.float32(turns))


POSE = turned(truths(FRAMES, 1)[0])


@jax.jit
def _keypoints_px(rig, pose):
    return project(window_keypoints(rig, window_transforms(rig, pose), pose), CAMERA)


def keypoints_px(rig, pose):
    return np.asarray(_keypoints_px(rig, pose))


def targets(points_px, confidence=1.0):
    """Return the observations of one window."""
    return Targets(
        keypoints_px=points_px[None],
        confidence=np.full((1, FRAMES, len(NAMES)), confidence),
        mask=np.zeros((1, FRAMES, 0, 0), np.uint8),
        has_mask=np.zeros((1, FRAMES), bool),
        present=np.ones((1, FRAMES), bool),
        corner_px=np.zeros((1, FRAMES, 2)),
        frame_s=np.full(1, 0.04),
    )


def one_window(pose):
    return jax.device_put(jax.tree.map(lambda values: np.asarray(values)[None], pose))


def used(config):
    return BIRD, fit_model(BIRD, config).rig, CAMERA


def learnt(points_px, confidence=1.0):
    return learn_offsets(
        *used(PLAIN),
        first_offsets(BIRD, {}),
        one_window(POSE),
        targets(points_px, confidence),
        SCALE,
    )


def test_a_moved_keypoint_moves_like_a_vertex_beside_the_old_one():
    offset, k = np.float32([0.5, -0.3, 0.7]), NAMES.index("nape")
    vertex = int(np.argmax(np.asarray(BIRD.keypoint_weights)[k]))
    vertices, weights = np.asarray(BIRD.vertices), np.asarray(BIRD.skin_weights)
    places = np.concatenate([vertices, vertices[[vertex]] + offset])
    skin = np.concatenate([weights, weights[[vertex]]])
    basis = np.zeros((0, len(places), 3), np.float32)
    larger = dataclasses.replace(BIRD, vertices=places, skin_weights=skin, shape_basis=basis)
    frame = jax.tree.map(lambda x: x[0], eqx.filter(POSE, lambda x: len(x) == FRAMES))
    frame = dataclasses.replace(frame, scale=POSE.scale[:1][0], bone_length=POSE.bone_length, betas=POSE.betas)
    by_hand = skin_by_hand(larger, frame)[0][-1]
    keypoints_cam = jax.jit(lambda rig: window_keypoints(rig, window_transforms(rig, POSE), POSE))
    rig, others = fold_bird(BIRD), np.arange(len(NAMES)) != k
    points, unchanged = (
        np.asarray(keypoints_cam(each)) for each in (move_keypoints(rig, np.float32(~others)[:, None] * offset), rig)
    )
    np.testing.assert_allclose(points[0, k], by_hand, atol=2e-3)
    np.testing.assert_array_equal(points[:, others], unchanged[:, others])


def test_known_offsets_are_found():
    exact = keypoints_px(move_keypoints(fold_bird(BIRD), PLACED), POSE)
    noise = np.random.default_rng(0).normal(size=exact.shape) * 0.3
    found = learnt(exact + noise)
    np.testing.assert_allclose(found.offsets, PLACED, atol=0.12)
    mirrored = found.offsets[NAMES.index("right_wingtip")] * [-1, 1, 1]
    np.testing.assert_array_equal(found.offsets[NAMES.index("left_wingtip")], mirrored)
    assert found.offsets[NAMES.index("nape"), 0] == 0  # a keypoint in the middle stays in the middle
    assert found.prior_sd < first_offsets(BIRD, {}).prior_sd  # most true offsets are 0


def test_offsets_are_0_without_data_and_smaller_with_little_data():
    exact = keypoints_px(move_keypoints(fold_bird(BIRD), PLACED), POSE)
    nothing = learnt(exact, confidence=0.0)
    assert (nothing.offsets == 0).all()
    assert nothing.prior_sd == pytest.approx(first_offsets(BIRD, {}).prior_sd)
    rest = np.asarray(BIRD.keypoints)
    longest = max(np.linalg.norm(a - b) for a in rest for b in rest)
    assert nothing.prior_sd == pytest.approx(PRIOR_SHARE * longest, rel=1e-5)
    unsure = learn_offsets(
        *used(PLAIN),
        first_offsets(BIRD, {}),
        one_window(POSE),
        targets(exact),
        SCALE | {"sd_sure_px": 30.0},
    )
    assert np.linalg.norm(unsure.offsets) < 0.5 * np.linalg.norm(learnt(exact).offsets)


def observed():
    """Return single pictures whose keypoints have the offsets, and a little noise."""
    exact = detect(BIRD, [POSE], camera=CAMERA)
    points = keypoints_px(move_keypoints(fold_bird(BIRD), PLACED), POSE)[None]
    points = points + np.random.default_rng(0).normal(size=points.shape) * 0.1
    return dataclasses.replace(exact.with_keypoints(np.float32(points), np.ones(points.shape[:3])), masks={})


def test_the_fit_and_its_result_have_the_keypoints_of_the_config():
    observations = observed()
    given = dataclasses.replace(PLAIN, keypoint_offsets={name: tuple(map(float, o)) for name, o in TRUE.items()})

    def error_px(own):
        solution = fit(observations, BIRD, own)
        return float(np.linalg.norm(solution.keypoints.px - observations.keypoints_px, axis=-1).mean())

    assert error_px(given) < 0.6 * error_px(PLAIN)


def test_offsets_are_not_learnt_from_outlines():
    """The network `outline` gives the points of the model; one label may be another point."""
    seen, learning = observed(), dataclasses.replace(PLAIN, learn_weights=("keypoint_offsets", "keypoint_likelihood"))
    origin = np.where(seen.present, FROM_OUTLINE, 0)
    outlines = dataclasses.replace(seen, keypoint_origin=origin)
    alone = dataclasses.replace(learning, learn_weights=("keypoint_offsets",))
    learnt = learn_weights(outlines, BIRD, alone)
    assert (learnt.values, learnt.config) == ({}, dataclasses.replace(PLAIN, learn_weights=()))
    assert "# no keypoint_offsets are learnt: outlines gave all keypoints" in learnt.to_yaml()
    assert without_offsets_of_outlines(learning, outlines)[0].learn_weights == ("keypoint_likelihood",)
    origin[tuple(np.argwhere(seen.present)[0])] = FROM_LABEL
    assert without_offsets_of_outlines(learning, dataclasses.replace(seen, keypoint_origin=origin)) == (learning, ())
    assert without_offsets_of_outlines(learning, seen) == (learning, ())


@pytest.mark.extended
def test_learning_lowers_the_error_and_the_file_repeats_the_fit(tmp_path):
    observations = observed()
    learning = dataclasses.replace(PLAIN, learn_weights=("keypoint_offsets",), memory_gb=1.0)
    found = learn_weights(observations, BIRD, learning)
    assert set(found.values) == {f"keypoint_offsets.{name}" for name in NAMES}
    (tmp_path / "learnt.yaml").write_text(found.to_yaml())
    assert load_config(tmp_path / "learnt.yaml") == found.config

    def error_px(own):
        solution = fit(observations, BIRD, own)
        return float(np.linalg.norm(solution.keypoints.px - observations.keypoints_px, axis=-1).mean())

    assert error_px(found.config) < 0.7 * error_px(dataclasses.replace(learning, learn_weights=()))


@pytest.mark.parametrize(
    ("offsets", "words"),
    [
        ("{nape: [0, 1]}", "three"),
        ("{nape: [0, 1, .nan]}", "expected a finite number"),
        ("{nape: 3}", "expected a list"),
    ],
)
def test_wrong_offsets_are_an_error_of_the_config(tmp_path, offsets, words):
    (tmp_path / "mine.yaml").write_text(f"base: photo\nkeypoint_offsets: {offsets}\n")
    with pytest.raises(InputError, match=f"keypoint_offsets.*{words}"):
        load_config(tmp_path / "mine.yaml")


def test_an_offset_of_an_unknown_keypoint_is_an_error():
    with pytest.raises(InputError, match=r"model lacks: antenna"):
        fit(observed(), BIRD, dataclasses.replace(PLAIN, keypoint_offsets={"antenna": (0.0, 0.0, 1.0)}))


def test_learnt_offsets_do_not_change_once_they_are_found():
    exact = keypoints_px(move_keypoints(fold_bird(BIRD), PLACED), POSE)
    first = learnt(exact)
    given = dataclasses.replace(PLAIN, keypoint_offsets=first.by_name(BIRD))
    again = learn_offsets(
        *used(given),
        first_offsets(BIRD, given.keypoint_offsets),
        one_window(POSE),
        targets(exact),
        SCALE,
    )
    np.testing.assert_allclose(again.offsets, first.offsets, atol=0.02)
