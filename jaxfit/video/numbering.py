"""Number decoded pictures, and determine which pictures damage affects, from the packets of a video."""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

from jaxfit.limits import VIDEO_GAP_FRAMES

__all__ = ["Packet", "Place", "Timeline"]

_REORDER = 16  # the most pictures that a codec delays to change their order
_MOST_DELAYED = 128  # a picture that is shown after so many later packets has a damaged time stamp


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
        if self.stamped and any(packet.order - one.order > _MOST_DELAYED for one in self._pending):
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
