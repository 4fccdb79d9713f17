"""Tracking of a video: segmentation of every frame, assignment of identities, detection of keypoints."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

from jaxfit.clock import Clock
from jaxfit.config.checks import require
from jaxfit.config.perception import TrackConfig
from jaxfit.data.observations import Observations
from jaxfit.errors import InputError
from jaxfit.model.anatomy import mirror_pairs, skeleton_pairs
from jaxfit.perception.frame_loop import expected_frames, process_frames
from jaxfit.perception.instances import KeypointDetector, Segmenter
from jaxfit.perception.keypoints import load_keypoint_detector
from jaxfit.perception.keypoints.detector import BUILTIN_PATH
from jaxfit.perception.segmentation import KINDS, load_segmenter, segmenter_files
from jaxfit.perception.tracking import (
    Tracker,
    TrackRecorder,
    drop_low_scores,
    drop_short_tracks,
    load_tracker,
    mean_scores,
    repair_left_right_flips,
)
from jaxfit.perception.trust import Trust, footage_signals, judge
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.parts import Parts
from jaxfit.video.reader import read_frames

__all__ = [
    "TrackingResult",
    "check_segmenter",
    "network_files",
    "open_keypoint_detector",
    "open_segmenter",
    "run_tracking",
    "track_video",
]

_logger = logging.getLogger(__name__)

RETRY_FRAMES, RETRY_MIN_SCORE = 8, 0.05
"""After a video without any bird: number of frames that are segmented again, and their least score."""


class TrackingResult(NamedTuple):
    """Tracks of a video, and how tracking went."""

    observations: Observations
    """The tracks that are not excluded; all readable frames, including frames without a bird."""
    short_tracks: dict[int, int]
    """Track → number of frames, for the excluded short tracks."""
    low_score_tracks: dict[int, float]
    """Track → mean score, for the excluded longer tracks of birds with low scores."""
    damaged_frames: list[int]
    """Numbers of the frames that could not be read."""
    failure: InputError | None
    """The reason and the remedy if there is no track."""
    trust: Trust
    """Whether tracking worked as it works on simulated footage, and the reasons if not."""
    seconds: dict[str, float]
    """Duration of each part; for decoding, only the time that the other parts waited."""


def track_video(
    source: str | Path,
    config: TrackConfig = TrackConfig(),
    segmenter: Segmenter | None = None,
    keypoints: KeypointDetector | None = None,
    tracker: Tracker | None = None,
    progress: ProgressTask = silent,
) -> Observations:
    """Detect and track every bird of a video, and detect its keypoints.

    Memory grows with the number of detections, not with the length of the video.

    Args:
        source: a video, or a folder of frames.
        config: frames, networks and tracker.
        segmenter: replaces the segmenter of `config`.
        keypoints: replaces the keypoint detector of `config`.
        tracker: replaces the tracker of `config`; it must be new.
        progress: reports every frame.

    Returns:
        Observations of all readable frames. If no bird is tracked, they have no tracks, and a warning says why.

    Raises:
        InputError: the video cannot be read, or a network or tracker cannot be used.
    """
    tracking = run_tracking(source, config, segmenter, keypoints, tracker, progress)
    if tracking.failure:
        _logger.warning("%s", tracking.failure)
    return tracking.observations


def open_segmenter(config: TrackConfig, min_score: float | None = None) -> Segmenter:
    """Load the segmenter of a config.

    Args:
        config: the whole config of tracking.
        min_score: replaces the score of the config; None keeps the score of the config.

    Raises:
        InputError: the segmenter cannot be used.
    """
    settings = config.segmenter
    require(settings.kind in KINDS, "track.segmenter.kind", f"is {settings.kind!r}", f"one of {', '.join(KINDS)}")
    return load_segmenter(
        settings.file,
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
        batch=settings.batch,
        threads=config.threads,
    )


def network_files(config: TrackConfig) -> dict[str, list[Path]]:
    """Return the files of the networks of a config, under the keys `segmenter` and `keypoints`."""
    keypoints = BUILTIN_PATH if config.keypoints.file == "builtin" else Path(config.keypoints.file)
    return {"segmenter": segmenter_files(config.segmenter.file), "keypoints": [keypoints]}


def run_tracking(
    source: str | Path,
    config: TrackConfig = TrackConfig(),
    segmenter: Segmenter | None = None,
    keypoints: KeypointDetector | None = None,
    tracker: Tracker | None = None,
    progress: ProgressTask = silent,
    parts: Parts | None = None,
) -> TrackingResult:
    """Track a video as `track_video` does, and return short tracks, damaged frames and durations too.

    Args:
        source, config, segmenter, keypoints, tracker, progress: as for `track_video`.
        parts: stores the frames while they are processed, and holds the frames of an interrupted call; None stores
            nothing. A `tracker` of the caller must not be given too.
    """
    frames, has_own_segmenter = config.frames, segmenter is not None
    reader, given_tracker = read_frames(source, frames.start, frames.stop, frames.step), tracker
    keypoints = keypoints or open_keypoint_detector(config)
    segmenter = segmenter or open_segmenter(config)
    recorder = TrackRecorder(keypoints.keypoint_names, skeleton_pairs(keypoints.keypoint_names), reader.info.fps)
    clock = Clock()
    processed = process_frames(
        reader,
        frames,
        segmenter,
        keypoints,
        lambda: given_tracker or _tracker_of(config),
        recorder,
        clock,
        progress,
        parts,
    )
    if not processed.frames:
        raise InputError(source, f"has no frame from {frames.start} on", "begin with an earlier frame")
    with clock("clean up"):
        all_tracks = recorder.observations()
        long_tracks = drop_short_tracks(all_tracks, config.min_track_frames)
        least = getattr(segmenter, "min_track_score", 0.0) if config.min_track_score is None else config.min_track_score
        observations = drop_low_scores(long_tracks, least)
        if config.repair_left_right_flips:
            observations, _ = repair_left_right_flips(observations, mirror_pairs(observations.keypoint_names))
    lengths = dict(zip(all_tracks.track_id.tolist(), all_tracks.present.sum(1).tolist(), strict=True))
    short_tracks = {track: length for track, length in lengths.items() if track not in long_tracks.track_id}
    scores = dict(zip(long_tracks.track_id.tolist(), mean_scores(long_tracks).tolist(), strict=True))
    low_score_tracks = {track: score for track, score in scores.items() if track not in observations.track_id}
    is_calibrated = getattr(keypoints, "curve", None) is not None
    distances = [each.tolist() for each in processed.distances]
    trust = judge(footage_signals(all_tracks, short_tracks, distances, is_calibrated))
    failure = None
    if not observations.num_tracks:
        if low_score_tracks:
            failure = _only_low_scores(source, low_score_tracks, least)
        elif short_tracks:
            best_score = max(float(frame.score.max(initial=0.0)) for frame in processed.frames)
            failure = _only_short_tracks(source, config, short_tracks, best_score)
        else:
            failure = _no_bird(source, config, len(processed.frames), has_own_segmenter)
    return TrackingResult(
        observations, short_tracks, low_score_tracks, processed.damaged, failure, trust, clock.seconds
    )


def _tracker_of(config: TrackConfig) -> Tracker:
    """Create the tracker of a config."""
    settings = config.tracker
    return load_tracker(
        settings.name,
        memory=settings.memory,
        min_iou=settings.min_iou,
        min_score=settings.min_score,
        step=config.frames.step,
    )


def _only_low_scores(source: str | Path, low_score_tracks: dict[int, float], least: float) -> InputError:
    problem = (
        f"no tracked bird has a mean score of {least:g}: the highest of {len(low_score_tracks)} tracks is "
        f"{max(low_score_tracks.values()):.3f}"
    )
    return InputError(source, problem, "lower min_track_score, or try another segmenter")


def _only_short_tracks(
    source: str | Path, config: TrackConfig, short_tracks: dict[int, int], best_score: float
) -> InputError:
    problem = (
        f"no bird was tracked for {config.min_track_frames} frames: there are {len(short_tracks)} shorter tracks, with "
        f"scores up to {best_score:.2f} and at most {max(short_tracks.values())} frames"
    )
    return InputError(source, problem, "lower min_track_frames, or try another segmenter or tracker")


def _no_bird(source: str | Path, config: TrackConfig, frame_count: int, has_own_segmenter: bool) -> InputError:
    """Create the error for a video without birds; the segmenter of the config reports its highest score."""
    classes, min_score = " or ".join(config.segmenter.classes) or "bird", config.segmenter.min_score
    problem = f"no {classes} was detected in {frame_count} frames"
    problem += "" if min_score is None else f" with a score of {min_score:g} or more"
    if not has_own_segmenter:
        best = _highest_score(source, config)
        problem += f"; the highest score is {best:.2f}" if best else f"; no score reaches {RETRY_MIN_SCORE}"
    remedy = "lower min_score, cut large frames into tiles (tile_px), or try another --segmenter or --classes"
    return InputError(source, problem, remedy)


def _highest_score(source: str | Path, config: TrackConfig) -> float:
    """Return the highest score in RETRY_FRAMES frames, evenly spaced if the number of frames is known."""
    frames, segmenter = config.frames, open_segmenter(config, RETRY_MIN_SCORE)
    reader = read_frames(source, frames.start, frames.stop, frames.step)
    count = expected_frames(reader, frames) or RETRY_FRAMES
    stride = frames.step * max(int(count) // RETRY_FRAMES, 1)
    stop = frames.start + RETRY_FRAMES * stride
    retried = read_frames(source, frames.start, stop if frames.stop is None else min(stop, frames.stop), stride)
    return max((instance.score for frame in retried for instance in segmenter(frame.picture)), default=0.0)
