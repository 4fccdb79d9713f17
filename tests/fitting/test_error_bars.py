"""Error bars against samples from the posterior, at the edges, and through a fit to a result folder."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.birds import pose_window
from support.fits import BIRD, CAMERA, config, truths
from support.stages import CONFIG, MODEL, POSTERIOR, B, T, case, problems, row

from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.solution import ERROR_BARS, load_solution, save_solution
from jaxfit.evaluation.calibration import calibration, plot_calibration
from jaxfit.evaluation.truth import Truth
from jaxfit.fitting import error_bars
from jaxfit.fitting.error_bars import ErrorBars, blend_error_bars, pack, unpack, window_error_bars
from jaxfit.fitting.fit import fit
from jaxfit.fitting.posterior import window_posteriors, with_shared
from jaxfit.fitting.solve import stage_program
from jaxfit.foundation.errors import InputError
from jaxfit.model.camera import project
from jaxfit.model.kinematics import window_keypoints, window_transforms
from jaxfit.objective.curvature import add_rows, frame_rows
from jaxfit.simulation.noise import detect

PROGRAM = with_shared(stage_program(CONFIG, POSTERIOR, MODEL), POSTERIOR)
SAMPLES = 4000


def scene(noise_px=0.0, weight=1.0, prior=None, **changes):
    """Return problems at some poses, whose keypoints have noise, with a weight of the keypoints and of other terms."""
    truth, targets = case()
    noise = np.random.default_rng(1).normal(size=targets.keypoints_px.shape) * noise_px
    points = np.stack([project(pose_window(MODEL.bird, row(truth, b))[0], MODEL.camera) for b in range(B)])
    targets = dataclasses.replace(targets, keypoints_px=np.float32(points + noise), **changes)
    prior = weight if prior is None else prior
    terms = {name: {"weight": weight if name == "keypoint_likelihood" else prior} for name in POSTERIOR.terms}
    own = dataclasses.replace(CONFIG, terms=terms)
    return problems(truth, targets, POSTERIOR, own), truth


@pytest.fixture(scope="module")
def laplace_only():
    """Leave out what `sandwich` adds to the Laplace approximation."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(error_bars, "constant_deviation", lambda *_: (np.zeros((1, 1, 1)), np.zeros((0, 1))))
        patch.setattr(error_bars, "time_factor", lambda *_: 1.0)
        yield


@pytest.fixture(scope="module")
def narrow(laplace_only):
    """Poses, the first posterior and its error bars. The posterior is narrow: the keypoints are linear in it."""
    several, pose = scene(weight=3000.0)
    bars, reasons = window_error_bars(PROGRAM, several, pose, common_size=True)
    assert reasons == ["", ""]
    return pose, window_posteriors(PROGRAM, several, pose)[0], bars[0]


def test_error_bars_are_those_of_samples_from_the_posterior(narrow):
    poses, posterior, bars = narrow
    pose = row(poses)
    columns, frame = np.concatenate([posterior.columns.own, posterior.columns.shared]), 2
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(
        np.zeros(len(columns)), posterior.covariance().of_frames()[frame], SAMPLES, method="eigh"
    )
    shape = frame_rows(pose, PROGRAM.shared).shape

    @jax.jit
    @jax.vmap
    def moved(draw):
        rows = jnp.zeros(shape).at[frame, columns].set(draw)
        # a change of a shared parameter is the mean over the rows
        shared = jnp.zeros(shape[1]).at[posterior.columns.shared].set(draw[len(posterior.columns.own) :])
        rows = jnp.where(shared != 0, shared, rows)
        new = add_rows(pose, rows, PROGRAM.shared)
        points = window_keypoints(MODEL.rig, window_transforms(MODEL.rig, new), new)
        return new, points[frame], project(points, MODEL.camera)[frame]

    new, cam, px = jax.tree.map(np.asarray, moved(np.float32(draws)))
    scale = new.scale[:, :1]
    expected = {
        "keypoints_px_cov": covariances(px),
        "keypoints_cam_cov": covariances(cam / scale[..., None]),
        "keypoints_centred_cov": covariances((cam - cam.mean(1, keepdims=True)) / scale[..., None]),
        "transl_sd": (new.transl[:, frame] / scale).std(0),
        "betas_sd": new.betas.std(0),
        "bone_length_sd": new.bone_length.std(0),
        "global_orient_sd": tangents(new.global_orient[:, frame], pose.global_orient[frame]).std(0),
        "body_pose_sd": np.stack(
            [
                tangents(new.body_pose[:, frame, j], pose.body_pose[frame, j]).std(0)
                for j in range(new.body_pose.shape[2])
            ]
        ),
    }
    for name, value in expected.items():
        found = getattr(bars, name)[frame]
        np.testing.assert_allclose(found, value, rtol=0.1, atol=0.06 * np.abs(value).max(), err_msg=name)
    assert (bars.scale_sd == 0).all()  # every bird has the size of the model


def covariances(points):
    return np.stack([np.cov(points[:, k], rowvar=False) for k in range(points.shape[1])])


def tangents(axis_angles, centre):
    """Return δ with R = R(centre)·exp(δ)."""
    return (Rotation.from_rotvec(centre).inv() * Rotation.from_rotvec(axis_angles)).as_rotvec()


def test_a_misfit_widens_the_error_bars(laplace_only):
    """Keypoints with 3 times the noise that the likelihood expects: a factor of about 9 on the covariance."""
    # strong priors: the keypoints do not pull the pose, so the poses of the scene stand for fitted poses
    calm, wild = (window_error_bars(PROGRAM, *scene(noise, prior=3e4), True)[0][0] for noise in (0.5, 3.6))
    assert (calm.misfit == 1).all()
    assert 4 < wild.misfit[0] < 20
    assert np.median(wild.keypoints_px_cov / calm.keypoints_px_cov) > 4


def test_missing_frames_and_birds_without_keypoints():
    present = np.ones((B, T), bool)
    present[0, 1] = False
    confidence = np.ones((B, T, MODEL.bird.num_keypoints), np.float32)
    confidence[1] = 0
    several, pose = scene(present=present, confidence=confidence * present[..., None])
    (first, second), reasons = window_error_bars(PROGRAM, several, pose, common_size=False)
    assert reasons == ["", ""]
    for name, values in first._asdict().items():
        finite = np.isfinite(values.reshape(T, -1))
        assert finite[present[0]].all(), name
        assert not finite[~present[0]].any(), name
    assert all(np.isfinite(values).all() for values in second)
    assert (second.misfit == 1).all()
    assert (second.transl_sd[..., 2] == 0).all()  # without a common size, the distance is fixed
    assert (second.scale_sd > 0).all()


def test_a_pose_that_is_not_finite_has_no_error_bars():
    several, pose = scene()
    transl = np.array(pose.transl)
    transl[0] = np.nan
    pose = jax.device_put(dataclasses.replace(pose, transl=transl))
    bars, reasons = window_error_bars(PROGRAM, several, pose, common_size=True)
    assert reasons[0]
    assert not reasons[1]
    assert all(np.isnan(values).all() for values in bars[0])


def test_packed_error_bars(narrow):
    _, _, bars = narrow
    again = unpack(pack(bars), bars.body_pose_sd.shape[1], bars.betas_sd.shape[1], bars.keypoints_px_cov.shape[1])
    for a, b in zip(bars, again, strict=True):
        np.testing.assert_array_equal(a, b)


def test_blended_error_bars():
    def bars(value):
        sizes = 4, 1, 1, 1
        own = unpack(np.full((4, pack(unpack(np.zeros((4, 99), np.float32), 1, 1, 1)).shape[1]), value), 1, 1, 1)
        assert len(own.scale_sd) == sizes[0]
        return own

    ends = np.array([0, 1])
    blended = blend_error_bars(bars(2.0), bars(4.0), ends + 2, ends, np.array([0.25, 0.75]), np.array([1.0, 2.0]))
    assert isinstance(blended, ErrorBars)
    np.testing.assert_allclose(blended.scale_sd, [np.sqrt(7), np.sqrt(13), 4, 4])
    np.testing.assert_allclose(blended.keypoints_cam_cov[:, 0, 0, 0], [2.5, 3.5, 4, 4])
    np.testing.assert_allclose(blended.keypoints_px_cov[:, 0, 0, 0], [2.5, 5.0, 4, 4])


TERMS = {"keypoint_likelihood": {"weight": 1, "sd_sure_px": 1.0}, "pose_prior": 0.5}


def fit_config():
    """One stage of a few steps: how good the fit is does not matter."""
    plain = config(error_bars=True, terms=TERMS)
    return dataclasses.replace(plain, stages=(dataclasses.replace(plain.stages[0], steps=3, terms=tuple(TERMS)),))


def test_a_fit_with_error_bars(tmp_path):
    poses = truths(birds=2)
    observations = detect(BIRD, poses, 0.25, masks=False, camera=CAMERA)
    solution = fit(observations, BIRD, fit_config())
    assert solution.error_bars is not None
    for name, values in solution.cells().items():
        if name in ERROR_BARS:
            assert np.isfinite(values[solution.valid]).all(), name
    save_solution(solution, BIRD, config_to_yaml(fit_config()), {}, tmp_path / "out")
    again, _ = load_solution(tmp_path / "out")
    for name, values in solution.cells().items():
        np.testing.assert_array_equal(again.cells()[name], values)
    clean = detect(BIRD, poses, masks=False, camera=CAMERA)
    result = calibration(solution, Truth(clean))
    assert list(result.groups) == ["keypoints, image"]
    group = result.groups["keypoints, image"]
    assert group.overall.count == clean.confidence.sum()
    assert set(group.parts) == set(BIRD.keypoint_names)
    pytest.importorskip("matplotlib")
    plot_calibration(result, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(InputError, match="no error bars"):
        calibration(dataclasses.replace(solution, error_bars=None), Truth(clean))
    with pytest.raises(ValueError, match="misfit is missing"):
        solution.with_arrays(misfit=None)
