"""Calibration of error bars: coverage, sharpness and negative log-likelihood against the truth.

An error e with covariance Σ in d dimensions has z² = eᵀΣ⁻¹e. If the error bars are right, z² has the χ² distribution
with d degrees of freedom, and the region z² ≤ χ²_d(p) contains the truth in a fraction p of the cases (coverage).

- *keypoints, image*: d = 2, the projected keypoints against the annotated ones, image pixels.
- *keypoints, 3D*: d = 3, relative to the mean of the keypoints of the frame, in the real camera's frame, after one
  factor of size for each track, as in `SpatialErrors`: one camera cannot observe position along depth and size. The
  covariance is `keypoints_centred_cov`, rotated and scaled likewise.
- *angles*: d = 1, the components of δ = log(R_fitᵀ·R_true) for the root and every joint, radians.

Source: Gneiting, Balabdaoui and Raftery 2007, *Probabilistic forecasts, calibration and sharpness*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaxfit.data.observations import check_keypoints
from jaxfit.data.solution import Solution
from jaxfit.evaluation.spatial import best_scale, crop_rotation, real_camera
from jaxfit.evaluation.truth import Truth, match
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole

LEVELS = (0.5, 0.68, 0.95)
"""Probabilities of the regions."""
PLOTTED = tuple(round(0.05 * i, 2) for i in range(1, 20))
"""Probabilities of the reliability plot."""


@dataclass(frozen=True)
class CalibrationRow:
    """Calibration of one keypoint, one joint, or all of them."""

    count: int
    """Number of errors."""
    coverage: dict[str, float]
    """Probability of the region (`0.68`) → fraction of errors inside the region."""
    sd: float
    """Sharpness: mean standard deviation, √(tr Σ/d)."""
    error: float
    """RMS error of a component, in the same unit."""
    nll: float
    """Mean negative log-likelihood of the errors under their Gaussians, nats."""
    nll_constant: float
    """The same under a Gaussian of constant width, √(mean squared error), for each keypoint or joint: a bar that is
    fitted to the errors. Error bars are useful if `nll` is smaller."""


@dataclass(frozen=True)
class CalibrationGroup:
    """Calibration of one kind of errors."""

    unit: str
    overall: CalibrationRow
    parts: dict[str, CalibrationRow]
    """Keypoint or joint → its row; only those with errors."""
    reliability: dict[str, float]
    """Probability of the region → fraction of errors inside, for the plot."""


@dataclass(frozen=True)
class Calibration:
    """Calibration of the error bars of a result."""

    groups: dict[str, CalibrationGroup]
    """`keypoints, image`; with true poses also `keypoints, 3D`, and `angles` if both models have the same joints."""
    frames: int
    """Number of compared pairs of bird and frame."""
    without_error_bars: int
    """Number of poses with a truth but without error bars; they do not count."""

    def to_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return asdict(self)


def calibration(solution: Solution, truth: Truth) -> Calibration:
    """Compare the error bars of a result with its errors.

    Args:
        solution: the result, whose tracks are matched with the truth by id (`match_tracks`).
        truth: the annotations, optionally with exact poses.

    Raises:
        InputError: the result has no error bars, or shares no bird with the truth.
    """
    if solution.error_bars is None:
        problem = "the result has no error bars"
        raise InputError("--calibration", problem, "fit with `error_bars: true`, as the config `map` does")
    seen = check_keypoints(truth.observations, solution.keypoint_names, truth.source)
    n, t, shared = match(solution, seen.track_id, seen.frame_index)
    has_bars = np.isfinite(solution.cells()["misfit"])
    both = shared & seen.present[n, t] & solution.valid
    names, K = solution.keypoint_names, len(solution.keypoint_names)
    counted = (both & has_bars)[..., None] & (seen.confidence[n, t] > 0)
    error_px = solution.keypoints.px.astype(np.float64) - seen.keypoints_px[n, t]
    labels = np.broadcast_to(np.arange(K), counted.shape)
    covariance = solution.cells()["keypoints_px_cov"][counted]
    groups = {"keypoints, image": _group(error_px[counted], covariance, labels[counted], names, "px")}
    if truth.solution is not None:
        groups |= _spatial_groups(solution, truth.solution, truth.source)
    groups = {name: group for name, group in groups.items() if group.overall.count}
    if not groups:
        raise InputError(truth.source, "shares no bird with error bars with the result", "give the truth of the video")
    return Calibration(groups, int((both & has_bars).sum()), int((both & ~has_bars).sum()))


class KeypointErrors(NamedTuple):
    """Errors of the keypoints in space of M poses, and their covariances; real camera's frame, model units."""

    counted: Bool[np.ndarray, "N T"]
    """The M poses: the result and the truth have a pose, and the result has error bars."""
    error: Float[np.ndarray, "M K 3"]
    covariance: Float[np.ndarray, "M K 3 3"]

    def squared(self) -> Float[np.ndarray, "M K"]:
        """Return z² of every keypoint."""
        return _squared(self.error, _regular(self.covariance))


def keypoint_errors(solution: Solution, truth: Solution, source: object = "truth") -> KeypointErrors:
    """Return the errors of *keypoints, 3D*.

    Args:
        solution: a result with error bars, whose tracks are matched with the truth by id.
        truth: the exact poses.
        source: the file or folder of the truth, for error messages.
    """
    n, t, shared = match(solution, truth.track_id, truth.frame_index)
    counted = shared & solution.valid & np.isfinite(solution.cells()["misfit"]) & truth.valid[n, t]
    R = _rotations(solution, truth, source)
    order = [truth.keypoint_names.index(name) for name in solution.keypoint_names]
    p, q = solution.keypoints.cam.astype(np.float64), truth.keypoints.cam[n, t][:, :, order].astype(np.float64)
    p = (p - p.mean(2, keepdims=True)) @ np.swapaxes(R, -1, -2)
    q = q - q.mean(2, keepdims=True)
    size = best_scale(p, q, counted)[:, None, None, None]
    turn = (size[..., None] * R[:, :, None])[counted]
    covariance = turn @ solution.cells()["keypoints_centred_cov"][counted].astype(np.float64) @ turn.swapaxes(-1, -2)
    return KeypointErrors(counted, (size * p - q)[counted], covariance)


def _rotations(solution: Solution, truth: Solution, source: object) -> Float[np.ndarray, "N T 3 3"]:
    """Return the rotations from the crops' cameras to the real camera."""
    principal, focal = real_camera(truth, source)
    square_px = solution.crops.square_px
    return crop_rotation(square_px[..., :2] + square_px[..., 2:] / 2, principal, focal)


def _spatial_groups(solution: Solution, truth: Solution, source: object) -> dict[str, Any]:
    n, t, _ = match(solution, truth.track_id, truth.frame_index)
    counted, error, covariance = keypoint_errors(solution, truth, source)
    label = np.tile(np.arange(error.shape[1]), len(error))
    error, covariance = error.reshape(-1, 3), covariance.reshape(-1, 3, 3)
    groups = {"keypoints, 3D": _group(error, covariance, label, solution.keypoint_names, "model units")}
    if sorted(solution.joint_names) == sorted(truth.joint_names):
        order = [truth.joint_names.index(name) - 1 for name in solution.joint_names[1:]]
        own = np.concatenate([solution.poses.global_orient[:, :, None], solution.poses.body_pose], axis=2)[counted]
        true_pose = np.concatenate([truth.poses.global_orient[:, :, None], truth.poses.body_pose[:, :, order]], axis=2)
        R_own, R_true = (
            Rotation.from_rotvec(each.reshape(-1, 3).astype(np.float64)) for each in (own, true_pose[n, t][counted])
        )
        root = np.arange(len(R_own)) % own.shape[1] == 0
        R_crop = np.broadcast_to(np.eye(3), (len(R_own), 3, 3)).copy()
        R_crop[root] = _rotations(solution, truth, source)[counted]
        delta = ((Rotation.from_matrix(R_crop) * R_own).inv() * R_true).as_rotvec()
        cells = solution.cells()
        sd = np.concatenate([cells["global_orient_sd"][:, :, None], cells["body_pose_sd"]], axis=2)[counted]
        variance = sd.astype(np.float64).ravel() ** 2
        label = np.repeat(np.tile(np.arange(own.shape[1]), len(own)), 3)
        free = variance > 0
        error, covariance = delta.reshape(-1, 1)[free], variance[free, None, None]
        groups["angles"] = _group(error, covariance, label[free], solution.joint_names, "rad")
    return groups


def _group(
    error: Float[np.ndarray, "M d"],
    covariance: Float[np.ndarray, "M d d"],
    label: Int[np.ndarray, "M"],
    names: Sequence[str],
    unit: str,
) -> CalibrationGroup:
    """Return the calibration of some errors; `label` is the position of the keypoint or joint in `names`.

    Errors without a finite covariance do not count.
    """
    finite = np.isfinite(covariance).all((1, 2)) & np.isfinite(error).all(1)
    error, covariance = error[finite].astype(np.float64), covariance[finite].astype(np.float64)
    label, d = label[finite], error.shape[1]
    covariance = _regular(covariance)
    trace = np.trace(covariance, axis1=1, axis2=2)
    squared = _squared(error, covariance)
    nll = 0.5 * (squared + np.linalg.slogdet(covariance)[1] + d * np.log(2 * np.pi))
    error2, sd = (error**2).sum(1), np.sqrt(trace / d)

    def row(chosen: Bool[np.ndarray, "M"]) -> CalibrationRow:
        if not chosen.any():
            return CalibrationRow(0, _coverage(squared[chosen], d, LEVELS), *[float("nan")] * 4)
        variance = float(error2[chosen].mean()) / d
        return CalibrationRow(
            count=int(chosen.sum()),
            coverage=_coverage(squared[chosen], d, LEVELS),
            sd=float(sd[chosen].mean()),
            error=float(np.sqrt(variance)),
            nll=float(nll[chosen].mean()),
            nll_constant=float(d / 2 * (np.log(2 * np.pi * max(variance, 1e-24)) + 1)),
        )

    parts = {name: row(label == i) for i, name in enumerate(names) if (label == i).any()}
    constant = sum(part.count * part.nll_constant for part in parts.values()) / max(len(label), 1)
    overall = replace(row(np.ones(len(label), bool)), nll_constant=constant)
    return CalibrationGroup(unit, overall, parts, _coverage(squared, d, PLOTTED))


def _regular(covariance: Float[np.ndarray, "*M d d"]) -> Float[np.ndarray, "*M d d"]:
    """Return the covariances with slightly larger eigenvalues: rounding of float32 may make a tiny one negative."""
    d = covariance.shape[-1]
    trace = np.trace(covariance, axis1=-2, axis2=-1)
    return covariance + (1e-6 * trace / d + 1e-12)[..., None, None] * np.eye(d)


def _squared(error: Float[np.ndarray, "*M d"], covariance: Float[np.ndarray, "*M d d"]) -> Float[np.ndarray, "*M"]:
    return (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1)


def _coverage(squared: np.ndarray, d: int, levels: Sequence[float]) -> dict[str, float]:
    """Return probability of a region → fraction of errors inside the region."""
    return {f"{p:g}": float((squared <= chi2.ppf(p, d)).mean()) if len(squared) else float("nan") for p in levels}


def plot_calibration(result: Calibration, path: Path) -> None:
    """Plot the reliability of every group as a PNG: coverage over probability (needs the extra `report`)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6, 4.4), layout="constrained")
    panel = figure.subplots()
    panel.plot([0, 1], [0, 1], color="grey", linewidth=0.8, linestyle=":", label="calibrated")
    for name, group in result.groups.items():
        p = [float(level) for level in group.reliability]
        panel.plot(p, list(group.reliability.values()), marker="o", markersize=3, label=name)
    panel.set(
        xlabel="probability of the region",
        ylabel="fraction of errors inside",
        xlim=(0, 1),
        ylim=(0, 1),
        title="Reliability of the error bars",
    )
    panel.grid(alpha=0.2)
    panel.legend(frameon=False)
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=110, metadata={"Software": None}))
