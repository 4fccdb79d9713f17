"""The film of the page: pictures of single frames, and a small copy that every browser plays."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from threading import Condition, Thread

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
MAX_WIDTH = 1920
"""Width of the pictures, pixels, at most; wider films are shown in a half, a third and so on of their size."""
MOST_BYTES = 64_000_000
"""Bytes of pictures in memory, at most."""
NEAR, MOST = 8, 128
"""Frames that are decoded after a request, and steps back that count as a movement backward; frames that are decoded at
once after a long movement backward, because a film has to be decoded from a keyframe on."""


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


class Pictures:
    """The pictures of the frames of results as JPEG. A thread decodes ahead of the requests, forward or backward.

    Args:
        video: a video, or a folder of images.
        frames: numbers of the frames of the results, ascending.

    Raises:
        InputError: the video cannot be read.
    """

    def __init__(self, video: Path, frames: Int[np.ndarray, "T"]):
        self._video, self._frames, self._step = video, set(frames.tolist()), frame_step(frames)
        self._part = -(-probe_video(video).size_px[0] // MAX_WIDTH)
        self._pictures: OrderedDict[int, bytes | Exception] = OrderedDict()  # those used last are last
        self._asked: list[int] = []
        """Numbers that requests wait for; the newest is last."""
        self._last, self._by, self._moved = int(frames[0]), self._step, 0
        """The number of the newest request, the step to the next number that is expected, and requests backward."""
        self._reader, self._position = iter(()), -1
        """A reader, and the number of the frame that it reads next."""
        self._changed, self._works = Condition(), False

    def picture(self, number: int) -> bytes:
        """Return the picture of a frame, as JPEG of at most `MAX_WIDTH` pixels width.

        Raises:
            InputError: the video cannot be read, or the frame is not one of the results or of the video.
        """
        if number not in self._frames:
            raise InputError(self._video, f"has no frame {number} that is shown", "reload the page")
        with self._changed:
            back = 0 < self._last - number <= NEAR * self._step
            self._last, self._by = number, -self._step if back else self._step
            self._moved = self._moved + 1 if back else 0
            self._asked.append(number)
            if not self._works and self._missing():
                self._works = True
                Thread(target=self._work, name="jaxfit pictures", daemon=True).start()
            self._changed.wait_for(lambda: number in self._pictures)
            self._asked.remove(number)
            self._pictures.move_to_end(number)
            found = self._pictures[number]
            if isinstance(found, Exception):
                del self._pictures[number]  # the next request tries again
                raise found
            return found

    def _waited(self) -> int | None:
        """Return the newest number that a request waits for."""
        return next((number for number in reversed(self._asked) if number not in self._pictures), None)

    def _missing(self) -> range:
        """Return the numbers to decode next: what the newest request waits for, or else what is expected."""
        waited, count = self._waited(), min(NEAR << self._moved // NEAR, MOST)
        expected = range(self._last, self._last + count // 2 * self._by, self._by)
        expected = (number for number in expected if number in self._frames and number not in self._pictures)
        number = next(expected, None) if waited is None else waited
        if number is None:
            return range(0)
        last = number + (count - 1) * self._by
        return range(max(min(number, last), min(self._frames)), max(number, last) + 1, self._step)

    def _work(self) -> None:
        """Decode until nothing is missing."""
        while True:
            with self._changed:
                numbers = self._missing()
                self._works = bool(numbers)
            if not numbers:
                return
            try:
                if self._position != numbers[0]:
                    self._reader = iter(read_frames(self._video, numbers[0], None, self._step, part=self._part))
                    self._position = numbers[0]
                self._read(numbers)
            except Exception as error:  # every request has to end
                self._position = -1
                self._keep({number: error for number in numbers})

    def _read(self, numbers: range) -> None:
        """Keep the pictures of frames, until a request waits for another frame."""
        while self._position in numbers and self._waited() in (None, *numbers):
            frame = next(self._reader, None)
            number = numbers[-1] + self._step if frame is None else frame.index
            lost = InputError(self._video, f"has no frame {self._position}", "give the video of the result")
            self._keep({each: lost for each in range(self._position, number, self._step)})
            if frame is None:
                self._position = -1
            else:
                if number in self._frames:
                    _, jpeg = cv2.imencode(".jpg", frame.picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
                    self._keep({number: jpeg.tobytes()})
                self._position = number + self._step

    def _keep(self, pictures: Mapping[int, bytes | Exception]) -> None:
        with self._changed:
            self._pictures |= {number: picture for number, picture in pictures.items() if number in self._frames}
            sizes = [len(each) if isinstance(each, bytes) else 0 for each in self._pictures.values()]
            while sum(sizes) > MOST_BYTES and len(sizes) > 1:
                self._pictures.popitem(last=False)
                del sizes[0]
            self._changed.notify_all()


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
