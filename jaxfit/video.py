"""Frames out of a video or a folder of images, and into a video that players and browsers show."""

from __future__ import annotations

import logging
import math
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import av
import av.error
import cv2
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, Interpolation
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.storage import new_file

__all__ = ["CODECS", "VideoInfo", "VideoWriter", "probe_video", "read_frames"]

_logger = logging.getLogger(__name__)

CODECS = {
    "h264": ("libx264", {"preset": "veryfast", "crf": "23", "x264-params": "cpu-independent=1"}),
    "vp9": ("libvpx-vp9", {"deadline": "realtime", "cpu-used": "8", "row-mt": "1", "crf": "32", "b": "0"}),
    "mpeg4": ("mpeg4", {"qmin": "3", "qmax": "5"}),
}
"""Name → encoder and its settings. Browsers play h264 and vp9; mpeg4 only players.

Without ``cpu-independent`` x264 wrote other bytes in every third run, on one machine and even by one thread."""
CONTAINERS = {".mp4": ("h264", "vp9", "mpeg4"), ".webm": ("vp9",)}
"""A file's ending decides the container; its codecs, the first that this installation has being taken."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")

# As many on every machine: some encoders split a picture by threads, and with it the bytes they write.
_THREADS = 4
_BT709 = 1  # the number of matrix, primaries and transfer alike in H.273
_NUMBERS = re.compile(r"(\d*)(\D+|$)")
_EXACT = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.BITEXACT


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
            interpolation=_EXACT,
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


class VideoInfo(NamedTuple):
    """What a video says of itself."""

    frames: int | None
    """How many; None where the container does not say (``.webm``, streams)."""
    fps: float | None
    """Frames a second, their mean; None for a folder of images."""
    size_px: tuple[int, int]
    """Width and height; of a folder's first image."""


def probe_video(path: str | Path) -> VideoInfo:
    """Count, rate and size of a video or a folder of images, without reading the frames.

    Raises:
        InputError: as ``read_frames``.
    """
    path = _existing(path)
    if path.is_dir():
        files = _image_files(path)
        height, width = _read_image(files[0]).shape[:2]
        return VideoInfo(len(files), None, (width, height))
    with _opened(path) as (_, stream):
        rate = stream.average_rate or stream.guessed_rate
        return VideoInfo(stream.frames or None, float(rate) if rate else None, (stream.width, stream.height))


def read_frames(
    path: str | Path, start: int = 0, stop: int | None = None, step: int = 1
) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
    """The frames of a video, or of a folder of images in the order of their names (2 before 10).

    Frames are counted as they are decoded, from the first: what stands before ``start`` and between steps is
    decoded, though not converted, so that a number always means the same picture. A file that breaks off ends
    the frames with a warning. Frames come as they are stored: a rotation that the file asks players for is
    warned of and not applied.

    Args:
        path: a file of any kind that FFmpeg reads, or a folder of images.
        start: number of the first frame wanted.
        stop: number of the frame to stop before; None reads to the end.
        step: every how many-th frame.

    Yields:
        Number and (H, W, 3) uint8 blue-green-red picture of each frame.

    Raises:
        ValueError: a negative start or stop, a step below 1.
        InputError: no such file or folder, no video, no video stream, no image in the folder, an image or a first
            frame that cannot be read.
    """
    if start < 0 or (stop is not None and stop < 0) or step < 1:
        raise ValueError(f"start and stop must be 0 or more and step 1 or more, not {start}, {stop}, {step}")
    path = _existing(path)
    wanted = range(start, sys.maxsize if stop is None else stop, step)
    if path.is_dir():
        files = _image_files(path)
        return ((i, _read_image(files[i])) for i in wanted[: len(range(start, len(files), step))])
    return _decode(path, wanted)


def _decode(path: Path, wanted: range) -> Iterator[tuple[int, np.ndarray]]:
    count, problem = 0, ""
    with _opened(path) as (container, stream):
        try:
            for frame in container.decode(stream):
                if count >= wanted.stop:
                    return
                if count == 0 and frame.rotation:
                    _logger.warning("%s: is to be shown turned by %d°; its frames are not", path, frame.rotation)
                if count in wanted:
                    yield count, frame.to_ndarray(format="bgr24", interpolation=_EXACT)
                count += 1
        except av.error.FFmpegError as error:
            problem = f": {error.strerror}"
        if count == 0:
            raise InputError(path, f"no frame can be decoded{problem}", "it may be incomplete or damaged")
        if problem or count < stream.frames:
            _logger.warning("%s: breaks off after %d of %s frames%s", path, count, stream.frames or "more", problem)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """The container and its first video stream."""
    try:
        # a playlist may name addresses: nothing but files is opened
        container = av.open(str(path), options={"protocol_whitelist": "file"})
    except av.error.FFmpegError as error:
        problem = f"is no video that can be read: {error.strerror}"
        raise InputError(path, problem, "it may be incomplete, or of another kind") from error
    with container:
        if not container.streams.video:
            raise InputError(path, "holds no video stream", "give a video or a folder of images")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise InputError(path, "is coded in a way that this PyAV cannot decode", "convert it to H.264")
        stream.thread_type = "AUTO"
        yield container, stream


def _existing(path: str | Path) -> Path:
    path = Path(path).absolute()  # "concat:…" and the like are files here, not protocols
    if not path.exists():
        raise InputError(path, "does not exist", "give a video or a folder of images")
    return path


def _image_files(folder: Path) -> list[Path]:
    files = [file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES]
    if not files:
        raise InputError(folder, "holds no images", f"their names end in {', '.join(IMAGE_SUFFIXES)}")
    return sorted(files, key=lambda file: [(int(n or 0), text) for n, text in _NUMBERS.findall(file.name)])


def _read_image(file: Path) -> np.ndarray:
    image = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(file, "is no image that can be read", "remove or replace it")
    return image
