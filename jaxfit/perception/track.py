"""`track_video`: segmentation, tracking, keypoints."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from jaxfit.config.perception import TrackConfig
from jaxfit.data.footage import read_footage
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import Clock, ProgressTask, silent
from jaxfit.foundation.unfinished import Parts
from jaxfit.foundation.workers import Cluster
from jaxfit.model.anatomy import mirror_pairs, skeleton_pairs
from jaxfit.perception.detections import (
    Detections,
    LocalDetections,
    expected_frames,
    open_keypoint_detector,
    open_segmenter,
    process_frames,
)
from jaxfit.perception.network import KeypointDetector, Segmenter
from jaxfit.perception.segmenter_choice import SegmenterChoice, with_chosen_segmenter
from jaxfit.perception.tracking import (
    RecordedFrame,
    Tracker,
    TrackRecorder,
    drop_low_scores,
    drop_short_tracks,
    load_tracker,
    mean_scores,
    repair_left_right_flips,
)
from jaxfit.perception.trust import Trust, footage_signals, judge
from jaxfit.perception.worker_tasks import WorkerDetections
from jaxfit.video.reader import read_frames

_logger = logging.getLogger(__name__)

RETRY_FRAMES, RETRY_MIN_SCORE = 8, 0.05
"""After a video without any bird: number of frames that are segmented again, and their least score."""


ObservationsFrom = Callable[[int], Observations]
"""Function of the position of a frame that returns the observations from this frame on. Short tracks and tracks of low
scores are skipped, as at the end of the video, but only these frames count."""


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
    on_frame: Callable[[ObservationsFrom], object] | None = None,
) -> TrackingResult:
    """Track a video as `track_video` does, and also return trust, skipped tracks, damaged frames and durations.

    Args:
        source, config, segmenter, keypoints, tracker, progress: as for `track_video`.
        parts: stores the frames while they are processed, and holds the frames of an interrupted call; None stores
            nothing. A `tracker` of the caller must not be given too.
        cluster: worker processes that run the networks of `config`, in place of `segmenter` and `keypoints`. They read
            the video and the files of the networks under the same paths. If the tracker uses pictures, or the video
            does not say its length, the networks run in this process. None: this process.
        on_frame: called after each frame, with a function that returns the observations so far.
    """
    frames, has_own_segmenter = config.frames, segmenter is not None
    reader, given_tracker = read_frames(source, frames.start, frames.stop, frames.step), tracker
    config, choice = (config, None) if has_own_segmenter else with_chosen_segmenter(source, config, progress)
    keypoints, segmenter = keypoints or open_keypoint_detector(config), segmenter or open_segmenter(config)
    footage, names = read_footage(source, reader.info.frames), keypoints.keypoint_names
    recorder = TrackRecorder(names, skeleton_pairs(names), reader.info.fps, footage)
    clock = Clock()
    total = expected_frames(reader, frames)
    end = None if total is None else frames.start + total * frames.step

    def new_tracker() -> Tracker:
        return given_tracker or _tracker_of(config)

    if cluster is not None and (reason := _no_workers(new_tracker(), end)):
        _logger.warning("%s: the networks run in this process, because %s", source, reason)
        cluster = None

    def detections_from(start: int) -> Detections:
        if cluster is not None and end is not None:
            return WorkerDetections(cluster, reader.path, config, range(start, end, frames.step), clock)
        own = reader if start == frames.start else read_frames(source, start, frames.stop, frames.step)
        return LocalDetections(own, segmenter, keypoints, clock)

    least = getattr(segmenter, "min_track_score", 0.0) if config.min_track_score is None else config.min_track_score

    def frame_added() -> None:
        if on_frame is not None:
            on_frame(lambda first: _clean(recorder.observations(first), config, least)[1])

    processed = process_frames(
        detections_from, reader.path.name, total, frames, new_tracker, recorder, clock, progress, parts, frame_added
    )
    if not processed.frames:
        raise InputError(source, f"has no frame from {frames.start} on", "begin with an earlier frame")
    with clock("clean up"):
        all_tracks = recorder.observations()
        long_tracks, observations = _clean(all_tracks, config, least)
    lengths = dict(zip(all_tracks.track_id.tolist(), all_tracks.present.sum(1).tolist(), strict=True))
    short_tracks = {track: length for track, length in lengths.items() if track not in long_tracks.track_id}
    scores = dict(zip(long_tracks.track_id.tolist(), mean_scores(long_tracks).tolist(), strict=True))
    low_score_tracks = {track: score for track, score in scores.items() if track not in observations.track_id}
    distances = [each.tolist() for each in processed.distances]
    trust = judge(footage_signals(all_tracks, short_tracks, distances, getattr(keypoints, "curve", None) is not None))
    skipped = short_tracks, low_score_tracks, processed.damaged
    result = TrackingResult(observations, *skipped, None, trust, choice, clock.seconds)
    if observations.num_tracks:
        return result
    return result._replace(failure=_failure(source, config, result, processed.frames, least, has_own_segmenter))


def _clean(tracks: Observations, config: TrackConfig, least: float) -> tuple[Observations, Observations]:
    """Return the long tracks, and the repaired long tracks with a mean score of at least `least`."""
    long_tracks = drop_short_tracks(tracks, config.min_track_frames)
    observations = drop_low_scores(long_tracks, least)
    if config.repair_left_right_flips:
        observations, _ = repair_left_right_flips(observations, mirror_pairs(observations.keypoint_names))
    return long_tracks, observations


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


def _failure(
    source: str | Path,
    config: TrackConfig,
    result: TrackingResult,
    frames: list[RecordedFrame],
    least: float,
    has_own_segmenter: bool,
) -> InputError:
    """Return why a result has no track."""
    if result.low_score_tracks:
        return _only_low_scores(source, result.trust, result.low_score_tracks, least)
    if result.short_tracks:
        best_score = max(float(frame.score.max(initial=0.0)) for frame in frames)
        return _only_short_tracks(source, config, result.trust, result.short_tracks, best_score)
    return _no_bird(source, config, len(frames), has_own_segmenter)


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
