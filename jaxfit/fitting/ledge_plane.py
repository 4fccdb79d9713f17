"""`estimate_ledge`: the plane that the birds of one camera stand on.

World: the ledge is z = 0, z up, x along the ledge, metres.
"""

from __future__ import annotations

import csv
import io
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxfit.cameras.camera import Camera
from jaxfit.data.flags import CONTRADICTED, flags
from jaxfit.data.projection import in_image, upward
from jaxfit.data.solution import Solution, select_solution
from jaxfit.data.world import in_frame_of_camera, largest_image_px
from jaxfit.fitting.ledge import SLOW, feet_cam, interval_of, metres, speed_lengths
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import read_text
from jaxfit.model.bird import Bird

SIZE_SD_LOG = 0.05
"""Relative standard deviation of lengths of adults of a species, as in the term `size_prior`."""
TILT_SD = 0.1
"""Standard deviation of the sideways lean of a standing bird, radians; a larger value is estimated from the birds."""
WITHIN_SD = 0.01
"""Standard deviation of the changes of a bird's logarithmic size between blocks; or a larger one, from the birds."""
USUAL_FOCAL, FOCAL_SD_LOG = 1.2, 0.5
"""Focal length relative to the longer side of the picture: 16 to 117 mm (2 sd) of a lens for 36 mm film."""
DISTANCE_SD = 0.01
"""Relative standard deviation of a measured distance."""
PER_BLOCK, BLOCK_S, MAX_BLOCKS = 5, 1.0, 200
"""Poses of a block, its length in seconds, and the number of blocks that the plane is estimated from."""
ALONG = 2.0
"""Places of birds that spread this many times as far in one direction as across show the direction of the ledge."""
MAX_ROUNDS, STEP = 5, 1e-3


class Distances(NamedTuple):
    """Measured distances between points of the ledge."""

    points_px: Float[np.ndarray, "D 2 2"]
    """Both ends in image pixels."""
    distance_m: Float[np.ndarray, "D"]


class Ledge(NamedTuple):
    """A camera above the ledge, and how sure it is."""

    camera: Camera
    """In the world of the ledge."""
    facts: dict[str, Any]
    """Values and standard deviations, for people and `summary.json`."""


def read_distances(path: Path) -> Distances:
    """Read distances from a CSV file with the columns `x1_px`, `y1_px`, `x2_px`, `y2_px` and `distance_m`.

    Raises:
        InputError: the file cannot be read, has fewer than three rows, or a row has no five numbers.
    """
    columns = ("x1_px", "y1_px", "x2_px", "y2_px", "distance_m")
    remedy = f"write the columns {', '.join(columns)}, one row for each measured distance"
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path, "a CSV file"))))
    except csv.Error as error:
        raise InputError(path, f"is not a CSV file: {error}", remedy) from None
    values = np.zeros((len(rows), 5))
    for i, row in enumerate(rows):
        try:
            values[i] = [float(row[name]) for name in columns]
        except (KeyError, ValueError, TypeError):
            raise InputError(path, f"line {i + 2} has no five numbers: {dict(row)}", remedy) from None
        if not np.isfinite(values[i]).all() or values[i, 4] <= 0 or (values[i, :2] == values[i, 2:4]).all():
            raise InputError(path, f"line {i + 2} has no distance above 0 between two points", remedy)
    if len(rows) < 3:
        raise InputError(path, f"has {len(rows)} distances", "measure three distances or more, in several directions")
    return Distances(values[:, :4].reshape(-1, 2, 2), values[:, 4])


def estimate_ledge(
    solution: Solution,
    bird: Bird,
    camera: Camera | None = None,
    distances: Distances | None = None,
    source: object = "the result",
) -> Ledge:
    """Estimate the plane that the birds stand on, and the focal length if no camera is given.

    The estimate maximises the posterior of the direction n of the plane's normal, the height h of the camera, the focal
    length f and the mean size of the birds, given for each bird (1) the size at which its feet are on the plane, which
    is that of the model up to `SIZE_SD_LOG`; (2) the component along n of its lateral axis, which is level when a bird
    stands; and (3) measured distances. Blocks of one second with a slow bird count as independent. The standard
    deviations between birds and within a bird are learnt from the birds. Flying birds lose weight by a robust loss.

    Args:
        solution: poses of one camera in crops, in the pixels of the camera without distortion.
        bird: the model, with its unit of length.
        camera: intrinsic matrix of the camera; its pose is not used. None: unknown.
        distances: measured distances, in pixels without distortion.
        source: name of the result in error messages.

    Returns:
        The camera in the world of the ledge, whose origin is the mean place of the birds.

    Raises:
        InputError: no bird stands with a pose that agrees with the detections, or no plane lies below the camera.
    """
    problem = _Problem(solution, bird, camera, distances, source)
    # several cameras know the sizes
    size_sd = WITHIN_SD if in_frame_of_camera(solution) else SIZE_SD_LOG
    sd, theta = _Deviations(size_sd, WITHIN_SD, TILT_SD, TILT_SD), problem.start()
    problem.check(theta, source)
    how: dict[str, Any] = {"jac": problem.jacobian, "loss": "soft_l1", "x_scale": "jac"}
    for _ in range(MAX_ROUNDS):
        solved = least_squares(problem.residuals, theta, args=(sd, size_sd), **how)
        theta = solved.x
        log_size, level = problem.errors(theta)
        sd = _Deviations(*_learnt(log_size, size_sd, WITHIN_SD), *_learnt(level, TILT_SD, TILT_SD))
    problem.check(theta, source)
    sd_theta = np.sqrt(np.diag(np.linalg.pinv(solved.jac.T @ solved.jac)))
    up, height, f, size = problem.unpacked(theta)
    placed = _world_camera(problem.camera(f), up, height * metres(bird), problem.places(theta) * metres(bird))
    facts = {
        "birds": int(np.isfinite(log_size).any(axis=1).sum()),
        "height_m": height * metres(bird),
        "height_sd_m": height * metres(bird) * sd_theta[2],
        "below_horizontal_deg": _below_horizontal_deg(placed),
        "tilt_sd_deg": float(np.degrees(np.sqrt(sd_theta[:2] @ sd_theta[:2] / 2))),
        "focal_px": f,
        "focal_sd_px": f * sd_theta[4] if camera is None else 0.0,
        "size": float(np.exp(size)),
        "size_sd": float(np.exp(size) * sd_theta[3]),
    }
    return Ledge(placed, facts)


def plane_of(camera: Camera, source: object) -> Ledge:
    """Return the plane z = 0 of the world of a calibrated camera.

    Raises:
        InputError: the camera does not look down on the plane.
    """
    height, down = float(camera.position_world[2]), _below_horizontal_deg(camera)
    if height <= 0 or down <= 0:
        problem = f"camera {camera.name} is at z = {height:.2f} m and looks {down:.0f}° below the plane z = 0"
        remedy = "calibrate with z up and with z = 0 on the ledge, or let the birds show the plane: --ledge birds"
        raise InputError(source, problem, remedy)
    return Ledge(camera, {"height_m": height, "below_horizontal_deg": down, "focal_px": float(camera.matrix[0, 0])})


class _Problem:
    """The least-squares problem of a plane.

    Its parameters θ are two components of the upward direction, and the logarithms of the height in model units, of the
    mean size of the birds, and, if it is unknown, of the focal length over the usual one.
    """

    def __init__(
        self, solution: Solution, bird: Bird, camera: Camera | None, distances: Distances | None, source: object
    ):
        self._size_px = largest_image_px(solution)
        self._usual = USUAL_FOCAL * max(self._size_px) if camera is None else float(camera.matrix[0, 0])
        self._given, self._unit_m = camera, metres(bird)
        x, y = np.array(self._size_px) / 2 if camera is None else camera.matrix[:2, 2]
        self._centre = float(x), float(y)
        self._sample = _Sample(solution, bird, source)
        self._pairs = distances
        self._start = self._sample.up(self._usual, self._centre)
        self._basis = np.linalg.svd(self._start[None])[2][1:]

    def start(self) -> Float[np.ndarray, "parameters"]:
        """Return parameters at which the median bird has the size of the model."""
        log_size, _ = self._sample.values(self._start, 1.0, self._usual, self._centre)
        height = -np.nanmedian(log_size)
        return np.array([0, 0, height, 0, 0] if self._given is None else [0, 0, height, 0])

    def unpacked(self, theta: np.ndarray) -> tuple[Float[np.ndarray, "3"], float, float, float]:
        """Return the upward direction, the height in model units, the focal length, and the logarithm of the size."""
        up = self._start + theta[:2] @ self._basis
        f = self._usual * np.exp(theta[4]) if self._given is None else self._usual
        return up / np.linalg.norm(up), float(np.exp(theta[2])), float(f), float(theta[3])

    def errors(self, theta: np.ndarray) -> tuple[Float[np.ndarray, "N B"], Float[np.ndarray, "N B"]]:
        """Return the errors of logarithmic sizes and of lateral axes, of each bird and block."""
        up, height, f, size = self.unpacked(theta)
        log_size, level = self._sample.values(up, height, f, self._centre)
        return log_size - size, level

    def residuals(self, theta: np.ndarray, sd: _Deviations, size_sd: float) -> Float[np.ndarray, "residuals"]:
        up, height, f, size = self.unpacked(theta)
        log_size, level = self.errors(theta)
        found = [_whitened(log_size, sd.size, sd.size_within), _whitened(level, sd.level, sd.level_within)]
        found.append(np.array([size / size_sd]))
        if self._given is None:
            found.append(theta[4:] / FOCAL_SD_LOG)
        if self._pairs is not None:
            found.append(_distance_error(self._pairs, up, height * self._unit_m, f, self._centre) / DISTANCE_SD)
        return np.concatenate(found)

    def check(self, theta: np.ndarray, source: object) -> None:
        """Raise InputError if most birds are not below the camera."""
        up, _, f, _ = self.unpacked(theta)
        if self._sample.share_below(up, f, self._centre) < 0.5:
            remedy = "a camera must look down on the birds; with a calibrated camera, the plane can be `world`"
            raise InputError(source, "shows birds that are not below the camera", remedy)

    def jacobian(self, theta: np.ndarray, *args: Any) -> Float[np.ndarray, "residuals parameters"]:
        """Return the derivatives of the residuals; orientations have the precision of float32, so steps are large."""
        steps = STEP * np.eye(len(theta))
        columns = [self.residuals(theta + step, *args) - self.residuals(theta - step, *args) for step in steps]
        return np.stack(columns, axis=1) / (2 * STEP)

    def places(self, theta: np.ndarray) -> Float[np.ndarray, "N 3"]:
        """Return the mean place of each bird that stands, in the camera frame of the image, model units."""
        up, height, f, _ = self.unpacked(theta)
        return self._sample.places(up, height, f, self._centre)

    def camera(self, f: float) -> Camera:
        """Return the camera in its own frame."""
        if self._given is not None:
            return self._given
        matrix = np.array([[f, 0, self._centre[0]], [0, f, self._centre[1]], [0, 0, 1]])
        return Camera("camera", matrix, np.zeros(0), np.eye(3), np.zeros(3), self._size_px)


class _Deviations(NamedTuple):
    """Standard deviations between birds and within a bird: of the logarithm of sizes, and of lateral axes, radians."""

    size: float
    size_within: float
    level: float
    level_within: float


class _Placed(NamedTuple):
    """Birds of the size of the model in the camera frame of the image, model units."""

    feet: Float[np.ndarray, "N C P 3"]
    axes: Float[np.ndarray, "N C 3 3"]
    """Rotation from the model."""
    root: Float[np.ndarray, "N C 3"]


class _Sample:
    """Poses that the plane is estimated from: N birds, B blocks of `PER_BLOCK` frames."""

    def __init__(self, solution: Solution, bird: Bird, source: object):
        interval_s = interval_of(solution)
        fast = speed_lengths(solution, bird, interval_s) >= SLOW
        # a short block has a frame more than once
        columns, self._at = np.unique(_blocks(len(solution.frame_index), interval_s), return_inverse=True)
        self._solution = select_solution(solution, np.arange(len(solution.track_id)), columns)
        contradicted = flags(self._solution.flags.doubts) == CONTRADICTED
        self._usable = self._solution.valid & ~fast[:, columns] & ~contradicted
        if not self._usable.any():
            remedy = "see the report of the result; with a calibrated camera, the plane can be `world`"
            problem = "shows no bird that stands, with a pose that the detections do not contradict"
            raise InputError(source, problem, remedy)
        self._bird, self._feet = bird, feet_cam(self._solution, bird)
        self._last: tuple[tuple[float, float, float], _Placed] | None = None

    def _placed(self, f: float, centre: tuple[float, float]) -> _Placed:
        if self._last is None or self._last[0] != (f, *centre):
            placed = in_image(self._solution, self._bird, f, centre)
            orient = Rotation.from_rotvec(np.nan_to_num(placed.orientation).reshape(-1, 3))
            axes = orient.as_matrix().reshape(*self._usable.shape, 3, 3)
            self._last = (
                (f, *centre),
                _Placed(placed.points(self._feet, np.asarray(self._solution.poses.scale)), axes, placed.root),
            )
        return self._last[1]

    def up(self, f: float, centre: tuple[float, float]) -> Float[np.ndarray, "3"]:
        """Return the upward direction of the birds in the camera frame of the image."""
        return upward(self._placed(f, centre).axes[self._usable])

    def values(
        self, up: np.ndarray, height: float, f: float, centre: tuple[float, float]
    ) -> tuple[Float[np.ndarray, "N B"], Float[np.ndarray, "N B"]]:
        """Return the logarithm of the size at which the feet are on the plane, and the lateral axis along `up`.

        Both are medians of blocks, NaN for blocks without a slow bird. A foot whose ray does not meet the plane seems
        very large.
        """
        placed = self._placed(f, centre)
        low = (placed.feet @ up).min(axis=-1)
        log_size = np.log(height) - np.log(np.maximum(-low, 1e-3))
        level = placed.axes[..., 0] @ up
        return self._medians(log_size), self._medians(level)

    def share_below(self, up: np.ndarray, f: float, centre: tuple[float, float]) -> float:
        """Return the share of the poses whose feet lie below the camera."""
        return float(np.mean((self._placed(f, centre).feet[self._usable] @ up).min(axis=-1) < 0))

    def places(self, up: np.ndarray, height: float, f: float, centre: tuple[float, float]) -> Float[np.ndarray, "N 3"]:
        """Return the mean place of each bird that stands, in the camera frame of the image, model units."""
        log_size, _ = self.values(up, height, f, centre)
        root = np.where(self._usable[..., None], self._placed(f, centre).root, np.nan)
        stands = np.isfinite(log_size).any(axis=1)
        size = np.exp(np.nanmedian(log_size[stands], axis=1))
        return np.nanmean(root[stands], axis=1) * size[:, None]

    def _medians(self, values: Float[np.ndarray, "N C"]) -> Float[np.ndarray, "N B"]:
        blocks = np.where(self._usable, values, np.nan)[:, self._at].reshape(len(values), -1, PER_BLOCK)
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # blocks without a bird
            return np.nanmedian(blocks, axis=2)


def _blocks(frames: int, interval_s: float) -> np.ndarray:
    """Return the positions of the frames of all blocks, `PER_BLOCK` for each block."""
    length = max(round(BLOCK_S / interval_s), 1)
    count = max(frames // length, 1)
    starts = np.unique(np.linspace(0, count - 1, min(count, MAX_BLOCKS)).astype(int)) * length
    within = np.linspace(0, min(length, frames) - 1, PER_BLOCK).astype(int)
    return (starts[:, None] + within).reshape(-1)


def _whitened(values: Float[np.ndarray, "N B"], between: float, within: float) -> Float[np.ndarray, "M"]:
    """Return independent residuals of unit variance, of values that vary between birds and within a bird."""
    found = []
    for own in values:
        own = own[np.isfinite(own)]
        if own.size:
            found.append((own - own.mean()) / within)
            found.append(own.mean(keepdims=True) / np.hypot(between, within / np.sqrt(own.size)))
    return np.concatenate(found)


def _learnt(values: Float[np.ndarray, "N B"], between: float, within: float) -> tuple[float, float]:
    """Return the standard deviations between birds and within a bird: at least those assumed, more if the birds say so.

    Errors of the poses of a bird that does not move repeat, so small deviations do not show small errors.
    """
    several = values[np.isfinite(values).any(axis=1)]
    means = np.nanmean(several, axis=1)
    changes = several - means[:, None]

    def robust(errors: np.ndarray) -> float:
        return float(1.4826 * np.median(np.abs(errors))) if errors.size else 0.0

    return max(between, robust(means)), max(within, robust(changes[np.isfinite(changes)]))


def _distance_error(
    distances: Distances, up: np.ndarray, height_m: float, f: float, centre: tuple[float, float]
) -> Float[np.ndarray, "D"]:
    """Return the logarithm of the ratio of the distances on the plane to the measured distances."""
    ends = (distances.points_px - np.array(centre)) / f
    rays = np.concatenate([ends, np.ones((*ends.shape[:-1], 1))], axis=-1)
    points = rays * (height_m / np.maximum(-(rays @ up), 1e-3))[..., None]
    length = np.linalg.norm(points[:, 0] - points[:, 1], axis=-1)
    return np.log(np.maximum(length, 1e-9) / distances.distance_m)


def _world_camera(
    camera: Camera, up: Float[np.ndarray, "3"], height_m: float, places_cam_m: Float[np.ndarray, "M 3"]
) -> Camera:
    """Return the camera in the world of the ledge.

    x is the direction in which the places of three or more birds spread most, to the right of the picture; if they
    spread as far across, x is the direction to the right of the picture.
    """
    feet = places_cam_m - (places_cam_m @ up + height_m)[:, None] * up
    origin = feet.mean(axis=0)
    right = np.array([1.0, 0, 0]) - up[0] * up
    if len(feet) > 2:
        spread = np.linalg.svd(feet - origin)[1:]
        if spread[0][0] > ALONG * spread[0][1]:
            right = spread[1][0] - (spread[1][0] @ up) * up
            right = right if right[0] > 0 else -right
    x = right / np.linalg.norm(right)
    R = np.stack([x, np.cross(up, x), up], axis=1)
    return replace(camera, R_cam_world=R, transl_cam=origin)


def _below_horizontal_deg(camera: Camera) -> float:
    return float(np.degrees(np.arcsin(np.clip(-camera.R_cam_world[2, 2], -1, 1))))
