"""Statistics of the errors of detected masks: offsets of the detected outline from the labelled outline."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree

from jaxfit.data.masks import decode_mask
from jaxfit.data.neighbours import FrameMasks
from jaxfit.data.observations import Observations
from jaxfit.evaluation.labelled_pairs import LabelledPairs
from jaxfit.fitting.crops import cut_mask, mark_unknown
from jaxfit.model.camera import CROP_PX
from jaxfit.progress import ProgressTask, silent
from jaxfit.raster.silhouette import UNKNOWN

__all__ = ["OutlineErrors", "OutlineNoise", "outline_errors", "outline_noise", "outline_offsets"]

OUTLINE_PX = 1024
"""Side of the crops in which outlines are compared: whole pixels of a smaller crop are too coarse for small offsets."""
NEAR_UNKNOWN_PX = 1.0
"""The outline does not count this close to unknown pixels and to the border of the crop, in crop pixels."""
LAGS = 128
"""Largest distance along the outline for the correlation, in crop pixels."""
LEAST_DEVIATION_PX = 0.05
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
        """Weight of an L1 mask term in nats per pixel: 1 / (mean absolute deviation × correlation length).

        Under a Laplace density, an offset d of a piece of outline costs |d| / deviation nats, and independent pieces
        are as long as the correlation length. The L1 term costs |d| × length of the piece, in pixels.
        """
        return 1 / (self.deviation_px * self.length_px)


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
        deviation_px=max(float(np.abs(samples - mean).mean()), LEAST_DEVIATION_PX),
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
