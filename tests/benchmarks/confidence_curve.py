"""Fit the curve of confidences of a keypoint network on simulated birds, and store the curve in the network file.

    python tests/benchmarks/confidence_curve.py keypoints.onnx scenes
    python tests/benchmarks/confidence_curve.py outline.onnx outlines.npz

`jaxfit.perception.network` describes the curves and reads them. The built-in segmenter
detects the birds of `scenes`, a folder of simulated scenes that the network was not trained on, as in tracking.
`outlines.npz` holds outlines of other seeds (`jaxfit.learning.networks.outlines.draw_outlines`).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import isotonic_regression

from jaxfit.data.masks import box_of_mask
from jaxfit.evaluation import metrics
from jaxfit.evaluation.detection import assign
from jaxfit.foundation.errors import InputError
from jaxfit.learning.networks.labelled_frames import LabelledFrames, load_frames
from jaxfit.perception.keypoints import load_keypoint_detector
from jaxfit.perception.network import CONFIDENCE_KEY, Curve, KeypointDetector, Segmenter
from jaxfit.perception.segmentation import load_segmenter

RIGHT = 0.05
"""Largest error of a keypoint that is right, as a share of the longer side of the bird's box."""
RANGES = 20
"""Number of equal ranges of values, each of which gives at most one point of a curve."""
MIN_IN_RANGE = 50
"""A range with fewer detections is merged with the next range."""
MIN_OUTCOMES = 200
"""Least number of detections for a curve."""


class Outcomes(NamedTuple):
    """Raw values of a network for M detections, and whether each detection is right."""

    values: Float[np.ndarray, "M"]
    """Raw values of the network."""
    right: Bool[np.ndarray, "M"]


def keypoint_outcomes(frames: LabelledFrames, segmenter: Segmenter, keypoints: KeypointDetector) -> Outcomes:
    """Detect the keypoints of known birds, and compare them with the known positions.

    The birds are those of the segmenter, as in tracking. A bird is compared with the known bird whose mask it shares
    with an IoU of at least 0.5. Every keypoint with a known position counts, also if it is hidden. A keypoint is right
    if its error is at most 5 % of the longer side of the bird's box: the box around the mask and the known keypoints.

    Args:
        frames: frames that neither network was trained on, with the keypoints in the order of the detector.
        segmenter: detects the birds.
        keypoints: the detector, without a curve.
    """
    values, right = [np.zeros(0)], [np.zeros(0, bool)]
    for picture, owner, true_px, known in zip(
        frames.pictures, frames.owner, frames.keypoints_px, frames.known, strict=True
    ):
        birds = segmenter(picture)
        masks = [owner == n for n in range(1, len(known) + 1)]
        whole = [bird.whole(owner.shape[::-1]) for bird in birds]
        iou = np.array([[np.nan_to_num(metrics.iou(own, mask)) for mask in masks] for own in whole])
        detected, true = assign(iou.reshape(len(birds), len(masks)))
        if not len(detected):
            continue
        points_px, confidence = (array[detected] for array in keypoints(picture, birds))
        for m, n in enumerate(true):
            side = _longer_side(masks[n], true_px[n, known[n]])
            error = np.linalg.norm(points_px[m] - true_px[n], axis=-1)
            values.append(confidence[m, known[n]])
            right.append(error[known[n]] <= RIGHT * side)
    return Outcomes(np.concatenate(values), np.concatenate(right))


def outline_outcomes(path: Path, keypoints: KeypointDetector, count: int = 4000) -> Outcomes:
    """Detect the keypoints of simulated outlines with errors of a segmenter, and compare them as `keypoint_outcomes`.

    The side is that of the mask. Keypoints that are hidden or cut off count, too.
    """
    from jaxfit.learning.networks.outlines import draw_scene, load_outlines  # needs PyTorch

    outlines, rng, values, right = load_outlines(path), np.random.default_rng(0), [], []
    for _ in range(count):
        scene = draw_scene(rng, outlines)
        points_px, confidence = keypoints(np.zeros((*scene.shape, 3), np.uint8), scene.birds)
        values.append(confidence[0])
        error = np.linalg.norm(points_px[0] - scene.points_px, axis=-1)
        right.append(error <= RIGHT * max(scene.birds[0].mask.shape))
    return Outcomes(np.concatenate(values), np.concatenate(right))


def fit_curve(outcomes: Outcomes, source: object = "outcomes") -> Curve:
    """Fit a monotone curve from raw values to the share of right detections.

    An isotonic regression gives the shares. The values are cut into 20 equal ranges; a range with fewer than 50
    detections is merged with the next range. The mean value and the mean share of a range are a point of the curve,
    and (0, 0) is its first point.

    Args:
        outcomes: detections and whether they are right.
        source: the network, for messages.

    Raises:
        InputError: fewer than 200 detections, or detections with equal values.
    """
    detected = outcomes.values > 0
    values, right = outcomes.values[detected].astype(np.float64), outcomes.right[detected]
    order = np.argsort(values, kind="stable")
    if len(values) < MIN_OUTCOMES or values.min() == values.max():
        problem = f"has {len(values)} detections of known birds, or equal confidences"
        raise InputError(source, problem, f"calibrate on pictures with at least {MIN_OUTCOMES} detected keypoints")
    shares = isotonic_regression(right[order].astype(float)).x
    edges = np.searchsorted(values[order], np.linspace(values.min(), values.max(), RANGES + 1)[1:-1])
    points, start = [(0.0, 0.0)], 0
    for stop in [*edges.tolist(), len(order)]:
        is_last = stop == len(order)
        if stop - start >= MIN_IN_RANGE and (is_last or len(order) - stop >= MIN_IN_RANGE):
            points.append((values[order][start:stop].mean(), shares[start:stop].mean()))
            start = stop
    return Curve(*np.array(points).T)


def _longer_side(mask: Bool[np.ndarray, "H W"], points_px: Float[np.ndarray, "M 2"]) -> float:
    """Return the longer side of the box around a mask and points, pixels."""
    x0, y0, width, height = box_of_mask(mask) or (0, 0, 0, 0)
    corners = np.concatenate([[[x0, y0], [x0 + width, y0 + height]], points_px])
    return float(np.ptp(corners, axis=0).max())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Fit the curve of confidences of a keypoint network.")
    parser.add_argument("network", type=Path, help="ONNX file of the keypoint network; it is replaced")
    parser.add_argument("scenes", type=Path, help="folder of simulated scenes of `jaxfit train`, or file of outlines")
    options = parser.parse_args()
    detector = load_keypoint_detector(options.network)
    detector.curve = None  # a curve that the file holds is replaced
    if options.scenes.is_dir():
        known = load_frames(*sorted(options.scenes.glob("scene_*")))
        outcomes = keypoint_outcomes(known, load_segmenter("builtin"), detector)
    else:
        outcomes = outline_outcomes(options.scenes, detector)
    curve = fit_curve(outcomes, options.network)
    from jaxfit.learning.networks.network_files import set_metadata  # needs PyTorch

    set_metadata(options.network, {CONFIDENCE_KEY: curve.text()})
