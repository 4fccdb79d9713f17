"""Estimated statistics of detection errors: known distributions are recovered, and poor data are rejected."""

import dataclasses

import numpy as np
import pytest
import yaml
from support.noisy_discs import BIRDS, RADIUS, SIDES, UNIT, K, detected, labelled, student_t

from jaxfit.config.fit import load_config
from jaxfit.config.yaml_file import rounded
from jaxfit.data.masks import encode_mask
from jaxfit.evaluation import detection_noise
from jaxfit.evaluation.detection_noise import estimate_noise, noise_yaml
from jaxfit.evaluation.truth import Truth
from jaxfit.foundation.errors import InputError

SURE, UNSURE, DOF = 1.5, 8.0, 5.0


@pytest.fixture(autouse=True)
def _few_resamples(monkeypatch):
    monkeypatch.setattr(detection_noise, "RESAMPLES", 2)


def draws(frames, dof=DOF, seed=0):
    """Return confidences, and errors whose scale falls from UNSURE to SURE with the confidence."""
    rng = np.random.default_rng(seed)
    shape = (BIRDS, frames, K)
    confidence = rng.uniform(0.05, 1, shape)
    scale = np.exp(np.log(UNSURE) + confidence * (np.log(SURE) - np.log(UNSURE)))
    return scale[..., None] * student_t(rng, shape, dof), confidence


def test_known_errors_are_recovered_from_every_tenth_frame(monkeypatch):
    """1,200 labelled keypoints; the errors of the other frames are far larger and do not count."""
    monkeypatch.setattr(detection_noise, "RESAMPLES", 20)
    error, confidence = draws(100)
    error[:, np.arange(100) % 10 != 0] *= 5
    noise = estimate_noise(detected(range(100), error, confidence), Truth(labelled(range(0, 100, 10), masks=False)))
    assert (noise.frames, noise.birds, noise.poses, noise.keypoints) == (10, BIRDS, 60, 60 * K)
    assert noise.keypoint.sd_sure_px == pytest.approx(SURE, rel=0.12)
    assert noise.keypoint.sd_unsure_px == pytest.approx(UNSURE, rel=0.12)
    assert noise.keypoint.dof == pytest.approx(DOF, rel=0.35)
    assert noise.exchanged[0] <= 2  # by accident, where errors are large
    assert noise.exchanged[1] == 60 * SIDES
    assert noise.correlations == {1: None, 4: None}
    assert all(factor == pytest.approx(1, abs=0.35) for factor in noise.factors.values())
    for path, interval in noise.intervals.items():
        assert interval.low <= noise.settings[path] <= interval.high


def test_a_normal_distribution_has_many_degrees_of_freedom():
    error, confidence = draws(40, dof=1e6)
    noise = estimate_noise(detected(range(40), error, confidence), Truth(labelled(range(40), masks=False)))
    assert noise.keypoint.dof > 15
    assert noise.keypoint.sd_sure_px == pytest.approx(SURE, rel=0.06)
    assert noise.outlier_share < 0.002


def test_a_keypoint_that_is_harder_has_a_greater_factor():
    error, confidence = draws(40)
    error[:, :, -1] *= 3
    factors = estimate_noise(detected(range(40), error, confidence), Truth(labelled(range(40), masks=False))).factors
    assert factors["f"] / factors["a"] == pytest.approx(3, rel=0.2)


def test_outliers_and_correlation_in_time():
    """An AR(1) process with ρ = 0.8 has the correlations 0.8 and 0.8⁴; 5 % of the errors become outliers."""
    rng = np.random.default_rng(1)
    error = np.empty((BIRDS, 60, K, 2))
    error[:, 0] = rng.normal(size=(BIRDS, K, 2))
    for t in range(1, 60):
        error[:, t] = 0.8 * error[:, t - 1] + 0.6 * rng.normal(size=(BIRDS, K, 2))
    far = rng.random((BIRDS, 60, K)) < 0.05
    error[far] += 20
    noise = estimate_noise(
        detected(range(60), error, rng.uniform(0.1, 1, far.shape)), Truth(labelled(range(60), masks=False))
    )
    assert noise.correlations == {1: pytest.approx(0.8, abs=0.05), 4: pytest.approx(0.8**4, abs=0.05)}
    assert noise.outlier_share == pytest.approx(0.05, abs=0.02)


def test_exchanged_keypoints_are_counted():
    error, confidence = draws(20)
    found = detected(range(20), error * 0.1, confidence)
    points = found.keypoints_px.copy()
    points[0, :5, [0, 1]] = points[0, :5, [1, 0]]  # the first left and right keypoint of one bird
    noise = estimate_noise(found.with_keypoints(points, confidence), Truth(labelled(range(20), masks=False)))
    assert noise.exchanged == (5, BIRDS * 20 * SIDES)


def estimated_outline(radius):
    error, confidence = draws(4)
    noise = estimate_noise(detected(range(4), error, confidence, radius), Truth(labelled(range(4))))
    assert noise.masks == BIRDS * 4
    return noise


@pytest.mark.parametrize("eroded_px", [-4, 0, 3])
def test_the_offset_of_a_smaller_disc(eroded_px):
    """Within 0.3 image pixels."""
    noise = estimated_outline(RADIUS - eroded_px)
    assert noise.outline.offset_px == pytest.approx(-eroded_px / UNIT, abs=0.3 / UNIT if eroded_px else 0.02)
    assert noise.outline.deviation_px < 0.4
    assert noise.outline.whole_px < 0.1


def test_waves_of_the_outline():
    """cos has the mean absolute value 2/π, and the correlation 1/e at acos(1/e)/2π of its wavelength."""
    noise = estimated_outline(lambda angle: RADIUS + 4 * np.cos(6 * angle))
    wavelength = 2 * np.pi * RADIUS / 6
    deviation, length = 8 / np.pi / UNIT, np.arccos(1 / np.e) / (2 * np.pi) * wavelength / UNIT
    assert noise.outline.deviation_px == pytest.approx(deviation, rel=0.1)
    assert noise.outline.length_px == pytest.approx(length, rel=0.15)
    edge_px, sd_px = np.sqrt(2 * np.log(2) * 1.6384), np.sqrt(np.pi / 2) * deviation
    expected = 2 * np.sqrt(np.pi) * edge_px / (np.sqrt(np.pi) * length * sd_px**2)
    assert noise.settings["terms.mask_smooth_l1"] == pytest.approx(expected, rel=0.3)


def test_an_outline_that_touches_another_bird_does_not_count():
    """A third of one bird belongs to a neighbour in the detections: that part of the outline does not count."""
    error, confidence = draws(4)
    found = detected(range(4), error, confidence)
    whole, masks = found.mask(0, 0), dict(found.masks)
    right = np.arange(whole.shape[1]) > 80
    for t in range(4):
        masks[0, t], masks[1, t] = (encode_mask(whole & part) for part in (right, ~right))
    labels = labelled(range(4))
    noise = estimate_noise(dataclasses.replace(found, masks=masks), Truth(labels))
    assert noise.masks == 4 * (BIRDS - 1)  # the mask of the neighbour matches no label
    assert noise.outline.offset_px == pytest.approx(0, abs=0.1)
    assert noise.outline.deviation_px < 0.2


def test_the_config_is_valid_and_says_where_its_numbers_come_from(tmp_path):
    error, confidence = draws(20)
    noise = estimate_noise(detected(range(20), error, confidence, RADIUS - 2), Truth(labelled(range(0, 20, 5))))
    text = noise_yaml(noise, "birds\n.json", "labels.json")
    (tmp_path / "noise.yaml").write_text(text)
    config = load_config(tmp_path / "noise.yaml")
    term = config.terms["keypoint_likelihood"]
    assert term["dof"] == float(rounded(noise.keypoint.dof))
    assert config.terms["mask_smooth_l1"] == float(rounded(noise.outline.mask_weight))
    assert config.stages == load_config("map").stages
    comments = " ".join(line.lstrip("# ") for line in text.splitlines() if line.startswith("#"))
    assert "4 frames, 6 birds, 480 keypoints and 24 masks" in comments
    assert "birds\\n.json" in comments


def test_labels_without_masks_leave_the_settings_of_masks_out():
    error, confidence = draws(4)
    noise = estimate_noise(detected(range(4), error, confidence), Truth(labelled(range(4), masks=False)))
    assert noise.outline is None
    assert yaml.safe_load(noise_yaml(noise, "a", "b")).keys() == {"base", "learn_weights", "terms"}


def without_birds(found, labels):
    return found.select(tracks=[0]), labels.select(tracks=[5])


def without_keypoints(found, labels):
    confidence = labels.confidence.copy()
    confidence[:, :, 2:] = 0
    return found, labels.with_keypoints(labels.keypoints_px, confidence).select(frames=[0])


def equally_sure(found, labels):
    return found.with_keypoints(found.keypoints_px, np.full_like(found.confidence, 0.7)), labels


def copied(found, labels):
    return found, dataclasses.replace(found, confidence=np.ones_like(found.confidence))


POOR = {
    "no common bird": (without_birds, "matches no labelled bird"),
    "few keypoints": (without_keypoints, "labels 12 of the detected keypoints; the estimate needs 50"),
    "one confidence": (equally_sure, "has the confidence 0.7 at all labelled keypoints"),
    "copies": (copied, "100% of the labelled keypoints lie exactly on the detected keypoints"),
    "no common frame": (lambda found, labels: (found.select(frames=[3]), labels.select(frames=[0])), "no frame"),
}


@pytest.mark.parametrize("name", POOR)
def test_poor_data_are_rejected(name):
    change, problem = POOR[name]
    found, labels = change(detected(range(4), *draws(4)), labelled(range(4)))
    with pytest.raises(InputError, match=problem):
        estimate_noise(found, Truth(labels))
