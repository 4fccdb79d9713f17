"""Points of the world from their pixels in several cameras, and consistency of pixels of two cameras.

All pixels here are without distortion (`Camera.undistort`). Errors are in pixels of the camera that sees the point.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.cameras.camera import Camera

MIN_ANGLE_DEG = 1.0
"""Rays that meet at a smaller angle do not determine a point."""
PRIOR_FREEDOM = 10.0
"""Degrees of freedom that the pixel errors of all keypoints of a bird are worth for one keypoint."""


class Triangulated(NamedTuple):
    """Points of the world, and the views that agree with them."""

    points_world: Float[np.ndarray, "*B 3"]
    """Metres; NaN where fewer than two views agree."""
    agrees: Bool[np.ndarray, "V *B"]
    """Whether the pixel of a view agrees with the point, so that the point uses this pixel."""
    error_px: Float[np.ndarray, "V *B"]
    """Distance of the pixel of each view from the projected point; NaN without a point, or without a pixel."""


def reprojection_error_px(
    cameras: Sequence[Camera], points_world: Float[np.ndarray, "*B 3"], points_px: Float[np.ndarray, "V *B 2"]
) -> Float[np.ndarray, "V *B"]:
    """Return the distance of pixels from projected points; NaN for points behind a camera."""
    shown = np.stack([camera.pinhole().project(points_world) for camera in cameras])
    return np.linalg.norm(shown - points_px, axis=-1)


def triangulate(
    cameras: Sequence[Camera], points_px: Float[np.ndarray, "V *B 2"], weight: Float[np.ndarray, "V *B"]
) -> Float[np.ndarray, "*B 3"]:
    """Return the points that agree best with their pixels, by the weighted direct linear transform.

    A view with pixel (u, v) on the plane z = 1 and rows P₁, P₂, P₃ of [R | t] gives the equations (u·P₃ − P₁)·X = 0 and
    (v·P₃ − P₂)·X = 0, times the focal length and the weight. X is the homogeneous point with the least sum of squares.

    Args:
        cameras: V cameras.
        points_px: pixels without distortion; any value where the weight is 0.
        weight: 0 or more.

    Returns:
        Points of the world, metres; NaN where fewer than two views have a weight, or where the rays are parallel.

    Source: Hartley and Zisserman 2004, *Multiple View Geometry*, section 12.2.
    """
    centre = np.mean([camera.position_world for camera in cameras], axis=0)  # numbers near 0 round less
    normal = np.zeros((*weight.shape[1:], 4, 4))
    for camera, px, w in zip(cameras, np.asarray(points_px, np.float64), weight, strict=True):
        px = np.where(w[..., None] > 0, px, 0)
        rays = camera.pinhole().rays_cam(px)
        plane = rays[..., :2] / rays[..., 2:]
        P = np.concatenate([camera.R_cam_world, (camera.transl_cam + camera.R_cam_world @ centre)[:, None]], axis=1)
        focal_px = np.array([camera.matrix[0, 0], camera.matrix[1, 1]])
        rows = (plane[..., None] * P[2] - P[:2]) * (focal_px[:, None] * w[..., None, None])
        normal += np.einsum("...ri,...rj->...ij", rows, rows)
    enough = (weight > 0).sum(axis=0) >= 2
    normal[~enough] = np.eye(4)
    _, vectors = np.linalg.eigh(normal)
    X = vectors[..., 0]
    far = np.abs(X[..., 3:]) < 1e-9 * np.linalg.norm(X[..., :3], axis=-1, keepdims=True)
    points = X[..., :3] / np.where(far, 1, X[..., 3:]) + centre
    return np.where(enough[..., None] & ~far, points, np.nan)


def triangulate_robustly(
    cameras: Sequence[Camera],
    points_px: Float[np.ndarray, "V *B 2"],
    weight: Float[np.ndarray, "V *B"],
    tolerance_px: Float[np.ndarray, "V *B"],
) -> Triangulated:
    """Triangulate points of which some pixels are wrong: random sample consensus over all pairs of views.

    Every pair of views proposes a point. The views that agree with it to the tolerance support it with their weights.
    The point with the most support is triangulated again from these views.

    Args:
        cameras, points_px, weight: as for `triangulate`.
        tolerance_px: largest reprojection error of a pixel that agrees.

    Source: Fischler and Bolles 1981, *Random sample consensus*; with few views, all samples are drawn.
    """
    V, shape = len(cameras), weight.shape[1:]
    best = np.zeros(shape)
    agrees = np.zeros(weight.shape, bool)
    for pair in combinations(range(V), 2):
        both = np.all([weight[v] > 0 for v in pair], axis=0)
        if not both.any():
            continue
        some = [points_px[v][both] for v in pair]
        proposed = triangulate([cameras[v] for v in pair], np.stack(some), np.stack([weight[v][both] for v in pair]))
        error_px = reprojection_error_px(cameras, proposed, points_px[:, both])
        own = (error_px <= tolerance_px[:, both]) & (weight[:, both] > 0)
        own &= (own[pair[0]] & own[pair[1]]) & _wide(cameras, pair, proposed)
        # of two points with equal support, the more exact one
        quality = (
            own * weight[:, both] * (1 - 0.5 * np.minimum(np.nan_to_num(error_px, nan=0) / tolerance_px[:, both], 1))
        )
        support = quality.sum(axis=0)
        better = support > best[both]
        at = np.flatnonzero(both.ravel())[better]
        best.reshape(-1)[at] = support[better]
        agrees.reshape(V, -1)[:, at] = own[:, better]
    points = triangulate(cameras, points_px, weight * agrees)
    error_px = np.where(weight > 0, reprojection_error_px(cameras, points, points_px), np.nan)
    return Triangulated(points, agrees, error_px)


def triangulation_sd(
    cameras: Sequence[Camera],
    found: Triangulated,
    weight: Float[np.ndarray, "V N T K"],
) -> Float[np.ndarray, "N T K 3"]:
    """Return standard deviations of triangulated keypoints along the axes of the world, metres; NaN without a point.

    With J the Jacobian of the pixels of a point and D = diag(weight × depth), the direct linear transform is near its
    result dX = G·dx, G = (Jᵀ·D²·J)⁻¹·Jᵀ·D². Independent errors of pixels with one standard deviation σ give

        Cov(X) = σ²·G·Gᵀ,   E(sum of squared residuals) = σ²·ν,   ν = ‖1 − J·G‖²,

    over the views that agree; ν is 2·views − 3 for equal D. With two views, a point has one degree of freedom, so σ² is
    that of a keypoint of a bird over all frames, with that of all keypoints of the bird as its prior, worth
    `PRIOR_FREEDOM` degrees of freedom. Errors that fit a common point in all views leave no residual.

    Args:
        cameras: V cameras.
        found: keypoints (N, T, K) of N birds.
        weight: the weights of the triangulation.

    Source: Hartley and Zisserman 2004, sections 5.1 and 5.2; Smyth 2004, *Linear models and empirical Bayes methods*
    (the prior of σ²).
    """
    known = np.isfinite(found.points_world).all(-1)
    J, depth = zip(*(_jacobian(camera, found.points_world[known]) for camera in cameras), strict=True)
    used = found.agrees[:, known]
    rows = np.moveaxis(np.stack(J) * used[..., None, None], 0, 1)  # (points, V, 2, 3)
    D2 = np.moveaxis((np.where(used, weight[:, known], 0) * np.stack(depth)) ** 2, 0, 1)
    weighted = rows * D2[..., None, None]
    P, V = D2.shape
    rows, weighted = rows.reshape(P, 2 * V, 3), weighted.reshape(P, 2 * V, 3)
    G = np.linalg.solve(rows.swapaxes(1, 2) @ weighted, weighted.swapaxes(1, 2))
    left = np.eye(2 * V) * np.repeat(used.T, 2, axis=1)[:, None] - rows @ G
    squares, freedom = np.zeros(known.shape), np.zeros(known.shape)
    squares[known] = np.where(used, found.error_px[:, known] ** 2, 0).sum(axis=0)
    freedom[known] = (left**2).sum(axis=(1, 2))
    of_bird = squares.sum(axis=(1, 2)) / np.maximum(freedom.sum(axis=(1, 2)), 1e-9)
    variance = (squares.sum(axis=1) + PRIOR_FREEDOM * of_bird[:, None]) / (freedom.sum(axis=1) + PRIOR_FREEDOM)
    sd = np.full(found.points_world.shape, np.nan)
    sd[known] = np.sqrt((G**2).sum(axis=-1))
    return sd * np.sqrt(variance)[:, None, :, None]


def _jacobian(camera: Camera, points_world: Float[np.ndarray, "P 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives (P, 2, 3) of the pixels of a camera without distortion, and the depths (P,) of points."""
    rows = camera.matrix @ camera.R_cam_world
    seen = camera.to_camera(points_world) @ camera.matrix.T
    depth = seen[:, 2]
    return (rows[:2] - seen[:, :2, None] / depth[:, None, None] * rows[2]) / depth[:, None, None], depth


def _wide(cameras: Sequence[Camera], pair: tuple[int, int], points: np.ndarray) -> np.ndarray:
    """Return whether the rays of two cameras to points meet at a sufficient angle."""
    a, b = (points - cameras[v].position_world for v in pair)
    with np.errstate(invalid="ignore"):
        cosine = np.einsum("...c,...c->...", a, b) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))
        return np.abs(cosine) < np.cos(np.radians(MIN_ANGLE_DEG))


def fundamental_matrix(first: Camera, second: Camera) -> Float[np.ndarray, "3 3"]:
    """Return F with x₂ᵀ·F·x₁ = 0 for the homogeneous pixels x₁, x₂ of a point in two cameras without distortion.

    Source: Hartley and Zisserman 2004, equation 9.1 (F = K₂⁻ᵀ [t]ₓ R K₁⁻¹).
    """
    R = second.R_cam_world @ first.R_cam_world.T
    x, y, z = second.transl_cam - R @ first.transl_cam
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.inv(second.matrix).T @ cross @ R @ np.linalg.inv(first.matrix)


def epipolar_error_px(
    F: Float[np.ndarray, "3 3"], first_px: Float[np.ndarray, "*B 2"], second_px: Float[np.ndarray, "*B 2"]
) -> Float[np.ndarray, "*B"]:
    """Return the Sampson distance of two pixels from showing one point, in pixels.

    The Sampson distance is the reprojection error of the best point in both views, to first order. A distance of 0 does
    not prove that both pixels show one point: all points of a ray have this distance.

    Source: Hartley and Zisserman 2004, equation 11.9.
    """
    one = np.ones((*np.broadcast_shapes(first_px.shape[:-1], second_px.shape[:-1]), 1))
    x1, x2 = (np.concatenate([np.broadcast_to(px, (*one.shape[:-1], 2)), one], axis=-1) for px in (first_px, second_px))
    line2, line1 = x1 @ F.T, x2 @ F
    value = np.einsum("...i,...i->...", x2, line2)
    return np.abs(value) / np.sqrt((line1[..., :2] ** 2).sum(-1) + (line2[..., :2] ** 2).sum(-1))
