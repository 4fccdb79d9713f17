"""From a video to posed birds, drawn: what `jaxfit reconstruct` does."""

from __future__ import annotations

import hashlib
import logging
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from jaxfit.clock import Clock
from jaxfit.config.reconstruct import OverlayConfig, ReconstructConfig, load_reconstruct_config
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution, write_solution
from jaxfit.data.track_quality import track_quality
from jaxfit.errors import InputError
from jaxfit.fitting.fit import fit
from jaxfit.fitting.summary import summarise
from jaxfit.model.bird import Bird
from jaxfit.model.files import load_murre
from jaxfit.perception.instances import KeypointDetector, Segmenter
from jaxfit.perception.track import Tracking, find_tracks, network_files, open_keypoint_detector
from jaxfit.perception.tracking import TrackRecorder
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.files import check_replaceable, new_folder
from jaxfit.video.reader import VideoInfo, probe_video
from jaxfit.view.checks import check_outputs
from jaxfit.view.overlay import overlay

__all__ = ["OBSERVATIONS", "OVERLAY", "Reconstruction", "reconstruct"]

OBSERVATIONS, OVERLAY, MARKER = "observations.json", "overlay.mp4", "poses.npz"
LIBRARIES = ("onnxruntime", "opencv-python-headless", "av", "scipy")

_logger = logging.getLogger(__name__)


class Reconstruction(NamedTuple):
    """What came of a video."""

    tracking: Tracking
    """What was found."""
    solution: Solution
    """Its poses."""
    summary: dict[str, Any]
    """What `summary.json` says."""


def reconstruct(
    video: str | Path,
    folder: str | Path,
    bird: Bird | None = None,
    config: ReconstructConfig | None = None,
    segmenter: Segmenter | None = None,
    keypoints: KeypointDetector | None = None,
    overwrite: bool = False,
    progress: ProgressTask = silent,
) -> Reconstruction:
    """Find, follow, pose and draw the birds of a video.

    The folder then holds `observations.json` as `jaxfit track` writes it; the poses as `jaxfit fit` writes them, with
    `config.yaml` for the whole of it, and in `summary.json` also the quality of tracks and the networks' hashes;
    `overlay.mp4` and its contact sheet `overlay.png`. It appears whole or not at all.

    Args:
        video: a video, or a folder of frames.
        folder: where the result goes.
        bird: the model; None takes the murre.
        config: what to do; None takes `reconstruct`.
        segmenter, keypoints: used instead of those that `config` names.
        overwrite: replace an earlier result in that folder.
        progress: told of every part.

    Returns:
        The result. A bird whose fit fails has a status that says so, and the others are as they are.

    Raises:
        InputError: no video, a network or tracker that cannot be used, keypoints that are not the model's, a folder
            that cannot be written, or holds the video or something else already; a video without a bird.
    """
    video, folder, clock = Path(video), Path(folder), Clock()
    given = {"segmenter": segmenter is not None, "keypoints": keypoints is not None}
    with clock("load"):
        config = config or load_reconstruct_config()
        info = probe_video(video)
        check_outputs([folder / OVERLAY], video, overwrite=True)  # before the work, not after it
        if folder.resolve() in video.resolve().parents:
            raise InputError(folder, "holds the video, which would be lost", "choose another --out")
        check_replaceable(folder, overwrite, MARKER)
        bird = bird or load_murre()
        keypoints = keypoints or open_keypoint_detector(config.track)
        named = {kind: files for kind, files in network_files(config.track).items() if not given[kind]}
        nothing_yet = TrackRecorder(keypoints.keypoint_names).observations()
        check_keypoints(nothing_yet, bird.keypoint_names, config.track.keypoints.file)
    with new_folder(folder, overwrite, marker=MARKER) as part:
        with clock("track"):
            tracking = find_tracks(video, config.track, segmenter, keypoints, progress=progress)
        if tracking.nothing is not None:
            raise tracking.nothing
        found = tracking.observations
        with clock("fit"):
            solution = fit(found, bird, config.fit, progress=progress, source=video)
        write_coco(found, part / OBSERVATIONS)
        with clock("overlay"):
            _draw(solution, bird, video, part / OVERLAY, found, config.overlay, progress)
        summary = _summary(tracking, solution, bird, named, video, info, clock)
        write_solution(solution, bird, config_to_yaml(config), summary, part)
    return Reconstruction(tracking, solution, summary)


def _draw(
    solution: Solution,
    bird: Bird,
    video: Path,
    out: Path,
    found: Observations,
    config: OverlayConfig,
    progress: ProgressTask,
) -> None:
    if not config.write:
        return
    if not solution.valid.any():
        _logger.warning("%s: no bird could be posed, so that there is nothing to draw", video)
        return
    overlay(
        solution,
        bird,
        video,
        out,
        observations=found if config.detections else None,
        side_views=config.side_views,
        max_width=config.max_width_px,
        codec=config.codec,
        progress=progress,
    )


def _summary(
    tracking: Tracking,
    solution: Solution,
    bird: Bird,
    networks: dict[str, list[Path]],
    video: Path,
    info: VideoInfo,
    clock: Clock,
) -> dict[str, Any]:
    summary = summarise(solution, bird, clock.seconds)
    summary["versions"] |= {name: metadata.version(name) for name in LIBRARIES}
    return summary | {
        "video": {"file": str(video), **info._asdict(), "damaged": tracking.damaged},
        "quality": {row.track_id: row._asdict() for row in track_quality(tracking.observations)},
        "short_tracks": tracking.short,
        "seconds_of_tracking": {part: round(value, 3) for part, value in tracking.seconds.items()},
        "networks": {
            kind: {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}
            for kind, files in networks.items()
        },
    }
