"""Six views of one surface over another, coloured by a value in per cent of the length, with a colour bar."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfit.view.colours import DARK, GREY, PAPER
from jaxfit.view.drawing import text, text_width, write_png
from jaxfit.view.side_views import draw_parallel
from jaxfit.view.six_views import LIGHT, MARGIN_PX, TEXT_PX, TILE_PX, TITLE_PX, VIEWS

__all__ = ["Surface", "error_colours", "surface_views"]

BAR_PX, LINE_PX = 260, 26
RAMP = np.array([[214, 160, 90], [235, 235, 225], [70, 190, 250], [40, 40, 200]]) / 255
"""Blue, green, red: blue for 0, then white, orange, and red for the largest value."""


class Surface(NamedTuple):
    """A mesh with the colours of its vertices (blue, green, red in [0, 1])."""

    vertices: Float[np.ndarray, "V 3"]
    """In the axes of the bird: x right, y forward, z up."""
    faces: Int[np.ndarray, "F 3"]
    colours: Float[np.ndarray, "V 3"]
    lift: float = 0.0
    """Distance by which the surface is drawn nearer to the viewer, in the unit of the vertices."""


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
    middle = (points.min(0) + points.max(0)) / 2
    zoom = (TILE_PX - 2 * MARGIN_PX) / np.ptp(points, axis=0).max()
    parts = []
    for block, label in zip(rows, labels, strict=True):
        tiles = [_tile(block, name, middle, zoom, points) for name in VIEWS]
        heading = np.full((LINE_PX + 10, 3 * TILE_PX, 3), PAPER, np.uint8)
        text(heading, label, MARGIN_PX, LINE_PX * 0.7, TEXT_PX, DARK)
        parts += [heading, _row(tiles[:3]), _row(tiles[3:])]
    write_png(path, np.vstack([*parts, _foot(largest, lines)]))


def _row(tiles: Sequence[UInt8[np.ndarray, "_ W 3"]]) -> UInt8[np.ndarray, "H X 3"]:
    """Return tiles side by side, filled below to one height."""
    height = max(len(tile) for tile in tiles)
    below = [((0, height - len(tile)), (0, 0), (0, 0)) for tile in tiles]
    return np.hstack([np.pad(tile, pad, constant_values=PAPER[0]) for tile, pad in zip(tiles, below, strict=True)])


def _tile(block: Sequence[Surface], name: str, middle, zoom: float, points) -> UInt8[np.ndarray, "H W 3"]:
    right, down = (np.array(axis, float) for axis in VIEWS[name])
    axes = np.stack([right, down, np.cross(right, down)])
    height = round(float(np.ptp(points @ down)) * zoom) + 2 * MARGIN_PX
    tile = np.full((height, TILE_PX, 3), PAPER, np.uint8)
    first, vertices, faces, colours = 0, [], [], []
    for surface in block:
        seen = (surface.vertices - middle) @ axes.T
        vertices.append((seen - [0, 0, surface.lift]) * zoom)
        faces.append(surface.faces + first)
        colours.append(surface.colours)
        first += len(surface.vertices)
    stacked = [np.concatenate(arrays) for arrays in (vertices, faces, colours)]
    tile = draw_parallel(tile, *stacked, samples=3, light=LIGHT)
    title = np.full((TITLE_PX, TILE_PX, 3), PAPER, np.uint8)
    text(title, name, (TILE_PX - text_width(name, TEXT_PX)) / 2, TITLE_PX * 0.6, TEXT_PX, GREY)
    return np.vstack([title, tile])


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
