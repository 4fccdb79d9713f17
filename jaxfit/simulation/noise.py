"""What detectors would report of a scene: keypoints, confidences and masks with the faults that real ones have.

The model, per bird; side is the longer side of its box, in pixels:

- jitter: σ = JITTER · side + MOTION · |velocity a frame| (blur), × HIDDEN where the keypoint is not seen. 60 % of its
  variance is correlated in time (AR(1), ρ = 0.85), the rest is white;
- gross outliers, in runs of some frames: the keypoint lands on a neighbour's of that name as that was detected, or
  somewhere in the box, and stays there while the run lasts;
- left and right swapped, for all pairs of a bird or for one, in runs;
- missing keypoints, mostly hidden ones, and whole frames without a detection, in runs;
- confidence falls with the jitter that was made, and most outliers are doubted, but through noise: swaps and some
  outliers are trusted, some right points are not;
- masks: of the visible part, eroded or grown by an amount that drifts, with ragged borders, now and then torn at
  the tips, and now and then merged with a touching neighbour.

Rates hold for keypoints in the picture. What it leaves out: tracks are the true ones, without exchanged identities,
false or double birds; confidence follows the error that was made more closely than a network's would.

The figures are estimates of what networks for animals do on video, not measured on any; they were set before anything
was fitted to what they give.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import cv2
import numpy as np
from jaxtyping import Bool, Float

from jaxfit.data.masks import box_of_mask, encode_patch
from jaxfit.data.observations import Observations

__all__ = ["detect_noisily"]

JITTER, MOTION, HIDDEN = 0.012, 0.15, 2.5
CORRELATED, RHO = 0.6, 0.85
OUTLIERS_SEEN, OUTLIERS_HIDDEN, OUTLIERS_DOUBTED, STOLEN = 0.015, 0.06, 0.65, 0.4
SWAPS_ALL, SWAPS_ONE = 0.008, 0.006
MISSING_SEEN, MISSING_HIDDEN, MISSING_FRAMES = 0.015, 0.35, 0.012
GRAIN = 0.04
"""Size of the border's bumps as a share of the side."""
RUN_FRAMES = 4.0
"""Mean length of a run of outliers, swaps, gaps or mergers."""
ERODED, DRIFT, RAGGED, MERGED = 0.005, 0.007, 0.01, 0.02
"""Shares of the side: the border's mean inset, its drift over time, its raggedness; share of frames that may merge."""


def detect_noisily(
    truth: Observations,
    seen: Bool[np.ndarray, "N T K"],
    keypoint_pairs: Sequence[tuple[int, int]],
    seed: int,
) -> Observations:
    """Observations as detectors would give them of true ones.

    Args:
        truth: exact keypoints, boxes and visible masks.
        seen: whether the camera sees the keypoint.
        keypoint_pairs: (left, right).
        seed: the same seed gives the same faults.
    """
    rng = np.random.default_rng((seed, 3))
    N, T, K = truth.confidence.shape
    labelled = truth.confidence > 0
    exact = truth.keypoints_px.astype(np.float64)
    side = np.where(truth.present, truth.box_px[..., 2:].max(-1), 1.0)[..., None]
    moved = np.zeros((N, T, K))
    moved[:, 1:] = np.where(labelled[:, 1:] & labelled[:, :-1], np.linalg.norm(np.diff(exact, axis=1), axis=-1), 0)
    sigma = (JITTER * side + MOTION * np.minimum(moved, 0.2 * side)) * np.where(seen, 1, HIDDEN)
    points = exact + sigma[..., None] * _jitter(rng, (N, T, K, 2))
    error = np.linalg.norm(points - exact, axis=-1) / side

    everybody = _runs(rng, SWAPS_ALL, (N, T))
    for left, right in keypoint_pairs:
        both = labelled[:, :, left] & labelled[:, :, right]
        when = ((everybody | _runs(rng, SWAPS_ONE, (N, T))) & both)[..., None]
        a, b = points[:, :, left], points[:, :, right]
        points[:, :, left], points[:, :, right] = np.where(when, b, a), np.where(when, a, b)

    wrong = _runs(rng, np.where(seen, OUTLIERS_SEEN, OUTLIERS_HIDDEN), (N, T, K))
    points = np.where(wrong[..., None], _elsewhere(rng, truth, points, wrong), points)
    doubted = wrong & (_held(rng.random((N, T, K)), wrong) < OUTLIERS_DOUBTED)
    trust = 2.2 - 22 * error - 0.9 * ~seen - 2.6 * doubted + 0.8 * rng.normal(size=(N, T, K))
    confidence = 1 / (1 + np.exp(-trust))
    missing = _runs(rng, np.where(seen, MISSING_SEEN, MISSING_HIDDEN), (N, T, K)) | (confidence < 0.08)
    # a detector finds a bird by what is to be seen of it
    area = np.array([[_area(truth, n, t) for t in range(T)] for n in range(N)])
    found = truth.present & ~_runs(rng, MISSING_FRAMES, (N, T)) & (area > 0.02 * side[..., 0] ** 2)
    confidence = np.where(labelled & ~missing & found[..., None], confidence, 0)

    masks, boxes = _masks(rng, truth, found)
    found &= boxes[..., 2] > 0
    confidence = np.where(found[..., None], confidence, 0)
    return Observations(
        track_id=truth.track_id,
        frame_index=truth.frame_index,
        present=found,
        keypoints_px=points.astype(np.float32),
        confidence=confidence.astype(np.float32),
        box_px=boxes,
        image_size_px=truth.image_size_px,
        file_name=truth.file_name,
        keypoint_names=truth.keypoint_names,
        skeleton=truth.skeleton,
        masks=masks,
    )


def _jitter(rng: np.random.Generator, shape: tuple[int, ...]) -> Float[np.ndarray, "N T *rest"]:
    """Unit noise, part of it correlated from frame to frame."""
    slow = rng.normal(size=shape)
    for t in range(1, shape[1]):
        slow[:, t] = RHO * slow[:, t - 1] + np.sqrt(1 - RHO**2) * slow[:, t]
    return np.sqrt(CORRELATED) * slow + np.sqrt(1 - CORRELATED) * rng.normal(size=shape)


def _runs(rng: np.random.Generator, rate, shape: tuple[int, ...]) -> Bool[np.ndarray, "N T *rest"]:
    """Events along the second axis that hold `rate` of the time in runs of about RUN_FRAMES."""
    rate = np.broadcast_to(rate, shape)
    begins = rng.random(shape) < rate / (RUN_FRAMES * (1 - rate) + rate)
    stays = rng.random(shape) < 1 - 1 / RUN_FRAMES
    on = begins.copy()
    on[:, 0] = rng.random((shape[0], *shape[2:])) < rate[:, 0]
    for t in range(1, shape[1]):
        on[:, t] |= on[:, t - 1] & stays[:, t]
    return on


def _held(values: np.ndarray, on: Bool[np.ndarray, "N T K"]) -> np.ndarray:
    """Values (N, T, K, …) that stay the same for as long as a run goes on."""
    held = values.copy()
    for t in range(1, on.shape[1]):
        goes_on = (on[:, t] & on[:, t - 1]).reshape(*on[:, t].shape, *[1] * (values.ndim - 3))
        held[:, t] = np.where(goes_on, held[:, t - 1], held[:, t])
    return held


def _elsewhere(
    rng: np.random.Generator, truth: Observations, points: Float[np.ndarray, "N T K 2"], wrong: np.ndarray
) -> Float[np.ndarray, "N T K 2"]:
    """Where outliers land: on the nearest neighbour's keypoint as it was detected, or anywhere in the own box."""
    N, T, K = wrong.shape
    low, size = truth.box_px[..., None, :2], truth.box_px[..., None, 2:]
    anywhere = low + _held(rng.uniform(-0.1, 1.1, points.shape), wrong) * size
    if N < 2:
        return anywhere
    centre = truth.box_px[..., :2] + truth.box_px[..., 2:] / 2
    distance = np.linalg.norm(centre[:, None] - centre[None], axis=-1)  # N N T
    distance = np.where(truth.present[None] & ~np.eye(N, dtype=bool)[..., None], distance, np.inf)
    nearest, frames = distance.argmin(1), np.arange(T)  # N T
    near = np.take_along_axis(distance, nearest[:, None], 1)[:, 0] < 1.5 * truth.box_px[..., 2:].max(-1)
    to_be_taken = near[..., None] & (truth.confidence > 0)[nearest, frames]
    stolen = (_held(rng.random((N, T, K)), wrong) < STOLEN) & to_be_taken
    return np.where(stolen[..., None], points[nearest, frames], anywhere)


def _area(truth: Observations, n: int, t: int) -> float:
    from pycocotools import mask as coco_mask

    rle = truth.masks.get((n, t))
    return 0.0 if rle is None else float(coco_mask.area(cast(Any, rle)))


def _masks(rng: np.random.Generator, truth: Observations, found: np.ndarray):
    """Masks with drifting, ragged borders, and their boxes (x, y, width, height)."""
    N, T = found.shape
    drift = _jitter(rng, (N, T))
    merged = _runs(rng, MERGED, (N, T))
    boxes = np.zeros((N, T, 4), np.float32)
    masks = {}
    for n, t in np.argwhere(found).tolist():
        mask = truth.mask(n, t)
        if mask is None:
            continue
        side = float(truth.box_px[n, t, 2:].max())
        if merged[n, t]:
            mask = _with_neighbour(truth, n, t, mask, max(2, int(0.02 * side)))
        margin = int(0.08 * side) + 4
        x, y, width, height = cast(tuple[int, int, int, int], box_of_mask(mask))
        top, bottom = max(y - margin, 0), min(y + height + margin, mask.shape[0])
        left, right = max(x - margin, 0), min(x + width + margin, mask.shape[1])
        part = np.ascontiguousarray(mask[top:bottom, left:right]).astype(np.uint8)
        # signed distance to the border, moved by the drift and by smooth noise: thin tips get lost
        inside = cv2.distanceTransform(part, cv2.DIST_L2, 3) - cv2.distanceTransform(1 - part, cv2.DIST_L2, 3)
        patch = max(2, round(GRAIN * side))
        field = rng.normal(size=[4 + length // patch for length in part.shape]).astype(np.float32)
        field = cv2.resize(field, part.shape[::-1], interpolation=cv2.INTER_CUBIC)
        reported = inside + side * (DRIFT * drift[n, t] - ERODED + RAGGED * field) > 0
        box = box_of_mask(reported)
        if box is None:
            continue
        boxes[n, t] = left + box[0], top + box[1], *box[2:]
        masks[n, t] = encode_patch(reported, left, top, mask.shape[1], mask.shape[0])
    return masks, boxes


def _with_neighbour(truth: Observations, n: int, t: int, mask: np.ndarray, reach_px: int) -> np.ndarray:
    """The mask together with the first neighbour's that touches it."""
    grown = cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach_px + 1,) * 2, np.uint8)) > 0
    for other in range(truth.num_tracks):
        theirs = truth.mask(other, t) if other != n else None
        if theirs is not None and (grown & theirs).any():
            return mask | theirs
    return mask
