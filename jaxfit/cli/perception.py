"""From video: find and follow birds, and reconstruct them."""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from jaxfit.cli.tables import counted, show, track_table
from jaxfit.model.files import find_bird
from jaxfit.progress import terminal

if TYPE_CHECKING:
    from jaxfit.config.reconstruct import ReconstructConfig

_logger = logging.getLogger(__name__)

__all__ = ["reconstruct", "track"]


def track(options: argparse.Namespace) -> None:
    from jaxfit.data.formats.coco import write_coco
    from jaxfit.perception.track import find_tracks
    from jaxfit.storage.files import check_writable
    from jaxfit.view.checks import check_outputs

    began = time.perf_counter()
    if options.video.exists():  # or tracking says so
        check_outputs([options.out], options.video, options.overwrite)  # before the work, not after it
    check_writable(options.out)
    config = _reconstruct_config(options).track
    tracking = find_tracks(options.video, config, progress=terminal)
    write_coco(tracking.observations, options.out)
    if tracking.nothing:
        _logger.warning("%s", tracking.nothing)
    else:
        show(track_table(tracking.observations))
    _left_out(tracking.short, config.min_track_frames)
    birds, frames = tracking.observations.present.shape
    seconds = time.perf_counter() - began
    show(f"{counted(birds, 'bird')} over {counted(frames, 'frame')} in {seconds:.1f} s → {options.out}")


def reconstruct(options: argparse.Namespace) -> None:
    from jaxfit.pipeline import OBSERVATIONS, OVERLAY, reconstruct

    began = time.perf_counter()
    config = _reconstruct_config(options)
    bird = find_bird(options.model)
    done = reconstruct(options.video, options.out, bird, config, overwrite=options.overwrite, progress=terminal)
    show(track_table(done.tracking.observations, done.solution))
    _left_out(done.tracking.short, config.track.min_track_frames)
    birds = counted(done.summary["tracks"], "bird")
    show(f"{counted(done.summary['poses'], 'pose')} of {birds} in {time.perf_counter() - began:.0f} s. Look at")
    for name, what in (
        (OVERLAY, "the posed birds on the footage"),
        (OVERLAY.replace(".mp4", ".png"), "a contact sheet"),
        (OBSERVATIONS, "what was found in it"),
        ("poses.npz", "the poses"),
        ("summary.json", "how it was made, and figures"),
    ):
        if (options.out / name).is_file():
            show(f"  {options.out / name}: {what}")


def _reconstruct_config(options: argparse.Namespace) -> ReconstructConfig:
    """The config of `--config`, with what other options say laid over it."""
    from jaxfit.config.reconstruct import load_reconstruct_config

    def given(**values: Any) -> dict[str, Any]:
        return {name: value for name, value in values.items() if value is not None}

    config = load_reconstruct_config(options.config)
    classes = tuple(options.classes.split(",")) if options.classes else None
    track = replace(
        config.track,
        frames=replace(config.track.frames, **given(start=options.start, stop=options.stop, step=options.step)),
        segmenter=replace(config.track.segmenter, **given(file=options.segmenter, classes=classes)),
        keypoints=replace(config.track.keypoints, **given(file=options.keypoints)),
    )
    return replace(config, track=track)


def _left_out(short: dict[int, int], least: int) -> None:
    if short:
        frames = ", ".join(f"{track} ({count})" for track, count in list(short.items())[:10])
        more = ", …" if len(short) > 10 else ""
        show(f"left out: {counted(len(short), 'track')} of fewer than {least} frames: {frames}{more}")
