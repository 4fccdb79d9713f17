"""Learnt weights: known noise, the statistics of outlines against drawn outlines, and input that teaches nothing."""

import dataclasses
import logging

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from support.fits import BIRD, CAMERA, SIZE, config, truths

from jaxfit.config.fit import StageConfig, load_config
from jaxfit.data.masks import decode_mask, encode_mask
from jaxfit.evaluation.ablation.grid import Run
from jaxfit.evaluation.ablation.runs import fit_batches
from jaxfit.fitting.evidence import Evidence, expanded, mask_evidence, outline_correlation_px, outline_error
from jaxfit.fitting.fit import fit, fit_runs, learn_weights
from jaxfit.fitting.learn import (
    MAX_FACTOR,
    MAX_FRAMES,
    MAX_WINDOWS,
    PRIOR_COUNT,
    SETTINGS,
    choose_windows,
    updated_precision,
)
from jaxfit.fitting.windows import Windows
from jaxfit.foundation.errors import InputError
from jaxfit.simulation.noise import detect

T, SD = 40, "terms.keypoint_likelihood.sd_sure_px"
TERMS = {
    "keypoint_likelihood": {"sd_sure_px": 3.0, "sd_unsure_px": 9.0, "dof": 30.0},
    "pose_prior": 0.5,
    "motion_likelihood": {"sd_rad_s2": 30.0},
    "place_likelihood": {"sd_px_s2": 300.0},
}
STAGE = StageConfig("only", 12, tuple(TERMS), step_scale={"transl": (1, 1, 0)}, solver="levenberg_marquardt")
LEARNING = dataclasses.replace(config(T), stages=(STAGE,), terms=TERMS, learn_weights=tuple(SETTINGS), memory_gb=1.0)


@pytest.fixture(scope="module")
def exact():
    return detect(BIRD, truths(T, 2), camera=CAMERA)


def noisy(exact, sd_px):
    """Return observations whose keypoints have Gaussian errors, in pixels of a 256-pixel crop."""
    noise = np.random.default_rng(0).normal(size=exact.keypoints_px.shape) * sd_px * SIZE / 256
    return exact.with_keypoints((exact.keypoints_px + noise).astype(np.float32), np.ones_like(exact.confidence))


@pytest.fixture(scope="module")
def learnt(exact):
    return learn_weights(noisy(exact, 3.0), BIRD, LEARNING)


@pytest.mark.extended
def test_the_learnt_scale_is_that_of_the_noise_and_follows_it(exact, learnt):
    scales = {factor: learn_weights(noisy(exact, 3.0 * factor), BIRD, LEARNING).values[SD] for factor in (0.5, 2, 4)}
    scales[1] = learnt.values[SD]
    # Student's t with 30 degrees of freedom is almost Gaussian
    for factor, scale in scales.items():
        assert scale == pytest.approx(3.0 * factor, rel=0.15), scales
        assert scale == pytest.approx(scales[1] * factor, rel=0.15), scales


@pytest.mark.extended
def test_the_learnt_config_is_complete_and_its_fit_learns_nothing(exact, learnt, caplog):
    observations = noisy(exact, 3.0)
    assert not learnt.config.learn_weights
    assert set(learnt.values) == {
        *("terms.keypoint_likelihood.sd_sure_px", "terms.keypoint_likelihood.sd_unsure_px"),
    }
    likelihood = learnt.config.terms["keypoint_likelihood"]
    assert likelihood["sd_unsure_px"] == pytest.approx(3 * likelihood["sd_sure_px"], rel=0.01)
    assert likelihood["dof"] == 30
    with caplog.at_level(logging.INFO):
        by_fit = fit(observations, BIRD, LEARNING)
    assert "learnt: terms.keypoint_likelihood" in caplog.text
    given = fit(observations, BIRD, learnt.config)
    np.testing.assert_array_equal(by_fit.poses.body_pose, given.poses.body_pose)


@pytest.mark.extended
def test_a_file_of_learnt_values_is_a_config(learnt, tmp_path):
    (tmp_path / "learnt.yaml").write_text(learnt.to_yaml())
    assert load_config(tmp_path / "learnt.yaml") == learnt.config
    assert f"# learnt from the data: {SD} = " in learnt.to_yaml()


@pytest.mark.parametrize("changes", [{"stages": (dataclasses.replace(STAGE, terms=("keypoints", "pose_prior")),)}, {}])
def test_without_data_the_values_of_the_config_stay(exact, caplog, changes):
    confidence = np.ones_like(exact.confidence)
    if not changes:  # two keypoints in each frame
        confidence[..., 2:] = 0
    observations = exact.with_keypoints(exact.keypoints_px, confidence)
    own = dataclasses.replace(LEARNING, min_keypoints=2, **changes)
    learnt = learn_weights(observations, BIRD, own)
    assert learnt.values == {}
    assert learnt.config == dataclasses.replace(own, learn_weights=())
    assert len(learnt.remarks) == 1
    assert caplog.text.count("no weights are learnt") == 1


def test_several_configs_do_not_learn(exact):
    with pytest.raises(InputError, match="learn_weights"):
        fit_runs(exact, BIRD, [LEARNING, LEARNING])
    with pytest.raises(InputError, match="learn_weights"):
        next(fit_batches(exact, BIRD, [Run("a", {}, LEARNING)]))


def test_the_fixed_point_is_the_posterior_mean_of_a_variance():
    """Errors of the variance v: the precision is that of n₀ prior errors of variance 1 and γ errors of variance v."""
    assert updated_precision(1.0, Evidence(90.0, 180.0)) == pytest.approx(100 / (180 + PRIOR_COUNT))
    # the same errors, from another current precision
    assert updated_precision(0.5, Evidence(90.0, 90.0)) == pytest.approx(100 / (180 + PRIOR_COUNT))
    precision = 1.0
    for _ in range(20):
        precision = updated_precision(precision, Evidence(1e6, 1e-6 * precision))
    assert precision == MAX_FACTOR
    assert updated_precision(1.0, Evidence(0.0, 0.0)) == pytest.approx(1.0)
    # the weight of the mask does not fall
    assert updated_precision(1.0, Evidence(90.0, 180.0), 1, 1.0) == 1
    assert updated_precision(1.0, Evidence(180.0, 90.0), 1, 1.0) == pytest.approx(190 / 100)


@pytest.mark.parametrize("scale", [0.5, 2.0, 4.0])
def test_three_rounds_find_the_scale_of_heavy_tailed_errors(scale):
    rng, dof, n = np.random.default_rng(0), 4.0, 3000
    squared = (rng.normal(size=(n, 2)) ** 2).sum(1) * scale**2 / (rng.chisquare(dof, n) / dof)

    def after_rounds(step):
        precision = 1.0
        for _ in range(3):
            energy = precision * (squared * (dof + 2) / (dof + precision * squared)).sum()
            precision = updated_precision(precision, step(Evidence(2.0 * n, energy)), 2)
        return precision**-0.5

    assert after_rounds(lambda evidence: expanded(evidence, dof)) == pytest.approx(scale, rel=0.05)
    if scale == 4:
        assert after_rounds(lambda evidence: evidence) < 0.8 * scale


def test_linear_gaussian_errors_and_parameters():
    """y = x + e with x ~ N(0, 4) and e ~ N(0, 0.25): the fixed points find both variances, as the sum y² cannot."""
    rng, n, per = np.random.default_rng(0), 400, 3
    x = rng.normal(size=n) * 2
    y = x[:, None] + rng.normal(size=(n, per)) * 0.5
    of_prior, of_errors = 1.0, 1.0
    for _ in range(60):
        H = of_prior + per * of_errors
        estimate = of_errors * y.sum(1) / H
        prior = Evidence(n - n * of_prior / H, of_prior * (estimate**2).sum())
        errors = Evidence(n * per - n * per * of_errors / H, of_errors * ((y - estimate[:, None]) ** 2).sum())
        of_prior, of_errors = updated_precision(of_prior, prior), updated_precision(of_errors, errors)
    assert 1 / of_prior == pytest.approx(4, rel=0.15)
    assert 1 / of_errors == pytest.approx(0.25, rel=0.1)


def drawn_outlines(tau, sd, sigma=1.5, length=2048, width=64):
    """Return a filtered silhouette, and its mask with a displaced outline of Gaussian correlation."""
    error = gaussian_filter1d(np.random.default_rng(1).normal(size=length), tau / np.sqrt(2), mode="wrap")
    error *= sd / error.std()
    rows = np.arange(width)[:, None]
    mask = np.clip(rows + 1 - width / 2 - error, 0, 1)
    truth = np.broadcast_to(np.clip(rows + 1.0 - width / 2, 0, 1), (width, length))
    return gaussian_filter(truth, sigma, mode="constant"), mask


@pytest.mark.parametrize(("tau", "sd"), [(2.0, 0.3), (6.0, 0.3), (6.0, 0.6), (15.0, 0.3)])
def test_correlation_and_weight_of_a_drawn_outline(tau, sd):
    shown, mask = drawn_outlines(tau, sd)
    sigma, margin = 1.5, 12
    error = shown - gaussian_filter(mask, sigma, mode="constant")
    wider = gaussian_filter(error, np.sqrt(3) * sigma, mode="constant")
    squared, of_wider = ((each[margin:-margin, margin:-margin] ** 2).sum() for each in (error, wider))
    assert outline_correlation_px(of_wider / squared, sigma) == pytest.approx(tau, rel=0.2)
    # the error of the mean displacement of a long piece has the precision length / (√(2π)·τ·sd²), and the mask term
    # has weight · length / (2·√π·σ)
    expected = np.sqrt(2) * sigma / (tau * sd**2)
    outlines = np.array([[squared, of_wider, mask.shape[1] - 2 * margin]])
    count, energy = mask_evidence(outlines, 1.0, 0.0, expected, sigma)
    assert energy == pytest.approx(count, rel=0.15)


def test_outline_statistics_at_the_edges():
    assert outline_correlation_px(0.1, 1.5) == outline_correlation_px(0.25, 1.5) == 0
    assert np.isfinite(outline_correlation_px(0.6, 1.5))
    disc = np.hypot(*(np.mgrid[:64, :64] - 31.5)) < 20
    shown = gaussian_filter(disc.astype(float), 1.5, mode="constant")
    squared, wider, length = outline_error(shown, disc, np.zeros_like(disc), 1.5)
    assert squared == pytest.approx(0, abs=1e-6)
    assert wider == pytest.approx(0, abs=1e-6)
    assert length == pytest.approx(2 * np.pi * 20, rel=0.03)
    unknown = np.zeros_like(disc)
    unknown[:, 32:] = True
    assert outline_error(shown, disc & ~unknown, unknown, 1.5)[2] < 0.5 * length


def test_the_sample_takes_tracks_in_turn():
    tracks = np.repeat([0, 1, 2], [50, 2, 1])
    windows = empty_windows(tracks, 10)
    rows = choose_windows(windows)
    np.testing.assert_array_equal(rows, choose_windows(windows))
    assert len(rows) == 21  # 40 %
    assert len(choose_windows(empty_windows(np.arange(100), 10))) == MAX_WINDOWS
    assert set(tracks[rows]) == {0, 1, 2}
    assert len(choose_windows(empty_windows(tracks, 200))) == MAX_FRAMES // 200
    assert len(choose_windows(windows, 1)) == 1


def empty_windows(tracks, frames):
    values = {field.name: np.zeros(len(tracks)) for field in dataclasses.fields(Windows)}
    return Windows(**values | {"track": tracks, "present": np.ones((len(tracks), frames), bool)})


@pytest.mark.extended
def test_the_weight_of_the_mask_rises_with_exact_outlines_and_never_falls():
    own = dataclasses.replace(
        LEARNING,
        edge="unbiased",
        stages=(dataclasses.replace(STAGE, terms=(*STAGE.terms, "mask_smooth_l1")),),
        terms=TERMS | {"mask_smooth_l1": 0.3},
    )
    weights = []
    for noise in (0, 1):
        exact = detect(BIRD, truths(T, 1), camera=CAMERA)
        learnt = learn_weights(deformed(exact, noise), BIRD, own)
        weights.append(learnt.values["terms.mask_smooth_l1.weight"])
    assert weights[0] > 2 * weights[1]
    assert weights[1] >= 0.3


def deformed(observations, noise):
    """Return observations whose masks have outlines with random errors."""
    rng, masks = np.random.default_rng(0), {}
    for key, rle in observations.masks.items():
        mask = decode_mask(rle)
        field = gaussian_filter(rng.normal(size=mask.shape), 1.5)
        soft = gaussian_filter(mask.astype(float), 1.5) + noise * 0.2 * field / field.std()
        masks[key] = encode_mask(soft > 0.5 if noise else mask)
    return dataclasses.replace(observations, masks=masks)


@pytest.mark.extended
def test_overridden_settings_and_terms_of_others_keep_their_values(exact):
    stage = dataclasses.replace(STAGE, override={"keypoint_likelihood": {"sd_sure_px": 2.0}})
    learnt = learn_weights(noisy(exact, 3.0), BIRD, dataclasses.replace(LEARNING, stages=(stage,)))
    assert learnt.values == {}
    assert learnt.config.terms == LEARNING.terms


@pytest.mark.extended
def test_a_model_without_prior_learns_from_keypoints_alone(exact):
    terms = {"keypoint_likelihood": TERMS["keypoint_likelihood"]}
    own = dataclasses.replace(LEARNING, stages=(dataclasses.replace(STAGE, terms=tuple(terms)),), terms=terms)
    learnt = learn_weights(noisy(exact, 3.0), BIRD, own)
    assert learnt.values or len(learnt.remarks) == 1
    assert all(np.isfinite(value) for value in learnt.values.values())
