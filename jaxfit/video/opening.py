"""Open a video file with FFmpeg. The file cannot make FFmpeg open other files or wait."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import av
import av.error
from av.stream import Disposition

from jaxfit.errors import InputError
from jaxfit.limits import FRAMES_PER_S, IMAGE_PIXELS, IMAGE_SIDE_PX, SECONDS_PER_FRAME
from jaxfit.storage.reading import open_file
from jaxfit.video.pictures import is_too_large

__all__ = ["MP4", "frame_count", "frame_rate", "opened"]

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
