"""Fit of a model to a scan, by Gauss-Newton steps on keypoints and surface; errors of the fit and their picture.

Comparison of a posed bird with the surface of a scan: residuals, derivatives and weights, in both directions. A noisy
point of a scan lies more often outside a curved surface than inside. Its closest point on the model makes the model too
large: with noise of standard deviation σ, a sphere of radius R by σ²/R. So every point p of the scan is compared with
points q of the model that are drawn from p(q | p) ∝ exp(−‖p − q‖² / 2σ²), which has no such bias. The bias is small
without noise, and there closest points are more exact than drawn points.

Source: Myronenko and Song 2010, *Point Set Registration: Coherent Point Drift*, for the distribution and for σ.

The fit starts from the keypoints. Then model and surface are compared in both directions (`surface_rows`). The
correspondences and the weights are renewed before every Gauss-Newton step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.species.species import (
    body_length,
    mean_keypoints,
    species_bird,
    symmetric_bone_precision,
    symmetric_bones,
    with_offsets,
)
from jaxfit.learning.species.surface import (
    Samples,
    Similarity,
    boundary_faces,
    closest_points,
    robust_similarity,
    sample_surface,
    search_samples,
    visible_faces,
)
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose, Rig, fold_bird, joint_transforms, posed_keypoints, posed_vertices
from jaxfit.raster.zbuffer import vertex_normals
from jaxfit.view.mesh_views import Surface, error_colours, surface_views


class Rows(NamedTuple):
    """Weighted residuals and their derivatives by the P parameters."""

    residual: Float[np.ndarray, "R"]
    jacobian: Float[np.ndarray, "R P"]
    weight: Float[np.ndarray, "R"]


class Linear(NamedTuple):
    """Posed points and their derivatives by the P parameters."""

    vertices: Float[np.ndarray, "V 3"]
    keypoints: Float[np.ndarray, "K 3"]
    by_vertices: Float[np.ndarray, "V 3 P"]
    by_keypoints: Float[np.ndarray, "K 3 P"]


class _Layout(eqx.Module):
    """What the compiled function needs besides the parameters."""

    rig: Rig
    bones: Float[Array, "bones Q"]
    bone_mean: Float[Array, "bones"]
    joints: int = eqx.field(static=True)


def _pose(x: Float[Array, "P"], layout: _Layout) -> Pose:
    orient, transl, log_scale, rest = x[:3], x[3:6], x[6], x[7:]
    angles, bones = 3 * (layout.joints - 1), layout.bones.shape[1]
    return Pose(
        global_orient=orient,
        body_pose=rest[:angles].reshape(-1, 3),
        transl=transl,
        scale=jnp.exp(log_scale),
        bone_length=layout.bone_mean + layout.bones @ rest[angles : angles + bones],
        betas=rest[angles + bones :],
    )


def _points(x, layout: _Layout):
    pose = _pose(x, layout)
    A = joint_transforms(layout.rig, pose)
    return posed_vertices(layout.rig, A, pose), posed_keypoints(layout.rig, A, pose)


_linearise = jax.jit(lambda x, layout: (*_points(x, layout), *jax.jacfwd(_points)(x, layout)))


class PosedFit:
    """The parameters x of a posed bird: orientation, translation, log scale, body pose, bone lengths, shape.

    The lengths of left and right bones are equal. The priors are those of the bird, with bone lengths that differ
    between species (`widened_bone_covariance`); orientation, translation and scale have no prior.
    """

    def __init__(self, bird: Bird):
        self.bird = bird
        bones = symmetric_bones(bird)
        self.layout = _Layout(fold_bird(bird), jnp.asarray(bones, jnp.float32), bird.bone_mean, bird.num_joints)
        angles = len(np.asarray(bird.pose_mean))
        self.size = 7 + angles + bones.shape[1] + bird.num_shapes
        self.prior_mean = np.zeros(self.size)
        self.prior_mean[7 : 7 + angles] = bird.pose_mean
        self.precision = np.zeros((self.size, self.size))
        bones_at = slice(7 + angles, 7 + angles + bones.shape[1])
        self.precision[7 : 7 + angles, 7 : 7 + angles] = np.linalg.inv(np.asarray(bird.pose_covariance, np.float64))
        self.precision[bones_at, bones_at] = symmetric_bone_precision(bird)
        shapes = np.arange(bones_at.stop, self.size)
        self.precision[shapes, shapes] = 1 / np.asarray(bird.shape_variance, np.float64)

    def pose(self, x: Float[np.ndarray, "P"]) -> Pose:
        """Return the pose of parameters, as NumPy arrays."""
        return jax.tree.map(np.asarray, _pose(jnp.asarray(x, jnp.float32), self.layout))

    def linearise(self, x: Float[np.ndarray, "P"]) -> Linear:
        """Return the posed vertices and keypoints with their derivatives."""
        values: Any = _linearise(jnp.asarray(x, jnp.float32), self.layout)
        return Linear(*(np.asarray(value) for value in values))

    def step(self, x: Float[np.ndarray, "P"], rows: Rows, damping: float = 1e-3) -> Float[np.ndarray, "P"]:
        """Return the parameters after one damped Gauss-Newton step on the rows and the priors."""
        # JᵀWJ + Λ and JᵀWr + Λ (x − μ), with the precision Λ and the mean μ of the prior
        weighted = rows.jacobian * rows.weight[:, None].astype(np.float32)
        hessian = (weighted.T @ rows.jacobian).astype(np.float64)
        hessian = (hessian + hessian.T) / 2 + self.precision
        gradient = (weighted.T @ rows.residual.astype(np.float32)).astype(np.float64)
        gradient += self.precision @ (x - self.prior_mean)
        # the damping keeps a step finite in directions that neither the data nor a prior determines
        hessian[np.diag_indices(self.size)] += damping * np.diag(hessian) + 1e-6
        step = -np.linalg.solve(hessian, gradient)
        # a rotation by more than half a radian is outside the range of the linearisation
        largest = np.abs(np.concatenate([step[:3], step[6 : 7 + len(self.bird.pose_mean)]])).max()
        return x + step * min(1.0, 0.5 / max(largest, 1e-12))


DENSER = 4
"""Number of points of a surface that are searched, relative to the number of points that are compared."""
LITTLE_NOISE = 0.005
"""Largest σ as a share of the length for closest points: drawn points are too coarse for a scan with less noise."""
DRAWS = 3
"""Number of points of the model that are drawn for one point of the scan."""
CANDIDATES = 128
"""Number of nearest points of the model from which they are drawn."""
MEDIAN_DISTANCE = 1.54
"""Median distance of two points in space, relative to the standard deviation of one coordinate of their difference."""
SMALLEST_SIGMA = 2e-5
"""Smallest σ as a share of the length, for scans without noise."""
REACH = 0.06
"""Width of the robust weights of points of the scan, as a share of the length: the model can grow to such points."""
BEYOND = 4.0
"""A point of the scan farther than this many σ pulls the model towards itself, and not along the normal: no normal
points to a part of the scan beyond the end of the model, such as a longer tail."""
OF_MODEL = 0.1
"""Weight of the points of the model relative to the points of the scan. They are compared with closest points, which
are biased, but only they shorten a part of the model that the scan lacks."""
SLIDE = 0.1
"""Share of the weight for the whole distance, and not along the normal: the surfaces would slide otherwise."""


class ScanSurface:
    """The scan in the frame of the model, with the points that are compared."""

    def __init__(self, vertices: Float[np.ndarray, "P 3"], faces: Int[np.ndarray, "Q 3"], count: int):
        self.vertices, self.faces = vertices, faces
        self.search = search_samples(vertices, faces, DENSER * count)
        self.points = sample_surface(vertices, faces, count, seed=1).points(vertices, faces)
        self.boundary = boundary_faces(faces)
        random = np.random.default_rng(3).random((count, DRAWS))
        self.chances = (np.arange(DRAWS) + random) / DRAWS  # the same in all steps, so that the steps converge


class ModelSamples(NamedTuple):
    """The visible part of the model, with the points that are compared."""

    faces: Int[np.ndarray, "visible 3"]
    search: Samples
    samples: Samples

    @classmethod
    def of(cls, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], count: int) -> ModelSamples:
        """Return the visible part of a posed model with `count` points."""
        outer = faces[visible_faces(vertices, faces)]
        return cls(
            outer, search_samples(vertices, outer, DENSER * count), sample_surface(vertices, outer, count, seed=2)
        )


class _Pairs(NamedTuple):
    """Points of the model and the points of the scan that they are compared with."""

    samples: Samples
    target: Float[np.ndarray, "M 3"]
    weight: Float[np.ndarray, "M"]
    beyond: float
    """Distance from which on the residual is the distance."""


def surface_rows(
    posed: Linear, model: ModelSamples, scan: ScanSurface, length: float, coarse: float, weight: float
) -> list[Rows]:
    """Return the rows of points of the scan against the model, and of points of the model against the scan.

    Args:
        posed: the posed model.
        model: its visible part.
        scan: the scan.
        length: length of the bird, model units.
        coarse: largest σ, as a share of the length.
        weight: number of independent measurements that count as much as all points of the scan together.
    """
    vertices = posed.vertices.astype(np.float64)
    normals = vertex_normals(vertices, model.faces).astype(np.float64)
    # the samples without the vertices, whose density varies
    spread = model.search.points(vertices, model.faces)[: DENSER * len(model.samples.face)]
    chosen, sigma = _draw(scan, spread, coarse * length, SMALLEST_SIGMA * length)
    scanned = _Pairs(
        Samples(model.search.face[chosen], model.search.barycentric[chosen]),
        np.repeat(scan.points, DRAWS, axis=0),
        np.ones(len(chosen)),
        BEYOND * sigma,
    )
    of_model = OF_MODEL
    if sigma < LITTLE_NOISE * length:
        nearest = closest_points(scan.points, vertices, model.faces, model.search)
        scanned = _Pairs(Samples(nearest.face, nearest.barycentric), scan.points, np.ones(len(nearest.face)), 0.0)
        sigma, of_model = max(1.5 * float(np.median(nearest.distance)), SMALLEST_SIGMA * length), 1.0
    on_model = model.samples.points(vertices, model.faces)
    closest = closest_points(on_model, scan.vertices, scan.faces, scan.search)
    # a point of the model far from the border of a hole has no counterpart; without the near points, the model grows
    whole = ~scan.boundary[closest.face] | (closest.distance < REACH * length / 3)
    reach = max(3 * sigma, REACH * length)
    rows = []
    for pairs, width, share in (
        (scanned, reach, 1.0),
        (_Pairs(model.samples, closest.point, whole.astype(float), np.inf), 3 * sigma, of_model),
    ):
        rows += _rows(posed, vertices, normals, model.faces, pairs, width, share * weight / sigma**2)
    return rows


def _draw(
    scan: ScanSurface, points: Float[np.ndarray, "M 3"], largest: float, smallest: float
) -> tuple[Int[np.ndarray, "P*DRAWS"], float]:
    """Return the numbers of the points of the model that are drawn for every point of the scan, and σ."""
    distance, near = (np.asarray(found) for found in KDTree(points).query(scan.points, k=CANDIDATES))
    sigma = 1.5 * float(np.median(distance[:, 0]))
    for _ in range(4):
        sigma = float(np.clip(sigma, smallest, largest))
        chance = np.exp((distance[:, :1] ** 2 - distance**2) / (2 * sigma**2)).cumsum(axis=1)
        at = (chance[:, None] < chance[:, -1:, None] * scan.chances[..., None]).sum(axis=2)
        # noise of the scan gives distances of this median
        sigma = float(np.median(np.take_along_axis(distance, at, axis=1))) / MEDIAN_DISTANCE
    return np.take_along_axis(near, at, axis=1).ravel(), float(np.clip(sigma, smallest, largest))


def _rows(posed: Linear, vertices, normals, faces, pairs: _Pairs, width: float, weight: float) -> list[Rows]:
    """Return the rows of pairs of points: at all pairs along the normal, at some pairs in all directions."""
    corners, barycentric = faces[pairs.samples.face], pairs.samples.barycentric
    gap = pairs.samples.points(vertices, faces) - pairs.target
    distance = np.linalg.norm(gap, axis=1)
    direction = np.einsum("pk,pkc->pc", barycentric, normals[corners])
    direction = np.where((distance > pairs.beyond)[:, None], gap, direction)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    jacobian = np.einsum("pk,pkcx->pcx", barycentric.astype(np.float32), posed.by_vertices[corners], optimize=True)
    along = np.einsum("pc,pcx->px", direction.astype(np.float32), jacobian)
    robust = weight * pairs.weight / (1 + (distance / width) ** 2) ** 2
    some = slice(None, None, 5)
    whole = SLIDE * robust[some] / len(gap[some])
    return [
        Rows((gap * direction).sum(1), along, (1 - SLIDE) * robust / len(gap)),
        Rows(gap[some].ravel(), jacobian[some].reshape(3 * len(whole), -1), np.repeat(whole, 3)),
    ]


MIN_COARSE = 0.02
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
        largest = coarse * (1 - step / steps) + MIN_COARSE
        rows = [targets.rows(posed)]
        rows += surface_rows(posed, model, scan, length, largest, settings.surface_weight)
        x = fit.step(x, Rows(*(np.concatenate(parts) for parts in zip(*rows, strict=True))))
        report_progress(1, "surface")
    return x


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
