"""Check of calibrated cameras against observations: reprojection errors, and which camera is wrong, and how.

Tried in this order: another order of the cameras, an offset in time of one camera, another pose of one camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, permutations
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.triangulation import (
    epipolar_error_px,
    fundamental_matrix,
    reprojection_error_px,
)
from jaxfit.data.observations import Observations
from jaxfit.data.view_matching import BirdMatches, pair_costs
from jaxfit.data.views import MAX_ERROR, ViewKeypoints, Views, stacked_keypoints

UNMATCHED = 0.5
"""Cost of a bird without a partner in another camera, relative to the side of its box."""
CLEARLY_BETTER = 0.6
"""A change explains an inconsistency if it lowers the cost below this share."""
CLEAR_SHIFT, CLEAR_SHARE = 3.0, 0.01
"""A camera has moved if its other pose shifts the keypoints by more than this multiple of their remaining error, and by
more than this share of the side of the box. A smaller error of moving keypoints is no sign of an offset in time."""
MAX_OFFSET = 10
"""Largest offset in time that is tried, frames."""
MAX_PERMUTED = 5
"""Up to this number of cameras, all orders are tried; with more cameras, all exchanges of two."""
SAMPLED_FRAMES = 60
SPEED_FRAMES, FASTEST = 2, 0.9
"""The speed of a keypoint is measured over this many frames before and after; the quantile of the speeds above which a
keypoint counts for offsets in time."""
MIN_POINTS = 60
"""Keypoints of a camera that are needed to estimate its pose."""


class CameraCheck(NamedTuple):
    """Errors of the detected keypoints from the triangulated keypoints, pixels without distortion."""

    by_camera: dict[str, Float[np.ndarray, "3"]]
    """Camera → median error in pixels, median relative to the side of the box, share of keypoints that agree."""
    by_keypoint: dict[str, Float[np.ndarray, "2"]]
    """Keypoint → median error in pixels, share that agrees."""
    findings: list[str]
    """What is wrong, in sentences; empty if nothing was found."""


def check_cameras(
    views: Views,
    unmatched: Sequence[Observations],
    matches: BirdMatches,
    offset_frames: Sequence[float] | None = None,
    step_frames: Sequence[float] | None = None,
) -> CameraCheck:
    """Check cameras.

    Args:
        views: cameras and birds, as for a fit.
        unmatched: the tracks of the cameras before they were matched, in the frames of the first camera.
        matches: the matches of the tracks.
        offset_frames: the offsets with which the cameras were brought to common frames. None: 0.
        step_frames: for each camera, the number of its frames between two common frames (`own_steps`). None: 1.
    """
    cameras = views.cameras
    findings = _order(cameras, unmatched) or (
        _offsets(views, offset_frames or [0.0] * len(cameras), step_frames or [1.0] * len(cameras))
        if matches.birds
        else []
    )
    tables = _errors(views) if matches.birds else ({}, {})
    if not findings and matches.birds and len(cameras) > 2:
        findings = _moved(views)
    if not findings and not matches.birds:
        findings = ["no track of one camera agrees with a track of another camera: the calibration is of other cameras"]
    return CameraCheck(*tables, findings)


def consistency(cameras: Sequence[Camera], observations: Sequence[Observations]) -> float:
    """Return the median cost of the best one-to-one match of tracks, as a mean over pairs of cameras.

    Args:
        cameras, observations: V cameras without distortion, and their tracks in common frames.
    """
    frames = np.unique(np.linspace(0, observations[0].num_frames - 1, SAMPLED_FRAMES).astype(int))
    costs = []
    for i, j in combinations(range(len(cameras)), 2):
        cost = pair_costs((cameras[i], cameras[j]), (observations[i], observations[j]), frames)
        cost = np.where(np.isfinite(cost), np.minimum(cost, UNMATCHED), UNMATCHED)
        if cost.size:
            costs.append(float(np.median(cost[linear_sum_assignment(cost)])))
    return float(np.mean(costs)) if costs else UNMATCHED


def _order(cameras: Sequence[Camera], observations: Sequence[Observations]) -> list[str]:
    """Try other orders of the cameras."""
    now, count = consistency(cameras, observations), len(cameras)
    if count <= MAX_PERMUTED:
        orders = list(permutations(range(count)))[1:]
    else:
        orders = []
        for i, j in combinations(range(count), 2):
            order = list(range(count))
            order[i], order[j] = j, i
            orders.append(tuple(order))
    scores = {order: consistency([cameras[v] for v in order], observations) for order in orders}
    best = min(scores, key=scores.__getitem__)
    if scores[best] > min(CLEARLY_BETTER * now, MAX_ERROR):
        return []
    names = ", ".join(cameras[v].name for v in best)
    text = f"the order of the cameras is wrong: the files fit the cameras {names}, in this order"
    return [f"{text} (error {now:.2f} → {scores[best]:.3f} of the birds' size)"]


def _offsets(views: Views, given: Sequence[float], steps: Sequence[float]) -> list[str]:
    """Try offsets in time of one camera, with the keypoints that move fastest: birds at rest show no offset."""
    px, confidence, side = stacked_keypoints(views.observations)
    T = px.shape[2]
    most = min(MAX_OFFSET, T // 4)
    if most <= SPEED_FRAMES:
        return []
    frames, found = np.arange(most, T - most), []
    speed = np.zeros(confidence.shape)
    speed[:, :, SPEED_FRAMES:-SPEED_FRAMES] = np.linalg.norm(
        px[:, :, 2 * SPEED_FRAMES :] - px[:, :, : -2 * SPEED_FRAMES], axis=-1
    )
    for i in range(2 * SPEED_FRAMES + 1):  # all positions of the movement must be known
        shifted = np.roll(confidence, SPEED_FRAMES - i, axis=2)
        speed = np.where(shifted > 0, speed, 0)
    speed /= side
    for v, camera in enumerate(views.cameras):
        errors: dict[int, list[np.ndarray]] = {offset: [] for offset in range(-most, most + 1)}
        for w, other in enumerate(views.cameras):
            if w == v:
                continue
            F = fundamental_matrix(other, camera)
            known = speed[w][:, frames] > 0
            if known.sum() < MIN_POINTS:
                continue
            moving = known & (speed[w][:, frames] >= np.quantile(speed[w][:, frames][known], FASTEST))
            for offset, own in errors.items():
                seen = moving & (confidence[v][:, frames + offset] > 0)
                error_px = epipolar_error_px(F, px[w][:, frames][seen], px[v][:, frames + offset][seen])
                own.append(error_px / side[v][:, frames + offset][seen])
        scores = {offset: float(np.median(np.concatenate(own))) for offset, own in errors.items() if own}
        if scores:
            best = min(scores, key=scores.__getitem__)
            if best and scores[0] > CLEAR_SHARE and scores[best] < CLEARLY_BETTER * scores[0]:
                found.append((scores[best] / scores[0], v, best, scores))
    if not found:
        return []
    _, v, best, scores = min(found, key=lambda each: each[0])
    count = len(views.cameras)
    # an offset of the first camera is one of all others
    moved = [0, *[-best] * (count - 1)] if v == 0 else [best if w == v else 0 for w in range(count)]
    option = ",".join(f"{each + move * step:.6g}" for each, move, step in zip(given, moved, steps, strict=True))
    text = f"camera {views.cameras[v].name} is {abs(best) * steps[v]:.6g} frames {'late' if best > 0 else 'early'}"
    text += f": --offsets {option}"
    return [f"{text} (error of moving keypoints {scores[0]:.3f} → {scores[best]:.3f} of the birds' size)"]


def _errors(views: Views) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    keypoints = stacked_keypoints(views.observations)
    found = keypoints.triangulated(views.cameras)
    by_camera, by_keypoint = {}, {}
    compared = (keypoints.confidence > 0) & np.isfinite(found.error_px)
    for v, camera in enumerate(views.cameras):
        own = compared[v]
        if own.any():
            error = found.error_px[v][own]
            by_camera[camera.name] = np.array(
                [np.median(error), np.median(error / keypoints.side_px[v][own]), found.agrees[v][own].mean()]
            )
    for k, name in enumerate(views.observations[0].keypoint_names):
        own = compared[..., k]
        if own.any():
            by_keypoint[name] = np.array([np.median(found.error_px[..., k][own]), found.agrees[..., k][own].mean()])
    return by_camera, by_keypoint


def _mean_error(cameras: Sequence[Camera], keypoints: ViewKeypoints) -> float:
    """Return the mean error of all keypoints, relative to the side of the box; at most `MAX_ERROR` each.

    A wrong pose of one camera can explain the keypoints of this camera, but not those of the others.
    """
    relative, seen = keypoints.triangulated(cameras).error_px / keypoints.side_px, keypoints.confidence > 0
    error = np.where(np.isfinite(relative), np.minimum(relative, MAX_ERROR), MAX_ERROR)
    return float(error[seen & (seen.sum(axis=0) > 1)].mean())


def _moved(views: Views) -> list[str]:
    """Estimate the pose of each camera from keypoints that the other cameras triangulate."""
    keypoints, found = stacked_keypoints(views.observations), []
    for v, camera in enumerate(views.cameras):
        others = [w for w in range(len(views.cameras)) if w != v]
        rest = keypoints.of_views(others).triangulated([views.cameras[w] for w in others])
        known = np.isfinite(rest.points_world).all(-1) & (keypoints.confidence[v] > 0)
        if known.sum() < MIN_POINTS:
            continue
        points, shown = rest.points_world[known], keypoints.px[v][known]
        before = float(np.median(reprojection_error_px([camera], points, shown[None])))
        centre = points.mean(axis=0)
        rvec, tvec = cv2.Rodrigues(camera.R_cam_world)[0], camera.transl_cam + camera.R_cam_world @ centre
        tolerance = 2 * float(np.median(keypoints.side_px[v][known])) * MAX_ERROR
        solved, rvec, tvec, _ = cv2.solvePnPRansac(
            points - centre, shown, camera.matrix, None, rvec.copy(), tvec.copy()[:, None], True, 300, tolerance
        )
        if not solved:
            continue
        R = cv2.Rodrigues(rvec)[0]
        new = replace(camera, R_cam_world=R, transl_cam=tvec[:, 0] - R @ centre)
        after = float(np.median(reprojection_error_px([new], points, shown[None])))
        # the errors of the keypoints alone move the estimated pose too
        shift_px = float(np.median(reprojection_error_px([new], points, camera.project(points)[None])))
        least_px = max(CLEAR_SHIFT * after, CLEAR_SHARE * float(np.median(keypoints.side_px[v][known])))
        if after < CLEARLY_BETTER * before and shift_px > least_px:
            corrected = [new if w == v else each for w, each in enumerate(views.cameras)]
            found.append((_mean_error(corrected, keypoints), camera, new, before, after))
    if not found:
        return []
    _, camera, new, before, after = min(found, key=lambda each: each[0])
    moved_m = float(np.linalg.norm(new.position_world - camera.position_world))
    turn_deg = float(np.degrees(Rotation.from_matrix(new.R_cam_world @ camera.R_cam_world.T).magnitude()))
    text = f"camera {camera.name} is not where its calibration says: it seems to have moved by {100 * moved_m:.1f} cm"
    return [f"{text} and turned by {turn_deg:.1f}° (median error {before:.1f} → {after:.1f} px): calibrate it again"]
