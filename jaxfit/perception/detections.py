"""The networks of a config on every frame, and the tracker on their detections, with resumption."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.config.checks import require
from jaxfit.config.perception import AUTO, BUILTIN, FramesConfig, TrackConfig
from jaxfit.foundation.errors import one_line
from jaxfit.foundation.progress import Clock, ProgressTask
from jaxfit.foundation.unfinished import Parts
from jaxfit.perception.keypoints import BUILTIN_PATH, load_keypoint_detector
from jaxfit.perception.network import Instance, KeypointDetector, Segmenter
from jaxfit.perception.segmentation import KINDS, load_segmenter, segmenter_files
from jaxfit.perception.tracking import RecordedFrame, Tracker, TrackRecorder
from jaxfit.video.decoding import Frame
from jaxfit.video.reader import FrameReader, ahead


def open_segmenter(config: TrackConfig, min_score: float | None = None) -> Segmenter:
    """Load the segmenter of a config.

    Args:
        config: the whole config of tracking. `auto` is the built-in segmenter here
            (`jaxfit.perception.segmenter_choice` replaces `auto` by the name of a segmenter).
        min_score: replaces the score of the config; None keeps the score of the config.

    Raises:
        InputError: the segmenter cannot be used.
    """
    settings = config.segmenter
    require(settings.kind in KINDS, "track.segmenter.kind", f"is {settings.kind!r}", f"one of {', '.join(KINDS)}")
    return load_segmenter(
        _segmenter_name(config),
        kind=settings.kind,
        names=settings.names or None,
        classes=settings.classes or None,
        min_score=settings.min_score if min_score is None else min_score,
        tile_px=settings.tile_px,
        tile_overlap=settings.tile_overlap,
        threads=config.threads,
    )


def check_segmenter(config: TrackConfig) -> None:
    """Load the segmenter of a config and release it, to report an unusable segmenter before long work.

    Raises:
        InputError: the segmenter cannot be used.
    """
    open_segmenter(config)


def open_keypoint_detector(config: TrackConfig) -> KeypointDetector:
    """Load the keypoint detector of a config.

    Raises:
        InputError: the keypoint detector cannot be used.
    """
    settings = config.keypoints
    return load_keypoint_detector(
        settings.file,
        kind=settings.kind,
        names=settings.names or None,
        pad_px=settings.pad_px,
        dilate_px=settings.dilate_px,
        background=settings.background,
        batch=settings.batch,
        threads=config.threads,
    )


def network_files(config: TrackConfig) -> dict[str, list[Path]]:
    """Return the files of the networks of a config, under the keys `segmenter` and `keypoints`."""
    keypoints = BUILTIN_PATH if config.keypoints.file == "builtin" else Path(config.keypoints.file)
    return {"segmenter": segmenter_files(_segmenter_name(config)), "keypoints": [keypoints]}


def _segmenter_name(config: TrackConfig) -> str:
    return BUILTIN if config.segmenter.file == AUTO else config.segmenter.file


Keypoints = tuple[Float[np.ndarray, "_ K 2"], Float[np.ndarray, "_ K"]]
"""Positions in image pixels and confidences, as `KeypointDetector` returns them."""
Distances = tuple[Float[np.ndarray, "_"], Float[np.ndarray, "_"]]
"""Distances of the activations of the segmenter and of the keypoint network; empty for networks without statistics."""


class FrameDetections(NamedTuple):
    """The detections of one frame."""

    frame_index: int
    time_s: float | None
    size_px: tuple[int, int]
    """Width and height."""
    instances: list[Instance]
    keypoints: Callable[[], Keypoints]
    """Function that returns the keypoints of all instances."""
    picture: UInt8[np.ndarray, "H W 3"] | None
    """None where another process has read the picture."""


@runtime_checkable
class Detections(Protocol):
    """Detections of the frames of a video, in the order of the frames."""

    @property
    def damaged(self) -> list[int]:
        """Numbers of the frames so far that could not be read."""
        ...

    def __iter__(self) -> Generator[FrameDetections]:
        """Yield the detections of every frame that can be read."""
        ...

    def take_distances(self) -> Distances:
        """Return the distances of the frames since the last call."""
        ...


class LocalDetections:
    """Detections by networks in this process; a thread runs the segmenter on the next frames.

    Args:
        reader: the frames.
        segmenter, keypoints: the networks.
        clock: measures the parts of the work.
    """

    damaged: list[int]
    """Numbers of the frames so far that could not be read."""

    def __init__(self, reader: FrameReader, segmenter: Segmenter, keypoints: KeypointDetector, clock: Clock):
        self._reader, self._segmenter, self._keypoints, self._clock = reader, segmenter, keypoints, clock
        self._distances: list[np.ndarray] = []
        self.damaged = []
        self.take_distances()  # those of an earlier video
        _take_distances(segmenter)

    def __iter__(self) -> Generator[FrameDetections]:
        self.damaged = []
        with single_opencv_thread(), closing(ahead(self._segmented, SEGMENTED_AHEAD)) as segmented:
            for frame, instances, distances, num_damaged in self._clock.each("detect", segmented):
                self.damaged = self._reader.damaged[:num_damaged]
                self._distances.append(distances)
                picture = frame.picture
                size_px = (picture.shape[1], picture.shape[0])
                keypoints = partial(self._keypoints_of, picture, instances)
                yield FrameDetections(frame.index, frame.time_s, size_px, instances, keypoints, picture)
        self.damaged = self._reader.damaged

    def _segmented(self, stopped: Callable[[], bool]) -> Generator[tuple[Frame, list[Instance], np.ndarray, int]]:
        """Yield each frame with its instances, its distances, and the number of damaged frames before this frame."""
        for frame in self._reader:
            if stopped():
                return
            instances = self._segmenter(frame.picture)
            yield frame, instances, _take_distances(self._segmenter), len(self._reader.damaged)

    def _keypoints_of(self, picture: np.ndarray, instances: Sequence[Instance]) -> Keypoints:
        with self._clock("keypoints"):
            return self._keypoints(picture, instances)

    def take_distances(self) -> Distances:
        """Return the distances of the frames since the last call."""
        taken, self._distances = self._distances, []
        return np.concatenate([np.zeros(0), *taken]), _take_distances(self._keypoints)


def _take_distances(network: object) -> np.ndarray:
    """Return the distances of the activations of a network since the last call; empty without statistics."""
    monitor = getattr(network, "activations", None)
    return np.zeros(0) if monitor is None else np.asarray(monitor.take())


SEGMENTED_AHEAD = 1
"""Segmented frames that wait; more do not make tracking faster, because the segmenter takes most of the time."""


def joined_distances(parts: Iterable[Distances]) -> Distances:
    """Return the distances of some parts of a video as those of one part."""
    segmenter, keypoints = zip(*parts, (np.zeros(0), np.zeros(0)), strict=True)
    return np.concatenate(segmenter), np.concatenate(keypoints)


@contextmanager
def single_opencv_thread() -> Iterator[None]:
    """Restrict OpenCV to one thread: the networks use all cores, and OpenCV's threads would slow them down."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


FRAMES_PER_PART = 50
"""Frames between two writes. An interruption costs at most the work on so many frames."""

_LAYOUT = {
    "frame_index": "F",
    "file_name": "F",
    "size_px": "F 2",
    "time_s": "F",
    "birds": "F",  # number of instances of each frame
    "box_px": "M 4",
    "score": "M",
    "identity": "M",
    "mask_length": "m",
    "masks": "bytes",
    "keypoints_px": "m K 2",
    "confidence": "m K",
    "damaged": "D",
    "segmenter_distance": "S",
    "keypoint_distance": "P",
    "is_last": "",
}


class FramePart(NamedTuple):
    """Consecutive frames of a video, as the networks and the tracker processed them."""

    frames: list[RecordedFrame]
    damaged: list[int]
    """Numbers of the damaged frames among these frames."""
    distances: Distances
    is_last: bool
    """Whether the video ends with these frames."""


def store_frames(parts: Parts, part: FramePart, num_keypoints: int) -> None:
    """Store frames as the next part.

    Raises:
        InputError: as `Parts.add`.
    """
    frames = part.frames
    counts = [mask["counts"] for frame in frames for mask in frame.masks]

    def joined(name: str, shape: tuple[int, ...], dtype: type) -> np.ndarray:
        return np.concatenate([np.zeros((0, *shape), dtype), *(getattr(frame, name) for frame in frames)])

    parts.add(
        {
            "frame_index": np.array([frame.frame_index for frame in frames], np.int64),
            "file_name": np.array([frame.file_name for frame in frames] or np.zeros(0, "U1")),
            "size_px": np.array([frame.size_px for frame in frames], np.int64).reshape(-1, 2),
            "time_s": np.array([frame.time_s for frame in frames], np.float64),
            "birds": np.array([len(frame.score) for frame in frames], np.int64),
            "box_px": joined("box_px", (4,), np.float32),
            "score": joined("score", (), np.float64),
            "identity": joined("identity", (), np.int64),
            "mask_length": np.array([len(each) for each in counts], np.int64),
            "masks": np.frombuffer(b"".join(counts), np.uint8),
            "keypoints_px": joined("keypoints_px", (num_keypoints, 2), np.float32),
            "confidence": joined("confidence", (num_keypoints,), np.float32),
            "damaged": np.array(part.damaged, np.int64),
            "segmenter_distance": part.distances[0],
            "keypoint_distance": part.distances[1],
            "is_last": np.array(part.is_last),
        }
    )


def load_frames(parts: Parts, number: int) -> FramePart:
    """Return the frames of a part.

    Raises:
        InputError: the file is damaged.
    """
    arrays = parts.load(number, _LAYOUT)
    tracked = arrays["identity"] > 0
    ends = np.cumsum(arrays["birds"])
    is_whole = (arrays["birds"] >= 0).all() and (ends[-1] if len(ends) else 0) == len(tracked)
    is_whole &= len(arrays["mask_length"]) == tracked.sum() and (arrays["mask_length"] >= 0).all()
    if not is_whole or arrays["mask_length"].sum() != len(arrays["masks"]):
        raise parts.damaged(number, "holds frames whose numbers of birds do not agree")
    mask_ends, text = np.cumsum(arrays["mask_length"]), arrays["masks"].tobytes()
    first_tracked = np.concatenate([[0], np.cumsum(tracked)])
    frames = []
    for f, end in enumerate(ends.tolist()):
        birds = slice(end - int(arrays["birds"][f]), end)
        own = slice(int(first_tracked[birds.start]), int(first_tracked[end]))
        width, height = arrays["size_px"][f].tolist()
        masks = tuple(
            {"size": [height, width], "counts": text[int(mask_ends[m] - arrays["mask_length"][m]) : int(mask_ends[m])]}
            for m in range(own.start, own.stop)
        )
        frames.append(
            RecordedFrame(
                int(arrays["frame_index"][f]),
                str(arrays["file_name"][f]),
                (width, height),
                float(arrays["time_s"][f]),
                arrays["box_px"][birds],
                arrays["score"][birds],
                arrays["identity"][birds],
                masks,
                arrays["keypoints_px"][own],
                arrays["confidence"][own],
            )
        )
    distances = arrays["segmenter_distance"], arrays["keypoint_distance"]
    return FramePart(frames, arrays["damaged"].tolist(), distances, bool(arrays["is_last"]))


def replay(tracker: Tracker, frames: Sequence[RecordedFrame]) -> bool:
    """Bring a new tracker into its state after some frames; return whether it gives the recorded identities.

    The masks of the instances are rectangles: trackers see the boxes and scores only.
    """
    for frame in frames:
        instances = [
            Instance(np.broadcast_to(True, (h, w)), x, y, score, "bird")
            for (x, y, w, h), score in zip(frame.box_px.astype(int).tolist(), frame.score.tolist(), strict=True)
        ]
        identities = tracker.update(frame.frame_index, instances)
        if [identity or 0 for identity in identities] != frame.identity.tolist():
            return False
    return True


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
            # crops also hide birds without a track, so the network gets all birds
            points_px[tracked], confidence[tracked] = (array[tracked] for array in frame.keypoints())
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
