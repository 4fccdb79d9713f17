"""Statistics of the errors of detections, from labelled frames of the same video, as settings of the config `map`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from jaxfit.config.fit import FitConfig, load_config
from jaxfit.data.frame_numbers import frame_step
from jaxfit.data.observations import Observations
from jaxfit.errors import InputError
from jaxfit.evaluation import keypoint_noise
from jaxfit.evaluation.bootstrap import LEVEL, Interval
from jaxfit.evaluation.keypoint_noise import KeypointNoise, fit_student_t
from jaxfit.evaluation.labelled_pairs import labelled_pairs
from jaxfit.evaluation.outline_noise import OutlineNoise, outline_errors, outline_noise
from jaxfit.evaluation.truth import Truth
from jaxfit.limits import GROW_MASKS_PX
from jaxfit.progress import ProgressTask, silent

__all__ = ["BASE", "DetectionNoise", "estimate_noise"]

BASE = "map"
"""The shipped config whose settings are estimated."""
SHIPPED_OFFSET_PX = -0.67
"""Mean offset of the outlines of the simulated masks with which `grow_masks_px` of the config `map` gives fitted birds
without a systematic error of size, crop pixels (scenes of the seeds 100 to 104)."""
LAGS = (1, 4)
"""Numbers of frames of the correlations in time."""
LEAST_KEYPOINTS = 50
"""Fewest keypoints that are both detected and labelled."""
LEAST_CONFIDENCE_RANGE = 0.01
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
        return _settings(config, fitted, outline_noise(again) if again else outline)

    scaled = keypoint_noise.scaled_errors(pairs, keypoint)
    step = frame_step(detected.frame_index)
    settings = _settings(config, keypoint, outline)
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
        correlations={lag: keypoint_noise.frame_correlation(pairs, scaled, lag * step) for lag in LAGS},
        outlier_share=keypoint_noise.outlier_share(scaled),
        exchanged=keypoint_noise.exchanged_pairs(pairs),
        unmoved_share=unmoved,
        factors=keypoint_noise.keypoint_factors(scaled, keypoint.dof, pairs.keypoint_names),
    )


def _checked(error_px: np.ndarray, confidence: np.ndarray, labels: object, source: object) -> float:
    """Return the share of labelled keypoints that lie exactly on the detected keypoints, if the data suffice.

    Raises:
        InputError: too few keypoints, one confidence for all keypoints, or mostly labels that are copies.
    """
    if len(error_px) < LEAST_KEYPOINTS:
        problem = f"labels {len(error_px)} of the detected keypoints; the estimate needs {LEAST_KEYPOINTS}"
        raise InputError(labels, problem, "label more frames")
    if np.ptp(confidence) < LEAST_CONFIDENCE_RANGE:
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


def _settings(config: FitConfig, keypoint: KeypointNoise, outline: OutlineNoise | None) -> Mapping[str, float]:
    """Return path → value of the estimated settings."""
    settings = {f"terms.keypoint_likelihood.{name}": value for name, value in keypoint._asdict().items()}
    if outline is not None:
        grow_px = min(max(config.grow_masks_px + SHIPPED_OFFSET_PX - outline.offset_px, 0.0), GROW_MASKS_PX)
        settings |= {"terms.mask": outline.mask_weight, "grow_masks_px": grow_px}
    return settings


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
