"""From a video to tracks of keypoints and masks: every frame segmented, every bird followed, its keypoints found."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2

from jaxfit.clock import Clock
from jaxfit.config.checks import require
from jaxfit.config.perception import TrackConfig
from jaxfit.data.observations import Observations
from jaxfit.errors import InputError
from jaxfit.model.anatomy import mirror_pairs, skeleton_pairs
from jaxfit.perception.instances import KeypointDetector, Segmenter
from jaxfit.perception.keypoints import load_keypoint_detector
from jaxfit.perception.keypoints.detector import BUILTIN_PATH
from jaxfit.perception.segmentation import KINDS, load_segmenter, segmenter_files
from jaxfit.perception.tracking import Tracker, TrackRecorder, drop_short_tracks, load_tracker, repair_left_right_flips
from jaxfit.progress import ProgressTask, silent
from jaxfit.video.reader import FrameReader, read_frames

__all__ = ["Tracking", "find_tracks", "network_files", "open_keypoint_detector", "open_segmenter", "track_video"]

_logger = logging.getLogger(__name__)

LOOKS, FAINT = 8, 0.05
"""Where no bird was found: frames that are looked at again, and the score from which on something is told."""


class Tracking(NamedTuple):
    """What tracking found, and how."""

    observations: Observations
    """Birds that were seen long enough; frames that could be read, also those without a bird."""
    short: dict[int, int]
    """Track → frames of the birds that were left out because they were seen in too few."""
    damaged: list[int]
    """Frames that could not be read."""
    nothing: InputError | None
    """Where there is no track: what was looked for, what came nearest, what to try."""
    seconds: dict[str, float]
    """How long each part took; decoding only as far as the others waited for it."""


def track_video(
    source: str | Path,
    config: TrackConfig = TrackConfig(),
    segmenter: Segmenter | None = None,
    keypoints: KeypointDetector | None = None,
    tracker: Tracker | None = None,
    progress: ProgressTask = silent,
) -> Observations:
    """Find and follow every bird of a video, and its keypoints.

    Memory grows with what is found, not with the length of the video.

    Args:
        source: a video, or a folder of frames.
        config: which frames, which networks, how birds are followed.
        segmenter: used instead of the one that `config` names.
        keypoints: used instead of the one that `config` names.
        tracker: used instead of the one that `config` names; it must be new.
        progress: told of every frame.

    Returns:
        Observations of all frames that could be read. Without any bird they have no track, and a warning says what
        was looked for.

    Raises:
        InputError: no video, or a network or tracker that cannot be used.
    """
    tracking = find_tracks(source, config, segmenter, keypoints, tracker, progress)
    if tracking.nothing:
        _logger.warning("%s", tracking.nothing)
    return tracking.observations


def open_segmenter(config: TrackConfig, min_score: float | None = None) -> Segmenter:
    """The segmenter that a config names.

    Args:
        config: the whole of it.
        min_score: in place of the config's; None leaves that.

    Raises:
        InputError: it cannot be used.
    """
    knobs = config.segmenter
    require(knobs.kind in KINDS, "track.segmenter.kind", f"is {knobs.kind!r}", f"one of {', '.join(KINDS)}")
    return load_segmenter(
        knobs.file,
        kind=knobs.kind,
        names=knobs.names or None,
        classes=knobs.classes or None,
        min_score=knobs.min_score if min_score is None else min_score,
        tile_px=knobs.tile_px,
        tile_overlap=knobs.tile_overlap,
        threads=config.threads,
    )


def open_keypoint_detector(config: TrackConfig) -> KeypointDetector:
    """The keypoint detector that a config names.

    Raises:
        InputError: it cannot be used.
    """
    knobs = config.keypoints
    return load_keypoint_detector(
        knobs.file,
        kind=knobs.kind,
        names=knobs.names or None,
        pad_px=knobs.pad_px,
        dilate_px=knobs.dilate_px,
        batch=knobs.batch,
        threads=config.threads,
    )


def network_files(config: TrackConfig) -> dict[str, list[Path]]:
    """The files of each network that a config names: `segmenter` and `keypoints`."""
    keypoints = BUILTIN_PATH if config.keypoints.file == "builtin" else Path(config.keypoints.file)
    return {"segmenter": segmenter_files(config.segmenter.file), "keypoints": [keypoints]}


def find_tracks(
    source: str | Path,
    config: TrackConfig,
    segmenter: Segmenter | None = None,
    keypoints: KeypointDetector | None = None,
    tracker: Tracker | None = None,
    progress: ProgressTask = silent,
) -> Tracking:
    """What `track_video` does, with more about what was found."""
    knobs, frames, given = config.tracker, config.frames, segmenter is not None
    reader = read_frames(source, frames.start, frames.stop, frames.step)
    tracker = tracker or load_tracker(
        knobs.name, memory=knobs.memory, min_iou=knobs.min_iou, min_score=knobs.min_score, step=frames.step
    )
    keypoints = keypoints or open_keypoint_detector(config)
    segmenter = segmenter or open_segmenter(config)
    recorder = TrackRecorder(keypoints.keypoint_names, skeleton_pairs(keypoints.keypoint_names))
    clock, best, done, began = Clock(), 0.0, 0, time.perf_counter()
    with _one_opencv_thread(), progress("Tracking", _count(reader, config)) as report_progress:
        for number, picture, _ in clock.each("decode", reader):
            with clock("segment"):
                instances = segmenter(picture)
            with clock("track"):
                identities = tracker.update(number, instances, picture)
            followed = [(bird, one) for bird, one in zip(instances, identities, strict=True) if one is not None]
            birds = [bird for bird, _ in followed]
            with clock("keypoints"):
                points_px, confidence = keypoints(picture, birds)
            name, size_px = f"{reader.path.name}#{number}", (picture.shape[1], picture.shape[0])
            with clock("record"):
                recorder.add(number, name, size_px, birds, [one for _, one in followed], points_px, confidence)
            best, done = max([best, *(bird.score for bird in instances)]), done + 1
            noun = "bird" if len(birds) == 1 else "birds"
            report_progress(1, f"{done / (time.perf_counter() - began):.1f} frames/s, {len(birds)} {noun}")
    if not done:
        raise InputError(source, f"has no frame from {frames.start} on", "begin with an earlier frame")
    with clock("clean up"):
        every = recorder.observations()
        found = drop_short_tracks(every, config.min_track_frames)
        if config.repair_left_right_flips:
            found, _ = repair_left_right_flips(found, mirror_pairs(found.keypoint_names))
    counts = dict(zip(every.track_id.tolist(), every.present.sum(1).tolist(), strict=True))
    short = {track: count for track, count in counts.items() if track not in found.track_id}
    nothing = None
    if not found.num_tracks:
        nothing = _too_short(source, config, short, best) if short else _no_bird(source, config, done, given)
    return Tracking(found, short, reader.damaged, nothing, clock.seconds)


def _too_short(source: str | Path, config: TrackConfig, short: dict[int, int], best: float) -> InputError:
    problem = (
        f"no bird was followed for {config.min_track_frames} frames: of {len(short)} that were seen, with scores up to "
        f"{best:.2f}, none was in more than {max(short.values())}"
    )
    return InputError(source, problem, "lower min_track_frames, or try another segmenter or tracker")


def _no_bird(source: str | Path, config: TrackConfig, frames: int, given: bool) -> InputError:
    """Where the config names the segmenter, a few frames are looked at again for what it hardly trusts."""
    wanted, least = " or ".join(config.segmenter.classes) or "bird", config.segmenter.min_score
    problem = f"no {wanted} was found in {frames} frames"
    problem += "" if least is None else f" with a score of {least:g} or more"
    if not given:
        best = _second_look(source, config)
        problem += f"; the highest score seen is {best:.2f}" if best else f"; nothing has even a score of {FAINT}"
    remedy = "lower min_score, cut large frames into tiles (tile_px), or try another --segmenter or --classes"
    return InputError(source, problem, remedy)


def _second_look(source: str | Path, config: TrackConfig) -> float:
    """The highest score in some frames, evenly spaced where it is known how many there are."""
    frames, segmenter = config.frames, open_segmenter(config, FAINT)
    count = _count(read_frames(source, frames.start, frames.stop, frames.step), config) or LOOKS
    stride = frames.step * max(int(count) // LOOKS, 1)
    stop = frames.start + LOOKS * stride
    looks = read_frames(source, frames.start, stop if frames.stop is None else min(stop, frames.stop), stride)
    return max((instance.score for frame in looks for instance in segmenter(frame.picture)), default=0.0)


def _count(reader: FrameReader, config: TrackConfig) -> int | None:
    """How many frames are to come, as far as the container says."""
    frames, total = config.frames, reader.info.frames
    if total is None and frames.stop is None:
        return None
    ends = [end for end in (total, frames.stop) if end is not None]
    return len(range(frames.start, min(ends), frames.step))


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    """Networks have the cores; OpenCV's own threads would only wait for each other between two of their runs."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
