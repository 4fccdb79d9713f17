"""The birds of one frame over its picture: meshes, outlines, keypoints, numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfit.render import interpolate
from jaxfit.view.marks import DETECTED, FITTED, INK, dot, line, ring, tag, text_width, track_colour

__all__ = ["DrawnBird", "Style", "draw_birds", "draw_keypoints", "draw_number"]

HEAD = ("crown", "forehead", "nape", "left_eye", "right_eye", "bill_base", "neck", "bill_tip")
"""Keypoints that a bird's number may stand at, the best first."""
_STEP = 100.0  # depth between two layers; a bird is 1 deep there, so that perspective has no part in it


class Style(NamedTuple):
    """How birds are drawn; lengths in pixels of the picture."""

    unit: float
    """Width of a thin line; everything else follows it."""
    opacity: float = 0.6
    """Of the meshes over the footage."""

    @classmethod
    def of_width(cls, width: int, opacity: float = 0.6) -> Style:
        """That suits a picture of this width."""
        return cls(max(width / 1280, 0.75), opacity)

    @property
    def text_px(self) -> float:
        """Height of words."""
        return max(11.0, 13 * self.unit)

    @property
    def dot_px(self) -> float:
        """Radius of a fitted keypoint."""
        return max(1.6, 1.9 * self.unit)

    @property
    def ring_px(self) -> float:
        """Radius of a detected keypoint."""
        return max(3.2, 4.2 * self.unit)

    @property
    def line_px(self) -> int:
        """Width of an outline."""
        return max(1, round(1.4 * self.unit))


class DrawnBird(NamedTuple):
    """One bird of one frame."""

    position: int
    """Of its track, which decides the colour."""
    name: str
    """What stands beside its head."""
    screen: Float[np.ndarray, "V 3"]
    """Vertices: x, y in pixels of the picture, depth in model units."""
    colours: Float[np.ndarray, "V 3"]
    """Blue, green, red in [0, 1], lit."""
    keypoints_px: Float[np.ndarray, "K 2"]
    detected_px: Float[np.ndarray, "D 2"]
    """Detected keypoints, of which there may be none."""


def draw_birds(
    image: UInt8[np.ndarray, "H W 3"],
    birds: Sequence[DrawnBird],
    faces: Int[np.ndarray, "F 3"],
    style: Style,
    one_camera: bool,
) -> None:
    """Draw the meshes of a frame and their outlines into the picture.

    Which of two birds hides the other: where all share one camera, the z-buffer decides, pixel by pixel. A fit
    knows no bird's distance, since each has a crop camera and a size of its own; there the bird whose lower edge
    is lower in the picture hides the other, as it must where all stand on level ground and the camera is upright,
    however steeply it looks down.

    Args:
        image: is drawn into.
        birds: of this frame, in any order.
        faces: of the model.
        style: lines and opacity.
        one_camera: the depths of different birds can be compared.
    """
    height, width = image.shape[:2]
    for group in _overlapping(birds, width, height):
        members = sorted((birds[i] for i in group), key=lambda bird: -float(bird.screen[:, 1].max()))
        low = np.clip(np.floor(np.min([b.screen[:, :2].min(0) for b in members], 0)) - 2, 0, None).astype(int)
        high = np.ceil(np.max([b.screen[:, :2].max(0) for b in members], 0)) + 2
        high = np.minimum(high, [width, height]).astype(int)
        meshes = [b.screen - np.array([*low, 0], np.float32) for b in members]
        if not one_camera:
            meshes = [_layer(mesh, rank) for rank, mesh in enumerate(meshes)]
        V = len(meshes[0])
        values, coverage, face = interpolate(
            np.concatenate(meshes),
            np.concatenate([faces + i * V for i in range(len(members))]),
            np.concatenate([b.colours for b in members]),
            *(int(side) for side in high - low),
        )
        box = image[low[1] : high[1], low[0] : high[0]]
        seen = coverage > 0
        box[seen] = (
            box[seen] * (1 - style.opacity * coverage[seen][:, None]) + 255 * style.opacity * values[seen] + 0.5
        ).astype(np.uint8)
        owner = np.where(face >= 0, face // len(faces), -1)
        for i in reversed(range(len(members))):
            edges, _ = cv2.findContours((owner == i).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(box, edges, -1, track_colour(members[i].position), style.line_px, cv2.LINE_AA)


def _layer(mesh: Float[np.ndarray, "V 3"], rank: int) -> Float[np.ndarray, "V 3"]:
    """The mesh with its depths squeezed into a layer of its own, rank 0 the nearest."""
    depth = mesh[:, 2]
    thickness = max(float(depth.max() - depth.min()), 1e-6)
    behind = depth <= 1e-3  # at or behind the camera: stays so, and is not drawn
    layered = np.where(behind, depth, _STEP * (rank + 1) + (depth - depth.min()) / thickness)
    return np.column_stack([mesh[:, :2], layered]).astype(np.float32)


def _overlapping(birds: Sequence[DrawnBird], width: int, height: int) -> list[list[int]]:
    """Birds whose boxes overlap, group by group; those outside of the picture are left out."""
    boxes = [(b.screen[:, :2].min(0), b.screen[:, :2].max(0)) for b in birds]
    inside = [
        i
        for i, (low, high) in enumerate(boxes)
        if np.isfinite([low, high]).all() and (high > 0).all() and (low < [width, height]).all()
    ]
    groups: list[list[int]] = []
    for i in inside:
        meets = [
            g
            for g in groups
            if any((boxes[i][0] <= boxes[j][1] + 4).all() and (boxes[j][0] <= boxes[i][1] + 4).all() for j in g)
        ]
        groups = [g for g in groups if g not in meets] + [[i, *(j for g in meets for j in g)]]
    return groups


def draw_keypoints(
    image: UInt8[np.ndarray, "H W 3"], bird: DrawnBird, pairs: Sequence[tuple[int, int]], style: Style
) -> None:
    """Fitted keypoints as dots that lines join, detected ones as rings."""
    points = bird.keypoints_px
    for a, b in pairs:
        line(image, points[a], points[b], FITTED, max(1, round(0.7 * style.unit)))
    for point in bird.detected_px:
        ring(image, point, style.ring_px, DETECTED, max(1, round(style.unit)))
    for point in points:
        dot(image, point, style.dot_px, FITTED)


def draw_number(
    image: UInt8[np.ndarray, "H W 3"],
    bird: DrawnBird,
    keypoint_names: Sequence[str],
    style: Style,
    taken: list[tuple[float, float, float, float]],
) -> None:
    """The bird's number beyond its head, clear of the plates in `taken`, to which its own is added."""
    height, width = image.shape[:2]
    body = bird.screen[:, :2].mean(0)
    named = [keypoint_names.index(name) for name in HEAD if name in keypoint_names]
    head = bird.keypoints_px[named[0]] if named else bird.screen[bird.screen[:, 1].argmin(), :2]
    if not ((head > 0) & (head < [width, height])).all():
        return
    size = style.text_px
    away = (head - body) / max(float(np.linalg.norm(head - body)), 1e-6)
    w, h = text_width(bird.name, size) + 0.9 * size, 1.7 * size
    reach = 4.2 * size
    for _ in range(12):
        centre = np.clip(head + reach * away, [w / 2 + 1, h / 2 + 1], [width - w / 2 - 1, height - h / 2 - 1])
        plate = (centre[0] - w / 2, centre[1] - h / 2, centre[0] + w / 2, centre[1] + h / 2)
        if not any(plate[0] < o[2] and o[0] < plate[2] and plate[1] < o[3] and o[1] < plate[3] for o in taken):
            break
        reach += 0.8 * size
    taken.append(plate)
    line(image, head, centre, INK, style.line_px + 2)
    line(image, head, centre, track_colour(bird.position), style.line_px)
    tag(image, bird.name, plate[0], centre[1], size, track_colour(bird.position))
