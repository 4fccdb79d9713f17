"""Deinterlacing: one whole picture for every interlaced picture."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import av.error
import av.filter

__all__ = ["NumberedPicture", "deinterlaced"]

_logger = logging.getLogger(__name__)

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
