"""Drawing primitives: colours of tracks, text, dots, rings and lines."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.storage.files import write_whole

__all__ = [
    "DETECTED",
    "FITTED",
    "INK",
    "PAPER",
    "PLUMAGE_SHARE",
    "dot",
    "line",
    "ring",
    "tag",
    "text",
    "text_width",
    "tinted",
    "track_colour",
    "write_png",
]

Colour = tuple[int, int, int]

PAPER: Colour = (250, 250, 250)
INK: Colour = (40, 40, 40)
FITTED: Colour = (255, 255, 255)
DETECTED: Colour = (60, 235, 255)
"""Colours here and below: blue, green, red."""

TRACK_COLOURS: tuple[Colour, ...] = (
    (0, 159, 230),  # orange
    (233, 180, 86),  # sky blue
    (136, 204, 60),  # green
    (191, 121, 224),  # pink
    (66, 228, 240),  # yellow
    (0, 84, 213),  # vermilion
    (214, 134, 30),  # blue
    (153, 136, 17),  # teal
    (204, 170, 255),  # rose
    (51, 153, 153),  # olive
    (230, 110, 150),  # violet
    (210, 245, 190),  # mint
)
"""Colours of the tracks in order, repeated after the last. The first seven are the colours of Okabe and Ito with the
dark colours made lighter; people with any colour vision can distinguish them. All contrast with dark and with white
plumage."""

PLUMAGE_SHARE = 0.4
"""Weight of the model's colours in the colours of a drawn bird; the rest is the colour of the track."""

SHIFT = 4  # OpenCV draws in units of 1/16 pixel; pixel centres are whole numbers in OpenCV, halves in jaxfit


def track_colour(n: int) -> Colour:
    """Return the colour of the track at position `n`."""
    return TRACK_COLOURS[n % len(TRACK_COLOURS)]


def tinted(vertex_colours: Float[np.ndarray, "V 3"], n: int, share: float = PLUMAGE_SHARE) -> Float[np.ndarray, "V 3"]:
    """Mix a model's colours (red, green, blue) with the colour of a track: blue, green, red in [0, 1]."""
    own = np.asarray(vertex_colours, np.float32)[:, ::-1]
    return share * own + (1 - share) * np.array(track_colour(n), np.float32) / 255


def fixed(point_px: Float[np.ndarray, "2"] | tuple[float, float]) -> tuple[int, int]:
    """Convert a position in image pixels to OpenCV's fixed-point numbers with `SHIFT`."""
    x, y = np.clip(np.round((np.asarray(point_px, np.float64) - 0.5) * (1 << SHIFT)), -(2**19), 2**19)
    return int(x), int(y)


def dot(image: UInt8[np.ndarray, "H W 3"], point_px, radius: float, colour: Colour, edge: Colour | None = INK) -> None:
    """Draw a filled circle with a thin edge."""
    at = fixed(point_px)
    if edge is not None:
        cv2.circle(image, at, round((radius + 0.8) * (1 << SHIFT)), edge, -1, cv2.LINE_AA, SHIFT)
    cv2.circle(image, at, round(radius * (1 << SHIFT)), colour, -1, cv2.LINE_AA, SHIFT)


def ring(
    image: UInt8[np.ndarray, "H W 3"],
    point_px,
    radius: float,
    colour: Colour,
    width: int = 1,
    edge: Colour | None = INK,
) -> None:
    """Draw a circle with an edge on both sides, so that it contrasts with any background."""
    at = fixed(point_px)
    if edge is not None:
        cv2.circle(image, at, round(radius * (1 << SHIFT)), edge, width + 1, cv2.LINE_AA, SHIFT)
    cv2.circle(image, at, round(radius * (1 << SHIFT)), colour, width, cv2.LINE_AA, SHIFT)


def line(image: UInt8[np.ndarray, "H W 3"], a_px, b_px, colour: Colour, width: int = 1) -> None:
    """Draw a straight line between two positions in pixels."""
    cv2.line(image, fixed(a_px), fixed(b_px), colour, width, cv2.LINE_AA, SHIFT)


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
