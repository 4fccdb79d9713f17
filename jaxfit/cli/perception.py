"""`track`, `reconstruct`, `suggest`."""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from jaxfit.cli.observations import show_names
from jaxfit.cli.tables import flag_line, right_aligned, show, track_table
from jaxfit.foundation.errors import counted
from jaxfit.foundation.progress import terminal
from jaxfit.model.files import find_bird

if TYPE_CHECKING:
    from jaxfit.config.reconstruct import ReconstructConfig
    from jaxfit.perception.track import TrackingResult


def track(options: argparse.Namespace) -> None:
    """Track the birds of a video and write a COCO file."""
    from jaxfit.data.formats.coco import write_coco
    from jaxfit.foundation.files import check_writable
    from jaxfit.foundation.workers import open_cluster
    from jaxfit.perception.photographs import track_photographs
    from jaxfit.perception.track import run_tracking
    from jaxfit.view.overlay import check_outputs

    start = time.perf_counter()
    if options.video.exists():  # tracking reports a missing video
        check_outputs([options.out], options.video, options.overwrite)  # before the long work
    check_writable(options.out)
    config = reconstruct_config(options).track
    if options.photographs:
        tracking = track_photographs(options.video, config, terminal)
    else:
        with open_cluster(options.workers, options.scheduler) as cluster:
            tracking = run_tracking(options.video, config, progress=terminal, cluster=cluster)
    write_coco(tracking.observations, options.out, tracking.info())
    if tracking.failure:
        _show_failure(tracking, config.min_track_frames)
    else:
        _show_trust(tracking, tracking.trust.sentence())
        if options.photographs:
            _show_photographs(tracking)
        else:
            show(track_table(tracking.observations))
        _show_skipped_tracks(tracking, config.min_track_frames)
    tracks, frames = tracking.observations.present.shape
    seconds, what = time.perf_counter() - start, f"{counted(tracks, 'track')} over {counted(frames, 'frame')}"
    if options.photographs:
        what = f"{counted(tracks, 'bird')} in {counted(tracking.observations.photographs, 'photograph')}"
    show(f"{what} in {seconds:.1f} s → {options.out}")
    if tracking.failure:
        raise tracking.failure  # last, because it says what to do next


def reconstruct(options: argparse.Namespace) -> None:
    """Track the birds of a video, fit their poses and draw them."""
    from jaxfit.config.fit import load_config
    from jaxfit.data.result_folder import OBSERVATIONS, OVERLAY, POSES, SUMMARY
    from jaxfit.foundation.workers import open_cluster
    from jaxfit.pipeline import NoTrackError, reconstruct
    from jaxfit.view.report.contents import on_what
    from jaxfit.view.report.write import REPORT

    start = time.perf_counter()
    config = reconstruct_config(options)
    fit_of_others = load_config("few_labels") if options.config == "reconstruct" else None
    bird = find_bird(options.model)
    with open_cluster(options.workers, options.scheduler) as cluster:
        try:
            done = reconstruct(
                options.video,
                options.out,
                bird,
                config,
                overwrite=options.overwrite,
                progress=terminal,
                cluster=cluster,
                labels=options.labels,
                masks=options.masks,
                fit_of_others=fit_of_others,
            )
        except NoTrackError as error:
            _show_failure(error.tracking, config.track.min_track_frames)
            raise
    if done.names.mapped and done.names.changes_names:
        how = "mapped by their words; `jaxfit track` and `jaxfit fit --names MAP.yaml` use another map"
        show_names(done.names, Path(config.track.keypoints.file).name, how)
    _show_trust(done.tracking, done.tracking.trust.sentence())
    for track, frames in done.summary.get("pose_sources", {}).items():
        show(f"poses of track {track}: {on_what(frames)}")
    show(flag_line(done.solution))
    show(track_table(done.tracking.observations, done.solution))
    _show_skipped_tracks(done.tracking, config.track.min_track_frames)
    tracks = counted(done.summary["tracks"], "track")
    show(f"{counted(done.summary['poses'], 'pose')} of {tracks} in {time.perf_counter() - start:.0f} s. Files:")
    for name, text in (
        (REPORT, "warnings, quality and pictures: open it in a browser"),
        (OVERLAY, "the posed birds on the footage"),
        (OVERLAY.replace(".mp4", ".png"), "a contact sheet, with a legend"),
        (OBSERVATIONS, "the tracked keypoints and masks"),
        (POSES, "the poses"),
        (SUMMARY, "metrics, timings and versions"),
    ):
        if (options.out / name).is_file():
            show(f"  {options.out / name}: {text}")


def reconstruct_config(options: argparse.Namespace) -> ReconstructConfig:
    """Return the config of `--config`, with the values of the options for single settings."""
    from jaxfit.config.build import with_values
    from jaxfit.config.reconstruct import load_reconstruct_config

    settings = {path: value for path, value in vars(options).items() if path.startswith("track.") and value is not None}
    return with_values(load_reconstruct_config(options.config), settings)


def _show_trust(tracking: TrackingResult, judgement: str) -> None:
    """Print which segmenter `auto` chose, and the judgement of the video."""
    if tracking.choice and tracking.choice.is_compared:
        show(tracking.choice.sentence())
    show(judgement)


def _show_photographs(tracking: TrackingResult) -> None:
    """Print the birds of photographs."""
    birds = tracking.observations
    table = right_aligned("score", "length px")
    table.add_column("photograph")
    for n, score in enumerate(cast(np.ndarray, birds.score)[:, 0].tolist()):
        table.add_row(f"{score:.2f}", f"{birds.box_px[n, 0, 2:].max():.0f}", birds.image_file(n, 0))
    show(table)


def _show_failure(tracking: TrackingResult, min_frames: int) -> None:
    """Print why no track counts, but not what to do: `TrackingResult.failure` says so in the last line."""
    _show_trust(tracking, tracking.trust.judgement())
    _show_skipped_tracks(tracking, min_frames)


def _show_skipped_tracks(tracking: TrackingResult, min_frames: int) -> None:
    """Print which tracks were skipped, because of too few frames or of low scores."""
    short, low = tracking.short_tracks, tracking.low_score_tracks
    if short:
        frames = _some(f"{track} ({count})" for track, count in short.items())
        show(f"{counted(len(short), 'track')} with fewer than {min_frames} frames skipped: {frames}")
    if low:
        scores = _some(f"{track} ({score:.2f})" for track, score in low.items())
        show(f"{counted(len(low), 'track')} with low scores skipped (--min-track-score, --min-score): {scores}")


def _some(texts: Iterable[str]) -> str:
    """Return the first ten texts as one text."""
    shown = list(texts)
    return ", ".join([*shown[:10], *(["…"] if len(shown) > 10 else [])])


def suggest_frames(options: argparse.Namespace) -> None:
    """Choose frames for labelling, and write their pictures and pre-filled labels."""
    from jaxfit.perception.segmentation import load_segmenter
    from jaxfit.review.suggest import suggest

    config = reconstruct_config(options).track
    done = suggest(
        options.video,
        options.out,
        options.count,
        options.result,
        config,
        overwrite=options.overwrite,
        empty=options.empty,
        progress=terminal,
        teacher=None if options.teacher is None else load_segmenter(options.teacher),
    )
    table = right_aligned("frame", "time", "birds", "reason", "score")
    table.columns[3].justify = "left"
    for frame in done.frames:
        time = "–" if frame.time_s is None else f"{frame.time_s:.2f} s"
        table.add_row(str(frame.frame_index), time, str(frame.birds), frame.reason, f"{frame.score:.2f}")
    table.caption = (
        "reason: the strongest signal of uncertainty, or variety for a frame that mainly differs from the others; "
        "score: mean rank of all signals among the examined frames, from 0 to 1"
    )
    show(table)
    reasons = ", ".join(f"{reason} {number}" for reason, number in Counter(f.reason for f in done.frames).most_common())
    birds = counted(int(done.observations.present.sum()), "bird")
    show(f"{counted(len(done.frames), 'frame')} with {birds} ({reasons}) → {options.out}")
    if not done.observations.num_tracks:
        names = ", ".join(done.observations.keypoint_names) or "no keypoints"
        other = "your keypoints have other names, add them in the labelling program (DeepLabCut: the bodyparts and "
        show(f"the files have no labels and name {names}; if {other}individuals of config.yaml)")
    show(f"{options.out / 'README.txt'} says how to correct the labels and how to read them again")
