"""Frames into a video that players and browsers show."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.storage.files import new_file
from jaxfit.video.codecs import CODECS, CONTAINERS
from jaxfit.video.decoding import EXACT

__all__ = ["VideoWriter"]

_logger = logging.getLogger(__name__)

# As many on every machine: some encoders split a picture by threads, and with it the bytes they write.
_THREADS = 4
_BT709 = 1  # the number of matrix, primaries and transfer alike in H.273


class VideoWriter:
    """Writes a video frame by frame; the file appears whole at the end, or not at all.

    ``with VideoWriter("out.mp4", (width, height), fps) as video: video.write(frame)``. 4:2:0 colours in the
    BT.709 matrix, a keyframe at least every second, the index at the front of an ``.mp4``. 4:2:0 needs even
    sides: an odd side is padded by repeating the last row or column, and ``written_size_px`` says what came
    of it. The same frames give the same bytes from one run to the next, whatever the number of cores.

    Args:
        path: an ``.mp4`` or ``.webm``; an existing file is replaced, missing folders are made.
        size_px: width and height of every frame.
        fps: frames a second.
        codec: a name of ``CODECS``, or ``auto``: the first of the container's (``CONTAINERS``). Where this
            installation lacks it, the container's next is taken with a warning, and ``fallback`` is True.

    Raises:
        ValueError: another codec or one that the container does not hold; a size or rate that is none.
        InputError: another ending, no codec for this container, no frame written, or the system refuses the
            write (disk full, permissions).
    """

    codec: str
    """The codec that is written: a name of ``CODECS``."""
    fallback: bool
    """Whether it is another than the one asked for (for ``auto``: than the container's first)."""

    def __init__(self, path: str | Path, size_px: tuple[int, int], fps: float | Fraction, codec: str = "auto"):
        self.path = Path(path)
        if codec != "auto" and codec not in CODECS:
            raise ValueError(f"codec must be auto or one of {', '.join(CODECS)}, not {codec!r}")
        suited = CONTAINERS.get(self.path.suffix.lower())
        if suited is None:
            raise InputError(self.path, "is named as no video", f"end it in {' or '.join(CONTAINERS)}")
        if codec not in ("auto", *suited):
            raise InputError(self.path, f"{codec} does not go into such a file", f"choose {' or '.join(suited)}")
        width, height = (int(side) for side in size_px)
        if not (1 <= width <= 16384 and 1 <= height <= 16384):
            raise ValueError(f"size_px must be a width and a height within 1 and 16384, not {size_px}")
        if not 0 < fps < math.inf:
            raise ValueError(f"fps must be above 0 and finite, not {fps}")
        self.size_px = width, height
        self.written_size_px = width + width % 2, height + height % 2
        # denominators up to 1001 hold the rates of television (30000/1001) exactly
        self.fps = Fraction(fps).limit_denominator(1001)
        if not self.fps:
            raise ValueError(f"fps must be 1/1001 or more, not {fps}")
        self.frames = 0
        wanted = suited[0] if codec == "auto" else codec
        found = next((name for name in (wanted, *suited) if _has_encoder(name)), None)
        if found is None:
            raise InputError(self.path, f"no encoder for {', '.join(suited)} here", "install another build of PyAV")
        self.codec, self.fallback = found, found != wanted
        if self.fallback:
            note = "" if found != "mpeg4" else "; players show it, browsers do not"
            _logger.warning("%s: no %s encoder here, written as %s%s", self.path.name, wanted, found, note)
        self._stream: Any = None
        self._writing = self._write()

    @contextmanager
    def _write(self) -> Iterator[None]:
        options = {"fflags": "+bitexact"}
        if self.path.suffix.lower() == ".mp4":
            options["movflags"] = "+faststart"
        kind = self.path.suffix[1:].lower()
        with new_file(self.path) as part, av.open(str(part), "w", format=kind, container_options=options) as container:
            encoder, settings = CODECS[self.codec]
            stream: Any = container.add_stream(encoder, rate=self.fps, options=settings)
            stream.width, stream.height = self.written_size_px
            stream.pix_fmt = "yuv420p"
            context = stream.codec_context
            context.gop_size = max(1, math.floor(self.fps))
            context.thread_count = _THREADS
            context.color_range = ColorRange.MPEG
            context.colorspace = context.color_primaries = context.color_trc = _BT709
            self._container, self._stream = container, stream
            try:
                yield
                if not self.frames:
                    raise InputError(self.path, "no frame came: no video is written", "check the frames asked for")
                container.mux(stream.encode(None))
            finally:
                self._stream = None

    def __enter__(self) -> VideoWriter:
        self._writing.__enter__()
        return self

    def write(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        """Append one frame.

        Args:
            frame: (H, W, 3) uint8, blue-green-red, H and W as ``size_px`` says.

        Raises:
            ValueError: a frame of another shape or type, or outside of the ``with``.
            InputError: the system refuses the write.
        """
        width, height = self.size_px
        if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
            expected = f"uint8 of shape {(height, width, 3)}"
            raise ValueError(f"frame must be {expected}, not {frame.dtype} of shape {frame.shape}")
        if self._stream is None:
            raise ValueError("write needs the writer to be open: use it in a `with`")
        if self.size_px != self.written_size_px:
            frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="bgr24")
        picture = picture.reformat(
            format="yuv420p",
            dst_colorspace=Colorspace.ITU709,
            dst_color_range=ColorRange.MPEG,
            interpolation=EXACT,
        )
        picture.pts, picture.time_base = self.frames, 1 / self.fps
        self._container.mux(self._stream.encode(picture))
        self.frames += 1

    def __exit__(self, *error: Any) -> bool | None:
        return self._writing.__exit__(*error)


def _has_encoder(codec: str) -> bool:
    try:
        av.Codec(CODECS[codec][0], "w")
    except ValueError:  # PyAV's UnknownCodecError
        return False
    return True
