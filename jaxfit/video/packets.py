"""Opening of video files, and their packets: numbers and times of frames, seeking."""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import av
import av.error
import numpy as np
from av.stream import Disposition
from jaxtyping import Float

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import FRAMES_PER_S, IMAGE_PIXELS, IMAGE_SIDE_PX, SECONDS_PER_FRAME, VIDEO_GAP_FRAMES
from jaxfit.foundation.reading import open_file
from jaxfit.video.pictures import is_too_large

MP4 = "mov,mp4,m4a,3gp,3g2,mj2"
"""Name of the format of MP4 and QuickTime files in FFmpeg."""

_OPTIONS = {
    "protocol_whitelist": "none",  # a playlist may name other files and network addresses
    "max_pixels": str(IMAGE_PIXELS),  # decoders reject larger pictures before they take memory
}


@contextmanager
def opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a file. Gives its container and its first video stream.

    Raises:
        InputError: the file is not a readable video, or its pictures are too large.
    """
    with open_file(path, "a video") as file:
        try:
            container = av.open(file, options=_OPTIONS, metadata_errors="replace")
        except av.error.FFmpegError as error:
            problem = f"is not a readable video: {error.strerror}"
            raise InputError(path, problem, "the file may be incomplete or of another type") from error
        with container:
            stream = _video_stream(path, container)
            stream.codec_context.options = {"max_pixels": _OPTIONS["max_pixels"]}
            stream.thread_type = "SLICE"  # with threads for frames, the detected damage would vary from run to run
            yield container, stream


def _video_stream(path: Path, container: Any) -> Any:
    # the cover picture of a music file is also a video stream
    streams = [one for one in container.streams.video if not one.disposition & Disposition.attached_pic]
    if not streams:
        raise InputError(path, "has no video stream", "give a video or a folder of images")
    stream: Any = streams[0]
    if stream.codec_context is None:
        raise InputError(path, "has a codec that this PyAV cannot decode", "convert the video to H.264")
    if is_too_large(stream.width, stream.height):
        problem = f"has pictures of {stream.width}×{stream.height}"
        raise InputError(path, problem, f"the limits are {IMAGE_SIDE_PX} pixels a side and {IMAGE_PIXELS:,} pixels")
    return stream


def frame_count(stream: Any) -> int | None:
    """Return the number of frames that players show; None if the container does not store a number.

    An edit list of an MP4 file hides frames. FFmpeg marks these frames in its index, or leaves the frames out.
    """
    if not stream.frames or stream.container.format.name != MP4:
        return stream.frames or None
    return sum(not entry.is_discard for entry in stream.index_entries) or stream.frames


def frame_rate(stream: Any) -> float | None:
    """Return the mean frame rate in frames per second; None if it is unknown, or absurd because of damage."""
    rate = stream.average_rate or stream.guessed_rate
    return float(rate) if rate and 1 / SECONDS_PER_FRAME <= rate <= FRAMES_PER_S else None


_REORDER = 16  # the most pictures that a codec delays to change their order
_MAX_DELAYED = 128  # a picture that is shown after so many later packets has a damaged time stamp


class Packet(NamedTuple):
    """The properties of a packet that numbering needs. Packets sort by time."""

    stamp: int
    """Presentation time stamp, or `order` if the time stamps are unusable."""
    order: int
    """Position of the packet in decoding order."""
    groups: tuple[int, ...]
    """Numbers of the keyframes that its picture depends on: its own keyframe and, for a leading picture, the previous
    keyframe."""
    starts: bool
    """Whether the packet is a keyframe."""
    lost: bool
    """Whether damage hides the packet, so that only the index of the file lists the packet."""


class Place(NamedTuple):
    """A keyframe where decoding can start, and the state of the numbering there."""

    number: int
    stamp: int
    steady: bool
    skipped: int


class Timeline:
    """Number packets in the order of their time stamps, and give every decoded picture the number of its packet.

    A number is a rank: the number of packets in the file that are shown earlier. It needs no frame rate, it is correct
    for a variable frame rate, and it does not change if a picture cannot be decoded. There are two exceptions. First,
    damage may hide packets in a container without a list of packets. If the steps between frames were even before the
    gap, the frame rate gives the number of frames in the gap. If the steps were uneven, the number is unknown, and
    counting continues without a gap. Second, time stamps may be missing or contradict each other. Then pictures are
    counted in decoding order.

    A damaged or missing picture spoils all pictures that are decoded after it, up to the next keyframe, because
    decoders do not report which of these pictures repeat the damage.

    Args:
        interval: ticks of the time base between frames, to count the frames of gaps. None if unknown.
        stamped: False if the time stamps are known to be guesses.
        place: the keyframe of the first packet. None for the start of the file.
    """

    def __init__(self, interval: float | None, stamped: bool = True, place: Place | None = None):
        self.number = 0 if place is None else place.number
        """Number of the next frame, which is the count of numbered frames."""
        self.stamped = stamped
        self.skipped = 0 if place is None else place.skipped
        """Count of packets that are never shown and have no number."""
        self.troubled = False
        """Whether the decoder rejected a packet or reported a corrupt picture."""
        self.last: int | None = None
        """Time stamp of the last numbered packet."""
        self._floor = -math.inf if place is None else place.stamp
        self._interval = interval
        self._steady = place is None or place.steady
        self._order = self._group = 0
        self._torn = -math.inf
        self._key_stamp = -math.inf
        self._pending: list[Packet] = []
        self._held: deque[tuple[int, Packet, Any]] = deque()
        self._spoilt: dict[int, int] = {}
        self._lost = False
        """Whether the last packet was lost, and all pending packets are spoilt."""

    def add(
        self, stamp: int | None, starts: bool, *, lost: bool = False, corrupt: bool = False, torn: bool = False
    ) -> Packet | None:
        """Add the next packet of the file. Returns None if its frame is shown before the starting place.

        Args:
            stamp, starts, lost: as in `Packet`.
            corrupt: whether the container marks the packet as damaged.
            torn: whether the container skipped bytes, and perhaps packets, before this packet.
        """
        if self.stamped and (stamp is None or (self.last is not None and stamp <= self.last)):
            self._count()
        if self.stamped and stamp is not None and stamp < self._floor:
            return None
        if starts:
            self._group += 1
            self._key_stamp = stamp if self.stamped and stamp is not None else -math.inf
        stamp = self._order if stamp is None or not self.stamped else stamp
        groups = (self._group - 1, self._group) if stamp < self._key_stamp else (self._group,)
        packet = Packet(stamp, self._order, groups, starts, lost)
        self._order += 1
        heapq.heappush(self._pending, packet)
        if torn:
            self._torn = packet.order
        if lost:  # the decoder returns its pending pictures out of order, or not at all
            for one in [packet] if self._lost else self._pending:
                self._spoil(one)
        elif corrupt or (torn and not starts):
            self._spoil(packet)
        self._lost = lost
        return packet

    def settle(self, before: float) -> Iterator[tuple[int, Packet, bool]]:
        """Number the frames that are shown before a time stamp.

        Yields the number, a packet, and True if the packet is that of the frame. A frame in a gap has no packet: then
        the packet after the gap and False are given.
        """
        while self._pending and self._pending[0].stamp < before:
            yield from self._next()

    def place(self, number: int, packet: Packet) -> Place:
        """Return the place of a keyframe that `settle` has just yielded."""
        return Place(number, packet.stamp, self._steady, self.skipped)

    def show(self, picture: Any) -> None:
        """Add the next picture of the decoder."""
        stamp = picture.pts
        if self.stamped:
            if stamp is not None and stamp < self._floor:
                return
            if all(packet.stamp != stamp for packet in self._pending):
                if self.troubled and stamp is not None:
                    return  # damage also changes the order: the number of this picture is already counted as missed
                self._count()
        if not self.stamped:
            present = [packet for packet in self._pending if not packet.lost]
            # a keyframe can be recognised: all frames that are shown before this keyframe are missing
            keys = [packet for packet in present if packet.starts] if picture.key_frame else []
            stamp = min(keys or present).stamp if present else self._order
            if not present:
                self.add(None, picture.key_frame)
        self._miss(math.inf if stamp is None else stamp)
        *gap, (number, packet, _) = self._next()
        for missing, _, _ in gap:
            self._held.append((missing, packet, None))
        if picture.is_corrupt:
            self.troubled = True
            self._spoil(packet)
        self._held.append((number, packet, picture))
        if self.stamped and any(packet.order - one.order > _MAX_DELAYED for one in self._pending):
            self._count()  # otherwise all later pictures would wait in memory

    def finish(self) -> None:
        """End the pictures. Packets that still wait for a picture are missed."""
        self._miss(math.inf)

    def ready(self) -> Iterator[tuple[int, Packet, Any]]:
        """Yield number, packet and picture (None if damaged) of the frames that no later packet can change."""
        oldest = min((packet.order for packet in self._pending), default=math.inf)
        while self._held and self._held[0][1].order < oldest:
            number, packet, picture = self._held.popleft()
            spoilt = any(packet.order >= self._spoilt.get(group, math.inf) for group in packet.groups)
            yield number, packet, None if spoilt else picture

    def _next(self) -> list[tuple[int, Packet, bool]]:
        packet = heapq.heappop(self._pending)
        numbered = []
        if self.stamped:
            for _ in range(self._gap(packet)):
                numbered.append((self.number, packet, False))
                self.number += 1
            self.last = packet.stamp
        numbered.append((self.number, packet, True))
        self.number += 1
        return numbered

    def _gap(self, packet: Packet) -> int:
        """Return the number of frames that are lost directly before a packet."""
        if self._interval is None or not self._steady or self.last is None:
            return 0
        steps = (packet.stamp - self.last) / self._interval
        # time stamps are rounded to whole ticks, and an interval may have only a few ticks
        even = abs(steps - round(steps)) * self._interval <= 1 + 0.02 * self._interval
        follows = round(steps) == 1 or (packet.order <= self._torn + _REORDER and steps <= VIDEO_GAP_FRAMES)
        self._steady = even and follows
        return max(0, round(steps) - 1) if self._steady else 0

    def _miss(self, before: float) -> None:
        for number, packet, there in self.settle(before):
            self._held.append((number, packet, None))
            if there:
                self._spoil(packet)

    def _spoil(self, packet: Packet) -> None:
        group = packet.groups[-1]
        self._spoilt[group] = min(packet.order, self._spoilt.get(group, packet.order))

    def _count(self) -> None:
        self.stamped = False
        self._floor = -math.inf
        self._pending = [packet._replace(stamp=packet.order) for packet in self._pending]
        heapq.heapify(self._pending)


_MATROSKA = "matroska,webm"
_STAMPED = (MP4, _MATROSKA)  # every packet has a time stamp, so seeks are exact
_REORDERED = ("h264", "hevc")  # AVI has no time stamps, and FFmpeg cannot derive correct time stamps for these
_CHUNK_HEADER = 8  # bytes between the position in the index of an AVI file and the packet
_FIRST_PACKETS = 500  # packets; a later first picture would make probing slow
_MAX_HEADERS = 1024  # bytes; a larger gap between the packets of a Matroska file is damage


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
            torn = torn or (end is not None and packet.pos - end > _MAX_HEADERS)
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
