"""Decode the frames of a video. Frame numbers are stable across damaged frames."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import av
import av.error
import numpy as np
from av.video.reformatter import Interpolation
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.video.numbering import Timeline
from jaxfit.video.opening import opened
from jaxfit.video.packets import add_packet, begin, checked_by_index, demuxed, packet_timeline, time_of

__all__ = ["EXACT", "Frame", "decode"]

_logger = logging.getLogger(__name__)

EXACT = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.BITEXACT
"""Settings that convert colours identically on every machine."""


class Frame(NamedTuple):
    """One frame of a video."""

    index: int
    """Number of the frame, from 0. The number of a picture does not depend on the first frame that is read."""
    picture: UInt8[np.ndarray, "H W 3"]
    """Pixels, in the channel order blue, green, red."""
    time_s: float | None
    """Presentation time in seconds, as `jaxfit.video.packets.time_of` defines it. None if the time is unknown."""


def decode(path: Path, numbers: range, stopped: Callable[[], bool]) -> Generator[Frame | int, None, None]:
    """Yield the requested frames of a video in order. For a damaged or lost frame, yield only its number.

    If the container has time stamps (mp4, mkv, webm), the packets of earlier frames are counted and not decoded.
    Decoding starts at the third last keyframe before the first requested frame. A stream with gradual refresh has no
    true keyframes, and needs up to two of its recovery points until its pictures are complete.

    Args:
        path: the file.
        numbers: numbers of the requested frames.
        stopped: called between packets; True ends the decoding.

    Raises:
        InputError: the file is not a readable video, or no picture of it can be decoded.
    """
    if not numbers:
        return
    with opened(path) as (container, stream):
        begun = begin(container, stream, numbers.start, stopped)
        if begun is not None:
            yield from _read(path, container, stream, *begun, numbers, stopped)
            return
    with opened(path) as (container, stream):
        line = packet_timeline(container, stream)
        yield from _read(path, container, stream, demuxed(container, stream), line, numbers, stopped)


def _read(
    path: Path,
    container: Any,
    stream: Any,
    packets: Iterator[tuple[Any, bool]],
    line: Timeline,
    numbers: range,
    stopped: Callable[[], bool],
) -> Iterator[Frame | int]:
    any_picture, problem = False, ""
    size = stream.width, stream.height  # the decoder changes these values if the size of the pictures changes
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
            if not any_picture and picture.rotation:
                _logger.warning("%s: players rotate this video by %d°, the frames here are not", path, picture.rotation)
            any_picture = True
            line.show(picture)
        for number, packet, whole in line.ready():
            if number in numbers and whole is None:
                yield number
            elif number in numbers:
                time_s = time_of(number, packet, line, stream)
                picture_bgr = _convert(path, number, whole, size)
                yield number if picture_bgr is None else Frame(number, picture_bgr, time_s)
            if number >= numbers[-1]:
                return
        if picture is None:
            break
    if not any_picture:
        raise InputError(path, f"no frame can be decoded{problem}", "the file may be incomplete or damaged")
    _warn_if_short(path, container, stream, line, problem)


def _convert(path: Path, number: int, picture: Any, size: tuple[int, int]) -> np.ndarray | None:
    """Return the pixels of a decoded picture; None if its pixel format is damaged."""
    if (picture.width, picture.height) != size:
        problem = f"its frame {number} is {picture.width}×{picture.height}, but the video is {size[0]}×{size[1]}"
        raise InputError(path, problem, "convert the video to a single size")
    try:
        return picture.to_ndarray(format="bgr24", interpolation=EXACT)
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
    count = line.number + line.skipped
    if problem or count < stream.frames:
        _logger.warning("%s: ends after %d of %s frames%s", path, count, stream.frames or "more", problem)
    elif not stream.frames and container.duration and line.last is not None and len(container.streams) == 1:
        promised, end = container.duration / av.time_base, float(line.last * stream.time_base)
        if end + 1 < promised:
            _logger.warning("%s: ends after %.1f of %.1f seconds", path, end, promised)
