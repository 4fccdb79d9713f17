"""Noise of detectors: the full model, and simple noisy detections of posed birds.

The model of the errors, per bird (side is the longer side of its box, in pixels):

- jitter: σ = JITTER · side + MOTION · |velocity per frame| (blur), times OCCLUDED for an occluded keypoint. 60 % of the
  variance is correlated in time (AR(1), ρ = 0.85), the rest is white;
- gross outliers in runs of frames: the keypoint lies on the detected keypoint of the same name of a neighbour, or at a
  random position in the box, and stays there during the run;
- left-right flips in runs, of all pairs of a bird or of one pair;
- missing keypoints, mostly occluded keypoints, and frames without a detection, in runs;
- confidences that decrease with the jitter and are low for most outliers, with noise: flips and some outliers have a
  high confidence, and some correct keypoints a low confidence;
- masks of the visible part, with a border that is eroded or dilated by a drifting amount and is ragged. Thin tips may
  be lost, and a mask may merge with that of a touching neighbour.

The rates apply to keypoints in the picture. Not simulated: exchanged identities, false detections, duplicates. The
confidence depends on the error more closely than that of a network.

The parameters are estimates for animal pose networks on video, not measurements. They were chosen before any fit to
these detections.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import cv2
import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfit.data.masks import box_of_mask, encode_mask, encode_patch
from jaxfit.data.observations import Observations
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CropCamera, project, to_screen
from jaxfit.model.kinematics import Pose, Rig, fold_bird, window_keypoints, window_transforms, window_vertices
from jaxfit.raster.zbuffer import hard_mask

JITTER, MOTION, OCCLUDED = 0.012, 0.15, 2.5
CORRELATED, RHO = 0.6, 0.85
OUTLIERS_VISIBLE, OUTLIERS_OCCLUDED, OUTLIERS_LOW_CONFIDENCE, OUTLIERS_ON_NEIGHBOUR = 0.015, 0.06, 0.65, 0.4
FLIPS_ALL, FLIPS_ONE = 0.008, 0.006
MISSING_VISIBLE, MISSING_OCCLUDED, MISSING_FRAMES = 0.015, 0.35, 0.012
BORDER_WAVELENGTH = 0.04
"""Size of the irregularities of a mask's border, as a share of the side."""
RUN_FRAMES = 4.0
"""Mean length of a run of outliers, flips, missing detections or merged masks, frames."""
ERODED, DRIFT, RAGGED, MERGED = 0.005, 0.007, 0.01, 0.02
"""Mask border: mean erosion, drift and raggedness as shares of the side. Last: share of frames that may merge."""


def simulate_detections(
    truth: Observations,
    visible: Bool[np.ndarray, "N T K"],
    keypoint_pairs: Sequence[tuple[int, int]],
    seed: int,
) -> Observations:
    """Simulate the detections of true observations.

    Args:
        truth: exact keypoints, boxes and visible masks.
        visible: whether a keypoint is visible.
        keypoint_pairs: pairs (left, right) of keypoint indices.
        seed: seed of the errors.
    """
    rng = np.random.default_rng((seed, 3))
    N, T, K = truth.confidence.shape
    labelled = truth.confidence > 0
    exact = truth.keypoints_px.astype(np.float64)
    side = np.where(truth.present, truth.box_px[..., 2:].max(-1), 1.0)[..., None]
    moved = np.zeros((N, T, K))
    moved[:, 1:] = np.where(labelled[:, 1:] & labelled[:, :-1], np.linalg.norm(np.diff(exact, axis=1), axis=-1), 0)
    sigma = (JITTER * side + MOTION * np.minimum(moved, 0.2 * side)) * np.where(visible, 1, OCCLUDED)
    points = exact + sigma[..., None] * _jitter(rng, (N, T, K, 2))
    error = np.linalg.norm(points - exact, axis=-1) / side

    all_pairs = _runs(rng, FLIPS_ALL, (N, T))
    for left, right in keypoint_pairs:
        both = labelled[:, :, left] & labelled[:, :, right]
        when = ((all_pairs | _runs(rng, FLIPS_ONE, (N, T))) & both)[..., None]
        a, b = points[:, :, left], points[:, :, right]
        points[:, :, left], points[:, :, right] = np.where(when, b, a), np.where(when, a, b)

    is_outlier = _runs(rng, np.where(visible, OUTLIERS_VISIBLE, OUTLIERS_OCCLUDED), (N, T, K))
    points = np.where(is_outlier[..., None], _outlier_positions(rng, truth, points, is_outlier), points)
    low_confidence = is_outlier & (_hold_during_runs(rng.random((N, T, K)), is_outlier) < OUTLIERS_LOW_CONFIDENCE)
    logit = 2.2 - 22 * error - 0.9 * ~visible - 2.6 * low_confidence + 0.8 * rng.normal(size=(N, T, K))
    confidence = 1 / (1 + np.exp(-logit))
    missing = _runs(rng, np.where(visible, MISSING_VISIBLE, MISSING_OCCLUDED), (N, T, K)) | (confidence < 0.08)
    # birds with a small visible area are not detected
    area = np.array([[_visible_area(truth, n, t) for t in range(T)] for n in range(N)])
    detected = truth.present & ~_runs(rng, MISSING_FRAMES, (N, T)) & (area > 0.02 * side[..., 0] ** 2)
    confidence = np.where(labelled & ~missing & detected[..., None], confidence, 0)

    masks, boxes = _masks(rng, truth, detected)
    detected &= boxes[..., 2] > 0
    confidence = np.where(detected[..., None], confidence, 0)
    return Observations(
        track_id=truth.track_id,
        frame_index=truth.frame_index,
        present=detected,
        keypoints_px=points.astype(np.float32),
        confidence=confidence.astype(np.float32),
        box_px=boxes,
        image_size_px=truth.image_size_px,
        file_name=truth.file_name,
        keypoint_names=truth.keypoint_names,
        skeleton=truth.skeleton,
        masks=masks,
        timestamp_s=truth.timestamp_s,
        fps=truth.fps,
    )


def _jitter(rng: np.random.Generator, shape: tuple[int, ...]) -> Float[np.ndarray, "N T *rest"]:
    """Draw noise of unit variance, partly correlated between frames."""
    correlated = autoregressive(rng, shape, RHO)
    return np.sqrt(CORRELATED) * correlated + np.sqrt(1 - CORRELATED) * rng.normal(size=shape)


def autoregressive(rng: np.random.Generator, shape: tuple[int, ...], rho: float) -> Float[np.ndarray, "N T *rest"]:
    """Draw normal noise of unit variance, AR(1) along the second axis: z_t = ρ·z_{t−1} + √(1 − ρ²)·w_t."""
    noise = rng.normal(size=shape)
    for t in range(1, shape[1]):
        noise[:, t] = rho * noise[:, t - 1] + np.sqrt(1 - rho**2) * noise[:, t]
    return noise


def _runs(rng: np.random.Generator, rate, shape: tuple[int, ...]) -> Bool[np.ndarray, "N T *rest"]:
    """Draw events along the second axis that cover the share `rate` of the frames, in runs of about RUN_FRAMES."""
    rate = np.broadcast_to(rate, shape)
    begins = rng.random(shape) < rate / (RUN_FRAMES * (1 - rate) + rate)
    stays = rng.random(shape) < 1 - 1 / RUN_FRAMES
    on = begins.copy()
    on[:, 0] = rng.random((shape[0], *shape[2:])) < rate[:, 0]
    for t in range(1, shape[1]):
        on[:, t] |= on[:, t - 1] & stays[:, t]
    return on


def _hold_during_runs(values: np.ndarray, on: Bool[np.ndarray, "N T K"]) -> np.ndarray:
    """Hold values (N, T, K, …) constant during each run."""
    held = values.copy()
    for t in range(1, on.shape[1]):
        continues = (on[:, t] & on[:, t - 1]).reshape(*on[:, t].shape, *[1] * (values.ndim - 3))
        held[:, t] = np.where(continues, held[:, t - 1], held[:, t])
    return held


def _outlier_positions(
    rng: np.random.Generator, truth: Observations, points: Float[np.ndarray, "N T K 2"], is_outlier: np.ndarray
) -> Float[np.ndarray, "N T K 2"]:
    """Draw outliers: the detected keypoint of the nearest neighbour, or a random position in the own box."""
    N, T, K = is_outlier.shape
    low, size = truth.box_px[..., None, :2], truth.box_px[..., None, 2:]
    in_own_box = low + _hold_during_runs(rng.uniform(-0.1, 1.1, points.shape), is_outlier) * size
    if N < 2:
        return in_own_box
    centre = truth.box_px[..., :2] + truth.box_px[..., 2:] / 2
    distance = np.linalg.norm(centre[:, None] - centre[None], axis=-1)  # N N T
    distance = np.where(truth.present[None] & ~np.eye(N, dtype=bool)[..., None], distance, np.inf)
    nearest, frames = distance.argmin(1), np.arange(T)  # N T
    near = np.take_along_axis(distance, nearest[:, None], 1)[:, 0] < 1.5 * truth.box_px[..., 2:].max(-1)
    has_neighbour = near[..., None] & (truth.confidence > 0)[nearest, frames]
    on_neighbour = (_hold_during_runs(rng.random((N, T, K)), is_outlier) < OUTLIERS_ON_NEIGHBOUR) & has_neighbour
    return np.where(on_neighbour[..., None], points[nearest, frames], in_own_box)


def _visible_area(truth: Observations, n: int, t: int) -> float:
    from pycocotools import mask as coco_mask

    rle = truth.masks.get((n, t))
    return 0.0 if rle is None else float(coco_mask.area(cast(Any, rle)))


def _masks(rng: np.random.Generator, truth: Observations, detected: np.ndarray):
    """Simulate masks with drifting, ragged borders; return masks and boxes (x, y, width, height)."""
    N, T = detected.shape
    drift = _jitter(rng, (N, T))
    merged = _runs(rng, MERGED, (N, T))
    boxes = np.zeros((N, T, 4), np.float32)
    masks = {}
    for n, t in np.argwhere(detected).tolist():
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
        # signed distance to the border plus drift and smooth noise; thin tips may be lost
        inside = cv2.distanceTransform(part, cv2.DIST_L2, 3) - cv2.distanceTransform(1 - part, cv2.DIST_L2, 3)
        patch = max(2, round(BORDER_WAVELENGTH * side))
        field = rng.normal(size=[4 + length // patch for length in part.shape]).astype(np.float32)
        field = cv2.resize(field, part.shape[::-1], interpolation=cv2.INTER_CUBIC)
        simulated = inside + side * (DRIFT * drift[n, t] - ERODED + RAGGED * field) > 0
        box = box_of_mask(simulated)
        if box is None:
            continue
        boxes[n, t] = left + box[0], top + box[1], *box[2:]
        masks[n, t] = encode_patch(simulated, left, top, mask.shape[1], mask.shape[0])
    return masks, boxes


def _with_neighbour(truth: Observations, n: int, t: int, mask: np.ndarray, reach_px: int) -> np.ndarray:
    """Merge the mask with the mask of the first bird that touches it."""
    dilated = cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach_px + 1,) * 2, np.uint8)) > 0
    for other in range(truth.num_tracks):
        other_mask = truth.mask(other, t) if other != n else None
        if other_mask is not None and (dilated & other_mask).any():
            return mask | other_mask
    return mask


@jax.jit  # one program is compiled faster than a hundred operations
def _on_screen(rig: Rig, pose: Pose, camera: CropCamera) -> tuple[Float[Array, "T K 2"], Float[Array, "T V 3"]]:
    """Return the keypoints in pixels, and the vertices in pixels and depth."""
    A = window_transforms(rig, pose)
    return project(window_keypoints(rig, A, pose), camera), to_screen(window_vertices(rig, A, pose), camera)


def detect(
    bird: Bird,
    poses: Sequence[Pose],
    noise_px: float = 0.0,
    outliers: float = 0.0,
    seed: int = 0,
    masks: bool = True,
    camera: CropCamera = CropCamera(),
) -> Observations:
    """Simulate observations of several birds in one square image, without occlusion between birds.

    Args:
        bird: the model.
        poses: one window (T frames) per bird, camera frame.
        noise_px: standard deviation of x and y of each keypoint, pixels.
        outliers: share of keypoints with a uniformly random position in the image; their confidence is 1.
        seed: seed of the noise.
        masks: whether to render masks; masks are amodal.
        camera: the camera of the image.
    """
    rng = np.random.default_rng(seed)
    rig = fold_bird(bird)
    size, frames = camera.size_px, poses[0].global_orient.shape[0]
    keypoints_px, boxes, rle = [], [], {}
    for n, pose in enumerate(poses):
        projected, screen = map(np.asarray, _on_screen(rig, pose, camera))
        points = projected.astype(np.float64)
        points = points + rng.normal(size=points.shape) * noise_px
        is_outlier = rng.random(points.shape[:2]) < outliers
        keypoints_px.append(np.where(is_outlier[..., None], rng.uniform(0, size, points.shape), points))
        low, high = screen[..., :2].min(1), screen[..., :2].max(1)
        boxes.append(np.concatenate([low, high - low], axis=-1))
        if masks:
            for t in range(frames):
                rle[n, t] = encode_mask(hard_mask(screen[t], bird.faces, size, size))
    return Observations(
        track_id=np.arange(len(poses)),
        frame_index=np.arange(frames),
        present=np.ones((len(poses), frames), bool),
        keypoints_px=np.asarray(keypoints_px),
        confidence=np.ones((len(poses), frames, bird.num_keypoints)),
        box_px=np.asarray(boxes),
        image_size_px=np.full((frames, 2), size),
        file_name=np.array([f"{t:06d}.png" for t in range(frames)]),
        keypoint_names=bird.keypoint_names,
        masks=rle,
    )
