"""`reconstruct`: from a video to poses and an overlay; what unfinished work depends on."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.behaviour.result import shown_behaviour
from jaxfit.config.build import plain_config, with_values
from jaxfit.config.fit import FitConfig
from jaxfit.config.perception import OUTLINE, TrackConfig
from jaxfit.config.reconstruct import OverlayConfig, ReconstructConfig, load_reconstruct_config
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.keypoint_names import NameMap, map_keypoints, names_in_model, propose_names
from jaxfit.data.observations import Observations
from jaxfit.data.result_folder import OBSERVATIONS, OVERLAY, POSES
from jaxfit.data.solution import Solution, write_solution
from jaxfit.data.tracks import track_quality
from jaxfit.fitting.collect import summarise
from jaxfit.fitting.fit import fit, learn_weights, model_of_fit
from jaxfit.fitting.stored_windows import StoredWindows
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import LIBRARIES, TRACKING_LIBRARIES, library_versions
from jaxfit.foundation.files import check_replaceable, new_folder
from jaxfit.foundation.progress import Clock, ProgressTask, annotated, silent
from jaxfit.foundation.unfinished import Parts, unfinished_folder, unfinished_work
from jaxfit.foundation.workers import Cluster
from jaxfit.model.bird import Bird, model_hash
from jaxfit.model.files import load_murre
from jaxfit.perception.detections import check_segmenter, keypoint_name, network_files, open_keypoint_detector
from jaxfit.perception.keypoints import with_outline_keypoints
from jaxfit.perception.label_flow import carry_labels, origin_counts, read_few_labels
from jaxfit.perception.network import KeypointDetector, Segmenter
from jaxfit.perception.segmenter_choice import SegmenterChoice, with_chosen_segmenter
from jaxfit.perception.track import TrackingResult, given_tracks, run_tracking
from jaxfit.video.pictures import image_files
from jaxfit.video.reader import VideoInfo, probe_video
from jaxfit.view.overlay import check_outputs, is_inside, overlay
from jaxfit.view.report.write import REPORT, write_report

_logger = logging.getLogger(__name__)

_AFTER_TRACKING = ("min_track_frames", "min_track_score")
"""Settings of tracking that are applied to the stored frames."""
_FORMAT_VERSION = 2
"""Version of the stored frames and windows."""
_BLOCK_BYTES = 1 << 22


def tracking_record(
    config: TrackConfig, video: Path, networks: dict[str, dict[str, str]], progress: ProgressTask = silent
) -> dict[str, Any]:
    """Return what the stored frames of a video depend on.

    Args:
        config: the settings of tracking.
        video: a video, or a folder of frames; its content counts, not its folder.
        networks: the hashes of the networks (`file_hashes`).
        progress: reports the bytes of the video that were read.
    """
    settings = {key: value for key, value in plain_config(config).items() if key not in _AFTER_TRACKING}
    files = image_files(video) if video.is_dir() else [video]
    with progress("Checking the video", sum(file.stat().st_size for file in files)) as report_progress:
        content = _content_hash(files, lambda size: report_progress(size, ""))
    return {
        "track": settings,
        "video": {"name": video.name, "content": content},
        "networks": networks,
        "versions": library_versions(("jaxfit", "numpy", *TRACKING_LIBRARIES)),
        "format_version": _FORMAT_VERSION,
    }


def fit_record(config: FitConfig, bird: Bird) -> dict[str, Any]:
    """Return what the stored windows depend on, beside the content of each window."""
    return {
        "fit": {key: value for key, value in plain_config(config).items() if key != "memory_gb"},
        "model": model_hash(bird),
        "versions": library_versions(LIBRARIES),
        "format_version": _FORMAT_VERSION,
    }


def file_hashes(networks: dict[str, list[Path]]) -> dict[str, dict[str, str]]:
    """Return kind → name → SHA-256 hash of the files of networks."""
    return {kind: {file.name: _content_hash([file]) for file in files} for kind, files in networks.items()}


def _content_hash(files: Sequence[Path], report_bytes: Callable[[int], object] = lambda _: None) -> str:
    """Return the SHA-256 hash of a file, or of the names and contents of several files."""
    digest = hashlib.sha256()
    for file in files:
        one = hashlib.sha256()
        with file.open("rb") as opened:
            while block := opened.read(_BLOCK_BYTES):
                one.update(block)
                report_bytes(len(block))
        if len(files) == 1:
            return one.hexdigest()
        digest.update(f"{file.name!a} ".encode() + one.digest())
    return digest.hexdigest()


class NoTrackError(InputError):
    """A video without a track that counts, so that there is nothing to fit."""

    tracking: TrackingResult
    """What tracking found: trust, and the skipped tracks."""


class Reconstruction(NamedTuple):
    """The result of a reconstruction."""

    tracking: TrackingResult
    """Tracks of keypoints and masks."""
    solution: Solution
    """Poses."""
    summary: dict[str, Any]
    """Content of `summary.json`: metrics, timings, versions."""
    names: NameMap
    """The keypoints of the network → those of the model, by the words of their names."""


class Networks(NamedTuple):
    """The networks of a reconstruction."""

    segmenter: Segmenter | None
    """The segmenter of the caller; None for that of the config."""
    keypoints: KeypointDetector | None
    """None for given tracks."""
    choice: SegmenterChoice | None
    """The segmenter that `auto` stands for."""
    hashes: dict[str, dict[str, str]]
    """Kind → name → SHA-256 hash of the files of the networks of the config."""
    all_of_config: bool
    """Whether the caller gave no network, so that frames can be stored and workers can run the networks."""
    names: NameMap
    """The keypoints of the network → those of the model."""


class Store:
    """The unfinished work of a reconstruction in a folder, which an interrupted call has left."""

    def __init__(
        self,
        folder: Path,
        config: ReconstructConfig,
        video: Path,
        bird: Bird,
        networks: Networks,
        progress: ProgressTask,
    ):
        self.frames: Parts | None = None
        """The tracked frames; None with networks of the caller."""
        if networks.all_of_config:
            record = tracking_record(config.track, video, networks.hashes, progress)
            # the same command may use other files of the networks
            renewed = ("networks",) if networks.choice is None else ("networks", "track.segmenter.file")
            self.frames = Parts(folder / "frames", record, renewed)
        self._window_parts = Parts(folder / "windows", fit_record(config.fit, bird))
        self.windows = StoredWindows(self._window_parts)

    def size(self) -> str:
        """Return the size of the stored work, for progress."""
        size_bytes = self._window_parts.size_bytes + (self.frames.size_bytes if self.frames else 0)
        return f"{size_bytes / 1e6:.1f} MB stored"

    def state(self) -> str:
        """Return the number of fitted windows and the size of the stored work, for progress."""
        return f"{self.windows.state}, {self.size()}"


def reconstruct(
    video: str | Path,
    folder: str | Path,
    bird: Bird | None = None,
    config: ReconstructConfig | None = None,
    segmenter: Segmenter | None = None,
    keypoints: KeypointDetector | None = None,
    overwrite: bool = False,
    progress: ProgressTask = silent,
    cluster: Cluster | None = None,
    labels: str | Path | None = None,
    masks: str | Path | None = None,
    fit_of_others: FitConfig | None = None,
) -> Reconstruction:
    """Track the birds of a video, fit their poses and draw them on the video.

    The function writes to the folder: `observations.json` as `jaxfit track`; the files of `jaxfit fit`, with the whole
    config in `config.yaml`, and with the quality of tracks and the hashes of networks in `summary.json`; `overlay.mp4`
    and its contact sheet `overlay.png`; `report.html`. The folder is written completely or not at all.

    Until the folder is written, `FOLDER.unfinished` beside the folder holds the tracked frames and the fitted windows.
    After an interruption or a failure, a call with the same arguments continues there. The files of the result are then
    those of an uninterrupted call, bit by bit, on the same machine; durations and drawn videos may differ. With
    networks of the caller (`segmenter`, `keypoints`), tracking begins again and only fitted windows are kept.

    Args:
        video: a video, or a folder of frames.
        folder: folder for the result.
        bird: the model; None uses the murre.
        config: all settings; None uses the shipped config `reconstruct`.
        segmenter, keypoints: networks that replace the networks of `config`.
        overwrite: replace an earlier result in the folder.
        progress: receives the progress of every part.
        cluster: worker processes that run the networks of `config` and fit the windows. None: this process.
        labels: keypoints of a few frames in any format of observations. Optical flow carries them to the other frames,
            and the network `outline` detects them where there is no flow. None: a network detects the keypoints.
        masks: a folder of pictures in which every grey value is one bird, or a file of observations: the tracks with
            their masks, in place of tracking. Keypoints follow from the outlines.
        fit_of_others: settings in place of `config.fit` for keypoints of labels or outlines, which may be of any bird.

    Returns:
        The result. A failed fit of one bird appears in the bird's status and does not affect other birds.

    Raises:
        InputError: no video; an unusable network or tracker; a network without keypoints of the model; a folder that
            cannot be written, holds the video or holds other files; a video without birds (`NoTrackError`); labels of
            other keypoints, or of no tracked bird; unfinished
            work of another video, config, model or version; another process that works on the same result; a cluster
            that ends.
    """
    video, folder, clock = Path(video), Path(folder), Clock()
    with clock("load"):
        info = probe_video(video)
        check_outputs([folder / OVERLAY], video, overwrite=True)  # before the long work
        if is_inside(video, folder):
            raise InputError(folder, "holds the video, which the result would replace", "choose another --out")
        check_replaceable(folder, overwrite, POSES)
        bird, config = bird or load_murre(), config or load_reconstruct_config()
        model_of_fit(bird, config.fit)  # reports a setting that cannot be used before the tracking
        labelled = None if labels is None else read_few_labels(labels, video, bird.keypoint_names)
        if labelled is not None:
            config = with_values(config, {"track.keypoints.file": OUTLINE})
        given = None if masks is None else given_tracks(masks, video)
        config, networks = _choose(config, video, bird, segmenter, keypoints, progress, given is not None)
        if fit_of_others is not None and keypoint_name(config.track) == OUTLINE:
            config = replace(config, fit=fit_of_others)
    with _announced(folder), unfinished_work(folder) as unfinished:
        with clock("track"):
            store = Store(unfinished, config, video, bird, networks, progress)
            tracking = given or _track(video, config.track, networks, bird, store, progress, cluster)
            tracking = tracking._replace(observations=_with_names(tracking.observations, networks.names, bird))
            if given is not None:
                tracking = tracking._replace(observations=with_outline_keypoints(tracking.observations))
        carried = None
        if labelled is not None:
            with clock("labels"):
                carried = carry_labels(tracking.observations, labelled, video, labels, progress)
                tracking = tracking._replace(observations=carried.observations)
        with clock("fit"):
            learnt_yaml = None
            if config.fit.learns_first:
                learnt = learn_weights(tracking.observations, bird, config.fit, progress=progress, source=video)
                config, learnt_yaml = replace(config, fit=learnt.config), learnt.to_yaml()
            fit_progress = annotated(progress, store.state)
            solution = fit(tracking.observations, bird, config.fit, None, fit_progress, video, store.windows, cluster)
        behaviour = shown_behaviour(solution, bird, progress)
        with new_folder(folder, overwrite, marker=POSES) as part:
            with clock("overlay"):
                _draw(solution, bird, video, part / OVERLAY, tracking.observations, config.overlay, progress)
            summary = _summary(tracking, solution, bird, networks, video, info, clock)
            if carried is not None:
                summary["labels"] = {"file": str(labels), "used": carried.used, "problems": carried.problems}
            if np.any(tracking.observations.keypoint_origin):
                summary["pose_sources"] = origin_counts(tracking.observations)
            settings = config_to_yaml(config)
            write_coco(tracking.observations, part / OBSERVATIONS, tracking.info())
            write_solution(solution, bird, settings, summary, part, learnt_yaml)
            write_report(
                part / REPORT,
                solution,
                bird,
                tracking.observations,
                summary,
                settings,
                folder,
                video,
                force=True,
                describe=lambda: behaviour,
            )
    return Reconstruction(tracking, solution, summary, networks.names)


def _choose(
    config: ReconstructConfig,
    video: Path,
    bird: Bird,
    segmenter: Segmenter | None,
    keypoints: KeypointDetector | None,
    progress: ProgressTask,
    has_tracks: bool,
) -> tuple[ReconstructConfig, Networks]:
    """Return the config with a checked segmenter in place of `auto`, and the networks; none for given tracks."""
    if has_tracks:
        config = with_values(config, {"track.keypoints.file": OUTLINE})
        return config, Networks(None, None, None, {}, False, names_in_model((), bird.keypoint_names, ""))
    kinds = {"segmenter": segmenter, "keypoints": keypoints}
    choice = None
    if segmenter is None:
        track_config, choice = with_chosen_segmenter(video, config.track, progress)
        check_segmenter(track_config)
        config = replace(config, track=track_config)
    keypoints = keypoints or open_keypoint_detector(config.track)
    files = {kind: files for kind, files in network_files(config.track).items() if kinds[kind] is None}
    names = names_in_model(keypoints.keypoint_names, bird.keypoint_names, keypoint_name(config.track))
    all_of_config = not any(kinds.values())
    return config, Networks(segmenter, keypoints, choice, file_hashes(files), all_of_config, names)


def _track(
    video: Path,
    config: TrackConfig,
    networks: Networks,
    bird: Bird,
    store: Store,
    progress: ProgressTask,
    cluster: Cluster | None,
) -> TrackingResult:
    """Track the birds; raise the failure of tracking.

    Stored frames that cannot help another call are discarded.
    """
    tracking = run_tracking(
        video,
        config,
        networks.segmenter,
        networks.keypoints,
        progress=annotated(progress, store.size),
        parts=store.frames,
        cluster=cluster if networks.all_of_config else None,
    )
    tracking = tracking._replace(choice=networks.choice)
    if tracking.failure is None:
        return tracking
    if store.frames is not None and not (tracking.short_tracks or tracking.low_score_tracks):
        store.frames.keep(0)  # without a bird, only other settings of tracking help
    failure = NoTrackError(tracking.failure.source, tracking.failure.problem, tracking.failure.remedy)
    failure.tracking = tracking
    raise failure


def _with_names(observations: Observations, names: NameMap, bird: Bird) -> Observations:
    """Return the observations with the keypoints of the model; `names` maps the keypoints of the network."""
    if not names.mapped:  # given tracks have names of their own
        names = propose_names(observations.keypoint_names, bird.keypoint_names)
    return map_keypoints(observations, names, bird.keypoint_names)


@contextmanager
def _announced(folder: Path) -> Iterator[None]:
    """Log one line if the body fails and unfinished work is kept."""
    unfinished = unfinished_folder(folder)
    try:
        yield
    except NoTrackError:
        if unfinished.is_dir():
            text = (
                "%s holds the frames for a lower --min-track-score or --min-track-frames; for other networks, remove it"
            )
            _logger.warning(text, unfinished)
        raise
    except BaseException as error:
        if unfinished.is_dir() and not (isinstance(error, InputError) and error.source.startswith(str(unfinished))):
            _logger.warning("%s holds the work so far; the same command continues there", unfinished)
        raise


def _draw(
    solution: Solution,
    bird: Bird,
    video: Path,
    out: Path,
    observations: Observations,
    config: OverlayConfig,
    progress: ProgressTask,
) -> None:
    """Write the overlay and its contact sheet, unless the config or a lack of poses prevents it."""
    if not config.write:
        return
    if not solution.valid.any():
        _logger.warning("%s: no bird has a pose, so there is no overlay", video)
        return
    overlay(
        solution,
        bird,
        video,
        out,
        observations=observations if config.detections else None,
        side_views=config.side_views,
        max_width=config.max_width_px,
        codec=config.codec,
        force=True,  # a folder may receive further pictures during the reconstruction
        progress=progress,
    )


def _summary(
    tracking: TrackingResult,
    solution: Solution,
    bird: Bird,
    networks: Networks,
    video: Path,
    info: VideoInfo,
    clock: Clock,
) -> dict[str, Any]:
    """Return the content of `summary.json`."""
    summary = summarise(solution, bird, clock.seconds)
    summary["versions"] |= library_versions(TRACKING_LIBRARIES)
    described = {"file": str(video), **info._asdict(), "damaged": tracking.damaged_frames}
    return summary | {
        "video": summary.get("video", {}) | described,
        "quality": {row.track_id: row._asdict() for row in track_quality(tracking.observations)},
        "short_tracks": tracking.short_tracks,
        "low_score_tracks": tracking.low_score_tracks,
        **(tracking.choice.info() if tracking.choice else {}),
        "trust": tracking.trust.level,
        "trust_reasons": list(tracking.trust.reasons),
        "trust_signals": tracking.trust.signals._asdict(),
        "seconds_of_tracking": {part: round(value, 3) for part, value in tracking.seconds.items()},
        "networks": networks.hashes,
        **({"keypoint_names": networks.names.mapped} if networks.names.changes_names else {}),
    }
