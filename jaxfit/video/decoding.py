"""A video's frames, decoded: numbered for good, damaged ones told apart."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import av
import av.error
import numpy as np
from av.stream import Disposition
from av.video.reformatter import Interpolation
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.video.numbering import Packet, Place, Timeline

__all__ = ["EXACT", "Frame", "decode", "frame_rate", "opened"]

_logger = logging.getLogger(__name__)

EXACT = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.BITEXACT
"""Colours are converted alike on every machine."""

_MATROSKA = "matroska,webm"
_STAMPED = ("mov,mp4,m4a,3gp,3g2,mj2", _MATROSKA)  # every packet has a time stamp of its own: seeks are exact
_REORDERED = ("h264", "hevc")  # AVI has no time stamps, and nothing makes up right ones for these
_CHUNK_HEADER = 8  # bytes between what AVI's index names and the packet
_MOST_HEADERS = 1024  # bytes between packets of Matroska that need no explanation


class Frame(NamedTuple):
    """One frame of a video."""

    index: int
    """Its number, counted from 0: the same number is the same picture, wherever reading began."""
    picture: UInt8[np.ndarray, "H W 3"]
    """Blue-green-red."""
    time_s: float | None
    """Seconds since frame 0: the container's time stamps, or by the frame rate where it has none; None where there is
    neither."""


def decode(path: Path, wanted: range, stopped: Callable[[], bool]) -> Generator[Frame | int, None, None]:
    """Those frames of a video, in order; the bare number of one that is damaged or lost.

    What comes before is not decoded where the container has time stamps (mp4, mkv, webm): its packets are counted,
    then decoding begins at a keyframe before. It is the third last: a stream that refreshes bit by bit instead
    of having true keyframes needs up to two of its marks until pictures are whole.

    Args:
        path: the file.
        wanted: numbers.
        stopped: asked between packets whether to end.

    Raises:
        InputError: no video that can be read, or not a single picture in it.
    """
    if not wanted:
        return
    with opened(path) as (container, stream):
        begun = _begin(container, stream, wanted.start, stopped)
        if begun is not None:
            yield from _read(path, container, stream, *begun, wanted, stopped)
            return
    with opened(path) as (container, stream):
        line = _timeline(container, stream)
        yield from _read(path, container, stream, _demuxed(container, stream), line, wanted, stopped)


def _read(
    path: Path,
    container: Any,
    stream: Any,
    packets: Iterator[tuple[Any, bool]],
    line: Timeline,
    wanted: range,
    stopped: Callable[[], bool],
) -> Iterator[Frame | int]:
    rate, any_picture, problem = frame_rate(stream), False, ""
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
                _logger.warning("%s: is to be shown turned by %d°; its frames are not", path, picture.rotation)
            any_picture = True
            line.show(picture)
        for number, packet, whole in line.ready():
            if number in wanted and whole is None:
                yield number
            elif number in wanted:
                time_s = number / rate if rate else None
                if line.stamped and line.origin is not None:
                    time_s = float((packet.stamp - line.origin) * stream.time_base)
                yield Frame(number, whole.to_ndarray(format="bgr24", interpolation=EXACT), time_s)
            if number >= wanted[-1]:
                return
        if picture is None:
            break
    if not any_picture:
        raise InputError(path, f"no frame can be decoded{problem}", "it may be incomplete or damaged")
    _warn_if_short(path, container, stream, line, problem)


def _decoded(
    packets: Iterator[tuple[Any, bool]], stream: Any, line: Timeline, stopped: Callable[[], bool]
) -> Iterator[Any]:
    """Pictures as the decoder gives them; every packet is told to the timeline before."""
    problem = None
    packets = _checked_by_index(packets, stream, line)
    while not stopped():
        try:
            packet, torn = next(packets, (None, False))
        except av.error.FFmpegError as error:  # of the container: what is in the decoder still comes
            problem, packet, torn = error, None, False
        if packet is not None:
            _add(line, packet, torn)
        try:
            pictures = stream.decode(packet)  # nothing more empties the decoder
        except av.error.FFmpegError:  # of one packet: its frame is missed when the next comes
            pictures, line.troubled = [], True
        yield from pictures
        if packet is None:
            break
    if problem is not None:
        raise problem


def _add(line: Timeline, packet: Any, torn: bool) -> Packet | None:
    # VP8 has packets that only serve as references: a bit of their first byte says so
    hidden = packet.stream.codec_context.name == "vp8" and not memoryview(packet)[0] & 0x10
    if hidden or packet.is_discard:
        line.skipped += 1
        return None
    return line.add(packet.pts, packet.is_keyframe, corrupt=packet.is_corrupt, torn=torn)


def _demuxed(container: Any, stream: Any) -> Iterator[tuple[Any, bool]]:
    """The packets of a stream, none of them empty, and whether bytes were skipped before each."""
    matroska, end, torn = container.format.name == _MATROSKA, None, False
    # only all streams together fill a file
    for packet in container.demux() if matroska else container.demux(stream):
        if not packet.size:  # AVI's way to repeat a picture; the last of every stream
            continue
        if matroska and packet.pos is not None:
            torn = torn or (end is not None and packet.pos - end > _MOST_HEADERS)
            end = packet.pos + packet.size
        if packet.stream_index == stream.index:
            yield packet, torn
            torn = False


def _checked_by_index(packets: Iterator[tuple[Any, bool]], stream: Any, line: Timeline) -> Iterator[tuple[Any, bool]]:
    """AVI counts packets to know their time: where damage hides some, its index tells the right one."""
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
                continue  # bytes of a damaged packet that look like another one
            shift, at = index[at].timestamp - packet.dts, at + 1
            packet.pts = None if packet.pts is None else packet.pts + shift
            packet.dts += shift
        yield packet, torn


def _begin(
    container: Any, stream: Any, start: int, stopped: Callable[[], bool]
) -> tuple[Iterator[tuple[Any, bool]], Timeline] | None:
    """Packets from a keyframe before a frame on, or from the first; None where the keyframe is not found again."""
    if not start or container.format.name not in _STAMPED:
        return _demuxed(container, stream), _timeline(container, stream)
    found = _keyframe(container, stream, start, stopped)
    if found is None:
        return None
    place, mark = found
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
    """The third last keyframe up to a frame, by counting packets; None where there is none, or stamps are unusable."""
    line = _timeline(container, stream)
    waiting: dict[int, tuple] = {}
    found: deque[tuple[Place, tuple]] = deque(maxlen=3)
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
            # no later packet is shown before it is decoded
            for number, settled, there in line.settle(packet.dts):
                if number > start:
                    return found[0] if found else None
                if there and settled.order in waiting:
                    found.append((line.place(number, settled), waiting.pop(settled.order)))
    except av.error.FFmpegError:
        pass
    return found[0] if found else None


def _mark(packet: Any) -> tuple:
    return packet.pts, packet.pos, packet.size


def _timeline(container: Any, stream: Any, place: Place | None = None) -> Timeline:
    rate, kind = frame_rate(stream), container.format.name
    # where a hole in the file is noticed, its frames can be counted; mp4 and AVI list their packets
    interval = float(1 / (rate * stream.time_base)) if rate and kind == _MATROSKA else None
    return Timeline(interval, not (kind == "avi" and stream.codec_context.name in _REORDERED), place)


def _warn_if_short(path: Path, container: Any, stream: Any, line: Timeline, problem: str) -> None:
    count = line.number + line.skipped
    if problem or count < stream.frames:
        _logger.warning("%s: breaks off after %d of %s frames%s", path, count, stream.frames or "more", problem)
    elif not stream.frames and container.duration and line.last is not None and len(container.streams) == 1:
        promised, end = container.duration / av.time_base, float(line.last * stream.time_base)
        if end + 1 < promised:
            _logger.warning("%s: breaks off after %.1f of %.1f seconds", path, end, promised)


def frame_rate(stream: Any) -> float | None:
    """Frames a second, their mean."""
    rate = stream.average_rate or stream.guessed_rate
    return float(rate) if rate else None


@contextmanager
def opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """The container of a file and its first video stream.

    Raises:
        InputError: no video that can be read.
    """
    try:
        # a playlist may name addresses: nothing but files is opened
        container = av.open(str(path), options={"protocol_whitelist": "file"})
    except av.error.FFmpegError as error:
        problem = f"is no video that can be read: {error.strerror}"
        raise InputError(path, problem, "it may be incomplete, or of another kind") from error
    with container:
        # the cover of a piece of music is a video stream, too
        found = [one for one in container.streams.video if not one.disposition & Disposition.attached_pic]
        if not found:
            raise InputError(path, "holds no video stream", "give a video or a folder of images")
        stream: Any = found[0]
        if stream.codec_context is None:
            raise InputError(path, "is coded in a way that this PyAV cannot decode", "convert it to H.264")
        stream.thread_type = "SLICE"  # several frames at once would leave it to chance which damage is noticed
        yield container, stream
