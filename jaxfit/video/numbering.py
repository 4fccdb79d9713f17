"""Which number a decoded picture has, and which pictures a damaged one spoils: from the packets of a video."""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

__all__ = ["Packet", "Place", "Timeline"]

_REORDER = 16  # pictures that codecs hold back at most, to show them in another order


class Packet(NamedTuple):
    """What numbering needs of a packet; they sort by time."""

    stamp: int
    """Presentation time stamp; once these prove unusable, `order`."""
    order: int
    """Place in the file, as decoding goes."""
    groups: tuple[int, ...]
    """The keyframes, counted, without which its picture is wrong: its own, for leading pictures also the one before."""
    starts: bool
    """Whether it is a keyframe."""
    lost: bool
    """Known from the index alone: damage hides it."""


class Place(NamedTuple):
    """A keyframe to begin at, and what numbering knows there."""

    number: int
    stamp: int
    origin: int
    """Time stamp of frame 0."""
    steady: bool
    skipped: int


class Timeline:
    """Gives every packet its number, in the order of time stamps, and every decoded picture that of its packet.

    A number is a rank: how many of the file's packets are to be shown earlier. It needs no frame rate, holds for a
    variable one, and does not change when a picture cannot be decoded. Two cases differ. Where damage hides packets
    and the container keeps no list of them, a gap in steps that were even so far counts as the frames that the
    rate puts there; where steps are uneven, nobody can know, and the count goes on. Where time stamps are
    missing or contradict each other, pictures are counted as they are decoded.

    A picture that is damaged or does not come spoils what is decoded after it, up to the next keyframe: decoders
    do not say which of these pictures repeat the damage.

    Args:
        interval: ticks between frames, to fill gaps by; None where that is unknown.
        stamped: False where time stamps are known to be guesses.
        place: the keyframe that the first packet is; None begins the file.
    """

    def __init__(self, interval: float | None, stamped: bool = True, place: Place | None = None):
        self.number = 0 if place is None else place.number
        """Of the next frame: how many have theirs already."""
        self.stamped = stamped
        self.origin = None if place is None else place.origin
        self.skipped = 0 if place is None else place.skipped
        """Packets that are not to be shown, and have no number."""
        self.troubled = False
        """Whether the decoder refused anything."""
        self.last: int | None = None
        """Time stamp of the latest packet that has its number."""
        self._floor = -math.inf if place is None else place.stamp
        self._interval = interval
        self._steady = place is None or place.steady
        self._order = self._group = 0
        self._torn = -math.inf
        self._key_stamp = -math.inf
        self._pending: list[Packet] = []
        self._held: deque[tuple[int, Packet, Any]] = deque()
        self._spoilt: dict[int, int] = {}

    def add(
        self, stamp: int | None, starts: bool, *, lost: bool = False, corrupt: bool = False, torn: bool = False
    ) -> Packet | None:
        """Take a packet, in the order of the file; None where its frame comes before the place to begin at.

        Args:
            stamp, starts, lost: as `Packet` has them.
            corrupt: the container knows it as damaged.
            torn: the container skipped bytes before it, and whatever packets were in them.
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
        if lost:  # what is in the decoder comes out of order, if it comes
            for one in self._pending:
                self._spoil(one)
        elif corrupt or (torn and not starts):
            self._spoil(packet)
        return packet

    def settle(self, before: float) -> Iterator[tuple[int, Packet, bool]]:
        """Number and packet of all that is shown before a time stamp, and whether the packet itself is there."""
        while self._pending and self._pending[0].stamp < before:
            yield from self._next()

    def place(self, number: int, packet: Packet) -> Place:
        """The place of a keyframe that `settle` just gave."""
        origin = packet.stamp if self.origin is None else self.origin
        return Place(number, packet.stamp, origin, self._steady, self.skipped)

    def show(self, picture: Any) -> None:
        """Take a decoded picture, as the decoder gives them."""
        stamp = picture.pts
        if self.stamped:
            if stamp is not None and stamp < self._floor:
                return
            if all(packet.stamp != stamp for packet in self._pending):
                if self.troubled and stamp is not None:
                    return  # damage upsets the order, too: its number was given up already
                self._count()
        if not self.stamped:
            came = [packet for packet in self._pending if not packet.lost]
            # a keyframe is known again: whatever was to be shown before it has not come
            keys = [packet for packet in came if packet.starts] if picture.key_frame else []
            stamp = min(keys or came).stamp if came else self._order
            if not came:
                self.add(None, picture.key_frame)
        self._miss(math.inf if stamp is None else stamp)
        *gap, (number, packet, _) = self._next()
        for missing, _, _ in gap:
            self._held.append((missing, packet, None))
        if picture.is_corrupt:
            self.troubled = True
            self._spoil(packet)
        self._held.append((number, packet, picture))

    def finish(self) -> None:
        """No more pictures come: what waits for one is lost."""
        self._miss(math.inf)

    def ready(self) -> Iterator[tuple[int, Packet, Any]]:
        """Number, packet and picture of the frames whose fate is sure, in order; None for a damaged picture."""
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
            self.origin = packet.stamp if self.origin is None else self.origin
            self.last = packet.stamp
        numbered.append((self.number, packet, True))
        self.number += 1
        return numbered

    def _gap(self, packet: Packet) -> int:
        """How many frames are lost right before it."""
        if self._interval is None or not self._steady or self.last is None:
            return 0
        steps = (packet.stamp - self.last) / self._interval
        # time stamps are rounded to whole ticks, of which an interval may have few
        even = abs(steps - round(steps)) * self._interval <= 1 + 0.02 * self._interval
        self._steady = even and (round(steps) == 1 or packet.order <= self._torn + _REORDER)
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
