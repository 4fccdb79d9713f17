"""Drawing primitives: text, dots, rings and lines."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfit.foundation.files import write_whole
from jaxfit.view.colours import INK, Colour

SHIFT = 4  # OpenCV draws in units of 1/16 pixel; pixel centres are whole numbers in OpenCV, halves in jaxfit


CIRCLE, FINE_CIRCLE = (
    np.column_stack([f(np.linspace(0, 2 * np.pi, count, endpoint=False)) for f in (np.cos, np.sin)])
    for count in (12, 72)
)
"""Points of a circle of radius 1."""


def _fixed(points_px) -> Int[np.ndarray, "..."]:
    """Convert positions in image pixels to OpenCV's fixed-point numbers with `SHIFT`."""
    return np.clip(np.round((np.asarray(points_px, np.float64) - 0.5) * (1 << SHIFT)), -(2**19), 2**19).astype(np.int32)


def dot(image: UInt8[np.ndarray, "H W 3"], points_px, radius: float, colour: Colour, edge: Colour | None = INK) -> None:
    """Draw a filled circle with a thin edge at a position, or at (…, 2) positions."""
    for at in _fixed(points_px).reshape(-1, 2).tolist():
        if edge is not None:
            cv2.circle(image, at, round((radius + 0.8) * (1 << SHIFT)), edge, -1, cv2.LINE_AA, SHIFT)
        cv2.circle(image, at, round(radius * (1 << SHIFT)), colour, -1, cv2.LINE_AA, SHIFT)


def ring(
    image: UInt8[np.ndarray, "H W 3"],
    points_px,
    radius: float,
    colour: Colour,
    width: int = 1,
    edge: Colour | None = INK,
) -> None:
    """Draw circles with an edge on both sides, so that they contrast with any background; positions as for `dot`."""
    centres = np.asarray(points_px, np.float64).reshape(-1, 1, 2)
    curves = list(_fixed(centres + radius * (CIRCLE if radius < 10 else FINE_CIRCLE)))
    if edge is not None:
        cv2.polylines(image, curves, True, edge, width + 1, cv2.LINE_AA, SHIFT)
    cv2.polylines(image, curves, True, colour, width, cv2.LINE_AA, SHIFT)


def line(image: UInt8[np.ndarray, "H W 3"], a_px, b_px, colour: Colour, width: int = 1) -> None:
    """Draw straight lines between positions in pixels, (…, 2) each."""
    ends = _fixed(np.stack([a_px, b_px], axis=-2)).reshape(-1, 2, 2)
    cv2.polylines(image, list(ends), False, colour, width, cv2.LINE_AA, SHIFT)


def closed_curve(
    image: UInt8[np.ndarray, "H W 3"], points_px: Float[np.ndarray, "P 2"], colour: Colour, width: int = 1
) -> None:
    """Draw a closed line through positions in pixels, with a dark edge, so that it contrasts with any background."""
    at = [_fixed(points_px)]
    cv2.polylines(image, at, True, INK, width + 1, cv2.LINE_AA, SHIFT)
    cv2.polylines(image, at, True, colour, width, cv2.LINE_AA, SHIFT)


def text(image: UInt8[np.ndarray, "H W 3"], words: str, left: float, middle: float, size: float, colour=INK) -> None:
    """Draw text from column `left` on, `size` pixels high, vertically centred on row `middle`."""
    cv2.putText(
        image,
        words,
        (round(left), round(middle + 0.42 * size)),
        cv2.FONT_HERSHEY_SIMPLEX,
        size / 26,
        colour,
        max(1, round(size / 13)),
        cv2.LINE_AA,
    )


def text_width(words: str, size: float) -> int:
    """Return the width in pixels of a `text`."""
    return cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size / 26, max(1, round(size / 13)))[0][0]


def tag(image: UInt8[np.ndarray, "H W 3"], words: str, left: float, middle: float, size: float, colour: Colour) -> int:
    """Draw text on a coloured plate, and return the width of the plate in pixels."""
    width = text_width(words, size) + round(0.9 * size)
    low, high = (round(left), round(middle - 0.85 * size)), (round(left) + width, round(middle + 0.85 * size))
    cv2.rectangle(image, low, high, colour, -1)
    cv2.rectangle(image, low, high, INK, 1)
    bright = 0.114 * colour[0] + 0.587 * colour[1] + 0.299 * colour[2] > 110
    text(image, words, left + 0.45 * size, middle, size, (0, 0, 0) if bright else (255, 255, 255))
    return width


def write_png(path: str | Path, image: UInt8[np.ndarray, "H W 3"]) -> None:
    """Write an image (blue, green, red) as a PNG, completely or not at all."""
    written, png = cv2.imencode(".png", image)
    if not written:
        raise RuntimeError("OpenCV could not encode a PNG")
    write_whole(Path(path), png.tobytes())
