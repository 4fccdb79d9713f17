"""Error bars of a fitted window: standard deviations of the pose, covariances of the keypoints.

The posterior (`fitting/posterior.py`) is a Gaussian over the columns of a frame. This module converts it:

- Rotations: the tangent δ of SO(3) with R = R_fit·exp(δ), δ = Jr(r)·dr with the right Jacobian Jr of the axis-angle r.
  The axes of δ are those of the rotated part: of the bird's root for the global orientation, of the joint for a joint.
- Keypoints: J·Σ·Jᵀ with the derivatives J of the keypoints, in the camera frame and in pixels.
- Size: one camera cannot distinguish a small near bird from a large distant bird. The fit keeps the distance fixed and
  finds a size; a `Solution` has the size of the model and the distance that gives the same picture (`common_size`).
  The covariance follows this change: the deviation of size becomes one of distance. The variance along depth is
  therefore that of the distance *if the bird has exactly the size of the model*, in units of that size. Without
  `common_size`, distance is fixed, its deviation is 0, and `scale` has the deviation of the size.

Assumptions: the covariance is not H⁻¹ alone. `fitting/sandwich.py` adds what a pose that deviates from the pose prior
in the whole window does to the fit, and what errors of keypoints do that agree between frames.

Body: bone lengths and shape that the whole track gives (`fitting/bodies.py`) have errors with a covariance Σ_b, which
the fitted pose follows with the derivative S by the body. The covariance of pose and body together is therefore
[C + S·Σ_b·Sᵀ, S·Σ_b; Σ_b·Sᵀ, Σ_b], with the covariance C of the pose for a known body.

Misfit: if the keypoints lie farther from the fitted pose than the objective assumes, the posterior is too narrow. The
noise, and H⁻¹ with it, is multiplied by one factor for a window, the ratio of the median squared standardised residual
to its expected median, if this is above 1. A residual is standardised by the scale of its likelihood and by its
leverage: a keypoint that determines the pose pulls the pose to itself, and its residual is too small.

The error bars are those of the reported pose. Where a second pose explains the keypoints almost as well
(`Solution.flags.ambiguity_deg`), they do not contain the other pose.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfit.data.solution import ERROR_BARS
from jaxfit.fitting.posterior import BodySensitivity, Posterior, window_posteriors
from jaxfit.fitting.problem import Problem, Program
from jaxfit.fitting.sandwich import (
    constant_deviation,
    data_blocks,
    fit_correlation,
    lag_correlations,
    spread,
    time_factor,
)
from jaxfit.fitting.stored_programs import StoredProgram
from jaxfit.model.kinematics import (
    Pose,
    window_keypoint_derivatives,
    window_keypoint_rows,
    window_keypoints,
    window_transforms,
)
from jaxfit.model.rotation import right_jacobian
from jaxfit.objective.likelihood import keypoint_sd_px

MIN_RESIDUALS = 10
"""Number of detected keypoints that a misfit factor needs: the median of as many squared residuals lies within a factor
of 2 of the true median in 9 of 10 cases. A photograph has about 15."""
MAX_MISFIT = 100.0
MAX_LEVERAGE = 0.9


class ErrorBars(NamedTuple):
    """Error bars of one window, as NumPy arrays, float32; NaN in frames without the bird and without a posterior."""

    global_orient_sd: np.ndarray
    """(T, 3) radians, about the axes of the bird's root."""
    body_pose_sd: np.ndarray
    """(T, J−1, 3) radians, about the axes of the joint."""
    transl_sd: np.ndarray
    """(T, 3) as `Solution.poses.transl`."""
    scale_sd: np.ndarray
    """(T,) as `Solution.poses.scale`."""
    bone_length_sd: np.ndarray
    """(T, J−1)."""
    betas_sd: np.ndarray
    """(T, S)."""
    keypoints_cam_cov: np.ndarray
    """(T, K, 3, 3) as `Solution.keypoints.cam`."""
    keypoints_centred_cov: np.ndarray
    """(T, K, 3, 3) the same, of the keypoints relative to their mean."""
    keypoints_px_cov: np.ndarray
    """(T, K, 2, 2) crop pixels²."""
    misfit: np.ndarray
    """(T,) factor on H⁻¹, 1 or more; all others contain it."""


def error_bar_shapes(bones: int, shapes: int, keypoints: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of `ErrorBars` in one frame."""
    sizes = {"bones": bones, "S": shapes, "K": keypoints, "2": 2, "3": 3}
    return {name: tuple(sizes[axis] for axis in ERROR_BARS[name][0].split()[2:]) for name in ErrorBars._fields}


def no_error_bars(frames: int, bones: int, shapes: int, keypoints: int) -> ErrorBars:
    """Return the error bars of a window without a posterior: NaN."""
    shapes_of = error_bar_shapes(bones, shapes, keypoints)
    return ErrorBars(**{name: np.full((frames, *shape), np.nan, np.float32) for name, shape in shapes_of.items()})


def pack(bars: ErrorBars) -> Float[np.ndarray, "T E"]:
    """Return all error bars of a window in one array, for files."""
    return np.concatenate([values.reshape(len(values), -1) for values in bars], axis=1)


def unpack(packed: Float[np.ndarray, "T E"], bones: int, shapes: int, keypoints: int) -> ErrorBars:
    """Return the error bars of a window from `pack`."""
    sizes = error_bar_shapes(bones, shapes, keypoints)
    ends = np.cumsum([0, *(math.prod(shape) for shape in sizes.values())])
    pairs = zip(sizes.items(), ends[:-1], ends[1:], strict=True)
    return ErrorBars(**{name: packed[:, a:b].reshape(len(packed), *shape) for (name, shape), a, b in pairs})


def blend_error_bars(
    before: ErrorBars, own: ErrorBars, at_before: np.ndarray, at_own: np.ndarray, weight: np.ndarray, ratio: np.ndarray
) -> ErrorBars:
    """Return the error bars of a window, blended with those of the window before in their shared frames.

    Variances are interpolated linearly, as the poses are. Both windows use the same detections in these frames, so
    their errors may agree fully; the variance of the blended pose is then at most the interpolated variance.

    Args:
        before, own: error bars of the earlier and the later window.
        at_before, at_own: positions of the shared frames in both windows.
        weight: weight of the later window in each shared frame.
        ratio: size of the crop in the earlier window over that in the later window, for each shared frame.
    """
    blended = {}
    for name, value in own._asdict().items():
        w = weight.reshape(-1, *(1,) * (value.ndim - 1))
        earlier, later = getattr(before, name)[at_before], value[at_own]
        if name == "keypoints_px_cov":
            earlier = earlier * ratio[:, None, None, None] ** 2
        is_sd = name.endswith("_sd")
        mean = (1 - w) * earlier ** (2 if is_sd else 1) + w * later ** (2 if is_sd else 1)
        blended[name] = value.copy()
        blended[name][at_own] = np.sqrt(mean) if is_sd else mean
    return ErrorBars(**blended)


def window_error_bars(
    program: Program,
    problems: Problem,
    pose: Pose,
    common_size: bool,
    body_covariance: Float[np.ndarray, "B P P"] | None = None,
) -> tuple[list[ErrorBars], list[str]]:
    """Return the error bars of each of B problems of a stage at its fitted pose, and the reason why it has none.

    Args:
        program: the program of the stage, as for `posterior.window_blocks`.
        problems: B problems.
        pose: their fitted poses.
        common_size: as in the config.
        body_covariance: covariances of the bodies, which the problems optimise as shared parameters; None for windows
            without a given body.

    Returns:
        The error bars, and for each problem a reason, which is empty if it has error bars.
    """
    numbers = 0 if body_covariance is None else body_covariance.shape[-1]
    posteriors = window_posteriors(program, problems, pose, numbers)
    keypoints = jax.tree.map(np.asarray, _keypoints_and_derivatives(program, problems, pose))
    pose, problems = jax.tree.map(np.asarray, (pose, problems))
    bars, reasons = [], []
    for b, posterior in enumerate(posteriors):
        one, problem, own = jax.tree.map(lambda x, b=b: x[b], (pose, problems, keypoints))
        if isinstance(posterior, str):
            sizes = one.body_pose.shape[1], program.rig.num_shapes, own.points_cam.shape[1]
            bars.append(no_error_bars(len(one.transl), *sizes))
            reasons.append(posterior)
            continue
        of_body = None if body_covariance is None else np.asarray(body_covariance[b], np.float64)
        bars.append(_error_bars(program, problem, one, posterior, own, common_size, of_body))
        reasons.append("")
    return bars, reasons


class _Keypoints(NamedTuple):
    """Keypoints and their derivatives at some poses, camera frame, model units."""

    points_cam: Float[Array, "*B T K 3"]
    derivative: Float[Array, "*B T K 3 D"]
    """In the columns of `curvature.frame_rows`."""
    tangents: Float[Array, "*B T J 3 3"]
    """Jr of each rotation."""


@functools.partial(StoredProgram, structure=lambda program, problems, pose: _Keypoints._make([0, 0, 0]))
def _keypoints_and_derivatives(program: Program, problems: Problem, pose: Pose) -> _Keypoints:
    def one(pose: Pose) -> _Keypoints:
        A = window_transforms(program.rig, pose)
        points = window_keypoints(program.rig, A, pose)
        axes = jnp.broadcast_to(jnp.eye(3), (*points.shape, 3))
        by_angles = window_keypoint_rows(program.rig, A, pose, axes)
        scale = jnp.broadcast_to(pose.scale, points.shape[:1])
        by_scale = (points - pose.transl[:, None]) / scale[:, None, None]
        by_shared = (window_keypoint_derivatives(program.rig, A, pose, name) for name in program.shared)
        derivative = jnp.concatenate([by_angles, axes, by_scale[..., None], *by_shared], axis=-1)
        angles = jnp.concatenate([pose.global_orient[:, None], pose.body_pose], axis=1)
        return _Keypoints(points, derivative, right_jacobian(angles))

    return jax.vmap(one)(pose)


def _error_bars(
    program: Program,
    problem: Problem,
    pose: Pose,
    window: Posterior,
    keypoints: _Keypoints,
    common_size: bool,
    body_covariance: Float[np.ndarray, "P P"] | None,
) -> ErrorBars:
    """Return the error bars of one window."""
    T, _, _, D = keypoints.derivative.shape
    columns = np.concatenate([window.columns.own, window.columns.shared])
    bones, shapes = pose.body_pose.shape[1], program.rig.num_shapes
    points, by_cam = np.asarray(keypoints.points_cam, np.float64), np.array(keypoints.derivative, np.float64)
    points_px, by_px = _in_views(program, problem, points, by_cam[..., columns])
    covariance, misfit = _covariance(program, problem, window, points_px, by_px)
    if window.body is not None and body_covariance is not None:
        covariance = _with_body(covariance, window.body, body_covariance)
        columns = np.concatenate([columns, window.body.columns])
        # the keypoints of the result are without the offsets, the last shape coefficients
        by_cam[..., D - (len(pose.betas) - shapes if "betas" in program.shared else 0) :] = 0
        by_px = _in_views(program, problem, points, by_cam[..., columns])[1]
    by_transl, scale = np.zeros((T, 3, D)), np.broadcast_to(pose.scale, T).astype(np.float64)
    by_transl[:, :, 3 * bones + 3 : 3 * bones + 6] = np.eye(3)
    at_scale = 3 * bones + 6
    common_size &= problem.targets.views is None  # several views know the size
    if (
        common_size
    ):  # quotient rule: d(x/s) = dx/s − x·ds/s², so that the deviation of the size is along the viewing ray
        by_cam /= scale[:, None, None, None]
        by_cam[..., at_scale] -= points / scale[:, None, None] ** 2
        by_transl /= scale[:, None, None]
        by_transl[..., at_scale] -= pose.transl / scale[:, None] ** 2

    variance = np.zeros((T, D))  # fixed parameters have none
    variance[:, columns] = np.einsum("tii->ti", covariance)
    numbers = {"bone_length": bones, "betas": len(pose.betas)}
    ends = np.cumsum([at_scale + 1, *(numbers[name] for name in program.shared)])
    shared_variance = {name: variance[:, a:b] for name, a, b in zip(program.shared, ends[:-1], ends[1:], strict=True)}
    angles_sd = _tangent_sd(np.asarray(keypoints.tangents, np.float64), columns, covariance)
    transl_cov = _propagate(by_transl[:, None][..., columns], covariance)[:, 0]
    values = ErrorBars(
        global_orient_sd=angles_sd[:, 0] ** 2,
        body_pose_sd=angles_sd[:, 1:] ** 2,
        transl_sd=np.einsum("tii->ti", transl_cov),
        scale_sd=np.zeros(T) if common_size else variance[:, at_scale],
        bone_length_sd=shared_variance.get("bone_length", np.zeros((T, bones))),
        betas_sd=shared_variance.get("betas", np.zeros((T, shapes)))[:, :shapes],
        keypoints_cam_cov=_propagate(by_cam[..., columns], covariance),
        keypoints_centred_cov=_propagate((by_cam - by_cam.mean(axis=1, keepdims=True))[..., columns], covariance),
        keypoints_px_cov=_propagate(by_px[:, : points.shape[1]], covariance),  # of the first view
        misfit=np.full(T, misfit),
    )
    present = np.asarray(problem.targets.present, bool)
    found = {}
    for name, value in values._asdict().items():
        value = np.sqrt(value) if name.endswith("_sd") else value
        value[~present] = np.nan
        found[name] = value.astype(np.float32)
    return ErrorBars(**found)


def _with_body(
    covariance: Float[np.ndarray, "T Q Q"], slopes: BodySensitivity, of_body: Float[np.ndarray, "P P"]
) -> Float[np.ndarray, "T Q+P Q+P"]:
    """Return the covariance of pose and body, from that of the pose for a known body and that of the body."""
    T, (C, P) = len(slopes.own), slopes.shared.shape
    S = np.concatenate([slopes.own, np.broadcast_to(slopes.shared, (T, C, P))], axis=1)
    cross = S @ of_body
    both = np.broadcast_to(of_body, (T, P, P))
    return np.block([[covariance + cross @ S.swapaxes(1, 2), cross], [cross.swapaxes(1, 2), both]])


def _propagate(J: Float[np.ndarray, "T K R P"], covariance: Float[np.ndarray, "T P P"]) -> np.ndarray:
    """Return J·Σ·Jᵀ of each point, (T, K, R, R)."""
    T, K, R, P = J.shape
    half = (J.reshape(T, K * R, P) @ covariance).reshape(T, K, R, P)
    return half @ J.swapaxes(-1, -2)


def _tangent_sd(
    Jr: Float[np.ndarray, "T J 3 3"], columns: np.ndarray, covariance: np.ndarray
) -> Float[np.ndarray, "T J 3"]:
    """Return the standard deviations of the tangents δ of all rotations; 0 for rotations that are fixed."""
    T, J, _, _ = Jr.shape
    full = np.zeros((T, J, 3, 3))
    position = np.full(3 * J, -1)
    inside = columns < 3 * J
    position[columns[inside]] = np.flatnonzero(inside)
    for j in range(J):
        at = position[3 * j : 3 * j + 3]
        if (at >= 0).all():
            full[:, j] = covariance[:, at[:, None], at]
    # exp(r + dr) = exp(r)·exp(Jr(r)·dr) to first order, so δ = Jr·dr has the covariance Jr·Σ·Jrᵀ
    return np.sqrt(np.einsum("tjab,tjbc,tjac->tja", Jr, full, Jr))


def _in_views(
    program: Program, problem: Problem, points: Float[np.ndarray, "T K 3"], slope: Float[np.ndarray, "T K 3 P"]
) -> tuple[Float[np.ndarray, "T KV 2"], Float[np.ndarray, "T KV 2 P"]]:
    """Return keypoints in crop pixels and their derivatives, of all views one after the other (`Targets`)."""
    views, T = problem.targets.views, len(points)
    if views is not None:
        linear, offset = np.asarray(views.linear, np.float64), np.asarray(views.offset, np.float64)
        points = (np.einsum("tvij,tkj->tvki", linear, points) + offset[:, :, None]).reshape(T, -1, 3)
        slope = np.einsum("tvij,tkjp->tvkip", linear, slope).reshape(T, -1, 3, slope.shape[-1])
    # u = f·x/z + c: du = f·(dx/z − x·dz/z²)
    x, z, camera = points[..., :2], points[..., 2:], program.camera
    by_px = camera.focal_px * (slope[..., :2, :] / z[..., None] - (x / z**2)[..., None] * slope[..., 2:, :])
    return camera.focal_px * x / z + camera.centre_px, by_px


class _Noise(NamedTuple):
    """The noise of the keypoints that the objective assumes: bivariate Student t, or Gaussian."""

    confidence: Float[np.ndarray, "T K"]
    scale2: Float[np.ndarray, "T K"]
    """Squared scale, pixels²."""
    weight: float
    """Weight of the term."""
    dof: float
    """Degrees of freedom; infinite for a Gaussian."""

    @property
    def variance(self) -> Float[np.ndarray, "T K"]:
        """Squared scale of the weighted term, pixels²."""
        return self.scale2 / self.weight

    @property
    def gaussian(self) -> float:
        """Variance of a Gaussian of equal Fisher information, in units of `variance`.

        The Fisher information of a t of n dimensions is (ν + n)/(ν + n + 2) per squared scale; n = 2.
        """
        return 1.0 if math.isinf(self.dof) else (self.dof + 4) / (self.dof + 2)

    @property
    def expected(self) -> float:
        """Median of the squared residual in units of `variance`: twice the median of the F distribution of 2 and ν."""
        return 2 * math.log(2) if math.isinf(self.dof) else self.dof * math.expm1(2 * math.log(2) / self.dof)

    def precision(self, error_px: Float[np.ndarray, "T K 2"]) -> Float[np.ndarray, "T K"]:
        """Return the curvature of the term for x and y of a keypoint, at some errors (`residual_curvature`)."""
        # ρ = (ν + 2)/2·log(1 + q/ν) with q = ‖e‖²/s²; the mean over directions of its second derivative is
        # 2(ρ′ + q·ρ″)/s² = (1 + 2/ν)/(1 + q/ν)²/s²
        squared = (error_px**2).sum(-1) / self.scale2
        return (1 + 2 / self.dof) / (1 + squared / self.dof) ** 2 / self.variance


def _noise(problem: Problem) -> _Noise | None:
    """Return the noise of the keypoints; None for objectives without a keypoint term of the library."""
    settings = problem.hyperparameters.settings
    on, confidence = problem.hyperparameters.keypoints_on, np.asarray(problem.targets.confidence, np.float64)
    confidence = confidence * np.tile(on, confidence.shape[1] // len(on))  # of all views
    if "keypoint_likelihood" in settings:
        own = {name: float(value) for name, value in settings["keypoint_likelihood"].items()}
        scale_px = np.asarray(keypoint_sd_px(confidence, own["sd_sure_px"], own["sd_unsure_px"]))
        return _Noise(confidence, scale_px**2, own["weight"], own["dof"]) if own["weight"] > 0 else None
    if "keypoints" in settings and float(settings["keypoints"]["weight"]) > 0:
        weight = float(settings["keypoints"]["weight"])
        return _Noise(confidence, 1 / (2 * np.maximum(confidence, 1e-6)), weight, math.inf)
    return None


def _covariance(
    program: Program, problem: Problem, window: Posterior, keypoints_px: np.ndarray, J: np.ndarray
) -> tuple[Float[np.ndarray, "T P P"], float]:
    """Return the covariance of the parameters of each frame (`sandwich`), and the misfit factor.

    Args:
        program, problem, window: of the window.
        keypoints_px: (T, K, 2) the fitted keypoints.
        J: (T, K, 2, P) their derivatives.
    """
    inverse, misfit = window.covariance(), 1.0
    covariance = inverse.of_frames()
    present = np.asarray(problem.targets.present, bool)
    noise = _noise(problem)
    if noise is not None:
        error_px, counted = _errors(problem, noise, keypoints_px)
        misfit = _misfit(noise, error_px, counted, _propagate(J, covariance))
        factor = time_factor(lag_correlations(error_px, counted), fit_correlation(J, inverse, present))
        if factor > 1:
            data = data_blocks(J, counted * noise.precision(error_px), len(window.columns.own))
            covariance = covariance + (factor - 1) * spread(window.precision, covariance, data)
    prior = problem.hyperparameters.settings.get("pose_prior")
    covariance = misfit * covariance
    if prior is not None:
        whitener = np.asarray(program.priors.pose_whitener, np.float64)
        own, shared = constant_deviation(window, whitener, 3, float(prior["weight"]), present)
        V = np.concatenate([own, np.broadcast_to(shared, (len(own), *shared.shape))], axis=1)
        covariance = covariance + V @ V.swapaxes(1, 2)
    return covariance, misfit


def window_misfits(
    program: Program, problems: Problem, pose: Pose, posteriors: Sequence[Posterior | str]
) -> tuple[Float[np.ndarray, "B"], Float[np.ndarray, "B T K 2"]]:
    """Return the misfit factor of each of B problems at their fitted poses, 1 for a problem without a posterior, and
    the keypoints of a fit without offsets of keypoints, crop pixels.

    Args:
        program, problems, pose: as for `window_error_bars`.
        posteriors: of the problems (`posterior.window_posteriors`).
    """
    free, without_px = program.rig.of_detector, []
    keypoints = jax.tree.map(np.asarray, _keypoints_and_derivatives(program, problems, pose))
    problems, factors = jax.tree.map(np.asarray, problems), np.ones(len(posteriors))
    for b, posterior in enumerate(posteriors):
        problem, own = jax.tree.map(lambda x, b=b: x[b], (problems, keypoints))
        noise, columns = _noise(problem), np.zeros(0, int)
        if not isinstance(posterior, str):
            columns = np.concatenate([posterior.columns.own, posterior.columns.shared])
        points, slope = (np.asarray(each, np.float64) for each in (own.points_cam, own.derivative[..., columns]))
        points_px, J = _in_views(program, problem, points, slope)
        without_px.append(points_px)
        if isinstance(posterior, str):
            continue
        covariance = posterior.covariance().of_frames()
        if noise is not None:
            factors[b] = _misfit(noise, *_errors(problem, noise, points_px), _propagate(J, covariance))
        if free:  # the last columns: the other parameters follow them by the regression Cov(x, o)·Cov(o)⁻¹
            of_offsets = np.linalg.solve(covariance[0, -free:, -free:], np.asarray(pose.betas)[b, -free:])
            without_px[b] = points_px - np.einsum("tkap,tp->tka", J, covariance[..., -free:] @ of_offsets)
    return factors, np.stack(without_px)


def _errors(
    problem: Problem, noise: _Noise, keypoints_px: Float[np.ndarray, "T K 2"]
) -> tuple[Float[np.ndarray, "T K 2"], Bool[np.ndarray, "T K"]]:
    """Return the errors of fitted keypoints, crop pixels, and which of them count."""
    error_px = keypoints_px - np.asarray(problem.targets.keypoints_px, np.float64)
    return error_px, (noise.confidence > 0) & np.asarray(problem.targets.present, bool)[:, None]


def _misfit(noise: _Noise, error_px: np.ndarray, counted: np.ndarray, px_cov: np.ndarray) -> float:
    """Return the misfit factor of a window, see the head of this module; 1 for windows with few detected keypoints."""
    # the residual of a keypoint has the variance σ²(1 − h) with the leverage h, the share of its variance that the fit
    # takes: h = tr(J·Σ·Jᵀ)/(2σ²), the mean over x and y
    leverage = np.einsum("tkii->tk", px_cov) / (2 * noise.gaussian * noise.variance)
    squared = (error_px**2).sum(-1) / (noise.variance * (1 - np.minimum(leverage, MAX_LEVERAGE)))
    squared = squared[counted & np.isfinite(squared)]
    if len(squared) < MIN_RESIDUALS:
        return 1.0
    return float(np.clip(np.median(squared) / noise.expected, 1, MAX_MISFIT))
