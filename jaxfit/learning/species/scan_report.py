"""Errors of a model that was fitted to a scan, the judgement whether the model fits, and the picture of the errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxfit.learning.species.scan_fit import ScanFit
from jaxfit.learning.species.species import body_length
from jaxfit.learning.species.surface import (
    boundary_faces,
    closest_points,
    sample_surface,
    search_samples,
    visible_faces,
)
from jaxfit.view.mesh_views import Surface, error_colours, surface_views

UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
"""Millimetres of the units of scans."""
PLAUSIBLE_MM = (50.0, 3000.0)
"""Lengths of birds from bill to tail."""
OFF_SURFACE = 0.05
"""A keypoint that is farther from the scan is reported, as a share of the length."""
WORST = {"median": 0.02, "p95": 0.08, "keypoints": 0.06}
"""A model fits a scan if no error exceeds these shares of the length."""
LARGEST_PERCENT = 3.0
"""The last colour of the picture."""


@dataclass(frozen=True, eq=False)
class ScanErrors:
    """Distances between a scan and the fitted model, as shares of the bird's length unless stated otherwise."""

    length: float
    """Length of the bird's rest pose, in the unit of the scan."""
    unit_mm: float
    """Millimetres of the unit of the scan."""
    of_scan: Float[np.ndarray, "P"]
    """Distance of each vertex of the scan from the model."""
    of_model: Float[np.ndarray, "M"]
    """Distance of points of the model's visible surface from the scan, where the scan has no hole."""
    covered: float
    """Share of the model's visible surface that the scan covers."""
    keypoints: dict[str, float]
    """Distance of each annotated keypoint from the keypoint of the model."""

    @property
    def summary(self) -> dict[str, float]:
        """`median` and `p95` of the distances of the scan, and the median error of the `keypoints`."""
        return {
            "median": float(np.median(self.of_scan)),
            "p95": float(np.percentile(self.of_scan, 95)),
            "keypoints": float(np.median(list(self.keypoints.values()))),
        }

    @property
    def problems(self) -> list[str]:
        """Why the model does not fit the scan; empty if the model fits."""
        names = {
            "median": "median distance",
            "p95": "95 % of the distances lie below",
            "keypoints": "keypoints, median",
        }
        return [
            f"{names[key]} {self.shown(value)}, at most {100 * WORST[key]:g} % expected"
            for key, value in self.summary.items()
            if value > WORST[key]
        ]

    @property
    def implausible_size(self) -> str:
        """A sentence about a length that no bird has; empty for plausible lengths."""
        length_mm = self.length * self.unit_mm
        if PLAUSIBLE_MM[0] <= length_mm <= PLAUSIBLE_MM[1]:
            return ""
        return f"the bird is {length_mm:.3g} mm long with this unit; give the unit of the scan by --unit (mm, cm, m)"

    def shown(self, share: float) -> str:
        """Return a share of the length as text in per cent and in mm."""
        return f"{100 * share:.2f} % of length ({share * self.length * self.unit_mm:.3g} mm)"


def keypoints_off_surface(
    vertices: Float[np.ndarray, "P 3"],
    faces: Int[np.ndarray, "Q 3"],
    keypoints: Mapping[str, Float[np.ndarray, "3"]],
    length: float,
) -> dict[str, float]:
    """Return the keypoints that are farther than 5 % of the length from the scan, with the distance as that share."""
    samples = search_samples(vertices, faces, 40_000)
    distance = closest_points(np.stack(list(keypoints.values())), vertices, faces, samples).distance / length
    return {name: float(d) for name, d in zip(keypoints, distance, strict=True) if d > OFF_SURFACE}


def measure_scan(
    fit: ScanFit,
    vertices: Float[np.ndarray, "P 3"],
    faces: Int[np.ndarray, "Q 3"],
    keypoints: Mapping[str, Float[np.ndarray, "3"]],
    unit_mm: float = 10.0,
) -> ScanErrors:
    """Measure the distances between a scan and the fitted model.

    Args:
        fit: the fit.
        vertices, faces: the scan.
        keypoints: the annotated keypoints.
        unit_mm: millimetres of the unit of the scan.
    """
    length = body_length(fit.bird) * fit.size
    own_faces = np.asarray(fit.bird.faces)
    outer = own_faces[visible_faces(fit.vertices, own_faces)]
    of_scan = closest_points(vertices, fit.vertices, own_faces, search_samples(fit.vertices, own_faces, 40_000))
    points = sample_surface(fit.vertices, outer, 5000, seed=3).points(fit.vertices, outer)
    of_model = closest_points(points, vertices, faces, search_samples(vertices, faces, 40_000))
    # no hole, and not a part that the scan lacks as a whole
    met = ~boundary_faces(faces)[of_model.face] | (of_model.distance < 0.02 * length)
    index = {name: k for k, name in enumerate(fit.bird.keypoint_names)}
    return ScanErrors(
        length,
        unit_mm,
        of_scan.distance / length,
        of_model.distance[met] / length,
        float(met.mean()),
        {name: float(np.linalg.norm(fit.keypoints[index[name]] - at)) / length for name, at in keypoints.items()},
    )


def draw_scan(
    path: str | Path,
    fit: ScanFit,
    vertices: Float[np.ndarray, "P 3"],
    faces: Int[np.ndarray, "Q 3"],
    errors: ScanErrors,
) -> None:
    """Write a picture of the scan over the model (grey) from six sides, coloured by the distance from the model."""
    turn = fit.R_scan_bird
    grey = np.full((len(fit.vertices), 3), 0.62)
    model = Surface(fit.vertices @ turn, np.asarray(fit.bird.faces), grey)
    # drawn a little nearer to the viewer, so that the scan hides the model where both surfaces agree
    colours = error_colours(100 * errors.of_scan, LARGEST_PERCENT)
    scan = Surface(vertices @ turn, faces, colours, lift=0.03 * errors.length)
    summary = errors.summary
    lines = [
        f"distance of the scan from the model: median {errors.shown(summary['median'])}",
        f"95 % below {errors.shown(summary['p95'])}",
        f"keypoints, median: {errors.shown(summary['keypoints'])}",
        "grey: the model, where the scan has no surface",
    ]
    if errors.problems:
        lines.append("the model does not fit this scan")
    surface_views(path, [[model, scan]], ["scan over model"], LARGEST_PERCENT, lines)
