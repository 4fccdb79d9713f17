"""The tracker on every frame of a video; an interrupted loop continues after its last stored frame."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import closing

import numpy as np

from jaxfit.clock import Clock
from jaxfit.config.perception import FramesConfig
from jaxfit.errors import one_line
from jaxfit.perception.detections import Detections, joined_distances
from jaxfit.perception.tracking import Tracker, TrackRecorder
from jaxfit.perception.tracking.stored_frames import FRAMES_PER_PART, FramePart, load_frames, replay, store_frames
from jaxfit.progress import ProgressTask
from jaxfit.storage.parts import Parts
from jaxfit.video.reader import FrameReader

__all__ = ["expected_frames", "process_frames"]

_logger = logging.getLogger(__name__)


def process_frames(
    detections_from: Callable[[int], Detections],
    name: str,
    total: int | None,
    frames: FramesConfig,
    new_tracker: Callable[[], Tracker],
    recorder: TrackRecorder,
    clock: Clock,
    progress: ProgressTask,
    parts: Parts | None,
    on_frame: Callable[[], object],
) -> FramePart:
    """Assign identities to the instances of every frame, and detect the keypoints of the birds with a track.

    Args:
        detections_from: returns the detections of the selected frames from a frame number on.
        name: name of the video.
        total: number of frames; None if it is unknown.
        frames: the selection of frames.
        new_tracker: creates a tracker that has seen no frame.
        recorder: receives the frames; it must be new.
        clock: measures the parts of the work.
        progress: reports every frame.
        parts: stores the frames, and holds the frames of an interrupted loop; None stores nothing.
        on_frame: called when the recorder has received a frame, also for each frame of an interrupted loop; not called
            if the interrupted loop had processed all frames.

    Returns:
        All frames as one part.

    Raises:
        InputError: the video cannot be read, a network cannot be used, or frames cannot be stored.
    """
    done, tracker = _continued(parts, new_tracker)
    is_complete = bool(done) and done[-1].is_last
    earlier = [frame for part in done for frame in part.frames]
    stored, seen_damaged = len(earlier), 0
    detections = detections_from(earlier[-1].frame_index + frames.step if stored else frames.start)

    def end_part(is_last: bool) -> None:
        nonlocal stored, seen_damaged
        distances = detections.take_distances()
        part = FramePart(recorder.frames[stored:], detections.damaged[seen_damaged:], distances, is_last)
        stored, seen_damaged = len(recorder.frames), len(detections.damaged)
        if parts is not None:
            store_frames(parts, part, recorder.num_keypoints)
        done.append(part)

    begun, start = stored, time.perf_counter()
    with progress("Tracking", total) as report_progress, closing(iter(detections)) as found:
        if begun:
            report_progress(begun, "stored frames")
        for frame in earlier:
            recorder.frames.append(frame)
            if not is_complete:
                on_frame()
        for frame in () if is_complete else found:
            instances = frame.instances
            with clock("track"):
                identities = tracker.update(frame.frame_index, instances, frame.picture)
            tracked = [i for i, identity in enumerate(identities) if identity is not None]
            points_px = np.zeros((len(instances), recorder.num_keypoints, 2), np.float32)
            confidence = np.zeros(points_px.shape[:2], np.float32)
            points_px[tracked], confidence[tracked] = frame.keypoints(tracked)
            own_name = f"{one_line(name)}#{frame.frame_index}"  # a name on the disk may be no text
            with clock("record"):
                given = (frame.frame_index, own_name, frame.size_px, instances, identities, points_px, confidence)
                recorder.add(*given, frame.time_s)
                if parts is not None and len(recorder.frames) - stored == FRAMES_PER_PART:
                    end_part(is_last=False)
            rate = (len(recorder.frames) - begun) / (time.perf_counter() - start)
            noun = "bird" if len(tracked) == 1 else "birds"
            report_progress(1, f"{len(recorder.frames)} frames, {rate:.1f} frames/s, {len(tracked)} {noun} now")
            on_frame()
    if not is_complete and recorder.frames:
        end_part(is_last=True)
    damaged = [number for part in done for number in part.damaged] if done else detections.damaged
    return FramePart(recorder.frames, damaged, joined_distances(part.distances for part in done), True)


def _continued(parts: Parts | None, new_tracker: Callable[[], Tracker]) -> tuple[list[FramePart], Tracker]:
    """Return the stored parts, and a tracker that has seen their frames.

    Only parts before the first missing part are used. If the tracker cannot be brought into its earlier state (a
    tracker that uses pictures), no part is used.
    """
    tracker = new_tracker()
    if parts is None or not parts.numbers:
        return [], tracker
    parts.keep(next((i for i, number in enumerate(parts.numbers) if i != number), len(parts.numbers)))
    done = [load_frames(parts, number) for number in parts.numbers]
    is_complete = bool(done) and done[-1].is_last
    if is_complete or (
        not getattr(tracker, "uses_pictures", False) and replay(tracker, [f for part in done for f in part.frames])
    ):
        return done, tracker
    _logger.warning("this tracker cannot continue after an interruption, so tracking begins again")
    parts.keep(0)
    return [], new_tracker()


def expected_frames(reader: FrameReader, frames: FramesConfig) -> int | None:
    """Return the number of frames to process; None if the container does not say its length."""
    total = reader.info.frames
    if total is None and frames.stop is None:
        return None
    ends = [end for end in (total, frames.stop) if end is not None]
    return max(0, -((frames.start - min(ends)) // frames.step))  # `len` of a range is limited to 64 bits
