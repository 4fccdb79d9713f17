"""Legends: the meaning of the symbols in overlays and contact sheets; in overlays also the number of the frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxfit.view.birds import Style
from jaxfit.view.colours import DETECTED, FITTED, PAPER, track_colour
from jaxfit.view.drawing import closed_curve, dot, line, ring, tag, text, text_width
from jaxfit.view.report.axis import clock

Symbol = Callable[[np.ndarray, float, float, float], None]
"""Draws a symbol, 1.7 times as wide as the text is high: image, left end, middle row, height of the text."""


def symbol_strip(
    width: int, size: float, entries: Sequence[tuple[Symbol | None, str]], first: float = 0.0
) -> UInt8[np.ndarray, "H W 3"]:
    """Return symbols with their meaning, in as many lines as the width requires.

    Args:
        width: width in pixels.
        size: height of the text in pixels.
        entries: symbol (None: only text) and meaning.
        first: empty space at the left of the first line, in pixels.
    """
    left, right, gap, line_px, row = 0.8 * size, width - 0.8 * size, 1.8 * size, 2.2 * size, 0
    x = left + first
    places = []
    for symbol, words in entries:
        wide = 2.6 * size + text_width(words, size)
        if x + wide > right and x > left:
            x, row = left, row + 1
        places.append((symbol, words, x, (row + 0.5) * line_px))
        x += wide + gap
    strip = np.full((round((row + 1) * line_px), width, 3), PAPER, np.uint8)
    for symbol, words, x, middle in places:
        if symbol is not None:
            symbol(strip, x, middle, size)
        text(strip, words, x + (0 if symbol is None else 2.1 * size), middle, size)
    return strip


class Legend:
    """A legend with a fixed layout, in as many lines as the width requires; the frame number changes.

    Args:
        width: width in pixels.
        style: style of the overlay.
        detected: explain the rings of detected keypoints.
        side_views: explain the side views.
        regions: explain the regions of 95 % of keypoints.
        flagged: explain the flags beside track numbers.
    """

    def __init__(
        self,
        width: int,
        style: Style,
        detected: bool,
        side_views: bool,
        regions: bool = False,
        flagged: bool = False,
    ):
        self._style, size = style, style.text_px
        entries: list[tuple[Symbol | None, str]] = [(self._number, "track"), (self._mesh, "fitted bird")]
        entries.append((self._fitted, "fitted keypoint"))
        if detected:
            entries.append((self._detected, "detected keypoint"))
        if regions:
            entries.append((self._region, REGION))
        if flagged:
            entries.append((None, FLAGGED))
        if side_views:
            entries.append((None, "below: each bird from its left, upright as birds stand"))
        frame_px = text_width("frame 000000   00:00:00.00", size) + 2.4 * size
        self._ground = symbol_strip(width, size, entries, frame_px)
        self.height = len(self._ground)

    def draw(self, number: int, seconds: float) -> UInt8[np.ndarray, "H W 3"]:
        """Return the legend for the frame with this number and time since the start of the video."""
        image, size = self._ground.copy(), self._style.text_px
        text(image, f"frame {number}", 0.8 * size, 1.1 * size, size)
        text(image, clock(seconds), 1.6 * size + text_width("frame 000000", size), 1.1 * size, size, (110, 110, 110))
        return image

    def _number(self, image, x, y, size):
        tag(image, "1", x + 0.2 * size, y, 0.85 * size, track_colour(0))

    def _mesh(self, image, x, y, size):
        shape = np.round([[x + 0.9 * size + 0.85 * size * np.cos(a), y + 0.5 * size * np.sin(a)] for a in _TURN])
        cv2.fillPoly(image, [shape.astype(np.int32)], (195, 185, 170), cv2.LINE_AA)
        cv2.polylines(image, [shape.astype(np.int32)], True, track_colour(0), self._style.line_px + 1, cv2.LINE_AA)

    def _fitted(self, image, x, y, size):
        line(image, (x, y + 0.3 * size), (x + 1.7 * size, y - 0.3 * size), (150, 150, 150))
        dot(image, (x + 0.85 * size, y), 0.17 * size, FITTED)

    def _detected(self, image, x, y, size):
        ring(image, (x + 0.85 * size, y), 0.34 * size, DETECTED, max(1, round(0.1 * size)))

    def _region(self, image, x, y, size):
        around = [[x + 0.85 * size + 0.8 * size * np.cos(a), y + 0.42 * size * np.sin(a)] for a in _TURN]
        closed_curve(image, np.array(around), track_colour(0))
        dot(image, (x + 0.85 * size, y), 0.17 * size, FITTED)


REGION = "95 % region of a fitted keypoint, if larger than the dot"
FLAGGED = "unsure, contradicted: flag of the pose"
_TURN = np.linspace(0, 2 * np.pi, 40)
