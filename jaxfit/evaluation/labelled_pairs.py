"""Detected birds and the labelled birds that they match, in crop pixels as a fit uses them."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfit.config.fit import FitConfig
from jaxfit.data.observations import Observations
from jaxfit.errors import InputError
from jaxfit.evaluation.detection import matches
from jaxfit.evaluation.overlap import overlap
from jaxfit.evaluation.truth import Truth
from jaxfit.fitting.windows import cut_windows
from jaxfit.model.camera import image_to_crop

__all__ = ["LabelledPairs", "labelled_pairs"]


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
    both = overlap(detected, truth)
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
