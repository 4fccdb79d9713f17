"""Rotation and colours of decoded pictures as players show them."""

from __future__ import annotations

import logging
import math
import struct
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from av.sidedata.sidedata import Type
from av.video.reformatter import ColorTrc, Interpolation
from jaxtyping import UInt8

__all__ = ["EXACT", "Turn", "display_turn", "displayed", "displayed_size", "warn_of_difference"]

_logger = logging.getLogger(__name__)

EXACT = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.BITEXACT
"""Settings that convert colours identically on every machine."""

_HDR = {ColorTrc.SMPTE2084: "PQ", ColorTrc.ARIB_STD_B67: "HLG"}
_LARGEST_TILT = math.tan(math.radians(1))  # players ignore smaller deviations from multiples of 90°, as FFmpeg does


class Turn(NamedTuple):
    """Rotation by a multiple of 90°, and reflection: rows and columns are swapped first, then the order is reversed."""

    transposed: bool
    reversed_x: bool
    reversed_y: bool

    def size_px(self, width: int, height: int) -> tuple[int, int]:
        """Return the width and height of a turned picture."""
        return (height, width) if self.transposed else (width, height)

    def apply(self, picture: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H2 W2 3"]:
        """Return the turned picture."""
        if self.transposed:
            picture = cv2.transpose(picture)
        if self.reversed_x or self.reversed_y:
            picture = cv2.flip(picture, -1 if self.reversed_x and self.reversed_y else int(self.reversed_x))
        return picture


_UPRIGHT = Turn(False, False, False)


def display_turn(picture: Any) -> Turn | None:
    """Return how players turn a decoded picture, from its display matrix; None for an angle between multiples of 90°.

    The display matrix (a b u; c d v; x y w) of a container or of a codec maps the coded position (p, q) to the shown
    position (a·p + c·q + x, b·p + d·q + y). Scale and translation are ignored, as FFmpeg ignores both.
    """
    content = _display_matrix(picture)
    if content is None or len(content) != 36:
        return _UPRIGHT
    a, b, _, c, d, *_ = struct.unpack("=9i", content)
    straight, crossed = math.hypot(a, d), math.hypot(b, c)
    if crossed <= _LARGEST_TILT * straight:
        return Turn(False, a < 0, d < 0)
    if straight <= _LARGEST_TILT * crossed:
        return Turn(True, c < 0, b < 0)
    return None


def _display_matrix(picture: Any) -> bytes | None:
    try:
        return next((bytes(data) for data in picture.side_data if data.type == Type.DISPLAYMATRIX), None)
    except ValueError:  # data of a type that PyAV does not know
        return None


def displayed_size(picture: Any) -> tuple[int, int]:
    """Return the width and height in pixels of a decoded picture as players show the picture."""
    return (display_turn(picture) or _UPRIGHT).size_px(picture.width, picture.height)


def displayed(picture: Any) -> UInt8[np.ndarray, "H W 3"]:
    """Return the pixels of a decoded picture, turned as players turn the picture.

    The conversion follows the colour matrix and the range of the picture; BT.601 without a matrix, as in FFmpeg.

    Raises:
        av.error.FFmpegError: the pixel format is damaged.
    """
    picture_bgr = picture.to_ndarray(format="bgr24", interpolation=EXACT)
    return (display_turn(picture) or _UPRIGHT).apply(picture_bgr)


def warn_of_difference(path: Path, stream: Any, picture: Any) -> None:
    """Warn if players show a video in another way: tilted, with stretched pixels, or with tone mapping."""
    if display_turn(picture) is None:
        _logger.warning("%s: players tilt this video by an angle between multiples of 90°, jaxfit does not", path)
    aspect = stream.sample_aspect_ratio
    if aspect and aspect != 1:
        remedy = "convert the video to square pixels, because the camera model needs square pixels"
        _logger.warning(
            "%s: players stretch the pixels of this video to %s; %s", path, f"{aspect}".replace("/", ":"), remedy
        )
    if picture.color_trc in _HDR:
        kind = _HDR[picture.color_trc]
        _logger.warning("%s: is HDR video (%s), so that colours look pale; convert the video to SDR", path, kind)
