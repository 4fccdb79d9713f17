"""The film of the page: pictures of single frames, and a small copy that every browser plays."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int

from jaxfit.data.tracks import frame_step
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.video.decoding import frame_times
from jaxfit.video.reader import probe_video, read_frames
from jaxfit.video.writer import SLOWEST_FPS, VideoWriter
from jaxfit.view.overlay import FOLDER_FPS

PLAYED = (".mp4", ".m4v", ".webm", ".mov")
"""Suffixes of films that browsers may play. The page shows pictures of the frames if its browser does not."""
JPEG_QUALITY = 85


def is_played(video: Path) -> bool:
    """Whether browsers may play a film as it is; a folder of images is no film."""
    return not video.is_dir() and video.suffix.lower() in PLAYED


def film_times(video: Path, frames: Int[np.ndarray, "T"]) -> list[float | None]:
    """Return the time at which a film begins to show each frame, seconds; None for a time that is unknown.

    Args:
        video: a film, which is not decoded.
        frames: numbers of the frames, ascending.

    Raises:
        InputError: the film cannot be read.
    """
    times_s = frame_times(video, int(frames[-1]) + 1)
    known = [float(times_s[number]) if number < len(times_s) else np.nan for number in frames.tolist()]
    return [round(time_s, 6) if np.isfinite(time_s) else None for time_s in known]


def frame_picture(video: Path, number: int, max_width: int = 1920) -> bytes:
    """Return one frame as JPEG.

    Args:
        video: a video, or a folder of images.
        number: number of the frame.
        max_width: greatest width in pixels.

    Raises:
        InputError: the video cannot be read, or has no such frame.
    """
    found = next(iter(read_frames(video, number, number + 1)), None)
    if found is None:
        raise InputError(video, f"has no frame {number}", "give the video of the result")
    picture = found.picture
    if picture.shape[1] > max_width:
        height = max(1, round(picture.shape[0] * max_width / picture.shape[1]))
        picture = cv2.resize(picture, (max_width, height), interpolation=cv2.INTER_AREA)
    encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return encoded.tobytes()


def write_copy(
    video: Path, frames: Int[np.ndarray, "T"], out: Path, max_width: int, progress: ProgressTask = silent
) -> Float[np.ndarray, "T"]:
    """Write the frames of a result as a film that browsers play, and return the time of each frame in it.

    Args:
        video: a video, or a folder of images.
        frames: numbers of the frames. Frames of gaps between them are written too; a frame that the video has lost
            looks like the frame before.
        out: the film to write, `.mp4` or `.webm`.
        max_width: greatest width in pixels.
        progress: reports frames.

    Raises:
        InputError: the video cannot be read, or lacks the frames.
    """
    info, step, first, last = probe_video(video), frame_step(frames), int(frames[0]), int(frames[-1])
    zoom = min(1.0, max_width / info.size_px[0])
    size = round(info.size_px[0] * zoom), max(1, round(info.size_px[1] * zoom))
    rate = max((info.fps or FOLDER_FPS) / step, SLOWEST_FPS)
    expected, shown = first, None
    with (
        progress("Copying the film", (last - first) // step + 1) as report_progress,
        VideoWriter(out, size, rate) as writer,
    ):
        for number, picture, _ in read_frames(video, first, last + 1, step):
            small = picture if zoom == 1 else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            for lost in range(expected, number, step):
                writer.write(small if shown is None else shown)
                report_progress(1, f"frame {lost}")
            writer.write(small)
            expected, shown = number + step, small
            report_progress(1, f"frame {number}")
    return (frames - first) / step / float(writer.fps)
