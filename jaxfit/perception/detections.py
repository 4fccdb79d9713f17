"""The networks of a config on every frame, and the tracker on their detections, with resumption."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.config.checks import require
from jaxfit.config.perception import AUTO, BUILTIN, OUTLINE, FramesConfig, TrackConfig
from jaxfit.foundation.errors import one_line
from jaxfit.foundation.progress import Clock
from jaxfit.foundation.threads import MAX_AT_ONCE, in_threads, usable_cores
from jaxfit.foundation.unfinished import Parts
from jaxfit.perception.carried_masks import BLOCK_FRAMES
from jaxfit.perception.general_networks import DETECTORS
from jaxfit.perception.keypoints import keypoint_file, load_keypoint_detector
from jaxfit.perception.network import Instance, KeypointDetector, Segmenter
from jaxfit.perception.segmentation import KINDS, load_segmenter, segmenter_files
from jaxfit.perception.tracking import RecordedFrame, Tracker, record_frame
from jaxfit.video.decoding import Frame
from jaxfit.video.reader import FrameReader

_logger = logging.getLogger(__name__)


def open_segmenter(config: TrackConfig, min_score: float | None = None) -> Segmenter:
    """Load the segmenter of a config. A run uses one thread, so the result does not depend on the number of cores.

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
        threads=1,
    )


def check_segmenter(config: TrackConfig) -> None:
    """Load the segmenter of a config and release it, to report an unusable segmenter before long work.

    Raises:
        InputError: the segmenter cannot be used.
    """
    open_segmenter(config)


def open_keypoint_detector(config: TrackConfig) -> KeypointDetector:
    """Load the keypoint detector of a config. A run uses one thread, as in `open_segmenter`.

    Raises:
        InputError: the keypoint detector cannot be used.
    """
    settings = config.keypoints
    return load_keypoint_detector(
        keypoint_name(config),
        kind=settings.kind,
        names=settings.names or None,
        pad_px=settings.pad_px,
        dilate_px=settings.dilate_px,
        background=settings.background,
        batch=settings.batch,
        threads=1,
    )


def network_files(config: TrackConfig) -> dict[str, list[Path]]:
    """Return the files of the networks of a config, under the keys `segmenter` and `keypoints`."""
    keypoints = [keypoint_file(keypoint_name(config))]
    return {"segmenter": segmenter_files(_segmenter_name(config)), "keypoints": keypoints}


def keypoint_name(config: TrackConfig) -> str:
    """Return the name of the keypoint network of a config; `auto` stands for `outline` with a general segmenter.

    The built-in keypoint network knows murres, which the built-in segmenter, and usually one that a user has trained,
    detects.
    """
    if config.keypoints.file != AUTO:
        return config.keypoints.file
    segmenter = _segmenter_name(config)
    return OUTLINE if segmenter in DETECTORS or "+" in segmenter else BUILTIN


def _segmenter_name(config: TrackConfig) -> str:
    return BUILTIN if config.segmenter.file == AUTO else config.segmenter.file


class FrameKeypoints(NamedTuple):
    """The keypoints of all instances of one frame."""

    positions_px: Float[np.ndarray, "M K 2"]
    """Image pixels."""
    confidence: Float[np.ndarray, "M K"]
    distance: Float[np.ndarray, "_"]
    """Distances of the activations of the keypoint network; empty for a network without statistics."""


class FrameDetections(NamedTuple):
    """The detections of one frame."""

    frame_index: int
    time_s: float | None
    size_px: tuple[int, int]
    """Width and height."""
    instances: list[Instance]
    distance: Float[np.ndarray, "_"]
    """Distances of the activations of the segmenter; empty for a network without statistics. Those of a block belong to
    its first frame."""
    keypoints: FrameKeypoints
    """The keypoints of all instances, because crops also hide birds without a track."""
    picture: UInt8[np.ndarray, "H W 3"] | None
    """None where another process has read the picture."""
    ends_block: bool
    """Whether the detections of the frames that follow do not depend on this frame or earlier frames."""


BLOCKS_BYTES = 2**30
"""Largest memory of the pictures of the blocks that are segmented at the same time."""


def frames_at_once(config: TrackConfig) -> int:
    """Return the number of frames on which the networks run at the same time: one for each core."""
    return min(config.threads or usable_cores(), MAX_AT_ONCE)


def detect(
    reader: FrameReader, segmenter: Segmenter, keypoints: KeypointDetector, clock: Clock, at_once: int = 1
) -> Generator[FrameDetections | int]:
    """Yield the detections of every frame, by networks in this process; for a damaged frame, yield only its number.

    Threads run the networks on the next frames. A segmenter with the method `segment_block` segments blocks of
    `BLOCK_FRAMES` frames; the first frame of the reader begins a block.

    Args:
        reader: the frames.
        segmenter, keypoints: the networks; several threads call them if `at_once` is above 1.
        clock: measures the time until the detections of a frame or block are complete.
        at_once: number of frames or blocks on which the networks run at the same time; fewer blocks of large frames.
    """
    for network in (segmenter, keypoints):
        take_distances(network)  # those of an earlier video
    block = getattr(segmenter, "segment_block", None)
    if block:
        at_once = max(1, min(at_once, BLOCKS_BYTES // (3 * BLOCK_FRAMES * int(np.prod(reader.info.size_px)))))

    def items() -> Generator[Frame | int]:
        seen = 0
        for frame in reader:
            yield from reader.damaged[seen:]
            seen = len(reader.damaged)
            yield frame
        yield from reader.damaged[seen:]

    def blocks() -> Generator[list[Frame | int]]:
        remaining = items()
        while group := list(islice(remaining, BLOCK_FRAMES if block else 1)):
            yield group

    def detected(group: list[Frame | int]) -> list[FrameDetections | int]:
        frames = [item for item in group if isinstance(item, Frame)]
        pictures = [frame.picture for frame in frames]
        segmented = block(pictures) if block and frames else map(segmenter, pictures)
        pairs = zip(frames, segmented, strict=True)
        found = {frame.index: of_frame(frame, instances, frame is group[-1]) for frame, instances in pairs}
        return [item if isinstance(item, int) else found[item.index] for item in group]

    def of_frame(frame: Frame, instances: list[Instance], ends_block: bool) -> FrameDetections:
        number, picture, time_s = frame
        distance = take_distances(segmenter)
        of_birds = FrameKeypoints(*keypoints(picture, instances), take_distances(keypoints))
        size_px = (picture.shape[1], picture.shape[0])
        return FrameDetections(number, time_s, size_px, instances, distance, of_birds, picture, ends_block)

    with single_opencv_thread(), closing(in_threads(detected, blocks(), at_once)) as results:
        for group in clock.each("detect", results):
            yield from group


def take_distances(network: object) -> np.ndarray:
    """Return the distances of the activations of a network since the last call of this thread; empty without any."""
    monitor = getattr(network, "activations", None)
    return np.zeros(0) if monitor is None else np.asarray(monitor.take())


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
"""Least number of frames between two writes, which follow the end of a block. An interruption costs the frames since
the last write."""

_LAYOUT = {  # F frames, M instances, m of them with a track
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
    "segmenter_distances": "F",  # number of distances of each frame
    "segmenter_distance": "S",
    "keypoint_distances": "F",
    "keypoint_distance": "P",
    "damaged": "D",
    "is_last": "",
}


def _store(parts: Parts, items: Sequence[RecordedFrame | int], num_keypoints: int, is_last: bool) -> None:
    """Store frames, and the numbers of damaged frames, as the next part; `is_last`: the video ends with them.

    Raises:
        InputError: as `Parts.add`.
    """
    frames = [item for item in items if isinstance(item, RecordedFrame)]
    masks = [mask["counts"] for frame in frames for mask in frame.masks]

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
            "mask_length": np.array([len(mask) for mask in masks], np.int64),
            "masks": np.frombuffer(b"".join(masks), np.uint8),
            "keypoints_px": joined("keypoints_px", (num_keypoints, 2), np.float32),
            "confidence": joined("confidence", (num_keypoints,), np.float32),
            "segmenter_distances": np.array([len(frame.segmenter_distance) for frame in frames], np.int64),
            "segmenter_distance": joined("segmenter_distance", (), np.float64),
            "keypoint_distances": np.array([len(frame.keypoint_distance) for frame in frames], np.int64),
            "keypoint_distance": joined("keypoint_distance", (), np.float64),
            "damaged": np.array([item for item in items if isinstance(item, int)], np.int64),
            "is_last": np.array(is_last),
        }
    )


def _load(parts: Parts, number: int) -> tuple[list[RecordedFrame | int], bool]:
    """Return the frames and the numbers of damaged frames of a part, and whether the video ends with them.

    Raises:
        InputError: the file is damaged.
    """
    arrays = parts.load(number, _LAYOUT)
    tracked = arrays["identity"] > 0
    sums = {"birds": len(tracked), "mask_length": len(arrays["masks"])}
    sums |= {f"{name}s": len(arrays[name]) for name in ("segmenter_distance", "keypoint_distance")}
    if any(arrays[name].sum() != total for name, total in sums.items()) or len(arrays["mask_length"]) != tracked.sum():
        raise parts.damaged(number, "holds frames whose numbers of birds do not agree")

    def split(name: str, counts: np.ndarray) -> list[np.ndarray]:
        return np.split(arrays[name], np.cumsum(counts)[:-1])

    birds = arrays["birds"]
    num_tracked = np.array([part.sum() for part in np.split(tracked, np.cumsum(birds)[:-1])], np.int64)
    box_px, score, identity = (split(name, birds) for name in ("box_px", "score", "identity"))
    keypoints_px, confidence = (split(name, num_tracked) for name in ("keypoints_px", "confidence"))
    segmenter_distance = split("segmenter_distance", arrays["segmenter_distances"])
    keypoint_distance = split("keypoint_distance", arrays["keypoint_distances"])
    masks = iter(split("masks", arrays["mask_length"]))
    items: list[RecordedFrame | int] = arrays["damaged"].tolist()
    for f, (width, height) in enumerate(arrays["size_px"].tolist()):
        size = [height, width]
        frame = RecordedFrame(
            frame_index=int(arrays["frame_index"][f]),
            file_name=str(arrays["file_name"][f]),
            size_px=(width, height),
            time_s=float(arrays["time_s"][f]),
            box_px=box_px[f],
            score=score[f],
            identity=identity[f],
            masks=tuple({"size": size, "counts": next(masks).tobytes()} for _ in range(num_tracked[f])),
            keypoints_px=keypoints_px[f],
            confidence=confidence[f],
            segmenter_distance=segmenter_distance[f],
            keypoint_distance=keypoint_distance[f],
        )
        items.append(frame)
    return items, bool(arrays["is_last"])


class StoredFrames(NamedTuple):
    """The frames of an interrupted tracking."""

    items: list[RecordedFrame | int]
    """Frames, and numbers of damaged frames."""
    is_complete: bool
    """Whether the video ends with these frames."""
    tracker: Tracker
    """A tracker that has seen these frames."""


def load_stored_frames(parts: Parts | None, new_tracker: Callable[[], Tracker]) -> StoredFrames:
    """Return the stored frames, and a tracker that has seen these frames.

    Only parts before the first missing part are used. If the tracker cannot be brought into its earlier state (a
    tracker that uses pictures), no part is used.
    """
    tracker = new_tracker()
    if parts is None or not parts.numbers:
        return StoredFrames([], False, tracker)
    parts.keep(next((i for i, number in enumerate(parts.numbers) if i != number), len(parts.numbers)))
    items, is_complete = [], False
    for number in parts.numbers:
        of_part, is_complete = _load(parts, number)
        items += of_part
    if is_complete or _replay(tracker, items):
        return StoredFrames(items, is_complete, tracker)
    _logger.warning("this tracker cannot continue after an interruption, so tracking begins again")
    parts.keep(0)
    return StoredFrames([], False, new_tracker())


def _replay(tracker: Tracker, items: Sequence[RecordedFrame | int]) -> bool:
    """Bring a new tracker into its state after some frames; return whether it gives the recorded identities.

    The masks of the instances are rectangles: trackers see the boxes and scores only.
    """
    if getattr(tracker, "uses_pictures", False):
        return False
    for frame in items:
        if isinstance(frame, int):
            continue
        instances = [
            Instance(np.broadcast_to(True, (h, w)), x, y, score, "bird")
            for (x, y, w, h), score in zip(frame.box_px.astype(int).tolist(), frame.score.tolist(), strict=True)
        ]
        identities = tracker.update(frame.frame_index, instances)
        if [identity or 0 for identity in identities] != frame.identity.tolist():
            return False
    return True


def tracked_frames(
    detections: Generator[FrameDetections | int],
    tracker: Tracker,
    num_keypoints: int,
    name: str,
    clock: Clock,
    parts: Parts | None,
) -> Generator[RecordedFrame | int]:
    """Yield every frame with its tracked birds and their keypoints; for a damaged frame, yield only its number.

    Args:
        detections: the detections of the frames (`detect`).
        tracker: assigns identities.
        num_keypoints: number of keypoints K of the network.
        name: name of the video.
        clock: measures the parts of the work.
        parts: stores the frames; None stores nothing.

    Raises:
        InputError: the video cannot be read, a network cannot be used, or frames cannot be stored.
    """
    unstored: list[RecordedFrame | int] = []
    has_frames = False
    with closing(detections):
        for detected in detections:
            if isinstance(detected, int):
                unstored.append(detected)
                yield detected
                continue
            with clock("track"):
                identities = tracker.update(detected.frame_index, detected.instances, detected.picture)
            with clock("record"):
                frame = record_frame(
                    detected.frame_index,
                    f"{one_line(name)}#{detected.frame_index}",  # a name on the disk may be no text
                    detected.size_px,
                    detected.instances,
                    identities,
                    detected.keypoints.positions_px,
                    detected.keypoints.confidence,
                    detected.time_s,
                    distances=(detected.distance, detected.keypoints.distance),
                )
                unstored.append(frame)
                has_frames = True
                num_unstored = sum(isinstance(item, RecordedFrame) for item in unstored)
                if parts is not None and num_unstored >= FRAMES_PER_PART and detected.ends_block:
                    _store(parts, unstored, num_keypoints, is_last=False)
                    unstored = []
            yield frame
    if parts is not None and has_frames:
        _store(parts, unstored, num_keypoints, is_last=True)


def expected_frames(reader: FrameReader, frames: FramesConfig) -> int | None:
    """Return the number of frames to process; None if the container does not say its length."""
    total = reader.info.frames
    if total is None and frames.stop is None:
        return None
    ends = [end for end in (total, frames.stop) if end is not None]
    return max(0, -((frames.start - min(ends)) // frames.step))  # `len` of a range is limited to 64 bits
