"""Views of meshes: beside an overlay, from six sides, coloured by a distance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial.transform import Rotation

from jaxfit.data.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose, fold_bird, joint_transforms, posed_vertices
from jaxfit.model.murre import POSTURES, Posture
from jaxfit.raster.zbuffer import draw, shade
from jaxfit.view.colours import DARK, GREY, PAPER, tinted, track_colour
from jaxfit.view.drawing import tag, text, text_width, write_png

SIDE_LIGHT = (-0.35, -0.6, -0.7)
"""Direction from the bird to the light, which is above and to the left of the camera."""
FOOT_WORDS = ("foot", "toe", "shin", "ankle")


def up_direction(solution: Solution) -> Float[np.ndarray, "3"]:
    """Estimate the upward direction in the camera frame: a unit vector.

    A standing bird has its body above its feet. So up is the mean over all birds and frames of the direction from the
    feet to the other keypoints; the leans of birds that face different directions cancel. Without keypoints on the
    feet, up is the upward direction of the image.
    """
    names, valid = solution.keypoint_names, solution.valid
    feet = np.array([any(word in name for word in FOOT_WORDS) for name in names], bool)
    if not feet.any() or feet.all() or not valid.any():
        return np.array([0.0, -1.0, 0.0])
    points = solution.keypoints.cam[valid].astype(np.float64)
    directions = points[:, ~feet].mean(1) - points[:, feet].mean(1)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    total = directions.mean(0)
    length = np.linalg.norm(total)
    return total / length if length > 0.1 else np.array([0.0, -1.0, 0.0])


class SideViews:
    """Draws a strip with one tile per track; each tile shows the bird from its left at eye level, so it faces left.

    The layout is the same in all frames. All birds are drawn at one size, independent of the scale of the fit, in
    parallel projection.

    Args:
        solution: the result.
        bird: the model of the result.
        width: width of the strip, pixels.
        text_px: height of the text, pixels.
    """

    def __init__(self, solution: Solution, bird: Bird, width: int, text_px: float):
        N, valid = len(solution.track_id), solution.valid
        self.solution, self.text_px, self.width = solution, text_px, width
        self.columns = max(1, min(N, max(2, width // 150), 8))
        self.tile_px = min(width // self.columns, max(width // 5, 128))
        self.height = math.ceil(N / self.columns) * self.tile_px
        self._faces = np.asarray(bird.faces)
        self._colours = [tinted(np.asarray(bird.vertex_colours), n, 0.75) for n in range(N)]
        up = up_direction(solution)
        turns = Rotation.from_rotvec(np.where(valid[..., None], solution.poses.global_orient, 0).reshape(-1, 3))
        left = turns.apply(_left(bird)).reshape(*valid.shape, 3)
        left -= (left @ up)[..., None] * up
        left /= np.maximum(np.linalg.norm(left, axis=-1, keepdims=True), 1e-6)
        down = np.broadcast_to(-up, left.shape)
        self._R_view_cam = np.stack([np.cross(down, -left), down, -left], axis=-2)  # x right, y down, z forward
        points = np.where(valid[..., None, None], solution.keypoints.cam, 0).astype(np.float64)
        self._centre_cam = points.mean(2)
        spread = np.einsum("ntij,ntkj->ntki", self._R_view_cam, points - self._centre_cam[:, :, None])
        reach = np.abs(spread[..., :2]).max((2, 3)) / np.where(valid, solution.poses.scale, 1)
        # a percentile, so that a few failed frames do not make all other birds small
        self._zoom = 0.5 * self.tile_px / max(1.12 * float(np.percentile(reach[valid], 98)), 1e-6) if valid.any() else 1

    def draw(
        self, t: int, shown: Bool[np.ndarray, "N"], vertices_cam: Sequence[Float[np.ndarray, "V 3"]]
    ) -> UInt8[np.ndarray, "H W 3"]:
        """Return the strip of the frame at position `t`.

        Args:
            t: position of the frame.
            shown: whether each track has a pose in this frame.
            vertices_cam: mesh of each track in the camera frame of its crop, model units.
        """
        strip = np.full((self.height, self.width, 3), PAPER, np.uint8)
        for n, track in enumerate(self.solution.track_id):
            y, x = (i * self.tile_px for i in divmod(n, self.columns))
            tile = strip[y : y + self.tile_px, x : x + self.tile_px]
            if shown[n]:
                tile[:] = self.bird(n, t, vertices_cam[n])
            else:
                text(tile, "not here", 0.6 * self.text_px, 3 * self.text_px, self.text_px, (170, 170, 170))
            tile[:, -1:] = (222, 222, 222)
            tile[:1] = tile[-1:] = (222, 222, 222)
            tag(tile, f"track {track}", 0.5 * self.text_px, 1.3 * self.text_px, self.text_px, track_colour(n))
        return strip

    def bird(self, n: int, t: int, vertices_cam: Float[np.ndarray, "V 3"]) -> UInt8[np.ndarray, "S S 3"]:
        """Return the tile of one bird, without its number."""
        blank = np.full((self.tile_px, self.tile_px, 3), PAPER, np.uint8)
        offset = (vertices_cam - self._centre_cam[n, t]) @ self._R_view_cam[n, t].T / self.solution.poses.scale[n, t]
        return draw_parallel(blank, offset * self._zoom, self._faces, self._colours[n])


def draw_parallel(
    image: UInt8[np.ndarray, "H W 3"],
    points_px: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    colours: Float[np.ndarray, "V 3"],
    samples: int = 2,
    light: tuple[float, float, float] = SIDE_LIGHT,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a shaded mesh in parallel projection over a copy of an image.

    Args:
        image: the background.
        points_px: x right, y down, z away from the viewer, relative to the centre of the image, pixels.
        faces, colours: faces and vertex colours of the mesh; the channels are in the order of the image.
        samples: as for `jaxfit.raster.zbuffer.draw`.
        light: as for `jaxfit.raster.zbuffer.shade`.
    """
    middle = np.array([image.shape[1] / 2, image.shape[0] / 2, 10 * max(image.shape)])
    lit = shade(points_px, faces, colours, light)
    return draw(image, (points_px + middle).astype(np.float32), faces, lit, samples)


def _left(bird: Bird) -> Float[np.ndarray, "3"]:
    """Return the bird's left in the rest pose, a unit vector: from pairs of joints or keypoints, else −x."""
    for places, pairs in ((bird.joints, bird.joint_pairs), (bird.keypoints, bird.keypoint_pairs)):
        if pairs:
            direction = np.mean([np.asarray(places)[a] - np.asarray(places)[b] for a, b in pairs], axis=0)
            if np.linalg.norm(direction) > 1e-6:
                return direction / np.linalg.norm(direction)
    return np.array([-1.0, 0.0, 0.0])


TILE_PX, MARGIN_PX, TITLE_PX, FOOT_PX, TEXT_PX = 400, 26, 44, 64, 17
LIGHT = (-0.3, -0.4, -0.85)
"""Direction to the light for `raster.zbuffer.shade`: towards the viewer, so that all views are equally bright."""

VIEWS = {  # name → right and down of the view, in the axes of the bird: x right, y forward, z up
    "left": ((0, -1, 0), (0, 0, -1)),
    "front": ((-1, 0, 0), (0, 0, -1)),
    "above": ((1, 0, 0), (0, -1, 0)),
    "right": ((0, 1, 0), (0, 0, -1)),
    "back": ((1, 0, 0), (0, 0, -1)),
    "below": ((-1, 0, 0), (0, -1, 0)),
}


class Surface(NamedTuple):
    """A mesh with the colours of its vertices (blue, green, red in [0, 1])."""

    vertices: Float[np.ndarray, "V 3"]
    """In the axes of the bird: x right, y forward, z up."""
    faces: Int[np.ndarray, "F 3"]
    colours: Float[np.ndarray, "V 3"]
    lift: float = 0.0
    """Distance by which the surface is drawn nearer to the viewer, in the unit of the vertices."""


def six_views(bird: Bird, path: str | Path, posture: Posture | str | None = None) -> None:
    """Draw a bird from left, right, front, back, above and below at one scale, and write a PNG.

    The projection is parallel, and the light comes from the viewer. The bird looks along +y and +z is up, as in the
    published models. In the views from above and below, the head is at the top.

    Args:
        bird: the model. The scale bar is in centimetres, or in model units if the length of a unit is unknown.
        path: PNG file to write, 1200 pixels wide.
        posture: a body pose and its pitch, or a name in `jaxfit.model.murre.POSTURES`. None: the murre stands, other
            models have the rest pose.

    Raises:
        ValueError: the posture is unknown, or has another number of joints.
        InputError: the system rejects the write.
    """
    if posture is None:
        posture = POSTURES["standing"] if bird.name == "murre" else None
    elif isinstance(posture, str):
        if posture not in POSTURES:
            raise ValueError(f"posture must be one of {', '.join(POSTURES)}, not {posture!r}")
        posture = POSTURES[posture]
    vertices = _posed(bird, posture)
    zoom = _zoom(vertices)
    # lighter than in nature, since shading is invisible on dark plumage
    colours = np.clip(0.1 + 0.9 * np.asarray(bird.vertex_colours)[:, ::-1] ** 0.75, 0, 1)
    rows = _six_tiles([Surface(vertices, np.asarray(bird.faces), colours)], vertices, zoom, samples=4)
    write_png(path, np.vstack([*rows, _scale(bird, zoom)]))


def _zoom(points: Float[np.ndarray, "P 3"]) -> float:
    """Return the pixels of a unit of length with which the longest side of the box of points fills a tile."""
    return (TILE_PX - 2 * MARGIN_PX) / float(np.ptp(points, axis=0).max())


def _six_tiles(
    surfaces: Sequence[Surface], points: Float[np.ndarray, "P 3"], zoom: float, samples: int
) -> list[UInt8[np.ndarray, "_ W 3"]]:
    """Draw surfaces from six sides with their names, and return two rows of three tiles.

    Args:
        surfaces: what is drawn together.
        points: points whose box is in the middle of all views, and which every view holds.
        zoom: pixels of a unit of length.
        samples: as for `jaxfit.raster.zbuffer.draw`.
    """
    middle, names, rows = (points.min(0) + points.max(0)) / 2, list(VIEWS), []
    first = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
    faces = np.concatenate([surface.faces + start for surface, start in zip(surfaces, first[:-1], strict=True)])
    colours = np.concatenate([surface.colours for surface in surfaces])
    for row in (names[:3], names[3:]):
        height = round(max(np.ptp(points @ np.array(VIEWS[name][1], float)) for name in row) * zoom + 2 * MARGIN_PX)
        tiles = []
        for name in row:
            right, down = VIEWS[name]
            axes = np.array([right, down, np.cross(right, down)], float)
            seen = [(s.vertices - middle) @ axes.T * zoom - [0, 0, s.lift * zoom] for s in surfaces]
            tile = np.full((height, TILE_PX, 3), PAPER, np.uint8)
            tile = draw_parallel(tile, np.concatenate(seen), faces, colours, samples, LIGHT)
            title = np.full((TITLE_PX, TILE_PX, 3), PAPER, np.uint8)
            text(title, name, (TILE_PX - text_width(name, TEXT_PX)) / 2, TITLE_PX * 0.6, TEXT_PX, DARK)
            tiles.append(np.vstack([title, tile]))
        rows.append(np.hstack(tiles))
    return rows


def _posed(bird: Bird, posture: Posture | None) -> Float[np.ndarray, "V 3"]:
    """Return the mesh in a posture, with the pitch of the posture, in the axes of the bird."""
    if posture is None:
        return np.asarray(bird.vertices, np.float64)
    bones = bird.num_joints - 1
    if np.shape(posture.body_pose) != (bones, 3):
        raise ValueError(f"posture must have a body_pose of shape ({bones}, 3), not {np.shape(posture.body_pose)}")
    pose = Pose(
        global_orient=np.array([posture.pitch_rad, 0, 0], np.float32),
        body_pose=np.asarray(posture.body_pose, np.float32),
        transl=np.zeros(3, np.float32),
        scale=np.ones((), np.float32),
        bone_length=np.ones(bones, np.float32),
        betas=np.zeros(bird.num_shapes, np.float32),
    )
    rig = fold_bird(bird)
    return np.asarray(posed_vertices(rig, joint_transforms(rig, pose), pose), np.float64)


def _scale(bird: Bird, zoom: float) -> np.ndarray:
    """Return the bottom strip of the sheet: name of the model and a scale bar of a round length."""
    metres = bird.metres_per_unit
    per_unit, unit = (1.0, "model units") if metres is None else (100 * metres, "cm")
    longest = 0.6 * TILE_PX / zoom * per_unit
    power = 10.0 ** np.floor(np.log10(longest))
    length = next(step * power for step in (5, 2, 1) if step * power <= longest)
    bar = round(length / per_unit * zoom)
    foot = np.full((FOOT_PX, 3 * TILE_PX, 3), PAPER, np.uint8)
    x, y = MARGIN_PX, FOOT_PX // 2
    cv2.rectangle(foot, (x, y - 2), (x + bar, y + 2), DARK, -1)
    for end in (x, x + bar):
        cv2.rectangle(foot, (end - 1, y - 8), (end + 1, y + 8), DARK, -1)
    text(foot, f"{length:g} {unit}", x + bar + 14, y, TEXT_PX, DARK)
    words = f"{bird.name}: {len(bird.vertices)} vertices, {len(bird.faces)} faces, {bird.num_joints} joints"
    text(foot, words, 3 * TILE_PX - MARGIN_PX - text_width(words, TEXT_PX), y, TEXT_PX, GREY)
    return foot


BAR_PX, LINE_PX = 260, 26
RAMP = np.array([[214, 160, 90], [235, 235, 225], [70, 190, 250], [40, 40, 200]]) / 255
"""Blue, green, red: blue for 0, then white, orange, and red for the largest value."""


def error_colours(values: Float[np.ndarray, "V"], largest: float) -> Float[np.ndarray, "V 3"]:
    """Return the colours of values between 0 and `largest`; larger values have the colour of `largest`."""
    at = np.clip(np.nan_to_num(values, nan=largest) / largest, 0, 1) * (len(RAMP) - 1)
    return np.stack([np.interp(at, np.arange(len(RAMP)), RAMP[:, channel]) for channel in range(3)], axis=1)


def surface_views(
    path: str | Path, rows: Sequence[Sequence[Surface]], labels: Sequence[str], largest: float, lines: Sequence[str]
) -> None:
    """Draw surfaces from six sides at one scale, and write a PNG of 1200 pixels width.

    Args:
        path: the PNG file.
        rows: for each block of six views, the surfaces that are drawn together.
        labels: the title of each block.
        largest: value of the last colour of the bar, in per cent of the length.
        lines: text below the views.
    """
    points = np.concatenate([surface.vertices for block in rows for surface in block])
    parts = []
    for block, label in zip(rows, labels, strict=True):
        heading = np.full((LINE_PX + 10, 3 * TILE_PX, 3), PAPER, np.uint8)
        text(heading, label, MARGIN_PX, LINE_PX * 0.7, TEXT_PX, DARK)
        parts += [heading, *_six_tiles(block, points, _zoom(points), samples=3)]
    write_png(path, np.vstack([*parts, _foot(largest, lines)]))


def _foot(largest: float, lines: Sequence[str]) -> UInt8[np.ndarray, "H W 3"]:
    """Return the colour bar and the lines of text."""
    foot = np.full((2 * LINE_PX + LINE_PX * max(len(lines), 2), 3 * TILE_PX, 3), PAPER, np.uint8)
    values = np.linspace(0, largest, BAR_PX)
    foot[LINE_PX // 2 : LINE_PX + 6, MARGIN_PX : MARGIN_PX + BAR_PX] = error_colours(values, largest) * 255
    for share, value in ((0, "0"), (0.5, f"{largest / 2:g}"), (1, f"{largest:g} % of length")):
        text(foot, value, MARGIN_PX + share * BAR_PX - 4, 1.9 * LINE_PX, TEXT_PX, DARK)
    for number, line in enumerate(lines):
        text(foot, line, MARGIN_PX + BAR_PX + 160, LINE_PX * (number + 0.9), TEXT_PX, DARK)
    return foot
