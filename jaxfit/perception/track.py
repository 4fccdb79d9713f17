"""`track_video`: segmentation, tracking, keypoints."""

from __future__ import annotations

import logging
import time
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxfit.config.perception import TrackConfig
from jaxfit.data.footage import read_footage
from jaxfit.data.formats.image_sizes import add_times, check_video
from jaxfit.data.formats.mask_files import mask_observations
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.observations import FROM_OUTLINE, Observations
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.progress import Clock, ProgressTask, silent
from jaxfit.foundation.unfinished import Parts
from jaxfit.foundation.workers import Cluster
from jaxfit.model.anatomy import skeleton_pairs
from jaxfit.perception.detections import (
    detect,
    expected_frames,
    frames_at_once,
    load_stored_frames,
    open_keypoint_detector,
    open_segmenter,
    tracked_frames,
)
from jaxfit.perception.keypoints import OnnxKeypoints
from jaxfit.perception.network import KeypointDetector, Segmenter
from jaxfit.perception.segmenter_choice import SegmenterChoice, with_chosen_segmenter
from jaxfit.perception.tracking import (
    RecordedFrame,
    Tracker,
    all_distances,
    load_tracker,
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
    """Track → mean score, for the excluded longer tracks of birds with low scores: a low mean, or, for segmenters that
    detect doubtful birds (`min_best_score`), no detection with a certain score."""
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
        segmenter: replaces the segmenter of `config`; a thread calls it and the keypoint detector on the next frames.
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
    settings = config.tracker
    own_tracker = partial(
        load_tracker,
        settings.name,
        memory=settings.memory,
        min_iou=settings.min_iou,
        min_score=settings.min_score,
        step=frames.step,
    )
    stored = load_stored_frames(parts, lambda: tracker or own_tracker())
    items = list(stored.items)
    records = [item for item in items if isinstance(item, RecordedFrame)]
    start = records[-1].frame_index + frames.step if records else frames.start

    end = None if total is None else frames.start + total * frames.step
    uses_pictures = getattr(stored.tracker, "uses_pictures", False)
    if cluster is not None and (uses_pictures or end is None):
        reason = "the tracker uses the pictures of the video"
        reason = reason if uses_pictures else "the file does not contain the number of its frames"
        _logger.warning("%s: the networks run in this process, because %s", source, reason)
    if cluster is not None and end is not None and not uses_pictures:
        detections = detect_on_workers(cluster, reader.path, config, range(start, end, frames.step), clock)
    else:
        remaining = reader if start == frames.start else read_frames(source, start, frames.stop, frames.step)
        is_own = has_own_segmenter or not isinstance(keypoints, OnnxKeypoints)  # several threads may not call these
        detections = detect(remaining, segmenter, keypoints, clock, 1 if is_own else frames_at_once(config))
    num_keypoints, name = len(keypoints.keypoint_names), reader.path.name
    tracked = tracked_frames(detections, stored.tracker, num_keypoints, name, clock, parts)
    with progress("Tracking", total) as report_progress, closing(tracked):
        if records:
            report_progress(len(records), "stored frames")
        begun_s, num_new = time.perf_counter(), 0
        for item in () if stored.is_complete else tracked:
            items.append(item)
            if isinstance(item, RecordedFrame):
                num_new += 1
                rate, birds = num_new / (time.perf_counter() - begun_s), len(item.masks)
                noun = "bird" if birds == 1 else "birds"
                report_progress(1, f"{len(records) + num_new} frames, {rate:.1f} frames/s, {birds} {noun} now")

    records = [item for item in items if isinstance(item, RecordedFrame)]
    damaged = [item for item in items if isinstance(item, int)]
    if not records:
        raise InputError(source, f"has no frame from {frames.start} on", "begin with an earlier frame")
    min_score = getattr(segmenter, "min_track_score", 0.0) if config.min_track_score is None else config.min_track_score
    with clock("clean up"):
        names, footage = keypoints.keypoint_names, read_footage(source, reader.info.frames)
        all_tracks = observations_of(records, names, skeleton_pairs(names), reader.info.fps, footage)
        sees_outlines = getattr(keypoints, "sees_outlines", False)
        if sees_outlines:
            all_tracks = replace(all_tracks, keypoint_origin=np.where(all_tracks.present, FROM_OUTLINE, 0))
        length = all_tracks.present.sum(1)  # frames with a detection of the bird, not the frames in between
        score = np.where(all_tracks.present, np.asarray(all_tracks.score), 0).sum(1) / np.maximum(length, 1)
        is_short = length < config.min_track_frames
        best = np.where(all_tracks.present, np.asarray(all_tracks.score), 0).max(1, initial=0)
        is_low = ~is_short & ((score < min_score) | (best < getattr(segmenter, "min_best_score", 0.0)))
        observations = all_tracks.select(tracks=~is_short & ~is_low)
    ids = all_tracks.track_id
    short_tracks = dict(zip(ids[is_short].tolist(), length[is_short].tolist(), strict=True))
    low_score_tracks = dict(zip(ids[is_low].tolist(), score[is_low].tolist(), strict=True))
    distances = all_distances(records)
    # an outline leaves much open, so the limit for confidences of the built-in network does not hold
    calibrated = getattr(keypoints, "curve", None) is not None and not sees_outlines
    trust = judge(footage_signals(all_tracks, short_tracks, distances, calibrated))
    tracking = TrackingResult(observations, short_tracks, low_score_tracks, damaged, None, trust, choice, clock.seconds)
    if observations.num_tracks:
        return tracking
    return tracking._replace(failure=_failure(source, config, tracking, records, min_score, has_own_segmenter))


def given_tracks(masks: str | Path, video: Path) -> TrackingResult:
    """Return tracks with the masks of a folder of pictures or of a file of observations, in place of tracking.

    Raises:
        InputError: the masks cannot be read, or are not those of the video.
    """
    masks = Path(masks)
    observations = mask_observations(masks) if masks.is_dir() else read_observations(masks, video)
    if not observations.masks:
        raise InputError(masks, "holds no mask", "give a folder of pictures of masks, or observations with masks")
    check_video(observations, masks, video)
    observations = add_times(observations, video)
    trust = judge(footage_signals(observations, {}))
    return TrackingResult(observations, {}, {}, [], None, trust, None, {})


def _failure(
    source: str | Path,
    config: TrackConfig,
    tracking: TrackingResult,
    records: list[RecordedFrame],
    min_score: float,
    has_own_segmenter: bool,
) -> InputError:
    """Return why a result has no track, and what to do; under low trust, lower limits are the last choice.

    Without any bird, the segmenter of the config runs again and reports its highest score.
    """
    low_scores, short_tracks = tracking.low_score_tracks, tracking.short_tracks
    if low_scores:
        tracks, best = counted(len(low_scores), "track"), max(low_scores.values())
        what, option = f"mean score of {min_score:g}", "--min-track-score"
        if best >= min_score:  # no detection is certain
            what, option = "certain detection", "--min-score"
        problem = f"no tracked bird has a {what}: the highest of {tracks} is {best:.3f}"
        remedy = f"lower {option}"
    elif short_tracks:
        best_score = max(float(record.score.max(initial=0.0)) for record in records)
        problem = (
            f"no bird was tracked for {config.min_track_frames} frames: there are {len(short_tracks)} shorter tracks, "
            f"with scores up to {best_score:.2f} and at most {max(short_tracks.values())} frames"
        )
        remedy = "lower --min-track-frames"
    else:
        settings = config.segmenter
        problem = f"no {' or '.join(settings.classes) or 'bird'} was detected in {len(records)} frames"
        problem += "" if settings.min_score is None else f" with a score of {settings.min_score:g} or more"
        if not has_own_segmenter:
            best = _highest_score(source, config)
            problem += f"; the highest score is {best:.2f}" if best else f"; no score reaches {RETRY_MIN_SCORE}"
        remedy = (
            "look whether birds are visible in the film; if so, label frames (jaxfit suggest), use another --segmenter "
            "or --classes, lower --min-score, or set --tile-px"
        )
        return InputError(source, problem, remedy)
    networks = ["label frames (jaxfit suggest)", "use other networks (--segmenter)"]
    first, second, last = [*networks, remedy] if tracking.trust.level == "low" else [remedy, *networks]
    return InputError(source, problem, f"{first}, {second}, or {last}")


def _highest_score(source: str | Path, config: TrackConfig) -> float:
    """Return the highest score in RETRY_FRAMES frames, evenly spaced if the number of frames is known."""
    frames, segmenter = config.frames, open_segmenter(config, RETRY_MIN_SCORE)
    reader = read_frames(source, frames.start, frames.stop, frames.step)
    count = expected_frames(reader, frames) or RETRY_FRAMES
    stride = frames.step * max(int(count) // RETRY_FRAMES, 1)
    stop = frames.start + RETRY_FRAMES * stride
    retried = read_frames(source, frames.start, stop if frames.stop is None else min(stop, frames.stop), stride)
    return max((instance.score for frame in retried for instance in segmenter(frame.picture)), default=0.0)
