"""Decode the frames of a video. Frame numbers are stable across damaged frames."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Generator, Iterator
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import av
import av.error
import numpy as np
from av.video.reformatter import Interpolation
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.video.numbering import Packet, Place, Timeline
from jaxfit.video.opening import frame_rate, opened

__all__ = ["EXACT", "Frame", "decode"]

_logger = logging.getLogger(__name__)

EXACT = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.BITEXACT
"""Settings that convert colours identically on every machine."""

_MATROSKA = "matroska,webm"
_STAMPED = ("mov,mp4,m4a,3gp,3g2,mj2", _MATROSKA)  # every packet has a time stamp, so seeks are exact
_REORDERED = ("h264", "hevc")  # AVI has no time stamps, and FFmpeg cannot derive correct time stamps for these
_CHUNK_HEADER = 8  # bytes between the position in the index of an AVI file and the packet
_MOST_HEADERS = 1024  # bytes; a larger gap between the packets of a Matroska file is damage


class Frame(NamedTuple):
    """One frame of a video."""

    index: int
    """Number of the frame, from 0. The number of a picture does not depend on the first frame that is read."""
    picture: UInt8[np.ndarray, "H W 3"]
    """Pixels, in the channel order blue, green, red."""
    time_s: float | None
    """Seconds since frame 0, from the time stamps of the container or else from the frame rate. None without both."""


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
        begun = _begin(container, stream, numbers.start, stopped)
        if begun is not None:
            yield from _read(path, container, stream, *begun, numbers, stopped)
            return
    with opened(path) as (container, stream):
        line = _timeline(container, stream)
        yield from _read(path, container, stream, _demuxed(container, stream), line, numbers, stopped)


def _read(
    path: Path,
    container: Any,
    stream: Any,
    packets: Iterator[tuple[Any, bool]],
    line: Timeline,
    numbers: range,
    stopped: Callable[[], bool],
) -> Iterator[Frame | int]:
    rate, any_picture, problem = frame_rate(stream), False, ""
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
                time_s = number / rate if rate else None
                if line.stamped and line.origin is not None:
                    time_s = float((packet.stamp - line.origin) * stream.time_base)
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
    packets = _checked_by_index(packets, stream, line)
    while not stopped():
        try:
            packet, torn = next(packets, (None, False))
        except av.error.FFmpegError as error:  # the container is damaged: the decoder still returns its last pictures
            problem, packet, torn = error, None, False
        if packet is not None:
            _add(line, packet, torn)
        try:
            pictures = stream.decode(packet)  # None flushes the decoder
        except av.error.FFmpegError:  # one packet is damaged: the timeline misses its frame at the next picture
            pictures, line.troubled = [], True
        yield from pictures
        if packet is None:
            break
    if problem is not None:
        raise problem


def _add(line: Timeline, packet: Any, torn: bool) -> Packet | None:
    # VP8 has packets that serve only as references. A bit of the first byte marks these packets.
    hidden = packet.stream.codec_context.name == "vp8" and not memoryview(packet)[0] & 0x10
    if hidden or packet.is_discard:
        line.skipped += 1
        return None
    return line.add(packet.pts, packet.is_keyframe, corrupt=packet.is_corrupt, torn=torn)


def _demuxed(container: Any, stream: Any) -> Iterator[tuple[Any, bool]]:
    """Yield the non-empty packets of a stream, each with whether bytes were skipped before the packet."""
    matroska, end, torn = container.format.name == _MATROSKA, None, False
    # in Matroska all streams are read, because gaps between packets of one stream are normal
    for packet in container.demux() if matroska else container.demux(stream):
        if not packet.size:  # a repeated picture in AVI, or the end of a stream
            continue
        if matroska and packet.pos is not None:
            torn = torn or (end is not None and packet.pos - end > _MOST_HEADERS)
            end = packet.pos + packet.size
        if packet.stream_index == stream.index:
            yield packet, torn
            torn = False


def _checked_by_index(packets: Iterator[tuple[Any, bool]], stream: Any, line: Timeline) -> Iterator[tuple[Any, bool]]:
    """Correct the times of AVI packets by the index of the file.

    FFmpeg derives the time of an AVI packet by counting packets, which is wrong after packets that damage hides.
    """
    index = stream.index_entries
    if stream.container.format.name != "avi" or len(index) < max(1, stream.frames):
        yield from packets
        return
    at, trusted = 0, None
    for packet, torn in packets:
        trusted = packet.pos == index[0].pos + _CHUNK_HEADER if trusted is None else trusted
        if trusted and packet.pos is not None and packet.dts is not None:
            while at < len(index) and index[at].pos + _CHUNK_HEADER < packet.pos:
                if index[at].size:
                    line.add(index[at].timestamp, index[at].is_keyframe, lost=True)
                at += 1
            if at == len(index) or index[at].pos + _CHUNK_HEADER > packet.pos:
                continue  # bytes of a damaged packet that look like a packet
            shift, at = index[at].timestamp - packet.dts, at + 1
            packet.pts = None if packet.pts is None else packet.pts + shift
            packet.dts += shift
        yield packet, torn


def _begin(
    container: Any, stream: Any, start: int, stopped: Callable[[], bool]
) -> tuple[Iterator[tuple[Any, bool]], Timeline] | None:
    """Return the packets from a keyframe before frame `start`, or from the first packet, and their timeline.

    Returns None if the seek does not find the keyframe again.
    """
    if not start or container.format.name not in _STAMPED:
        return _demuxed(container, stream), _timeline(container, stream)
    keyframe = _keyframe(container, stream, start, stopped)
    if keyframe is None:
        return None
    place, mark = keyframe
    try:
        container.seek(place.stamp, stream=stream)
        packets = _demuxed(container, stream)
        for packet, _ in packets:
            if stopped():
                return None
            if _mark(packet) == mark:
                return chain([(packet, False)], packets), _timeline(container, stream, place)
    except av.error.FFmpegError:
        pass
    return None


def _keyframe(container: Any, stream: Any, start: int, stopped: Callable[[], bool]) -> tuple[Place, tuple] | None:
    """Return the third last keyframe up to frame `start`, found by counting packets.

    Returns None if there is no such keyframe or the time stamps are unusable.
    """
    line = _timeline(container, stream)
    waiting: dict[int, tuple] = {}
    keyframes: deque[tuple[Place, tuple]] = deque(maxlen=3)
    try:
        for packet, torn in _demuxed(container, stream):
            if stopped():
                return None
            added = _add(line, packet, torn)
            if not line.stamped:
                return None
            if added is not None and added.starts:
                waiting[added.order] = _mark(packet)
            if packet.dts is None:
                continue
            # no later packet is shown before this decoding time
            for number, settled, there in line.settle(packet.dts):
                if number > start:
                    return keyframes[0] if keyframes else None
                if there and settled.order in waiting:
                    keyframes.append((line.place(number, settled), waiting.pop(settled.order)))
    except av.error.FFmpegError:
        pass
    return keyframes[0] if keyframes else None


def _mark(packet: Any) -> tuple:
    return packet.pts, packet.pos, packet.size


def _timeline(container: Any, stream: Any, place: Place | None = None) -> Timeline:
    rate, kind = frame_rate(stream), container.format.name
    # Matroska has no list of packets, so the frames in a gap of the file are counted by the interval
    interval = float(1 / (rate * stream.time_base)) if rate and kind == _MATROSKA else None
    return Timeline(interval, not (kind == "avi" and stream.codec_context.name in _REORDERED), place)


def _warn_if_short(path: Path, container: Any, stream: Any, line: Timeline, problem: str) -> None:
    count = line.number + line.skipped
    if problem or count < stream.frames:
        _logger.warning("%s: ends after %d of %s frames%s", path, count, stream.frames or "more", problem)
    elif not stream.frames and container.duration and line.last is not None and len(container.streams) == 1:
        promised, end = container.duration / av.time_base, float(line.last * stream.time_base)
        if end + 1 < promised:
            _logger.warning("%s: ends after %.1f of %.1f seconds", path, end, promised)
