"""A page for annotators: where the keypoints of a model sit, from six sides."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from jaxfit.model.bird import Bird
from jaxfit.raster.zbuffer import zbuffer
from jaxfit.storage.files import write_whole
from jaxfit.view.colours import PAPER
from jaxfit.view.side_views import draw_parallel
from jaxfit.view.six_views import LIGHT, MARGIN_PX, TILE_PX, VIEWS

__all__ = ["write_keypoint_page"]

HIDDEN = 0.02
"""A keypoint this far behind the visible surface is hidden in a view, as a share of the bird's length."""
STYLE = """
body { font: 16px/1.5 sans-serif; margin: 2em auto; max-width: 1300px; color: #222; background: #fafafa }
figure { display: inline-block; margin: 4px; background: white; border: 1px solid #ddd; vertical-align: top }
figcaption { text-align: center; padding: 4px }
text { font: bold 12px sans-serif; text-anchor: middle; dominant-baseline: central }
table { border-collapse: collapse } td, th { padding: 3px 12px; text-align: left; border-bottom: 1px solid #ddd }
.hidden circle { fill: none; stroke-dasharray: 3 2 } .hidden text { fill: #777 }
circle { fill: #ffd34d; stroke: #333 }
"""


def write_keypoint_page(bird: Bird, path: str | Path) -> None:
    """Write an HTML page with the keypoints of a model, in one file without links to other files.

    Every keypoint has a number. A dashed ring means that the keypoint is hidden in this view.

    Raises:
        InputError: the file cannot be written.
    """
    vertices = np.asarray(bird.vertices, np.float64)
    middle = (vertices.min(0) + vertices.max(0)) / 2
    zoom = (TILE_PX - 2 * MARGIN_PX) / np.ptp(vertices, axis=0).max()
    figures, seen_in = [], [[] for _ in bird.keypoint_names]
    for name in VIEWS:
        figure, visible = _view(bird, name, middle, zoom)
        figures.append(figure)
        for k in np.flatnonzero(visible):
            seen_in[k].append(name)
    rows = "".join(
        f"<tr><td>{k + 1}</td><td><code>{escape(name)}</code></td><td>{', '.join(seen_in[k]) or 'no view'}</td></tr>\n"
        for k, name in enumerate(bird.keypoint_names)
    )
    title = f"Keypoints of the model {escape(bird.name)}"
    page = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
        f"</head><body><h1>{title}</h1>\n<p>Left and right are those of the bird, not of the picture. A dashed ring: "
        f"the keypoint is hidden in this view. Move the pointer over a number to see the name.</p>\n"
        f"{''.join(figures)}\n"
        f"<table><tr><th></th><th>name in files</th><th>visible from</th></tr>\n{rows}</table></body></html>\n"
    )
    write_whole(path, page.encode())


def _view(bird: Bird, name: str, middle: Float[np.ndarray, "3"], zoom: float) -> tuple[str, np.ndarray]:
    """Return the figure of one view, and whether each keypoint is visible in this view."""
    right, down = (np.array(axis, float) for axis in VIEWS[name])
    axes = np.stack([right, down, np.cross(right, down)])
    vertices, faces = np.asarray(bird.vertices, np.float64), np.asarray(bird.faces)
    seen = (vertices - middle) @ axes.T * zoom
    height = round(float(np.ptp(seen[:, 1]))) + 2 * MARGIN_PX
    blank = np.full((height, TILE_PX, 3), PAPER, np.uint8)
    colours = np.clip(0.1 + 0.9 * np.asarray(bird.vertex_colours)[:, ::-1] ** 0.75, 0, 1)
    picture = draw_parallel(blank, seen, faces, colours, samples=3, light=LIGHT)
    _, png = cv2.imencode(".png", picture)
    shift = np.array([TILE_PX / 2, height / 2, 10 * TILE_PX])
    points = (np.asarray(bird.keypoints, np.float64) - middle) @ axes.T * zoom + shift
    depth = zbuffer((seen + shift).astype(np.float32), faces, TILE_PX, height).depth
    column = np.clip(points[:, 0].astype(int), 0, TILE_PX - 1)
    row = np.clip(points[:, 1].astype(int), 0, height - 1)
    length_px = float(np.ptp(vertices[:, 1])) * zoom
    visible = points[:, 2] < depth[row, column] + HIDDEN * length_px
    marks = "".join(
        f'<g class="{"seen" if visible[k] else "hidden"}"><title>{escape(label)}</title>'
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="9"/><text x="{x:.1f}" y="{y:.1f}">{k + 1}</text></g>'
        for k, (label, (x, y)) in enumerate(zip(bird.keypoint_names, points[:, :2], strict=True))
    )
    image = base64.b64encode(png.tobytes()).decode()
    return (
        f'<figure><svg width="{TILE_PX}" height="{height}" viewBox="0 0 {TILE_PX} {height}">'
        f'<image href="data:image/png;base64,{image}" width="{TILE_PX}" height="{height}"/>{marks}</svg>'
        f"<figcaption>{name}</figcaption></figure>\n",
        visible,
    )
