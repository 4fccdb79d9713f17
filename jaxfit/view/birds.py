"""Meshes, outlines, keypoints and detections of one frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution
from jaxfit.raster.zbuffer import interpolate
from jaxfit.view.colours import DETECTED, FITTED, track_colour
from jaxfit.view.drawing import closed_curve, dot, line, ring, tag, text_width

HEAD = ("crown", "forehead", "nape", "left_eye", "right_eye", "bill_base", "neck", "bill_tip")
"""Keypoints near which the number of a bird is placed, in order of preference."""
_TURNS = np.radians([50, -50, 85, -85, 0, 120, -120])
"""Directions from the head to the number, relative to the direction of the bill, in order of preference."""
_REACHES = (2.6, 4.2, 6.0)
"""Distances from the head to the number, in text heights, in order of preference."""
REGION_95 = 5.991
"""Quantile 0.95 of χ² with two degrees of freedom: squared Mahalanobis radius of a region of 95 % in the image."""
_CIRCLE = np.column_stack([f(np.linspace(0, 2 * np.pi, 48, endpoint=False)) for f in (np.cos, np.sin)])
_STEP = 100.0  # depth between two layers; each layer has depth 1, so that perspective is negligible


class Style(NamedTuple):
    """Sizes and opacity of the drawing; lengths in image pixels."""

    unit: float
    """Width of a thin line, from the width of the image."""
    mark_px: float
    """Radius of a fitted keypoint, from the size of the birds."""
    opacity: float = 0.6
    """Opacity of the meshes over the footage."""

    @classmethod
    def suited(cls, width: int, bird_px: float, opacity: float = 0.6) -> Style:
        """Return the style for an image of this width and birds of this length, both in pixels."""
        return cls(max(width / 1280, 0.75), float(np.clip(bird_px / 70, 1.4, 4)), opacity)

    @property
    def text_px(self) -> float:
        """Height of text."""
        return max(11.0, 13 * self.unit)

    @property
    def line_px(self) -> int:
        """Width of an outline."""
        return max(1, round(1.4 * self.unit))


class DrawnBird(NamedTuple):
    """One bird of one frame, ready to draw."""

    position: int
    """Position of the track, which determines the colour."""
    name: str
    """Text beside the head."""
    screen: Float[np.ndarray, "V 3"]
    """Vertices: x, y in image pixels, depth in model units."""
    colours: Float[np.ndarray, "V 3"]
    """Blue, green, red in [0, 1], after shading."""
    keypoints_px: Float[np.ndarray, "K 2"]
    detected_px: Float[np.ndarray, "D 2"]
    """Detected keypoints; D may be 0."""
    regions_px: Float[np.ndarray, "K P 2"] | None = None
    """Points around the region of 95 % of every fitted keypoint (`regions_95`); None without error bars."""


def draw_birds(
    image: UInt8[np.ndarray, "H W 3"],
    birds: Sequence[DrawnBird],
    faces: Int[np.ndarray, "F 3"],
    style: Style,
    one_camera: bool,
) -> None:
    """Draw the meshes of a frame and their outlines into the image.

    Order of overlapping birds: if all birds share one camera, the z-buffer decides for every pixel. In a fit, every
    bird has its own crop camera and size, so the distances of birds are unknown. Then the bird with the lower lower
    edge in the image hides the other bird; this is correct for an upright camera and birds on level ground. In
    simulated scenes seen from above, this order was correct for 80 % of overlapping pairs, the order of true mean
    distances for 84 %, and the order of distances from sizes with an error of 5 % for 67 %.

    Args:
        image: the image, which is changed.
        birds: the birds of this frame, in any order.
        faces: faces of the model.
        style: lines and opacity.
        one_camera: whether all birds share one camera, so that their depths are comparable.
    """
    height, width = image.shape[:2]
    for group in _rendered(birds, faces, (width, height), one_camera):
        box = image[group.low[1] : group.high[1], group.low[0] : group.high[0]]
        footage = box * (1 - style.opacity * group.coverage)[..., None]
        box[:] = footage + 255 * style.opacity * group.values + 0.5
        for i in reversed(range(len(group.birds))):
            edges = _edges(group, i)
            cv2.drawContours(box, edges, -1, track_colour(group.birds[i].position), style.line_px, cv2.LINE_AA)


def outlines(
    birds: Sequence[DrawnBird], faces: Int[np.ndarray, "F 3"], size_px: tuple[int, int], one_camera: bool
) -> dict[int, list[Int[np.ndarray, "_ 2"]]]:
    """Return the outlines that `draw_birds` draws, to a pixel: position of a track → closed curves, image pixels."""
    found = {}
    for group in _rendered(birds, faces, size_px, one_camera, samples=1):
        for i, bird in enumerate(group.birds):
            found[bird.position] = [edge[:, 0] + group.low for edge in _edges(group, i)]
    return found


class _Rendered(NamedTuple):
    """Birds with overlapping boxes in their part of the image, H × W pixels."""

    low: Int[np.ndarray, "2"]
    """First column and row of the part."""
    high: Int[np.ndarray, "2"]
    birds: list[DrawnBird]
    values: Float[np.ndarray, "H W 3"]
    """Blue, green, red in [0, 1]."""
    coverage: Float[np.ndarray, "H W"]
    owner: Int[np.ndarray, "H W"]
    """Index of the visible bird in `birds`; −1 without a bird."""


def _rendered(
    birds: Sequence[DrawnBird],
    faces: Int[np.ndarray, "F 3"],
    size_px: tuple[int, int],
    one_camera: bool,
    samples: int = 2,
) -> Iterator[_Rendered]:
    columns = [np.ascontiguousarray(bird.screen[:, :2].T) for bird in birds]  # NumPy is slow along the first axis
    lows, highs = (np.array([f.reduce(c, axis=1) for c in columns]) for f in (np.minimum, np.maximum))
    for group in _overlapping(lows, highs, size_px):
        nearest = sorted(group, key=lambda i: -highs[i, 1])
        members = [birds[i] for i in nearest]
        low = np.clip(np.floor(lows[group].min(0)) - 2, 0, None).astype(int)
        high = np.minimum(np.ceil(highs[group].max(0)) + 2, size_px).astype(int)
        meshes = [b.screen - np.array([*low, 0], np.float32) for b in members]
        if not one_camera:
            meshes = [_layer(mesh, rank) for rank, mesh in enumerate(meshes)]
        V = len(meshes[0])
        values, coverage, face = interpolate(
            np.concatenate(meshes),
            np.concatenate([faces + i * V for i in range(len(members))]),
            np.concatenate([b.colours for b in members]),
            int(high[0] - low[0]),
            int(high[1] - low[1]),
            samples,
        )
        owner = np.where(face >= 0, face // len(faces), -1)
        yield _Rendered(low, high, members, values, coverage, owner)


def _edges(group: _Rendered, i: int) -> Sequence[np.ndarray]:
    """Return the outlines of the visible part of a bird, (M, 1, 2) each, in pixels of its group."""
    return cv2.findContours((group.owner == i).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]


def _layer(mesh: Float[np.ndarray, "V 3"], rank: int) -> Float[np.ndarray, "V 3"]:
    """Return the mesh with its depths scaled into the layer of its rank; rank 0 is nearest."""
    depth = mesh[:, 2]
    thickness = max(float(depth.max() - depth.min()), 1e-6)
    behind = depth <= 1e-3  # vertices at or behind the camera keep their depth and are not drawn
    layered = np.where(behind, depth, _STEP * (rank + 1) + (depth - depth.min()) / thickness)
    return np.column_stack([mesh[:, :2], layered]).astype(np.float32)


def _overlapping(
    lows: Float[np.ndarray, "N 2"], highs: Float[np.ndarray, "N 2"], size_px: tuple[int, int]
) -> list[list[int]]:
    """Return the positions of boxes in groups that overlap or almost touch; boxes outside the image are skipped."""
    if not len(lows):
        return []
    inside = (np.isfinite(lows) & np.isfinite(highs) & (highs > 0) & (lows < size_px)).all(1)
    before = np.all(lows[:, None] <= highs + 4, axis=-1)
    near = before & before.T
    groups: list[list[int]] = []
    for i in np.flatnonzero(inside).tolist():
        meets = [g for g in groups if near[i, g].any()]
        groups = [g for g in groups if g not in meets] + [[i, *(j for g in meets for j in g)]]
    return groups


def draw_keypoints(
    image: UInt8[np.ndarray, "H W 3"], bird: DrawnBird, pairs: Sequence[tuple[int, int]], style: Style
) -> None:
    """Draw fitted keypoints as dots joined by lines, and detected keypoints as rings."""
    points, radius = bird.keypoints_px, style.mark_px
    low = np.clip(np.floor(points.min(0)) - 2, 0, [image.shape[1], image.shape[0]]).astype(int)
    high = np.clip(np.ceil(points.max(0)) + 2, 0, [image.shape[1], image.shape[0]]).astype(int)
    if (high > low).all():
        box = image[low[1] : high[1], low[0] : high[0]]
        lined = box.copy()
        first, second = np.array(pairs, int).reshape(-1, 2).T
        line(lined, points[first] - low, points[second] - low, FITTED, max(1, round(0.7 * style.unit)))
        cv2.addWeighted(lined, 0.6, box, 0.4, 0, dst=box)
    ring(image, bird.detected_px, max(2.2 * radius, 3.2), DETECTED, max(1, round(0.6 * radius)))
    dot(image, points, radius, FITTED)


def regions_95(
    points_px: Float[np.ndarray, "K 2"], covariance: Float[np.ndarray, "K 2 2"], largest_px: float
) -> Float[np.ndarray, "K P 2"]:
    """Return points around the ellipses that contain keypoints with a probability of 95 %.

    The ellipse of a Gaussian with covariance C is x = μ + √5.991·C^½·u for unit vectors u.

    Args:
        points_px: the keypoints μ.
        covariance: their covariances C, squared pixels.
        largest_px: longer semi-axes are drawn with this length.

    Returns:
        P points around every ellipse; NaN where the covariance is not finite.
    """
    known = np.isfinite(covariance).all((1, 2), keepdims=True)
    variance, axes = np.linalg.eigh(np.where(known, covariance, 0).astype(np.float64))
    semi = np.minimum(np.sqrt(REGION_95 * np.maximum(variance, 0)), largest_px)
    around = points_px[:, None] + _CIRCLE @ (axes * semi[:, None]).swapaxes(1, 2)
    return np.where(known, around, np.nan)


def draw_regions(image: UInt8[np.ndarray, "H W 3"], bird: DrawnBird, style: Style) -> None:
    """Draw the regions of 95 % of the keypoints that the dots of the keypoints do not hide."""
    if bird.regions_px is None:
        return
    reach = np.linalg.norm(bird.regions_px - bird.keypoints_px[:, None], axis=-1).max(1)
    for k in np.flatnonzero(reach > style.mark_px + 2):  # NaN is not drawn
        closed_curve(image, bird.regions_px[k], track_colour(bird.position))


class Number(NamedTuple):
    """The place of the number of a bird; positions in image pixels."""

    bird: DrawnBird
    head: Float[np.ndarray, "2"]
    left: float
    middle: Float[np.ndarray, "2"]

    def draw(self, image: UInt8[np.ndarray, "H W 3"], style: Style) -> None:
        """Draw the number, and a line from the head to the number."""
        colour = track_colour(self.bird.position)
        line(image, self.head, self.middle, colour, style.line_px)
        tag(image, self.bird.name, self.left, self.middle[1], style.text_px, colour)


class Numbers:
    """Places the number of each bird near its head, away from other numbers and birds, and steady over frames."""

    def __init__(self, keypoint_names: Sequence[str], style: Style):
        named = [keypoint_names.index(name) for name in HEAD if name in keypoint_names]
        self._head, self._style = named[0] if named else None, style
        self._last: dict[int, int] = {}

    def place(self, size_px: tuple[int, int], birds: Sequence[DrawnBird]) -> list[Number]:
        """Return the places of the numbers of all birds in an image of this width and height.

        Frames must be placed in increasing order.
        """
        if not birds:
            return []
        size, taken, placed = self._style.text_px, np.zeros((0, 4)), []
        points = np.concatenate([bird.keypoints_px for bird in birds])
        for bird in birds:
            top = bird.screen[bird.screen[:, 1].argmin(), :2]
            head = top if self._head is None else bird.keypoints_px[self._head]
            if not ((head > 0) & (head < size_px)).all():
                continue
            half = np.array([text_width(bird.name, size) / 2 + 0.45 * size, 0.85 * size])
            ahead = head - bird.screen[:, :2].mean(0)
            angle = np.arctan2(ahead[1], ahead[0]) + _TURNS
            places = head + np.outer(_REACHES, [size, size]).repeat(len(_TURNS), 0) * np.tile(
                np.column_stack([np.cos(angle), np.sin(angle)]), (len(_REACHES), 1)
            )
            places = np.clip(places, half + 1, size_px - half - 1)
            plates = np.concatenate([places - half, places + half], axis=1)
            low, high = plates[:, None, :2], plates[:, None, 2:]
            cost = ((points > low - 2) & (points < high + 2)).all(-1).sum(1) + 0.25 * np.arange(len(plates))
            cost += 10 * ((low < taken[:, 2:]) & (high > taken[:, :2])).all(-1).sum(1)
            if bird.position in self._last:
                cost[self._last[bird.position]] -= 3
            best = self._last[bird.position] = int(cost.argmin())
            taken = np.concatenate([taken, plates[best : best + 1]])
            placed.append(Number(bird, head, plates[best, 0], places[best]))
        return placed


class Detected:
    """Access to the observations by positions of tracks and frames in a result.

    Args:
        solution: the result.
        observations: the observations of the fit, or others of the same video; None for no observations.

    Raises:
        InputError: the observations have other keypoints than the result.
    """

    def __init__(self, solution: Solution, observations: Observations | None):
        self._count = len(solution.keypoint_names)
        self._rows, self._columns = {}, {}
        if observations is None:
            return
        self._observations = check_keypoints(observations, solution.keypoint_names, "observations")
        rows = {int(track): n for n, track in enumerate(observations.track_id)}
        columns = {int(frame): t for t, frame in enumerate(observations.frame_index)}
        self._rows = {n: rows[int(track)] for n, track in enumerate(solution.track_id) if int(track) in rows}
        self._columns = {t: columns[int(f)] for t, f in enumerate(solution.frame_index) if int(f) in columns}

    def keypoints(self, n: int, t: int) -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, "K"]]:
        """Return keypoints (image pixels) and confidence at positions of the result; 0 without an observation."""
        if n not in self._rows or t not in self._columns:
            return np.zeros((self._count, 2), np.float32), np.zeros(self._count, np.float32)
        at = self._rows[n], self._columns[t]
        return self._observations.keypoints_px[at], self._observations.confidence[at]

    def mask(self, n: int, t: int) -> Bool[np.ndarray, "H W"] | None:
        """Return the mask of the bird, or None without a mask."""
        if n not in self._rows or t not in self._columns:
            return None
        return self._observations.mask(self._rows[n], self._columns[t])
