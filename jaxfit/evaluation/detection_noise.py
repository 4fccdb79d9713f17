"""Errors of detections from labelled frames, as settings of the config `map`."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from jaxfit.config.fit import FitConfig, load_config
from jaxfit.config.yaml_file import rounded
from jaxfit.data.observations import Observations
from jaxfit.data.tracks import frame_step
from jaxfit.evaluation import noise_estimates
from jaxfit.evaluation.bootstrap import LEVEL, Interval
from jaxfit.evaluation.noise_estimates import (
    OUTLIER_SCALES,
    KeypointNoise,
    OutlineNoise,
    fit_student_t,
    labelled_pairs,
    outline_errors,
    outline_noise,
)
from jaxfit.evaluation.truth import Truth
from jaxfit.foundation.errors import InputError, one_line
from jaxfit.foundation.progress import ProgressTask, silent

BASE = "map"
"""The shipped config whose settings are estimated."""
LAGS = (1, 4)
"""Numbers of frames of the correlations in time."""
MIN_KEYPOINTS = 50
"""Fewest keypoints that are both detected and labelled."""
MIN_CONFIDENCE_RANGE = 0.01
"""Smallest difference of two confidences that differ."""
RESAMPLES = 200
"""Number of resamples of the bootstrap over birds."""


@dataclass(frozen=True)
class DetectionNoise:
    """Statistics of the errors of detections, in pixels of a 256-pixel crop."""

    frames: int
    """Number of labelled frames that count."""
    birds: int
    """Number of labelled birds that count."""
    poses: int
    """Number of pairs of a detected and a labelled bird."""
    keypoints: int
    """Number of keypoints that are both detected and labelled."""
    masks: int
    """Number of pairs of a detected and a labelled mask."""
    keypoint: KeypointNoise
    outline: OutlineNoise | None
    """None without a labelled mask."""
    settings: Mapping[str, float]
    """Path of a setting of `BASE` → its estimate. Without labelled masks, the settings of the masks are absent."""
    intervals: Mapping[str, Interval]
    """Path of a setting → its 95 % bootstrap interval over birds; NaN for one bird."""
    correlations: Mapping[int, float | None]
    """Number of frames → correlation of the errors of a keypoint; None where it is not measured."""
    outlier_share: float
    """Share of keypoint errors of more than 4 scales."""
    exchanged: tuple[int, int]
    """Number of exchanged left and right keypoints, and of all pairs of left and right keypoints."""
    unmoved_share: float
    """Share of labelled keypoints that lie exactly on the detected keypoints."""
    factors: Mapping[str, float]
    """Keypoint → factor between its scale and the scale of all keypoints."""


def estimate_noise(
    detected: Observations, truth: Truth, source: object = "the detections", progress: ProgressTask = silent
) -> DetectionNoise:
    """Estimate the statistics of the errors of detections.

    Detected and labelled birds are matched as in `evaluate_observations`. Hidden keypoints count where they are both
    labelled and detected, because a fit uses them too.

    Args:
        detected: observations of the whole video.
        truth: labels of some frames, with the same keypoint names in the same order.
        source: the file of the detections, for error messages.

    Raises:
        InputError: no common frame or bird, too few keypoints, one confidence for all keypoints, or labels that are
            copies of the detections.
    """
    config = load_config(BASE)
    pairs = labelled_pairs(detected, truth, config, source)
    known = pairs.confidence > 0
    error_px, confidence = (pairs.detected_px - pairs.labelled_px)[known], pairs.confidence[known]
    unmoved = _checked(error_px, confidence, truth.source, source)
    prior = _prior(config)
    keypoint = fit_student_t(error_px, confidence, prior)
    outlines = outline_errors(detected, truth.observations, pairs, progress)
    masks = [each for each in outlines if each is not None]
    outline = outline_noise(masks) if masks else None
    birds, row = np.unique(pairs.bird, return_inverse=True)
    row_of_error = np.broadcast_to(row[:, None], known.shape)[known]

    def resampled(counts: np.ndarray) -> Mapping[str, float]:
        """Return the settings if every bird occurs as often as the counts say."""
        again = [each for r, each in zip(row, outlines, strict=True) if each is not None for _ in range(counts[r])]
        fitted = fit_student_t(error_px, confidence, prior, counts[row_of_error].astype(float), keypoint)
        return _settings(fitted, outline_noise(again) if again else outline)

    scaled = noise_estimates.scaled_errors(pairs, keypoint)
    step = frame_step(detected.frame_index)
    settings = _settings(keypoint, outline)
    return DetectionNoise(
        frames=len(np.unique(pairs.frame_index)),
        birds=len(birds),
        poses=len(pairs.bird),
        keypoints=int(known.sum()),
        masks=len(masks),
        keypoint=keypoint,
        outline=outline,
        settings=settings,
        intervals=_intervals(resampled, len(birds), settings, progress),
        correlations={lag: noise_estimates.frame_correlation(pairs, scaled, lag * step) for lag in LAGS},
        outlier_share=noise_estimates.outlier_share(scaled),
        exchanged=noise_estimates.exchanged_pairs(pairs),
        unmoved_share=unmoved,
        factors=noise_estimates.keypoint_factors(scaled, keypoint.dof, pairs.keypoint_names),
    )


def _checked(error_px: np.ndarray, confidence: np.ndarray, labels: object, source: object) -> float:
    """Return the share of labelled keypoints that lie exactly on the detected keypoints, if the data suffice.

    Raises:
        InputError: too few keypoints, one confidence for all keypoints, or mostly labels that are copies.
    """
    if len(error_px) < MIN_KEYPOINTS:
        problem = f"labels {len(error_px)} of the detected keypoints; the estimate needs {MIN_KEYPOINTS}"
        raise InputError(labels, problem, "label more frames")
    if np.ptp(confidence) < MIN_CONFIDENCE_RANGE:
        problem = f"has the confidence {confidence.mean():.2g} at all labelled keypoints; the estimate needs several"
        raise InputError(source, problem, "give detections with confidences, in COCO as keypoint_scores")
    unmoved = float((np.abs(error_px).max(-1) < 1e-3).mean())
    if unmoved > 0.5:
        problem = f"{unmoved:.0%} of the labelled keypoints lie exactly on the detected keypoints"
        raise InputError(labels, problem, "correct pre-filled labels by hand")
    return unmoved


def _prior(config: FitConfig) -> KeypointNoise:
    """Return the settings of a config, as the centre of the prior."""
    term = config.stage_settings(config.stages[-1])["keypoint_likelihood"]
    return KeypointNoise(*(term[name] for name in KeypointNoise._fields))


def _settings(keypoint: KeypointNoise, outline: OutlineNoise | None) -> Mapping[str, float]:
    """Return path → value of the estimated settings."""
    settings = {f"terms.keypoint_likelihood.{name}": value for name, value in keypoint._asdict().items()}
    return settings if outline is None else settings | {"terms.mask_smooth_l1": outline.mask_weight}


def _intervals(
    resampled: Callable[[np.ndarray], Mapping[str, float]],
    birds: int,
    settings: Mapping[str, float],
    progress: ProgressTask,
) -> Mapping[str, Interval]:
    """Return the percentile intervals of the settings over resamples of birds, drawn with replacement."""
    if birds < 2:
        return dict.fromkeys(settings, Interval(np.nan, np.nan))
    rng = np.random.default_rng(0)
    draws = []
    with progress("Resampling birds", RESAMPLES) as report_progress:
        for _ in range(RESAMPLES):
            draws.append(resampled(np.bincount(rng.integers(birds, size=birds), minlength=birds)))
            report_progress(1, "")
    ends = (1 - LEVEL) / 2, (1 + LEVEL) / 2
    return {path: Interval(*np.quantile([draw[path] for draw in draws], ends).tolist()) for path in settings}


_MEANINGS = {
    "terms.keypoint_likelihood.sd_sure_px": "scale of keypoint errors at confidence 1",
    "terms.keypoint_likelihood.sd_unsure_px": "scale of keypoint errors at confidence 0",
    "terms.keypoint_likelihood.dof": "degrees of freedom: small numbers mean heavy tails",
    "terms.mask_smooth_l1": "nats per pixel, from the deviation of the outline and its correlation length",
}


def noise_yaml(noise: DetectionNoise, detections: object, labels: object) -> str:
    """Return a config with the base `map` and the estimated settings; its comments say what was measured.

    Args:
        noise: the estimate.
        detections: the file of the detections, for the comments.
        labels: the file of the labels, for the comments.
    """
    own = noise.settings
    term = ", ".join(f"{name}: {rounded(own[f'terms.keypoint_likelihood.{name}'])}" for name in noise.keypoint._fields)
    lines = [*_comments(noise, detections, labels), f"base: {BASE}"]
    lines.append("learn_weights: [] # the labels give the values")
    lines += ["terms:", f"  keypoint_likelihood: {{weight: 1, {term}}}"]
    if "terms.mask_smooth_l1" in own:
        lines.append(f"  mask_smooth_l1: {rounded(own['terms.mask_smooth_l1'])}")
    return "\n".join(lines) + "\n"


def facts(noise: DetectionNoise) -> dict[str, str]:
    """Return name → value of everything that was measured beside the settings."""
    swapped, sides = noise.exchanged
    found = {}
    if noise.outline is not None:
        found["mean offset of the outline"] = f"{noise.outline.offset_px:+.2f} px (negative: masks are small)"
        found["mean absolute deviation of the outline"] = f"{noise.outline.deviation_px:.2f} px"
        found["correlation length of the outline"] = f"{noise.outline.length_px:.1f} px"
        found["whole masks too large or small"] = f"± {noise.outline.whole_px:.2f} px (standard deviation)"
    for lag, value in noise.correlations.items():
        frames = "1 frame" if lag == 1 else f"{lag} frames"
        name = f"correlation of keypoint errors after {frames}"
        found[name] = "not measured: no labels at this distance" if value is None else f"{value:.2f}"
    found[f"outliers, more than {OUTLIER_SCALES:g} scales"] = f"{noise.outlier_share:.1%}"
    share = f" ({swapped / sides:.1%})" if sides else ""
    found["exchanged left and right keypoints"] = f"{swapped} of {sides} pairs{share}"
    if noise.unmoved_share > 0.01:
        text = f"{noise.unmoved_share:.0%}: pre-filled and not corrected? Then the scales are too small"
        found["labels exactly on the detection"] = text
    return found


def _comments(noise: DetectionNoise, detections: object, labels: object) -> Iterator[str]:
    """Yield the lines of the comments at the top of the config."""
    masks = f" and {noise.masks} masks" if noise.masks else "; no masks were labelled, so the mask settings are absent"
    text = (
        f"Errors of the detections {one_line(detections)}, estimated by `jaxfit calibrate` from the labels "
        f"{one_line(labels)}: {noise.frames} frames, {noise.birds} birds, {noise.keypoints} keypoints{masks}. "
        "All pixels are pixels of a 256-pixel crop. In parentheses: 95 % bootstrap interval over birds."
    )
    yield from _wrapped(text)
    yield "#"
    for path, value in noise.settings.items():
        yield from _wrapped(f"{path} = {rounded(value)}{_interval(noise.intervals[path])}: {_MEANINGS[path]}", "  ")
    yield "#"
    yield "# Measured, but not part of the config:"
    for name, value in facts(noise).items():
        yield from _wrapped(f"{name}: {value}", "  ")
    factors = ", ".join(f"{one_line(name)} {value:.2f}" for name, value in noise.factors.items())
    yield from _wrapped(f"scale of each keypoint, relative to the scale of all: {factors}", "  ")


def _interval(interval: Interval) -> str:
    return "" if math.isnan(interval.low) else f" ({rounded(interval.low)} to {rounded(interval.high)})"


def _wrapped(text: str, indent: str = "") -> list[str]:
    start = f"# {indent}"
    return textwrap.wrap(
        text, 118, initial_indent=start, subsequent_indent=start, break_long_words=False, break_on_hyphens=False
    )
