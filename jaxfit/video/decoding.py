"""Decoding of frames as players show them: whole pictures, rotation, colours; damaged frames are reported."""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Callable, Generator, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import av
import av.error
import av.filter
import cv2
import numpy as np
from av.sidedata.sidedata import Type
from av.video.reformatter import ColorTrc, Interpolation
from jaxtyping import UInt8

from jaxfit.foundation.errors import InputError
from jaxfit.video.packets import (
    Timeline,
    add_packet,
    begin,
    checked_by_index,
    demuxed,
    frame_count,
    opened,
    packet_timeline,
    time_of,
)

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


_FILTER = "bwdif"


class NumberedPicture(NamedTuple):
    """A decoded picture with its number and time."""

    number: int
    time_s: float | None
    picture: Any
    """None if the picture is damaged."""


def deinterlaced(path: Path, pictures: Iterator[NumberedPicture]) -> Iterator[NumberedPicture]:
    """Yield consecutive pictures; interlaced pictures are deinterlaced, all other pictures are unchanged.

    FFmpeg's filter `bwdif` fills the lines of one field from the other field and from the neighbours of the picture.
    A result depends on a picture and its two neighbours only, and not on where the reading begins. Damaged pictures are
    not used.
    """
    before: Any = None
    waiting: NumberedPicture | None = None
    lines: _Filter | None = None
    for numbered in pictures:
        picture = numbered.picture
        if waiting is not None and lines is not None:
            yield waiting._replace(picture=lines.next(picture))
            waiting = None
        if picture is None or not picture.interlaced_frame:
            lines = None
            yield numbered
        else:
            lines = lines or _Filter(path, before, picture)
            waiting = numbered
        before = picture
    if waiting is not None and lines is not None:
        yield waiting._replace(picture=lines.next(None))


class _Filter:
    """Deinterlaces consecutive pictures.

    Args:
        path: the file, for a warning.
        before: the picture before the first picture; None if unknown.
        first: the first picture.
    """

    def __init__(self, path: Path, before: Any, first: Any):
        self._path, self._last, self._graph = path, first, av.filter.Graph()
        try:
            source = self._graph.add(
                "buffer",
                video_size=f"{first.width}x{first.height}",
                pix_fmt=first.format.name,
                time_base=str(first.time_base or Fraction(1, 1000)),
                pixel_aspect="1/1",
                colorspace=str(int(first.colorspace)),
                range=str(int(first.color_range)),
            )
            filtering = self._graph.add(_FILTER, mode="send_frame", deint="interlaced")
            self._graph.link_nodes(source, filtering, self._graph.add("buffersink")).configure()
            if before is not None and _alike(before, first):
                self._graph.vpush(before)
                self._graph.vpush(first)
                self._graph.vpull()  # the picture before
            else:
                self._graph.vpush(first)
        except (av.error.FFmpegError, ValueError) as error:
            self._fail(error)

    def next(self, following: Any) -> Any:
        """Return the last picture deinterlaced, given the following picture; None if there is none."""
        picture, self._last = self._last, following
        if self._graph is None:
            return picture
        try:
            self._graph.vpush(following if following is not None and _alike(picture, following) else None)
            return self._graph.vpull()
        except (av.error.FFmpegError, ValueError) as error:
            self._fail(error)
            return picture

    def _fail(self, error: Exception) -> None:
        self._graph = None
        _logger.warning("%s: cannot be deinterlaced (%s), the frames keep two fields", self._path, error)


def _alike(a: Any, b: Any) -> bool:
    return (a.width, a.height, a.format.name) == (b.width, b.height, b.format.name)


class Frame(NamedTuple):
    """One frame of a video."""

    index: int
    """Number of the frame, from 0. The number of a picture does not depend on the first frame that is read."""
    picture: UInt8[np.ndarray, "H W 3"]
    """Pixels as players show the frame: upright and deinterlaced. The channel order is blue, green, red."""
    time_s: float | None
    """Presentation time in seconds, as `jaxfit.video.packets.time_of` defines it. None if the time is unknown."""


def decode(
    path: Path, numbers: range, size_px: tuple[int, int], stopped: Callable[[], bool]
) -> Generator[Frame | int, None, None]:
    """Yield the requested frames of a video in order. For a damaged or lost frame, yield only its number.

    If the container has time stamps (mp4, mkv, webm), the packets of earlier frames are counted and not decoded.
    Decoding starts at the third last keyframe before the first requested frame. A stream with gradual refresh has no
    true keyframes, and needs up to two of its recovery points until its pictures are complete.

    Args:
        path: the file.
        numbers: numbers of the requested frames.
        size_px: width and height of the video as players show it.
        stopped: called between packets; True ends the decoding.

    Raises:
        InputError: the file is not a readable video, no picture of it can be decoded, or a picture has another size.
    """
    if not numbers:
        return
    with opened(path) as (container, stream):
        begun = begin(container, stream, numbers.start, stopped)
        if begun is not None:
            yield from _read(path, container, stream, *begun, numbers, size_px, stopped)
            return
    with opened(path) as (container, stream):
        line = packet_timeline(container, stream)
        yield from _read(path, container, stream, demuxed(container, stream), line, numbers, size_px, stopped)


def _read(
    path: Path,
    container: Any,
    stream: Any,
    packets: Iterator[tuple[Any, bool]],
    line: Timeline,
    numbers: range,
    size_px: tuple[int, int],
    stopped: Callable[[], bool],
) -> Iterator[Frame | int]:
    pictures = _numbered(path, container, stream, packets, line, stopped)
    for number, time_s, picture in deinterlaced(path, pictures):
        if stopped():
            return
        if number in numbers:
            picture_bgr = None if picture is None else _convert(path, number, picture, size_px)
            yield number if picture_bgr is None else Frame(number, picture_bgr, time_s)
        if number >= numbers[-1]:
            return


def _numbered(
    path: Path,
    container: Any,
    stream: Any,
    packets: Iterator[tuple[Any, bool]],
    line: Timeline,
    stopped: Callable[[], bool],
) -> Iterator[NumberedPicture]:
    """Yield all pictures from the first packet on, in the order of their numbers."""
    any_picture, problem = False, ""
    decoded = _decoded(packets, stream, line, stopped)
    while True:
        try:
            picture = next(decoded, None)
        except av.error.FFmpegError as error:
            problem, picture = f": {error.strerror}", None
        if stopped():
            return
        if picture is None:
            line.finish()
        else:
            if not any_picture:
                warn_of_difference(path, stream, picture)
            any_picture = True
            line.show(picture)
        for number, packet, whole in line.ready():
            yield NumberedPicture(number, time_of(number, packet, line, stream), whole)
        if picture is None:
            break
    if not any_picture:
        raise InputError(path, f"no frame can be decoded{problem}", "the file may be incomplete or damaged")
    _warn_if_short(path, container, stream, line, problem)


def _convert(path: Path, number: int, picture: Any, size_px: tuple[int, int]) -> np.ndarray | None:
    """Return the pixels of a decoded picture; None if its pixel format is damaged."""
    width, height = displayed_size(picture)
    if (width, height) != size_px:
        problem = f"its frame {number} is {width}×{height}, but the video is {size_px[0]}×{size_px[1]}"
        raise InputError(path, problem, "convert the video to a single size")
    try:
        return displayed(picture)
    except av.error.FFmpegError:
        return None


def _decoded(
    packets: Iterator[tuple[Any, bool]], stream: Any, line: Timeline, stopped: Callable[[], bool]
) -> Iterator[Any]:
    """Yield decoded pictures in the order of the decoder. Every packet is added to the timeline first."""
    problem = None
    packets = checked_by_index(packets, stream, line)
    while not stopped():
        try:
            packet, torn = next(packets, (None, False))
        except av.error.FFmpegError as error:  # the container is damaged: the decoder still returns its last pictures
            problem, packet, torn = error, None, False
        if packet is not None:
            add_packet(line, packet, torn)
        try:
            pictures = stream.decode(packet)  # None flushes the decoder
        except av.error.FFmpegError:  # one packet is damaged: the timeline misses its frame at the next picture
            pictures, line.troubled = [], True
        yield from pictures
        if packet is None:
            break
    if problem is not None:
        raise problem


def _warn_if_short(path: Path, container: Any, stream: Any, line: Timeline, problem: str) -> None:
    frames = frame_count(stream)
    if problem or line.number + line.skipped < (frames or 0):
        _logger.warning("%s: ends after %d of %s frames%s", path, line.number, frames or "more", problem)
    elif not frames and container.duration and line.last is not None and len(container.streams) == 1:
        promised, end = container.duration / av.time_base, float(line.last * stream.time_base)
        if end + 1 < promised:
            _logger.warning("%s: ends after %.1f of %.1f seconds", path, end, promised)
