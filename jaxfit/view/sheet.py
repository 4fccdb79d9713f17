"""A contact sheet: every bird of a result beside what was seen of it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from jaxfit.fitting.posed import PosedBirds
from jaxfit.fitting.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.observations import Observations
from jaxfit.render import draw, hard_mask, shade
from jaxfit.storage import write_whole

__all__ = ["contact_sheet"]

TILE_PX = 256
PAPER, SEEN, OUTLINE, FITTED, DETECTED = (250, 250, 250), (205, 205, 205), (60, 140, 30), (40, 40, 220), (30, 30, 30)
"""Colours, BGR: background, annotated mask, outline of the mesh, its keypoints, annotated keypoints."""

PLUMAGE = (0.85, 0.9, 0.95)
"""The mesh, BGR in [0, 1]."""


def contact_sheet(
    solution: Solution, bird: Bird, observations: Observations, path: str | Path, columns: int = 4, most: int = 24
) -> None:
    """Draw birds of a result as pairs of tiles and write them as one PNG.

    Left tile: the annotated mask (grey) and keypoints (black rings), the fitted mesh's outline (green) and
    keypoints (red), joined to the annotated ones. Right tile: the mesh as the camera sees it, lit from above.

    Args:
        solution, bird: a result and its model.
        observations: what it was fitted to, with the same tracks and frames.
        path: PNG file to write.
        columns: pairs in a row.
        most: pairs at most, taken evenly over birds and frames.
    """
    posed = PosedBirds(solution, bird)
    pairs = np.argwhere(solution.valid)
    pairs = pairs[np.unique(np.linspace(0, len(pairs) - 1, most).astype(int))]
    tiles = [np.hstack([_evidence(posed, observations, n, t), _mesh(posed, n, t)]) for n, t in pairs]
    blank = np.full((TILE_PX, 2 * TILE_PX, 3), PAPER, np.uint8)
    tiles += [blank] * (-len(tiles) % columns)
    sheet = np.vstack([np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)])
    written, png = cv2.imencode(".png", sheet)
    if not written:
        raise RuntimeError("OpenCV could not encode a PNG")
    write_whole(Path(path), png.tobytes())


def _to_tile(points_px: np.ndarray, crop: np.ndarray) -> np.ndarray:
    return (points_px - crop[:2]) * (TILE_PX / crop[2])


def _evidence(posed: PosedBirds, observations: Observations, n: int, t: int) -> np.ndarray:
    solution, crop = posed.solution, posed.solution.crop[n, t]
    tile = np.full((TILE_PX, TILE_PX, 3), PAPER, np.uint8)
    mask = observations.mask(n, t)
    if mask is not None:
        zoom = TILE_PX / crop[2]
        place = np.array([[zoom, 0, -crop[0] * zoom], [0, zoom, -crop[1] * zoom]])
        seen = cv2.warpAffine(mask.astype(np.uint8), place, (TILE_PX, TILE_PX), flags=cv2.INTER_NEAREST)
        tile[seen > 0] = SEEN
    screen = posed.vertices_screen(n, t)
    screen = np.column_stack([_to_tile(screen[:, :2], crop), screen[:, 2]])
    covered = hard_mask(screen, posed.faces, TILE_PX, TILE_PX).astype(np.uint8)
    contours, _ = cv2.findContours(covered, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(tile, contours, -1, OUTLINE, 1, cv2.LINE_AA)
    fitted = _to_tile(solution.keypoints_2d[n, t], crop)
    detected = _to_tile(observations.keypoints_px[n, t], crop)
    for k in np.flatnonzero(observations.confidence[n, t] > 0):
        a, b = _fixed(fitted[k]), _fixed(detected[k])
        cv2.line(tile, a, b, FITTED, 1, cv2.LINE_AA, SHIFT)
        cv2.circle(tile, b, 3 << SHIFT, DETECTED, 1, cv2.LINE_AA, SHIFT)
        cv2.circle(tile, a, 2 << SHIFT, FITTED, -1, cv2.LINE_AA, SHIFT)
    name = f"bird {solution.track_id[n]}  frame {solution.frame_index[t]}"
    cv2.putText(tile, name, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.38, DETECTED, 1, cv2.LINE_AA)
    return tile


def _mesh(posed: PosedBirds, n: int, t: int) -> np.ndarray:
    """The mesh from the camera, lit."""
    screen, faces = posed.vertices_screen(n, t), np.asarray(posed.faces)
    solution, depth = posed.solution, screen[:, 2:]
    tile_px = _to_tile(screen[:, :2], solution.crop[n, t])
    focal_px = solution.focal * TILE_PX / solution.crop_px
    vertices_cam = np.concatenate([(tile_px - TILE_PX / 2) * depth / focal_px, depth], axis=1)
    colours = shade(vertices_cam, faces, np.broadcast_to(PLUMAGE, screen.shape))
    tile = np.full((TILE_PX, TILE_PX, 3), PAPER, np.uint8)
    return draw(tile, np.concatenate([tile_px, depth], axis=1), faces, colours, samples=3)


SHIFT = 4  # OpenCV draws at sixteenths of a pixel; its pixel centres are whole numbers, ours are halves


def _fixed(point: np.ndarray) -> tuple[int, int]:
    x, y = np.clip(np.round((point - 0.5) * (1 << SHIFT)), -(2**14), 2**14)
    return int(x), int(y)
