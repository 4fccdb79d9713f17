"""Suggestion of the frames of a video that a person should label: uncertain frames that differ from each other."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxfit.config.perception import FramesConfig, TrackConfig
from jaxfit.data.observations import Observations
from jaxfit.errors import InputError
from jaxfit.extras import require_extra
from jaxfit.labelling.folder import IMAGES, MARKER, picture_name, write_labels, write_list
from jaxfit.labelling.mirror import mirror_disagreement
from jaxfit.labelling.results import Result, read_result
from jaxfit.labelling.selection import choose, shortlist, thumbnail
from jaxfit.labelling.signals import combine, frame_signals
from jaxfit.perception.instances import KeypointDetector, Segmenter
from jaxfit.perception.opening import open_keypoint_detector
from jaxfit.perception.track import run_tracking
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.files import check_replaceable, new_folder
from jaxfit.video.reader import probe_video, read_frames
from jaxfit.view.checks import is_inside
from jaxfit.view.drawing import write_png

__all__ = ["SuggestedFrame", "Suggestions", "suggest"]

_logger = logging.getLogger(__name__)

MIRROR, VARIETY = "mirror image", "variety"
"""Reasons beside the signals of `frame_signals`: disagreement under flips; a frame unlike the others."""


class SuggestedFrame(NamedTuple):
    """A frame that a person should label."""

    frame_index: int
    """Number of the frame in the video."""
    time_s: float | None
    """Presentation time in seconds; None if the time is unknown."""
    birds: int
    """Number of birds with pre-filled labels."""
    reason: str
    """The strongest signal of uncertainty, or `variety`."""
    score: float
    """Mean rank of the signals among the examined frames, in [0, 1]."""


class Suggestions(NamedTuple):
    """The suggested frames of a video."""

    frames: list[SuggestedFrame]
    """In the order of their numbers."""
    observations: Observations
    """The birds of these frames: the pre-filled labels."""


class _Examined(NamedTuple):
    """The frames of the shortlist that could be decoded."""

    positions: list[int]
    thumbnails: np.ndarray
    mirror: np.ndarray
    times_s: dict[int, float | None]


def suggest(
    video: str | Path,
    out: str | Path,
    count: int = 40,
    result: str | Path | None = None,
    config: TrackConfig = TrackConfig(),
    segmenter: Segmenter | None = None,
    keypoints: KeypointDetector | None = None,
    overwrite: bool = False,
    empty: bool = False,
    progress: ProgressTask = silent,
) -> Suggestions:
    """Choose frames of a video for labelling, and write their pictures and pre-filled labels into a folder.

    A frame is uncertain if the signals of `frame_signals` are large, and if the keypoint network detects other
    keypoints in the mirror image (`mirror_disagreement`). The mirror image is examined for a shortlist of frames.
    `choose` takes frames that are uncertain and differ from the frames chosen before. Without any bird, the frames are
    chosen by variety alone.

    The video is read once, or twice without `result`. docs/files.md describes the folder.

    Args:
        video: a video, or a folder of frames.
        out: folder to write, completely or not at all.
        count: number of frames to choose.
        result: a folder of `jaxfit reconstruct` or `jaxfit fit`, or a file of observations of this video; None tracks
            the birds first.
        config: frames, networks and tracker.
        segmenter, keypoints: networks that replace the networks of `config`.
        overwrite: replace an earlier folder of suggestions.
        empty: write no labels, for networks that do not know the footage: wrong labels take longer than no labels.
        progress: reports every frame.

    Raises:
        InputError: the video, the result, a network or the folder cannot be used; the result belongs to another video;
            the video has fewer frames than `count`; or the extra `formats` is not installed.
    """
    video, out = Path(video), Path(out)
    if count < 1:
        raise InputError("--count", f"is {count}", "give 1 or more")
    require_extra("formats", "jaxfit suggest", "h5py")
    info = probe_video(video)
    if is_inside(video, out) or out.absolute() == video.absolute():
        raise InputError(out, "holds the video, which the suggestions would replace", "choose another --out")
    if video.is_dir() and is_inside(out, video):
        raise InputError(out, f"lies among the video's images in {video}", "choose an --out elsewhere")
    check_replaceable(out, overwrite, MARKER)
    if info.frames is not None:
        _check_count(count, len(_wanted(np.arange(info.frames), config.frames)), video)
    if result is None:
        tracking = run_tracking(video, config, segmenter, keypoints, progress=progress)
        found = Result(tracking.observations, None)
        if tracking.trust.level == "low" and not empty:
            _logger.warning(
                "%s: the labels may be wrong; --empty writes no labels. %s", video, tracking.trust.sentence()
            )
    else:
        found = read_result(Path(result), video)
        found = found._replace(
            observations=found.observations.select(frames=_wanted(found.observations.frame_index, config.frames))
        )
    observations = found.observations
    _check_count(count, observations.num_frames, video if result is None else Path(result))
    with new_folder(out, overwrite, marker=MARKER) as part:
        (part / IMAGES).mkdir()
        signals = frame_signals(observations, found.solution)
        candidates = shortlist(combine(signals)[0], count)
        detector = _detector(observations, config, keypoints)
        examined = _examine(video, observations, candidates, detector, part / IMAGES, progress)
        _check_count(count, len(examined.positions), video)
        frames, positions = _choose(observations, signals, examined, count)
        for t in set(examined.positions) - set(positions):
            (part / IMAGES / picture_name(video, int(observations.frame_index[t]))).unlink()
        chosen = observations.select(tracks=[] if empty else None, frames=positions)
        write_labels(chosen, video, part, out.resolve())
        rows = []
        for number, time_s, birds, reason, score in frames:
            time = "" if time_s is None else f"{time_s:.3f}"
            rows.append((number, time, picture_name(video, number), birds, reason, f"{score:.3f}"))
        write_list(rows, part / MARKER)
    return Suggestions(frames, chosen)


def _wanted(numbers: np.ndarray, frames: FramesConfig) -> np.ndarray:
    """Return the positions of the frames that the config processes."""
    last = np.inf if frames.stop is None else frames.stop
    inside = (numbers >= frames.start) & (numbers < last) & ((numbers - frames.start) % frames.step == 0)
    return np.flatnonzero(inside)


def _check_count(count: int, frames: int, source: Path) -> None:
    if count > frames:
        problem = f"has {frames} frames to choose from, fewer than --count {count}"
        raise InputError(source, problem, f"give --count {frames} or less" if frames else "give other frames")


def _detector(
    observations: Observations, config: TrackConfig, keypoints: KeypointDetector | None
) -> KeypointDetector | None:
    """Return the network that sees mirror images; None without birds, or if the network has other keypoints."""
    if not observations.present.any():
        _logger.warning("no bird is detected: the frames are chosen by variety alone, and their labels are empty")
        return None
    detector = keypoints or open_keypoint_detector(config)
    if sorted(detector.keypoint_names) != sorted(observations.keypoint_names):
        _logger.warning(
            "%s: has other keypoints than the result, so mirror images are not compared", config.keypoints.file
        )
        return None
    return detector


def _examine(
    video: Path,
    observations: Observations,
    candidates: np.ndarray,
    detector: KeypointDetector | None,
    folder: Path,
    progress: ProgressTask,
) -> _Examined:
    """Read the frames of the shortlist, write their pictures, and compare their mirror images."""
    numbers = observations.frame_index[candidates]
    position = dict(zip(numbers.tolist(), candidates.tolist(), strict=True))
    step = int(np.gcd.reduce(np.diff(numbers))) if len(numbers) > 1 else 1
    reader = read_frames(video, int(numbers[0]), int(numbers[-1]) + 1, step)
    positions, thumbnails, mirror, times = [], [], [], {}
    with progress("Examining frames", len(candidates)) as report_progress:
        for number, picture, time_s in reader:
            t = position.get(number)
            if t is None:
                continue
            positions.append(t)
            thumbnails.append(thumbnail(picture))
            mirror.append(np.nan if detector is None else mirror_disagreement(picture, observations, t, detector))
            times[t] = time_s
            write_png(folder / picture_name(video, number), picture)
            report_progress(1, f"frame {number}")
    return _Examined(positions, np.array(thumbnails), np.array(mirror), times)


def _choose(
    observations: Observations, signals: dict[str, np.ndarray], examined: _Examined, count: int
) -> tuple[list[SuggestedFrame], list[int]]:
    """Return the suggested frames and their positions, in the order of their numbers."""
    at = np.array(examined.positions)
    score, reasons = combine({name: values[at] for name, values in signals.items()} | {MIRROR: examined.mirror})
    if not observations.present.any():
        score, reasons = np.full(len(at), 0.5), [""] * len(at)
    picks = sorted(choose(score, examined.thumbnails, observations.frame_index[at], count))
    birds = observations.present.sum(0)
    frames = [
        SuggestedFrame(
            frame_index=int(observations.frame_index[at[i]]),
            time_s=examined.times_s[int(at[i])],
            birds=int(birds[at[i]]),
            reason=reasons[i] if score[i] > 0.5 else VARIETY,
            score=float(score[i]),
        )
        for i in picks
    ]
    return frames, at[picks].tolist()
