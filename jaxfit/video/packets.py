"""Packets of a video: numbers and times of frames without decoding, and seeking."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import av.error
import numpy as np
from jaxtyping import Float

from jaxfit.video.numbering import Packet, Place, Timeline
from jaxfit.video.opening import MP4, frame_rate, opened

__all__ = [
    "add_packet",
    "begin",
    "checked_by_index",
    "demuxed",
    "first_picture",
    "frame_times",
    "packet_timeline",
    "time_of",
]

_MATROSKA = "matroska,webm"
_STAMPED = (MP4, _MATROSKA)  # every packet has a time stamp, so seeks are exact
_REORDERED = ("h264", "hevc")  # AVI has no time stamps, and FFmpeg cannot derive correct time stamps for these
_CHUNK_HEADER = 8  # bytes between the position in the index of an AVI file and the packet
_FIRST_PACKETS = 500  # packets; a later first picture would make probing slow
_MOST_HEADERS = 1024  # bytes; a larger gap between the packets of a Matroska file is damage


def add_packet(line: Timeline, packet: Any, torn: bool) -> Packet | None:
    """Add a packet to a timeline, unless the picture of the packet is never shown."""
    # VP8 has packets that serve only as references. A bit of the first byte marks these packets.
    hidden = packet.stream.codec_context.name == "vp8" and not memoryview(packet)[0] & 0x10
    if hidden or packet.is_discard:
        line.skipped += 1
        return None
    return line.add(packet.pts, packet.is_keyframe, corrupt=packet.is_corrupt, torn=torn)


def demuxed(container: Any, stream: Any) -> Iterator[tuple[Any, bool]]:
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


def checked_by_index(packets: Iterator[tuple[Any, bool]], stream: Any, line: Timeline) -> Iterator[tuple[Any, bool]]:
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


def begin(
    container: Any, stream: Any, start: int, stopped: Callable[[], bool]
) -> tuple[Iterator[tuple[Any, bool]], Timeline] | None:
    """Return the packets from a keyframe before frame `start`, or from the first packet, and their timeline.

    Returns None if the seek does not find the keyframe again.
    """
    if not start or container.format.name not in _STAMPED:
        return demuxed(container, stream), packet_timeline(container, stream)
    keyframe = _keyframe(container, stream, start, stopped)
    if keyframe is None:
        return None
    place, mark = keyframe
    try:
        container.seek(place.stamp, stream=stream)
        packets = demuxed(container, stream)
        for packet, _ in packets:
            if stopped():
                return None
            if _mark(packet) == mark:
                return chain([(packet, False)], packets), packet_timeline(container, stream, place)
    except av.error.FFmpegError:
        pass
    return None


def _keyframe(container: Any, stream: Any, start: int, stopped: Callable[[], bool]) -> tuple[Place, tuple] | None:
    """Return the third last keyframe up to frame `start`, found by counting packets.

    Returns None if there is no such keyframe or the time stamps are unusable.
    """
    line = packet_timeline(container, stream)
    waiting: dict[int, tuple] = {}
    keyframes: deque[tuple[Place, tuple]] = deque(maxlen=3)
    try:
        for packet, torn in demuxed(container, stream):
            if stopped():
                return None
            added = add_packet(line, packet, torn)
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


def packet_timeline(container: Any, stream: Any, place: Place | None = None) -> Timeline:
    """Return an empty timeline for the packets of a stream, from the start or from a keyframe on."""
    rate, kind = frame_rate(stream), container.format.name
    # Matroska has no list of packets, so the frames in a gap of the file are counted by the interval
    interval = float(1 / (rate * stream.time_base)) if rate and kind == _MATROSKA else None
    return Timeline(interval, not (kind == "avi" and stream.codec_context.name in _REORDERED), place)


def time_of(number: int, packet: Packet, line: Timeline, stream: Any) -> float | None:
    """Return the presentation time of a frame in seconds; None if it is unknown.

    This is the time stamp of the container, which ffprobe shows as `pts_time` and `best_effort_timestamp_time`. An edit
    list is applied. The first frame of a file often has the time 0, but not always: transport streams and recordings
    that were cut begin later. If the container has no usable time stamps, the time is the number of the frame divided
    by the frame rate.
    """
    if line.stamped:
        return float(packet.stamp * stream.time_base)
    rate = frame_rate(stream)
    return number / rate if rate else None


def frame_times(path: Path, stop: int) -> Float[np.ndarray, "F"]:
    """Return the presentation times in seconds of the frames of a video before frame `stop`, without decoding.

    Returns:
        (F,) times as `time_of`, at most `stop`; NaN for frames whose packet damage hides.

    Raises:
        InputError: the file is not a readable video.
    """
    times: list[float] = []
    with opened(path) as (container, stream):
        line = packet_timeline(container, stream)

        def settle(before: float) -> None:
            for number, packet, there in line.settle(before):
                time_s = time_of(number, packet, line, stream) if there else None
                times.append(np.nan if time_s is None else time_s)

        try:
            for packet, torn in checked_by_index(demuxed(container, stream), stream, line):
                add_packet(line, packet, torn)
                if line.stamped and packet.dts is not None:
                    settle(packet.dts)  # no later packet is shown before this decoding time
                if len(times) >= stop:
                    break
        except av.error.FFmpegError:
            pass
        settle(np.inf)
    return np.array(times[:stop], np.float64)


def first_picture(container: Any, stream: Any) -> Any:
    """Return the first picture that can be decoded; None if there is none in the first packets."""
    packets = container.demux(stream)
    for _ in range(_FIRST_PACKETS):
        try:
            packet = next(packets, None)
            if packet is None:
                break
            pictures = stream.decode(packet)
        except av.error.FFmpegError:
            continue
        if pictures:
            return pictures[0]
    return None
