"""Errors of detected keypoints and outlines, from detected birds and the labelled birds that they match."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.optimize import minimize
from scipy.spatial import KDTree

from jaxfit.config.fit import FitConfig
from jaxfit.data.keypoint_names import opposite_keypoints
from jaxfit.data.masks import decode_mask
from jaxfit.data.observations import FrameMasks, Observations
from jaxfit.evaluation.detection import comparable_boxes, matches, overlap
from jaxfit.evaluation.truth import Truth
from jaxfit.fitting.crops import cut_mask, mark_unknown
from jaxfit.fitting.windows import cut_windows
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.model.camera import CROP_PX, image_to_crop
from jaxfit.objective.likelihood import keypoint_sd_px
from jaxfit.raster.silhouette_reference import UNKNOWN, Blur


class LabelledPairs(NamedTuple):
    """P pairs of a detected and a labelled bird; a pair belongs to one frame.

    Crop pixels are pixels of a 256-pixel crop, with the crop of the detected bird's window in a fit.
    """

    keypoint_names: tuple[str, ...]
    """K names of the detections."""
    frame_index: Int[np.ndarray, "P"]
    """Number of the frame."""
    bird: Int[np.ndarray, "P"]
    """Id of the labelled bird."""
    at_detected: Int[np.ndarray, "P 2"]
    """Positions of track and frame in the detections."""
    at_labelled: Int[np.ndarray, "P 2"]
    """Positions of track and frame in the labels."""
    crop: Float[np.ndarray, "P 3"]
    """x0, y0 and size of the crop, image pixels."""
    detected_px: Float[np.ndarray, "P K 2"]
    """Detected keypoints, crop pixels; NaN where a keypoint is not both detected and labelled."""
    labelled_px: Float[np.ndarray, "P K 2"]
    """Labelled keypoints, crop pixels; NaN as in `detected_px`."""
    confidence: Float[np.ndarray, "P K"]
    """Confidence of the detections; 0 where a keypoint is not both detected and labelled."""


def labelled_pairs(detected: Observations, truth: Truth, config: FitConfig, source: object) -> LabelledPairs:
    """Match detected with labelled birds as `evaluate_observations` does, and convert keypoints to crop pixels.

    Args:
        detected: observations of the whole video, because the crop of a window depends on all its frames.
        truth: labels of some frames, with the same keypoint names in the same order.
        config: of the fit, which determines the windows and their crops.
        source: the file of the detections, for error messages.

    Raises:
        InputError: as `overlap`; or no labelled bird matches a detected bird that a fit uses.
    """
    labels = truth.observations
    both = overlap(*comparable_boxes(detected, truth))
    i, m, n = matches(both).T
    t, s = both.true_frame[i], both.detected_frame[i]
    crops = _crops(detected, config)
    used = np.isfinite(crops[n, s, 2])
    m, n, t, s = m[used], n[used], t[used], s[used]
    if not len(m):
        problem = "matches no labelled bird"
        raise InputError(source, problem, f"give labels of the same frames of this video; labels: {truth.source}")
    crop = crops[n, s]
    confidence = np.where(labels.confidence[m, t] > 0, detected.confidence[n, s], 0).astype(np.float64)
    known = confidence[..., None] > 0

    def in_crop(points: Any) -> np.ndarray:
        return np.where(known, image_to_crop(points.astype(np.float64), crop), np.nan)

    return LabelledPairs(
        keypoint_names=detected.keypoint_names,
        frame_index=detected.frame_index[s],
        bird=labels.track_id[m],
        at_detected=np.stack([n, s], 1),
        at_labelled=np.stack([m, t], 1),
        crop=crop,
        detected_px=in_crop(detected.keypoints_px[n, s]),
        labelled_px=in_crop(labels.keypoints_px[m, t]),
        confidence=confidence,
    )


def _crops(detected: Observations, config: FitConfig) -> Float[np.ndarray, "N T 3"]:
    """Return the crop of every bird and frame of a fit; NaN where the fit does not use the bird."""
    fewest = min(config.min_keypoints, detected.num_keypoints)  # as `jaxfit fit` does
    config = dataclasses.replace(config, filter_window=1, unknown_pixels=False, min_keypoints=fewest)
    windows = cut_windows(detected, config)
    crops = np.full((detected.num_tracks, detected.num_frames, 3), np.nan)
    w, i = np.nonzero(windows.present)
    crops[windows.track[w], windows.frame[w, i]] = windows.crop[w, i]
    return crops


MIN_SD_PX, MAX_SD_PX = 0.1, 128.0
"""Limits of the scales, in crop pixels."""
MIN_DOF, MAX_DOF = 1.0, 30.0
"""Limits of the degrees of freedom; above 30 the density hardly differs from a normal density."""
PRIOR_SD = 2.0
"""Standard deviation of the weak prior on the logarithm of every parameter, about the values of the config."""
OUTLIER_SCALES = 4.0
"""An error of more than this number of scales is an outlier."""
EXCHANGE_RATIO = 2.0
"""A pair is exchanged if the RMS error of the exchanged assignment is smaller by more than this factor."""
MIN_CORRELATION_PAIRS = 30
"""Fewest pairs of errors for a correlation."""


class KeypointNoise(NamedTuple):
    """Parameters of the Student t density of keypoint errors, in crop pixels."""

    sd_sure_px: float
    """Scale at confidence 1."""
    sd_unsure_px: float
    """Scale at confidence 0."""
    dof: float
    """Degrees of freedom."""


def fit_student_t(
    error_px: Float[np.ndarray, "M 2"],
    confidence: Float[np.ndarray, "M"],
    prior: KeypointNoise,
    weight: Float[np.ndarray, "M"] | None = None,
    start: KeypointNoise | None = None,
) -> KeypointNoise:
    """Maximise the likelihood of errors e at confidences c under the density of `keypoint_likelihood`.

    Σ −log(2π s²) − (ν + 2)/2 · log(1 + ‖e‖²/(ν s²)),  s = s₁^c · s₀^(1−c)

    A normal prior on the logarithms of s₁, s₀ and ν, with the standard deviation `PRIOR_SD` about `prior`, decides
    only what the data leave open, for example s₀ where all confidences are near 1.

    Args:
        error_px: detected minus labelled position, crop pixels.
        confidence: of the detections, in (0, 1].
        prior: centre of the prior.
        weight: number of times that each error counts; None for 1.
        start: initial values; None for the centre of the prior.

    Source: Lange, Little and Taylor 1989, *Robust Statistical Modeling Using the t Distribution*.
    """
    squared = (error_px**2).sum(-1)
    weight = np.ones(len(squared)) if weight is None else weight
    limits = np.array([(MIN_SD_PX, MAX_SD_PX)] * 2 + [(MIN_DOF, MAX_DOF)])
    centre, first = (np.log(np.clip(values, *limits.T)) for values in (prior, start or prior))

    def loss(logs: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the negative log-density of errors and prior, and its gradient."""
        sure, unsure, dof = np.exp(logs)
        scale = keypoint_sd_px(confidence, sure, unsure)
        ratio = squared / (dof * scale**2)
        value = weight @ (2 * np.log(scale) + (dof + 2) / 2 * np.log1p(ratio))
        by_log_scale = weight * (2 - (dof + 2) * ratio / (1 + ratio))
        by_log_dof = weight @ (dof / 2 * np.log1p(ratio) - (dof + 2) / 2 * ratio / (1 + ratio))
        gradient = np.array([by_log_scale @ confidence, by_log_scale @ (1 - confidence), by_log_dof])
        off = (logs - centre) / PRIOR_SD
        return value + off @ off / 2, gradient + off / PRIOR_SD

    found = minimize(loss, first, jac=True, method="L-BFGS-B", bounds=np.log(limits))
    return KeypointNoise(*np.exp(found.x).tolist())


def scaled_errors(pairs: LabelledPairs, noise: KeypointNoise) -> Float[np.ndarray, "P K 2"]:
    """Return the errors divided by their scale; NaN where there is no error."""
    scale = keypoint_sd_px(pairs.confidence, noise.sd_sure_px, noise.sd_unsure_px)
    return (pairs.detected_px - pairs.labelled_px) / scale[..., None]


def outlier_share(scaled: Float[np.ndarray, "P K 2"]) -> float:
    """Return the share of errors of more than `OUTLIER_SCALES` scales."""
    size = np.linalg.norm(scaled, axis=-1)
    return float((size[np.isfinite(size)] > OUTLIER_SCALES).mean())


def keypoint_factors(scaled: Float[np.ndarray, "P K 2"], dof: float, names: tuple[str, ...]) -> Mapping[str, float]:
    """Return, for every keypoint with an error, the factor by which its scale differs from the scale of all keypoints.

    The factor maximises the likelihood at the same degrees of freedom, by the iteration of Lange et al. 1989:
    f² ← mean(w ‖e/s‖²)/2 with w = (ν + 2)/(ν + ‖e/s‖²/f²).
    """
    squared = (scaled**2).sum(-1)
    known = np.isfinite(squared).any(0)
    squared = squared[:, known]
    factor2 = np.nanmedian(squared, 0) + 1e-12
    for _ in range(100):
        factor2 = np.nanmean((dof + 2) / (dof + squared / factor2) * squared, 0) / 2 + 1e-12
    return dict(zip(np.array(names, object)[known].tolist(), np.sqrt(factor2).tolist(), strict=True))


def frame_correlation(pairs: LabelledPairs, scaled: Float[np.ndarray, "P K 2"], lag: int) -> float | None:
    """Return the correlation of the errors of one keypoint of one bird in two frames; None where it is not measured.

    Outliers do not count: few large errors would decide alone.

    Args:
        pairs: the pairs of birds.
        scaled: the result of `scaled_errors`.
        lag: difference of the frame numbers.

    Returns:
        Σ e(t)·e(t + lag) / √(Σ ‖e(t)‖² Σ ‖e(t + lag)‖²), or None for fewer than `MIN_CORRELATION_PAIRS` errors.
    """
    place = {(bird, frame): p for p, (bird, frame) in enumerate(zip(*_keys(pairs), strict=True))}
    both = [(p, place[bird, frame + lag]) for (bird, frame), p in place.items() if (bird, frame + lag) in place]
    if not both:
        return None
    inside = np.linalg.norm(scaled, axis=-1) <= OUTLIER_SCALES  # False for NaN
    first, second = np.array(both).T
    kept = inside[first] & inside[second]
    if kept.sum() < MIN_CORRELATION_PAIRS:
        return None
    a, b = scaled[first][kept], scaled[second][kept]
    return float((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum()))


def exchanged_pairs(pairs: LabelledPairs) -> tuple[int, int]:
    """Return the number of exchanged left and right keypoints, and of all pairs with both keypoints.

    A pair is exchanged if its RMS error is more than `EXCHANGE_RATIO` times the RMS error after an exchange.
    """
    opposite = opposite_keypoints(pairs.keypoint_names)
    sides = np.array([(k, other) for k, other in enumerate(opposite) if other > k], int).reshape(-1, 2)
    detected, labelled = pairs.detected_px[:, sides], pairs.labelled_px[:, sides]
    own, exchanged = (((detected - points) ** 2).sum((-1, -2)) for points in (labelled, labelled[:, :, ::-1]))
    known = np.isfinite(own)
    return int((exchanged[known] * EXCHANGE_RATIO**2 < own[known]).sum()), int(known.sum())


def _keys(pairs: LabelledPairs) -> tuple[Any, Any]:
    return pairs.bird.tolist(), pairs.frame_index.tolist()


OUTLINE_PX = 1024
"""Side of the crops in which outlines are compared: whole pixels of a smaller crop are too coarse for small offsets."""
NEAR_UNKNOWN_PX = 1.0
"""The outline does not count this close to unknown pixels and to the border of the crop, in crop pixels."""
LAGS = 128
"""Largest distance along the outline for the correlation, in crop pixels."""
MIN_DEVIATION_PX = 0.05
"""Smallest deviation, in crop pixels: about the error of outlines of whole pixels."""


class OutlineNoise(NamedTuple):
    """Errors of the detected outline, in crop pixels."""

    offset_px: float
    """Mean signed distance of the detected outline from the labelled outline; negative if detected masks are small."""
    deviation_px: float
    """Mean absolute deviation of the signed distance from its mean."""
    length_px: float
    """Distance along the outline at which the correlation of the deviations falls to 1/e. The deviations are from the
    mean of each outline, because whole masks are too large or too small: that part has no length."""
    whole_px: float
    """Standard deviation of the mean distance between masks."""

    @property
    def mask_weight(self) -> float:
        """Weight of `mask_smooth_l1` with the unbiased edge, nats per pixel: λ = 2√π·f / (√π·l·s²).

        A piece of outline of the length √π·l has an independent offset d of standard deviation s = √(π/2) · mean
        absolute deviation (Gaussian errors), and costs d²/2s² nats. l is the correlation length, and √π·l the integral
        of a Gaussian correlation. The edge has a Gaussian profile of standard deviation f, so the term costs
        λ·d² / (4√π·f) for every pixel of length.
        """
        edge_px = Blur.for_size(CROP_PX).filter_sd_px
        return 2 * edge_px / (self.length_px * math.pi / 2 * self.deviation_px**2)


class OutlineErrors(NamedTuple):
    """Errors along the outlines of one mask."""

    samples_px: Float[np.ndarray, "S"]
    """Signed distances at every crop pixel of the outline."""
    products: Float[np.ndarray, "lags"]
    """Σ r_i r_i+k for every lag k from 0 on, with r = d minus the mean of d over the outline of the mask."""
    counts: Float[np.ndarray, "lags"]
    """Number of products."""


def outline_errors(
    detected: Observations, labels: Observations, pairs: LabelledPairs, progress: ProgressTask = silent
) -> list[OutlineErrors | None]:
    """Return the errors of the outline of every pair; None where a mask is missing.

    The outline near unknown pixels (`mark_unknown`) does not count: the mask terms do not use it either.
    """
    masks_of_frame = FrameMasks(detected)
    found: list[OutlineErrors | None] = []
    with progress("Comparing outlines", len(pairs.crop)) as report_progress:
        for p, crop in enumerate(pairs.crop):
            (n, t), (m, s) = pairs.at_detected[p].tolist(), pairs.at_labelled[p].tolist()
            own, true = detected.mask(n, t), labels.mask(m, s)
            if own is None or true is None:
                found.append(None)
                report_progress(1, "")
                continue
            cut = cut_mask(own, crop, OUTLINE_PX)
            others = masks_of_frame.union_of_others(n, t, crop[[0, 1, 2, 2]])
            mark_unknown(cut, None if others is None else decode_mask(others), cast(Any, own.shape), crop)
            found.append(outline_offsets(cut, cut_mask(true, crop, OUTLINE_PX)))
            report_progress(1, "")
    return found


def outline_offsets(cut: UInt8[np.ndarray, "S S"], true: UInt8[np.ndarray, "S S"]) -> OutlineErrors | None:
    """Return the offsets of the outline of a detected mask from the outline of the labelled mask; positive: outside.

    Args:
        cut: crop of the detected mask: 1, 0 or `UNKNOWN`.
        true: crop of the labelled mask.

    Returns:
        The errors; None where a mask is empty or no part of the outline counts.
    """
    step = len(cut) / CROP_PX
    own, outline = _contours(cut == 1), _contours(true == 1)
    if not own or not outline:
        return None
    counted, tree = _counted(cut, step), KDTree(np.concatenate(outline))
    values, used = [], []
    for contour in own:
        points = _resampled(contour, step)
        x, y = points.T
        # the points of both outlines are the outermost pixels of the masks
        values.append(np.where(true[y, x], -1, 1) * tree.query(points)[0] / step)
        used.append(counted[y, x])
    samples_px = np.concatenate(values)[np.concatenate(used)]
    if not len(samples_px):
        return None
    mean = samples_px.mean()
    lagged = np.sum([_lagged(each - mean, here) for each, here in zip(values, used, strict=True)], 0)
    return OutlineErrors(samples_px, *lagged)


def _contours(mask: Bool[np.ndarray, "S S"]) -> list[np.ndarray]:
    """Return the outlines of a mask and of its holes, as the positions (x, y) of pixels of the mask."""
    found = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0]
    return [contour[:, 0].astype(np.float64) for contour in found]


def _lagged(values: Float[np.ndarray, "C"], counted: Bool[np.ndarray, "C"]) -> Float[np.ndarray, "2 lags"]:
    """Return products and counts as `OutlineErrors` for one closed outline, by circular correlation."""
    spectra = abs(np.fft.rfft([values * counted, counted])) ** 2
    lags = np.zeros((2, LAGS + 1))
    used = min(LAGS, len(values) // 2) + 1
    lags[:, :used] = np.fft.irfft(spectra, len(values))[:, :used]
    return lags


def outline_noise(errors: list[OutlineErrors]) -> OutlineNoise:
    """Return the statistics of the outlines of some masks; a mask may occur several times."""
    samples = np.concatenate([each.samples_px for each in errors])
    mean = float(samples.mean())
    covariance = sum(each.products for each in errors) / np.maximum(sum(each.counts for each in errors), 1)
    return OutlineNoise(
        offset_px=mean,
        deviation_px=max(float(np.abs(samples - mean).mean()), MIN_DEVIATION_PX),
        length_px=_decay_length(covariance),
        whole_px=float(np.std([each.samples_px.mean() for each in errors])),
    )


def _decay_length(covariance: Float[np.ndarray, "lags"]) -> float:
    """Return the lag at which a covariance falls to 1/e of its value at 0: at least 1, at most the last lag."""
    below = np.flatnonzero(covariance <= covariance[0] / np.e)
    if covariance[0] <= 0 or not len(below):
        return float(len(covariance) - 1) if covariance[0] > 0 else 1.0
    k = int(below[0])
    share = (covariance[k - 1] - covariance[0] / np.e) / (covariance[k - 1] - covariance[k])
    return max(float(k - 1 + share), 1.0)


def _resampled(contour: Float[np.ndarray, "C 2"], step: float) -> np.ndarray:
    """Return whole positions on a closed contour, one crop pixel apart along the contour."""
    closed = np.concatenate([contour, contour[:1]])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.arange(0, max(along[-1], step / 2), step)
    return np.stack([np.interp(at, along, closed[:, axis]) for axis in (0, 1)], 1).round().astype(int)


def _counted(cut: UInt8[np.ndarray, "S S"], step: float) -> Bool[np.ndarray, "S S"]:
    """Return the pixels at which an outline counts: away from unknown pixels and from the border of the crop."""
    radius = round(NEAR_UNKNOWN_PX * step)
    square = np.ones((2 * radius + 1,) * 2, np.uint8)
    counted = cv2.dilate((cut == UNKNOWN).astype(np.uint8), square) == 0
    counted[:radius] = counted[-radius:] = False
    counted[:, :radius] = counted[:, -radius:] = False
    return counted
