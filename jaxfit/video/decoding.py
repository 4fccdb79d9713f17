"""Decode the frames of a video. Frame numbers are stable across damaged frames."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import av
import av.error
import numpy as np
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.video.deinterlacing import NumberedPicture, deinterlaced
from jaxfit.video.display import displayed, displayed_size, warn_of_difference
from jaxfit.video.numbering import Timeline
from jaxfit.video.opening import frame_count, opened
from jaxfit.video.packets import add_packet, begin, checked_by_index, demuxed, packet_timeline, time_of

__all__ = ["Frame", "decode"]

_logger = logging.getLogger(__name__)


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
