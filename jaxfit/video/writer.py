"""Write frames as a video for players and browsers."""

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
from av.error import ArgumentError
from av.video.reformatter import ColorRange, Colorspace
from jaxtyping import UInt8

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import new_file
from jaxfit.video import CODECS, CONTAINERS
from jaxfit.video.decoding import EXACT

_logger = logging.getLogger(__name__)

SLOWEST_FPS = Fraction(1, 1001)
"""Least frame rate of a written video."""

# The same number on every machine, because the written bytes of some encoders depend on the number of threads.
_THREADS = 4
_BT709 = 1  # number of the matrix, the primaries and the transfer function in H.273


class VideoWriter:
    """Writes a video frame by frame. The complete file appears at the end, or no file if an error occurs.

    ``with VideoWriter("out.mp4", (width, height), fps) as video: video.write(frame)``. Colours are 4:2:0 with the
    BT.709 matrix, a keyframe is written at least every second, and the index is at the front of an ``.mp4``. 4:2:0
    needs an even width and height: an odd side is padded by repeating the last row or column, and ``written_size_px``
    is the padded size. The same frames give the same bytes in every run and for any number of cores.

    Args:
        path: an ``.mp4`` or ``.webm`` file. An existing file is replaced, and missing folders are made.
        size_px: width and height of every frame.
        fps: frames per second.
        codec: a name in ``CODECS``, or ``auto`` for the first codec of the container (``CONTAINERS``). If this
            installation lacks the codec, the next codec of the container is used with a warning, and ``fallback`` is
            True.
        b_frames: whether frames may depend on later frames. Without these, a film is a tenth larger and is encoded in
            three quarters of the time.

    Raises:
        ValueError: the codec is unknown, or the size or rate is invalid.
        InputError: the file name extension is unknown, the container does not support the codec, no codec of the
            container is installed, no frame was written, or the system rejects the write (disk full, permissions).
    """

    codec: str
    """Codec of the written video, a name in ``CODECS``."""
    fallback: bool
    """Whether the codec differs from the requested codec (for ``auto``, from the first codec of the container)."""

    def __init__(
        self,
        path: str | Path,
        size_px: tuple[int, int],
        fps: float | Fraction,
        codec: str = "auto",
        b_frames: bool = True,
    ):
        self.path = Path(path)
        if codec != "auto" and codec not in CODECS:
            raise ValueError(f"codec must be auto or one of {', '.join(CODECS)}, not {codec!r}")
        suited = CONTAINERS.get(self.path.suffix.lower())
        if suited is None:
            raise InputError(self.path, "has no video extension", f"end the name in {' or '.join(CONTAINERS)}")
        if codec not in ("auto", *suited):
            raise InputError(self.path, f"cannot hold the codec {codec}", f"choose {' or '.join(suited)}")
        width, height = (int(side) for side in size_px)
        if not (1 <= width <= 16384 and 1 <= height <= 16384):
            raise ValueError(f"size_px must be a width and a height from 1 to 16384, not {size_px}")
        if not 0 < fps < math.inf:
            raise ValueError(f"fps must be positive and finite, not {fps}")
        self.size_px = width, height
        self.written_size_px = width + width % 2, height + height % 2
        # denominators up to 1001 represent the rates of television (30000/1001) exactly
        self.fps = Fraction(fps).limit_denominator(1001)
        if not self.fps:
            raise ValueError(f"fps must be 1/1001 or more, not {fps}")
        self.frames = 0
        requested = suited[0] if codec == "auto" else codec
        chosen = next((name for name in (requested, *suited) if _has_encoder(name)), None)
        if chosen is None:
            problem = f"PyAV has no encoder for {', '.join(suited)}"
            raise InputError(self.path, problem, "install another build of PyAV")
        self.codec, self.fallback = chosen, chosen != requested
        self._options = {} if b_frames else {"bf": "0"}
        if self.fallback:
            note = "" if chosen != "mpeg4" else "; players play it, browsers do not"
            _logger.warning("%s: PyAV has no %s encoder, written as %s%s", self.path.name, requested, chosen, note)
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
            stream: Any = container.add_stream(encoder, rate=self.fps, options=settings | self._options)
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
                    raise InputError(self.path, "has no frames and is not written", "check the requested frames")
                container.mux(stream.encode(None))
            finally:
                self._stream = None

    def __enter__(self) -> VideoWriter:
        self._writing.__enter__()
        return self

    def write(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        """Append one frame.

        Args:
            frame: (H, W, 3) uint8 in the channel order blue, green, red, with the size ``size_px``.

        Raises:
            ValueError: the shape or type of the frame is wrong, or the writer is not open.
            InputError: the system rejects the write.
        """
        width, height = self.size_px
        if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
            expected = f"uint8 of shape {(height, width, 3)}"
            raise ValueError(f"frame must be {expected}, not {frame.dtype} of shape {frame.shape}")
        if self._stream is None:
            raise ValueError("the writer is not open: call write inside a `with` block")
        if self.size_px != self.written_size_px:
            frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        picture = av.VideoFrame.from_numpy_buffer(np.ascontiguousarray(frame), format="bgr24")
        picture = picture.reformat(
            format="yuv420p",
            dst_colorspace=Colorspace.ITU709,
            dst_color_range=ColorRange.MPEG,
            interpolation=EXACT,
        )
        picture.pts, picture.time_base = self.frames, 1 / self.fps
        try:
            packets = self._stream.encode(picture)
        except ArgumentError as error:
            what = f"{self.codec}, {width}×{height} at {float(self.fps):g} frames/s"
            problem = f"cannot be encoded as {what}: {error.strerror}"
            raise InputError(self.path, problem, "choose another codec, a smaller picture or a lower rate") from None
        self._container.mux(packets)
        self.frames += 1

    def __exit__(self, *error: Any) -> bool | None:
        return self._writing.__exit__(*error)


def _has_encoder(codec: str) -> bool:
    try:
        av.Codec(CODECS[codec][0], "w")
    except ValueError:  # PyAV's UnknownCodecError
        return False
    return True
