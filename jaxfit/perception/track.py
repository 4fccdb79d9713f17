"""`track_video`: segmentation, tracking, keypoints."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxfit.config.perception import TrackConfig
from jaxfit.data.footage import read_footage
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import Clock, ProgressTask, silent
from jaxfit.foundation.unfinished import Parts
from jaxfit.foundation.workers import Cluster
from jaxfit.model.anatomy import skeleton_pairs
from jaxfit.perception.detections import (
    detect,
    expected_frames,
    load_stored_frames,
    open_keypoint_detector,
    open_segmenter,
    tracked_frames,
)
from jaxfit.perception.network import KeypointDetector, Segmenter
from jaxfit.perception.segmenter_choice import SegmenterChoice, with_chosen_segmenter
from jaxfit.perception.tracking import (
    RecordedFrame,
    Tracker,
    drop_low_scores,
    drop_short_tracks,
    load_tracker,
    mean_scores,
    observations_of,
)
from jaxfit.perception.trust import Trust, footage_signals, judge
from jaxfit.perception.worker_tasks import detect_on_workers
from jaxfit.video.reader import read_frames

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
    choice: SegmenterChoice | None
    """The segmenter that `auto` stands for; None if the config or the caller names a segmenter."""
    seconds: dict[str, float]
    """Duration of each part; for the segmenter and for workers (`detect`), only the time that the others waited."""

    def info(self) -> dict[str, str]:
        """Return the judgement and the choice of the segmenter as texts, for the `info` of a COCO file."""
        return self.trust.info() | (self.choice.info() if self.choice else {})


def track_video(
    source: str | Path,
    config: TrackConfig = TrackConfig(),
    segmenter: Segmenter | None = None,
    keypoints: KeypointDetector | None = None,
    tracker: Tracker | None = None,
    progress: ProgressTask = silent,
) -> Observations:
    """Detect and track every bird of a video, and detect its keypoints.

    Memory grows with the number of frames and of tracks, also short ones: track hours of footage in ranges.

    Args:
        source: a video, or a folder of frames.
        config: frames, networks and tracker.
        segmenter: replaces the segmenter of `config`; a thread calls the segmenter on the next frames.
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


def run_tracking(
    source: str | Path,
    config: TrackConfig = TrackConfig(),
    segmenter: Segmenter | None = None,
    keypoints: KeypointDetector | None = None,
    tracker: Tracker | None = None,
    progress: ProgressTask = silent,
    parts: Parts | None = None,
    cluster: Cluster | None = None,
) -> TrackingResult:
    """Track a video as `track_video` does, and also return trust, skipped tracks, damaged frames and durations.

    Args:
        source, config, segmenter, keypoints, tracker, progress: as for `track_video`.
        parts: stores the frames while they are processed, and holds the frames of an interrupted call; None stores
            nothing. A `tracker` of the caller must not be given too.
        cluster: worker processes that run the networks of `config`, in place of `segmenter` and `keypoints`. They read
            the video and the files of the networks under the same paths. If the tracker uses pictures, or the video
            does not say its length, the networks run in this process. None: this process.
    """
    frames, has_own_segmenter = config.frames, segmenter is not None
    reader = read_frames(source, frames.start, frames.stop, frames.step)
    config, choice = (config, None) if has_own_segmenter else with_chosen_segmenter(source, config, progress)
    keypoints, segmenter = keypoints or open_keypoint_detector(config), segmenter or open_segmenter(config)
    clock = Clock()
    total = expected_frames(reader, frames)
    stored = load_stored_frames(parts, lambda: tracker or _tracker_of(config))
    items = list(stored.items)
    records = [item for item in items if isinstance(item, RecordedFrame)]
    start = records[-1].frame_index + frames.step if records else frames.start

    end = None if total is None else frames.start + total * frames.step
    if cluster is not None and (reason := _no_workers(stored.tracker, end)):
        _logger.warning("%s: the networks run in this process, because %s", source, reason)
        cluster = None
    if cluster is not None and end is not None:
        detections = detect_on_workers(cluster, reader.path, config, range(start, end, frames.step), clock)
    else:
        remaining = reader if start == frames.start else read_frames(source, start, frames.stop, frames.step)
        detections = detect(remaining, segmenter, keypoints, clock)
    num_keypoints, name = len(keypoints.keypoint_names), reader.path.name
    with progress("Tracking", total) as report_progress:
        if records:
            report_progress(len(records), "stored frames")
        if not stored.is_complete:
            tracked = tracked_frames(detections, stored.tracker, num_keypoints, name, clock, parts)
            begun_s, num_new = time.perf_counter(), 0
            for item in tracked:
                items.append(item)
                if isinstance(item, RecordedFrame):
                    num_new += 1
                    rate, birds = num_new / (time.perf_counter() - begun_s), len(item.masks)
                    noun = "bird" if birds == 1 else "birds"
                    note = f"{len(records) + num_new} frames, {rate:.1f} frames/s, {birds} {noun} now"
                    report_progress(1, note)

    records = [item for item in items if isinstance(item, RecordedFrame)]
    damaged = [item for item in items if isinstance(item, int)]
    if not records:
        raise InputError(source, f"has no frame from {frames.start} on", "begin with an earlier frame")
    min_score = getattr(segmenter, "min_track_score", 0.0) if config.min_track_score is None else config.min_track_score
    with clock("clean up"):
        names, footage = keypoints.keypoint_names, read_footage(source, reader.info.frames)
        all_tracks = observations_of(records, names, skeleton_pairs(names), reader.info.fps, footage)
        long_tracks = drop_short_tracks(all_tracks, config.min_track_frames)
        observations = drop_low_scores(long_tracks, min_score)
    lengths = dict(zip(all_tracks.track_id.tolist(), all_tracks.present.sum(1).tolist(), strict=True))
    short_tracks = {track: length for track, length in lengths.items() if track not in long_tracks.track_id}
    scores = dict(zip(long_tracks.track_id.tolist(), mean_scores(long_tracks).tolist(), strict=True))
    low_score_tracks = {track: score for track, score in scores.items() if track not in observations.track_id}
    distances = [
        np.concatenate([record.segmenter_distance for record in records]).tolist(),
        np.concatenate([record.keypoint_distance for record in records]).tolist(),
    ]
    trust = judge(footage_signals(all_tracks, short_tracks, distances, getattr(keypoints, "curve", None) is not None))
    failure = None
    if not observations.num_tracks:
        if low_score_tracks:
            failure = _only_low_scores(source, trust, low_score_tracks, min_score)
        elif short_tracks:
            best_score = max(float(record.score.max(initial=0.0)) for record in records)
            failure = _only_short_tracks(source, config, trust, short_tracks, best_score)
        else:
            failure = _no_bird(source, config, len(records), has_own_segmenter)
    return TrackingResult(observations, short_tracks, low_score_tracks, damaged, failure, trust, choice, clock.seconds)


def _no_workers(tracker: Tracker, end: int | None) -> str | None:
    """Return why the networks cannot run on workers; None if they can."""
    if getattr(tracker, "uses_pictures", False):
        return "the tracker uses the pictures of the video"
    return "the file does not contain the number of its frames" if end is None else None


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


def _remedy(trust: Trust, setting: str) -> str:
    """Return what to do about footage without a track; under low trust, lower limits are the last choice."""
    networks = ["label frames (jaxfit suggest)", "use other networks (--segmenter)"]
    first, second, last = [*networks, setting] if trust.level == "low" else [setting, *networks]
    return f"{first}, {second}, or {last}"


def _only_low_scores(source: str | Path, trust: Trust, low_score_tracks: dict[int, float], least: float) -> InputError:
    problem = (
        f"no tracked bird has a mean score of {least:g}: the highest of {len(low_score_tracks)} tracks is "
        f"{max(low_score_tracks.values()):.3f}"
    )
    return InputError(source, problem, _remedy(trust, "lower --min-track-score"))


def _only_short_tracks(
    source: str | Path, config: TrackConfig, trust: Trust, short_tracks: dict[int, int], best_score: float
) -> InputError:
    problem = (
        f"no bird was tracked for {config.min_track_frames} frames: there are {len(short_tracks)} shorter tracks, with "
        f"scores up to {best_score:.2f} and at most {max(short_tracks.values())} frames"
    )
    return InputError(source, problem, _remedy(trust, "lower --min-track-frames"))


def _no_bird(source: str | Path, config: TrackConfig, frame_count: int, has_own_segmenter: bool) -> InputError:
    """Create the error for a video without birds; the segmenter of the config reports its highest score."""
    classes, min_score = " or ".join(config.segmenter.classes) or "bird", config.segmenter.min_score
    problem = f"no {classes} was detected in {frame_count} frames"
    problem += "" if min_score is None else f" with a score of {min_score:g} or more"
    if not has_own_segmenter:
        best = _highest_score(source, config)
        problem += f"; the highest score is {best:.2f}" if best else f"; no score reaches {RETRY_MIN_SCORE}"
    remedy = (
        "look whether birds are visible in the film; if so, label frames (jaxfit suggest), use another --segmenter or "
        "--classes, lower --min-score, or set --tile-px"
    )
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
