"""Read the frames of a video or of a folder of images. A thread decodes ahead."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Semaphore, Thread, current_thread
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.reading import check_readable
from jaxfit.video.decoding import Frame, decode, displayed_size, first_picture, frame_count, frame_rate, opened
from jaxfit.video.pictures import image_files, page_count, read_pages, read_picture

_logger = logging.getLogger(__name__)

_AHEAD = 3  # pictures; enough to even out the decoding time, and 35 MB at 2592×1520


class VideoInfo(NamedTuple):
    """Properties of a video or of a folder of images."""

    frames: int | None
    """Number of frames. None if the container does not store it (``.mkv``, ``.webm``, streams)."""
    fps: float | None
    """Mean frame rate in frames per second, as the container states it. For a folder of images, the rate given to the
    reader, or None."""
    size_px: tuple[int, int]
    """Width and height as players show the video. For a folder, those of its first readable image."""


def probe_video(path: str | Path, *, fps: float | None = None) -> VideoInfo:
    """Return frame count, rate and size of a video or of a folder of images, after decoding of the first picture.

    Raises:
        InputError: as ``read_frames``.
    """
    path = _existing(path)
    if _holds_pictures(path):
        count = len(image_files(path)) if path.is_dir() else page_count(path)
        first = next((picture for _, _, picture in _pictures(path, range(count)) if picture is not None), None)
        if first is None:
            raise InputError(path, "has no readable image", "the files may be damaged, too large, or not be images")
        return VideoInfo(count, fps, (first.shape[1], first.shape[0]))
    if fps is not None:
        raise InputError(path, "is a video, which has its own frame rate", "give a rate only for a folder of images")
    with opened(path) as (container, stream):
        frames, rate, size_px = frame_count(stream), frame_rate(stream), (stream.width, stream.height)
        picture = first_picture(container, stream)  # PyAV shows the display matrix of pictures only
        return VideoInfo(frames, rate, size_px if picture is None else displayed_size(picture))


def read_frames(
    path: str | Path,
    start: int = 0,
    stop: int | None = None,
    step: int = 1,
    *,
    fps: float | None = None,
    part: int = 1,
) -> FrameReader:
    """Return a reader of the frames of a video, or of a folder of images in the order of their names (2 before 10).

    Frames are numbered from 0 in the order in which they are shown, from the first frame that can be decoded, as in
    OpenCV. The number of a picture does not depend on `start`. Damaged frames are skipped, together with the frames
    that depend on them, up to the next keyframe. The numbers of later frames stay correct, unless the damage hides
    frames from FFmpeg (in AVI, MKV and transport streams). One warning lists the skipped frames, and so does
    `FrameReader.damaged`. A decoder detects damage only by contradictions in the data: in VP8 and VP9 most damage is
    not detected. If a file is truncated, the frames end with a warning.

    Frames come as players show them: rotated and mirrored by the display matrix of the file, in 8 bits by its colour
    matrix and range, and deinterlaced where pictures are interlaced. Three things differ, and a warning reports each:
    a rotation by other angles than multiples of 90° is not applied, pixels that are not square are not stretched, and
    HDR video is not tone mapped.

    Args:
        path: a file of any type that FFmpeg reads, a TIFF file with one page per frame, or a folder of images.
        start: number of the first frame to read.
        stop: number of the frame before which reading stops. None reads to the end.
        step: distance between the numbers of the frames to read.
        fps: frame rate of a folder of images in frames per second.
        part: 2 halves width and height of the pictures, 3 gives a third, and so on, for people who look at them: the
            pixels of smaller pictures differ between machines.

    Returns:
        A reader, to iterate over.

    Raises:
        ValueError: start or stop is negative, step is below 1, or fps is not positive and finite.
        InputError: the path does not exist, is not a readable video, has no video stream or has no readable image; or
            fps is given for a file. During reading: no frame can be decoded, or an image has another size.
    """
    if start < 0 or (stop is not None and stop < 0) or step < 1:
        raise ValueError(f"start and stop must be 0 or more and step 1 or more, not {start}, {stop}, {step}")
    if fps is not None and not 0 < fps < float("inf"):
        raise ValueError(f"fps must be positive and finite, not {fps}")
    return FrameReader(path, range(start, sys.maxsize if stop is None else stop, step), fps, part)


class FrameReader:
    """Iterates over frames and lists the skipped frames. ``read_frames`` makes and documents readers.

    Every iteration reads the video again. A thread decodes a few frames ahead, so the memory does not depend on the
    length of the video. The thread ends with the iteration. The iteration raises the exceptions of the thread.
    """

    path: Path
    info: VideoInfo
    damaged: list[int]
    """Numbers of the requested frames that were skipped so far. Complete after an iteration."""

    def __init__(self, path: str | Path, numbers: range, fps: float | None, part: int):
        self.path = _existing(path)
        self.info = probe_video(self.path, fps=fps)
        self.damaged = []
        self._part = part
        self._numbers = numbers

    def __iter__(self) -> Iterator[Frame]:
        self.damaged = []
        try:
            with closing(ahead(self._read, _AHEAD)) as items:
                for item in items:
                    if isinstance(item, Frame):
                        yield item
                    else:
                        self.damaged.append(item)
        finally:
            warn_of_damage(self.path, self.damaged, self._numbers.step)

    def _read(self, stopped: Callable[[], bool]) -> Generator[Frame | int, None, None]:
        if not _holds_pictures(self.path):
            yield from decode(self.path, self._numbers, self.info.size_px, stopped, self._part)
            return
        numbers, fps = range(self.info.frames or 0), self.info.fps
        numbers = numbers[self._numbers.start : self._numbers.stop : self._numbers.step]
        for number, file, picture in _pictures(self.path, numbers):
            if picture is None:
                yield number
                continue
            height, width, _ = picture.shape
            if (width, height) != self.info.size_px:
                problem = f"is {width}×{height}, but the images before are {'×'.join(map(str, self.info.size_px))}"
                raise InputError(file, problem, "all images of a folder must have one size")
            if self._part > 1:
                size = max(width // self._part, 1), max(height // self._part, 1)
                picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            yield Frame(number, picture, number / fps if fps else None)


def _holds_pictures(path: Path) -> bool:
    """Return whether a path is a folder of images or a TIFF file, whose pages are the frames."""
    return path.is_dir() or path.suffix.lower() in (".tif", ".tiff")


def _pictures(path: Path, numbers: range) -> Iterator[tuple[int, Path, UInt8[np.ndarray, "H W 3"] | None]]:
    """Yield number, file and pixels (None if damaged) of the images of a folder, or of the pages of a TIFF file."""
    if not path.is_dir():
        yield from ((page, path, picture) for page, picture in read_pages(path, numbers))
        return
    files = image_files(path)
    for i in numbers:
        yield i, files[i], read_picture(files[i])


T = TypeVar("T")


def ahead(source: Callable[[Callable[[], bool]], Generator[T]], count: int) -> Generator[T]:
    """Yield the items of a source that runs in a thread, in their order; raise the exception of the source.

    Args:
        source: function that returns the items. Its argument is a function that returns True when no further item is
            needed.
        count: number of items that wait for the caller; one more item waits in the thread.
    """
    stopping, free, made = Event(), Semaphore(count), SimpleQueue()

    def work() -> None:
        end: BaseException | None = None
        try:
            with closing(source(stopping.is_set)) as items:
                for item in items:
                    free.acquire()
                    if stopping.is_set():
                        break
                    made.put(item)
                    del item  # the consumer owns the picture now
        except BaseException as error:
            end = error
        made.put(_End(end))

    thread = Thread(target=work, name="ahead", daemon=True)
    try:
        thread.start()
        while not isinstance(item := made.get(), _End):
            free.release()
            yield item
            del item
        if item.error is not None:
            raise item.error
    finally:
        stopping.set()
        free.release()
        # a garbage collection may close this generator in any thread
        if thread.is_alive() and thread is not current_thread():
            thread.join()


class _End(NamedTuple):
    error: BaseException | None


def warn_of_damage(path: Path, damaged: list[int], step: int) -> None:
    """Log one line with the numbers of the damaged frames of a video, if there are any."""
    if damaged:
        frames = counted(len(damaged), "damaged frame")
        _logger.warning("%s: %s skipped (%s)", path, frames, _spans(damaged, step))


def _spans(numbers: list[int], step: int) -> str:
    """Format numbers as spans such as "3, 7–12, …", at most ten."""
    starts = [i for i, number in enumerate(numbers) if not i or number - numbers[i - 1] != step]
    pairs = [(numbers[a], numbers[b - 1]) for a, b in zip(starts, [*starts[1:], len(numbers)], strict=True)]
    shown = ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in pairs[:10])
    return shown if len(pairs) <= 10 else f"{shown}, …"


def _existing(path: str | Path) -> Path:
    path = Path(path).absolute()  # names such as "concat:…" are file names here, not protocols
    is_folder = os.path.isdir(path)  # noqa: PTH112 - `Path.is_dir` raises an error for names that are too long
    return path if is_folder else check_readable(path, "a video or a folder of images")
