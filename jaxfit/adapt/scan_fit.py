"""Fit of a bird model to a scan: pose, bone lengths, shape and a smooth displacement of the surface.

The fit starts from the keypoints. Then model and surface are compared in both directions (`surface_rows`). The
correspondences and the weights are renewed before every Gauss-Newton step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxfit.adapt.gauss_newton import Linear, PosedFit, Rows
from jaxfit.adapt.offsets import with_offsets
from jaxfit.adapt.rigid_start import Similarity, robust_similarity
from jaxfit.adapt.species import body_length, mean_keypoints, species_bird
from jaxfit.adapt.surface_rows import ModelSamples, ScanSurface, surface_rows
from jaxfit.model.bird import Bird
from jaxfit.model.pose import Pose
from jaxfit.progress import ProgressTask, silent

__all__ = ["ScanFit", "ScanSettings", "fit_scan"]

LEAST_COARSE = 0.02
"""Largest σ of the surface in the last step, as a share of the length: no scan has more noise."""


class ScanSettings(NamedTuple):
    """Settings of the fit of a scan."""

    modes: int = 0
    """Number of even and of odd modes of the vertex offset (`offset_directions`); 0 for no offset."""
    offset_sd: float = 0.01
    """Standard deviation of one smooth mode of the offset, as a share of the bird's length."""
    samples: int = 2500
    """Number of points of the scan that are compared with the model."""
    keypoint_sd: float = 0.01
    """Expected error of annotated keypoints, as a share of the bird's length."""
    surface_weight: float = 800.0
    """Number of independent measurements that count as much as all compared points of the scan together.
    Neighbouring points of a surface have similar errors, so their number says little."""
    steps: tuple[int, int, int] = (10, 25, 15)
    """Number of steps on the keypoints alone, on the surface without the offset, and on the surface with the offset."""


@dataclass(frozen=True, eq=False)
class ScanFit:
    """The result of a fit to a scan."""

    bird: Bird
    """The adapted model: its mean shape and mean bone lengths are those of the scanned bird."""
    pose: Pose
    """The pose of the scanned bird, in the model's frame: see `to_scan`."""
    to_scan: Similarity
    """From the frame of the posed model to the frame of the scan."""
    vertices: Float[np.ndarray, "V 3"]
    """The posed model in the frame of the scan."""
    keypoints: Float[np.ndarray, "K 3"]
    """The posed keypoints in the frame of the scan."""

    @property
    def R_scan_bird(self) -> Float[np.ndarray, "3 3"]:  # noqa: N802
        """Rotation from the axes of the bird (x right, y forward, z up) to the axes of the scan."""
        return self.to_scan.R @ Rotation.from_rotvec(np.asarray(self.pose.global_orient)).as_matrix()

    @property
    def size(self) -> float:
        """Units of the scan per model unit."""
        return float(self.pose.scale) * self.to_scan.scale

    def tilt_deg(self, up: Float[np.ndarray, "3"]) -> float:
        """Return the angle between the back of the bird and the upward direction of the scan, in degrees."""
        return float(np.rad2deg(np.arccos(np.clip(up @ self.R_scan_bird[:, 2], -1, 1))))

    def pose_notes(self) -> dict[str, np.ndarray]:
        """Return the pose of the scanned bird as notes for its model file.

        The rest skeleton in this pose and with this rotation, size and shift is the skeleton of the scan.
        """
        root = np.asarray(self.bird.joints, np.float64)[0]
        placed = self.to_scan.apply(root * float(self.pose.scale) + np.asarray(self.pose.transl, np.float64))
        notes = {"R": self.R_scan_bird, "size": self.size, "root": placed, "body_pose": self.pose.body_pose}
        return {f"scan_{key}": np.asarray(value, np.float64) for key, value in notes.items()}


def fit_scan(
    bird: Bird,
    vertices: Float[np.ndarray, "P 3"],
    faces: Int[np.ndarray, "Q 3"],
    keypoints: Mapping[str, Float[np.ndarray, "3"]],
    settings: ScanSettings = ScanSettings(),
    name: str = "adapted",
    up: Float[np.ndarray, "3"] | None = None,
    progress: ProgressTask = silent,
) -> ScanFit:
    """Fit a bird model to a scan.

    Args:
        bird: the model to start from.
        vertices: vertices of the scan, in any unit and frame.
        faces: faces of the scan. Holes are allowed.
        keypoints: at least four keypoints of the model, by name, in the frame of the scan.
        settings: the settings.
        name: name of the adapted model.
        up: upward direction in the frame of the scan, a unit vector; None if it is not known.
        progress: shows progress.
    """
    index = np.array([bird.keypoint_names.index(key) for key in keypoints])
    annotated = np.array(list(keypoints.values()), np.float64)
    start, _ = robust_similarity(mean_keypoints(bird)[index], annotated, up=up)
    scan = ScanSurface(start.invert(vertices), faces, settings.samples)
    targets = _Targets(index, start.invert(annotated), settings.keypoint_sd * body_length(bird))
    extended = with_offsets(bird, settings.modes, settings.offset_sd)
    steps = sum(settings.steps if settings.modes else settings.steps[:2])
    with progress("Fitting the scan", steps) as report_progress:
        fit = PosedFit(bird)
        x = fit.prior_mean.copy()
        for _ in range(settings.steps[0]):
            x = fit.step(x, targets.rows(fit.linearise(x)))
            report_progress(1, "keypoints")
        x = _surface_steps(fit, x, scan, targets, settings, settings.steps[1], report_progress)
        if settings.modes:
            fit = PosedFit(extended)
            x = np.concatenate([x, np.zeros(fit.size - len(x))])
            x = _surface_steps(fit, x, scan, targets, settings, settings.steps[2], report_progress, coarse=0.03)
    pose, last = fit.pose(x), fit.linearise(x)
    shift = np.tensordot(pose.betas, np.asarray(fit.bird.shape_basis), axes=1)
    adapted = species_bird(bird, name, pose.bone_length, shift)
    own_pose = replace(pose, betas=np.zeros(bird.num_shapes, np.float32))
    return ScanFit(adapted, own_pose, start, start.apply(last.vertices), start.apply(last.keypoints))


class _Targets(NamedTuple):
    """The annotated keypoints, in the frame of the model."""

    index: Int[np.ndarray, "A"]
    points: Float[np.ndarray, "A 3"]
    sd: float

    def rows(self, posed: Linear) -> Rows:
        """Return residuals with Geman-McClure weights of scale 3 sd."""
        residual = posed.keypoints[self.index] - self.points
        squared = (residual**2).sum(1) / (3 * self.sd) ** 2
        weight = np.repeat(1 / (self.sd * (1 + squared)) ** 2, 3)
        jacobian = posed.by_keypoints[self.index].reshape(len(weight), -1)
        return Rows(residual.ravel(), jacobian, weight)


def _surface_steps(
    fit: PosedFit,
    x,
    scan: ScanSurface,
    targets: _Targets,
    settings: ScanSettings,
    steps: int,
    report_progress,
    coarse=0.1,
) -> Float[np.ndarray, "P"]:
    """Take Gauss-Newton steps on keypoints and surface. The largest σ of the surface decreases from `coarse`."""
    faces, length = np.asarray(fit.bird.faces), body_length(fit.bird)
    model: ModelSamples | None = None
    for step in range(steps):
        posed = fit.linearise(x)
        if model is None or step % 8 == 0:  # the visible part changes slowly
            model = ModelSamples.of(posed.vertices.astype(np.float64), faces, settings.samples)
        largest = coarse * (1 - step / steps) + LEAST_COARSE
        rows = [targets.rows(posed)]
        rows += surface_rows(posed, model, scan, length, largest, settings.surface_weight)
        x = fit.step(x, Rows(*(np.concatenate(parts) for parts in zip(*rows, strict=True))))
        report_progress(1, "surface")
    return x
