"""Contact sheet: birds of a result beside their observations."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.cameras.camera import Camera
from jaxfit.data.flags import CONTRADICTED, UNSURE, flags, with_flag
from jaxfit.data.observations import Observations
from jaxfit.data.projection import PosedBirds
from jaxfit.data.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.raster.zbuffer import draw, hard_mask, shade
from jaxfit.view.birds import Detected
from jaxfit.view.colours import (
    DETECTED,
    FITTED,
    INK,
    ON_PAPER_DETECTED,
    ON_PAPER_FITTED,
    OUTLINE,
    PAPER,
    SEEN,
    track_colour,
)
from jaxfit.view.drawing import dot, line, ring, tag, text, write_png
from jaxfit.view.legend import FLAGGED, Symbol, symbol_strip

TILE_PX = 256
"""Side of a tile."""
_TEXT_PX = 18.0
"""Height of the text of the legend."""
PALE = (0.85, 0.9, 0.95)
"""Colour that is mixed with the colours of the model, BGR in [0, 1], since shading is invisible on dark plumage."""


def sheet_pairs(solution: Solution, frames: int = 4, most: int = 24) -> list[list[tuple[int, int]]]:
    """Select the birds and frames of the sheet of a video: one row per track, with evenly spaced valid frames.

    Args:
        solution: the result.
        frames: number of frames in a row.
        most: greatest number of rows; tracks with a valid frame are selected evenly.

    Returns:
        Rows of positions (n, t).
    """
    tracks = np.flatnonzero(solution.valid.any(1))
    tracks = tracks[np.unique(np.linspace(0, len(tracks) - 1, most).astype(int))] if len(tracks) else tracks
    rows = []
    for n in tracks.tolist():
        own = np.flatnonzero(solution.valid[n])
        picks = own[np.unique(((np.arange(frames) + 0.5) / frames * len(own)).astype(int))]
        rows.append([(n, t) for t in picks.tolist()])
    return rows


def cut_tiles(
    posed: PosedBirds, picture: UInt8[np.ndarray, "H W 3"], pairs: list[tuple[int, int]]
) -> dict[tuple[int, int], UInt8[np.ndarray, "S S 3"]]:
    """Cut the tiles of birds out of the image of their frame, for `contact_sheet`; black beyond the edges."""
    tiles = {}
    for n, t in pairs:
        tiles[n, t] = _cut(picture, _window(posed, n, t), cv2.INTER_LINEAR)
    return tiles


def contact_sheet(
    solution: Solution,
    bird: Bird,
    observations: Observations | None,
    path: str | Path,
    columns: int = 4,
    most: int = 24,
    footage: Mapping[tuple[int, int], UInt8[np.ndarray, "S S 3"]] | None = None,
    lens: Camera | None = None,
) -> None:
    """Draw birds of a result as pairs of tiles, and write one PNG.

    Left tile: the annotated mask (grey) and keypoints (black rings), the outline of the fitted mesh (green) and the
    fitted keypoints (red), with lines to the annotated keypoints. With footage, the left tile shows the footage, the
    outline of the mesh in the colour of the track, fitted keypoints as white dots and annotated keypoints as yellow
    rings. The flag of a pose that is not `ok` stands beside the number of the frame. Right tile: the mesh as the camera
    sees it, lit from above. A legend above the tiles explains these symbols.

    Args:
        solution, bird: a result and its model.
        observations: the observations of the fit; tracks and frames are matched by their numbers.
        path: PNG file to write.
        columns: number of pairs in a row.
        most: greatest number of pairs, selected evenly over birds and frames; with footage, greatest number of rows.
        footage: (n, t) → tile of the footage, from `cut_tiles`; the sheet then has one row per track
            (`sheet_pairs`).
        lens: as for `jaxfit.data.projection.PosedBirds`.

    Raises:
        InputError: the system rejects the write.
    """
    posed = PosedBirds(solution, bird, lens)
    if footage is not None:
        rows = sheet_pairs(solution, columns, most)
    else:
        pairs = [(int(n), int(t)) for n, t in np.argwhere(solution.valid)]
        picks = np.unique(np.linspace(0, len(pairs) - 1, most).astype(int)).tolist() if pairs else []
        rows = [[pairs[i] for i in picks[start : start + columns]] for start in range(0, len(picks), columns)]
    detected = Detected(solution, observations)
    colours = 0.55 * np.asarray(bird.vertex_colours)[:, ::-1] + 0.45 * np.array(PALE)
    blank = np.full((TILE_PX, 2 * TILE_PX, 3), PAPER, np.uint8)
    drawn = []
    for row in rows or [[]]:
        tiles = []
        for n, t in row:
            ground = None if footage is None else footage.get((n, t))
            tiles.append(np.hstack([observed_tile(posed, detected, n, t, ground), _mesh_tile(posed, n, t, colours)]))
        drawn.append(np.hstack(tiles + [blank] * (columns - len(row))))
    flagged = bool(np.isin(flags(solution.flags.doubts), (UNSURE, CONTRADICTED)).any())
    legend = _legend(drawn[0].shape[1], footage is not None, observations is not None, flagged)
    write_png(path, np.vstack([legend, *drawn]))


def _legend(width: int, on_footage: bool, has_detections: bool, flagged: bool) -> UInt8[np.ndarray, "H W 3"]:
    """Return the meaning of the symbols in the left tiles, and of the right tiles."""
    rim, fill = (DETECTED, FITTED) if on_footage else (ON_PAPER_DETECTED, ON_PAPER_FITTED)
    edge = INK if on_footage else None

    def outline(image, x, y, size):
        colour = track_colour(0) if on_footage else OUTLINE
        cv2.ellipse(
            image, (round(x + 0.85 * size), round(y)), (round(0.8 * size), round(0.45 * size)), 0, 0, 360, colour
        )

    def fitted(image, x, y, size):
        dot(image, (x + 0.85 * size, y), 2, fill, edge)

    def detected(image, x, y, size):
        ring(image, (x + 0.85 * size, y), 4.5 if on_footage else 3, rim, edge=edge)

    def mask(image, x, y, size):
        cv2.rectangle(
            image, (round(x), round(y - 0.5 * size)), (round(x + 1.7 * size), round(y + 0.5 * size)), SEEN, -1
        )

    entries: list[tuple[Symbol | None, str]] = [(outline, "outline of the fitted bird"), (fitted, "fitted keypoint")]
    if has_detections:
        entries.append((detected, "detected keypoint, with a line to the fitted keypoint"))
        entries += [] if on_footage else [(mask, "detected mask")]
    entries += [(None, FLAGGED)] if flagged else []
    return symbol_strip(
        width, _TEXT_PX, [*entries, (None, "right of each pair: the fitted bird as the camera sees it")]
    )


def _window(posed: PosedBirds, n: int, t: int) -> Float[np.ndarray, "3"]:
    """Return x0, y0, size of the square of a tile: the crop, or a smaller square if the bird is small in the crop."""
    crop = posed.solution.crops.square_px[n, t]
    points = posed.solution.keypoints.px[n, t]
    low, high = points.min(0), points.max(0)
    size = 1.5 * float((high - low).max())
    return crop if crop[2] < 1.4 * size else np.array([*((low + high - size) / 2), size], np.float32)


def _cut(picture: np.ndarray, window: np.ndarray, interpolation: int) -> np.ndarray:
    """Cut a window out of a picture, as a tile."""
    x0, y0, size = window
    zoom = TILE_PX / size
    # pixel centres are halves in jaxfit and whole numbers in OpenCV
    place = np.array([[zoom, 0, (0.5 - x0) * zoom - 0.5], [0, zoom, (0.5 - y0) * zoom - 0.5]])
    return cv2.warpAffine(picture, place, (TILE_PX, TILE_PX), flags=interpolation)


def _to_tile(points_px: np.ndarray, window: np.ndarray) -> np.ndarray:
    return (points_px - window[:2]) * (TILE_PX / window[2])


def observed_tile(posed: PosedBirds, detected: Detected, n: int, t: int, footage: np.ndarray | None) -> np.ndarray:
    """Return the left tile of a bird in `contact_sheet`."""
    solution, window = posed.solution, _window(posed, n, t)
    tile = np.full((TILE_PX, TILE_PX, 3), PAPER, np.uint8) if footage is None else footage.copy()
    mask = detected.mask(n, t) if footage is None else None
    if mask is not None:
        tile[_cut(mask.astype(np.uint8), window, cv2.INTER_NEAREST) > 0] = SEEN
    screen = posed.vertices_screen(n, t)
    screen = np.column_stack([_to_tile(screen[:, :2], window), screen[:, 2]])
    covered = hard_mask(screen, posed.faces, TILE_PX, TILE_PX).astype(np.uint8)
    contours, _ = cv2.findContours(covered, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(tile, contours, -1, OUTLINE if footage is None else track_colour(n), 1, cv2.LINE_AA)
    fitted = _to_tile(solution.keypoints.px[n, t], window)
    places, confidence = detected.keypoints(n, t)
    near = _to_tile(places, window)
    rim, fill = (ON_PAPER_DETECTED, ON_PAPER_FITTED) if footage is None else (DETECTED, FITTED)
    for k in np.flatnonzero(confidence > 0):
        line(tile, fitted[k], near[k], fill)
        if footage is None:
            ring(tile, near[k], 3, rim, edge=None)
        else:
            ring(tile, near[k], 4.5, rim)
    for k in range(len(fitted)) if footage is not None else np.flatnonzero(confidence > 0):
        dot(tile, fitted[k], 2, fill, None if footage is None else INK)
    name, frame = f"track {solution.track_id[n]}", f"frame {solution.frame_index[t]}"
    frame = with_flag(frame, flags(solution.flags.doubts[n : n + 1, t : t + 1]).item())
    if footage is None:
        text(tile, f"{name}  {frame}", 6, 11, 11, ON_PAPER_DETECTED)
    else:
        tag(tile, f"{name}  {frame}", 4, 13, 12, track_colour(n))
    return tile


def _mesh_tile(posed: PosedBirds, n: int, t: int, colours: Float[np.ndarray, "V 3"]) -> np.ndarray:
    """Return the tile of the mesh as the camera sees it, after shading."""
    here, faces, window = slice(t, t + 1), np.asarray(posed.faces), _window(posed, n, t)
    cam = posed.vertices_cam_window(n, here)
    screen, lit = posed.to_image(cam, n, here)[0], shade(cam[0], faces, colours)
    tile = np.full((TILE_PX, TILE_PX, 3), PAPER, np.uint8)
    tile_px = _to_tile(screen[:, :2], window)
    return draw(tile, np.concatenate([tile_px, screen[:, 2:]], axis=1), faces, lit, samples=3)
