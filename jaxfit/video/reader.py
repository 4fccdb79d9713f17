"""Frames out of a video or a folder of images, decoded ahead in a thread."""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Semaphore, Thread, current_thread
from typing import NamedTuple

import cv2
import numpy as np

from jaxfit.errors import InputError
from jaxfit.video.decoding import Frame, decode, frame_rate, opened

__all__ = ["Frame", "FrameReader", "VideoInfo", "image_files", "probe_video", "read_frames"]

_logger = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")

_AHEAD = 3  # pictures: enough to even out decoding, and 35 MB at 2592×1520
_NUMBERS = re.compile(r"(\d*)(\D+|$)")


class VideoInfo(NamedTuple):
    """What a video says of itself."""

    frames: int | None
    """How many; None where the container does not say (``.mkv``, ``.webm``, streams)."""
    fps: float | None
    """Frames a second, their mean; of a folder of images what its reader was told, or None."""
    size_px: tuple[int, int]
    """Width and height; of a folder's first image that can be read."""


def probe_video(path: str | Path, *, fps: float | None = None) -> VideoInfo:
    """Count, rate and size of a video or a folder of images, without reading the frames.

    Raises:
        InputError: as ``read_frames``.
    """
    path = _existing(path)
    if path.is_dir():
        files = image_files(path)
        first = next((image for image in map(_read_image, files) if image is not None), None)
        if first is None:
            raise InputError(path, "holds no image that can be read", "the files may be damaged, or no images")
        return VideoInfo(len(files), fps, (first.shape[1], first.shape[0]))
    if fps is not None:
        raise InputError(path, "is a file, whose frame rate is its own", "give a rate for folders of images alone")
    with opened(path) as (_, stream):
        return VideoInfo(stream.frames or None, frame_rate(stream), (stream.width, stream.height))


def read_frames(
    path: str | Path, start: int = 0, stop: int | None = None, step: int = 1, *, fps: float | None = None
) -> FrameReader:
    """The frames of a video, or of a folder of images in the order of their names (2 before 10).

    Frames are numbered from 0 in the order in which they are shown, and a number always means the same picture,
    wherever reading starts (`Timeline` says how, and what is done for a variable frame rate). Damaged ones are
    left out, with all that builds on them, up to the next keyframe; the numbers after them stay right. One
    warning tells which, `FrameReader.damaged` likewise. A decoder notices damage by contradictions alone: in VP8
    and VP9 most goes unnoticed. A file that breaks off ends the frames with a warning. Frames come as they are
    stored: a rotation that the file asks players for is warned of and not applied.

    Args:
        path: a file of any kind that FFmpeg reads, or a folder of images.
        start: number of the first frame wanted.
        stop: number of the frame to stop before; None reads to the end.
        step: every how many-th frame.
        fps: frames a second of a folder of images, which has none of its own.

    Returns:
        What to iterate over.

    Raises:
        ValueError: a negative start or stop, a step below 1, an fps that is not above 0.
        InputError: no such file or folder, no video, no video stream, no image in the folder or none that can be
            read, fps given for a file; while reading: no frame that can be decoded, an image of another size.
    """
    return FrameReader(path, start, stop, step, fps=fps)


class FrameReader:
    """Iterates over frames, and says what it left out; ``read_frames`` makes it, and documents the arguments.

    Every iteration reads anew. A thread decodes a few frames ahead, so that memory does not grow with the video's
    length; it ends with the iteration, however that ends, and what goes wrong in it is raised here.
    """

    path: Path
    info: VideoInfo
    damaged: list[int]
    """Numbers of the frames wanted that were left out, so far: all of them after an iteration."""

    def __init__(
        self, path: str | Path, start: int = 0, stop: int | None = None, step: int = 1, *, fps: float | None = None
    ):
        if start < 0 or (stop is not None and stop < 0) or step < 1:
            raise ValueError(f"start and stop must be 0 or more and step 1 or more, not {start}, {stop}, {step}")
        if fps is not None and not 0 < fps < float("inf"):
            raise ValueError(f"fps must be above 0 and finite, not {fps}")
        self.path = _existing(path)
        self.info = probe_video(self.path, fps=fps)
        self.damaged = []
        self._wanted = range(start, sys.maxsize if stop is None else stop, step)

    def __iter__(self) -> Iterator[Frame]:
        self.damaged = []
        try:
            with closing(_ahead(self._read)) as found:
                for one in found:
                    if isinstance(one, Frame):
                        yield one
                    else:
                        self.damaged.append(one)
        finally:
            if self.damaged:
                count, spans = len(self.damaged), _spans(self.damaged, self._wanted.step)
                _logger.warning("%s: damaged and left out: %d frames (%s)", self.path, count, spans)

    def _read(self, stopped: Callable[[], bool]) -> Generator[Frame | int, None, None]:
        if not self.path.is_dir():
            yield from decode(self.path, self._wanted, stopped)
            return
        files, fps = image_files(self.path), self.info.fps
        for i in range(len(files))[self._wanted.start : self._wanted.stop : self._wanted.step]:
            picture = _read_image(files[i])
            if picture is None:
                yield i
                continue
            size = picture.shape[1], picture.shape[0]
            if size != self.info.size_px:
                problem = f"is {size[0]}×{size[1]}, but the images before are {'×'.join(map(str, self.info.size_px))}"
                raise InputError(files[i], problem, "all of a folder must have one size")
            yield Frame(i, picture, i / fps if fps else None)


def _ahead(source: Callable[[Callable[[], bool]], Generator[Frame | int, None, None]]) -> Generator[Frame | int]:
    """What a source gives, made by a thread that is a few items ahead."""
    stopping, free, made = Event(), Semaphore(_AHEAD), SimpleQueue()

    def work() -> None:
        end: BaseException | None = None
        try:
            with closing(source(stopping.is_set)) as items:
                for item in items:
                    free.acquire()
                    if stopping.is_set():
                        break
                    made.put(item)
                    del item  # the picture is the reader's now
        except BaseException as error:
            end = error
        made.put(_End(end))

    thread = Thread(target=work, name="frames", daemon=True)
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
        if thread.is_alive() and thread is not current_thread():  # a garbage collection may end it anywhere
            thread.join()


class _End(NamedTuple):
    error: BaseException | None


def _spans(numbers: list[int], step: int) -> str:
    """3, 7–12, …: ten at most."""
    starts = [i for i, number in enumerate(numbers) if not i or number - numbers[i - 1] != step]
    pairs = [(numbers[a], numbers[b - 1]) for a, b in zip(starts, [*starts[1:], len(numbers)], strict=True)]
    shown = ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in pairs[:10])
    return shown if len(pairs) <= 10 else f"{shown}, …"


def _existing(path: str | Path) -> Path:
    path = Path(path).absolute()  # "concat:…" and the like are files here, not protocols
    if not path.exists():
        raise InputError(path, "does not exist", "give a video or a folder of images")
    return path


def image_files(folder: Path) -> list[Path]:
    """The images of a folder in the order of their names, numbers by value; InputError where there is none."""
    files = [file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES]
    if not files:
        raise InputError(folder, "holds no images", f"their names end in {', '.join(IMAGE_SUFFIXES)}")
    return sorted(files, key=lambda file: [(int(n or 0), text) for n, text in _NUMBERS.findall(file.name)])


def _read_image(file: Path) -> np.ndarray | None:
    try:
        return cv2.imread(str(file), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
