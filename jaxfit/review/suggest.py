"""`suggest`: from a video or a result to a folder of frames that a person should label."""

from __future__ import annotations

import csv
import io
import logging
import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import numpy as np

from jaxfit.config.perception import FramesConfig, TrackConfig
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.formats.cvat import write_cvat, write_cvat_label
from jaxfit.data.formats.image_sizes import check_video
from jaxfit.data.formats.label_studio import write_label_studio
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.formats.write_deeplabcut import write_deeplabcut_labels
from jaxfit.data.formats.write_sleap import write_sleap_project
from jaxfit.data.observations import Observations
from jaxfit.data.projection import projected_observations
from jaxfit.data.result_folder import OBSERVATIONS
from jaxfit.data.solution import Solution, load_solution
from jaxfit.foundation.errors import InputError, one_line
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.files import check_replaceable, new_folder, write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.perception.detections import open_keypoint_detector
from jaxfit.perception.network import KeypointDetector, Segmenter
from jaxfit.perception.track import run_tracking
from jaxfit.review.signals import (
    SHORTLIST,
    choose,
    combine,
    frame_signals,
    mirror_disagreement,
    segmenter_disagreement,
    shortlist,
    thumbnail,
)
from jaxfit.video.reader import probe_video, read_frames
from jaxfit.view.drawing import write_png
from jaxfit.view.overlay import is_inside


class Result(NamedTuple):
    """What is known about the birds of a video."""

    observations: Observations
    solution: Solution | None
    """The fit of the observations, if there is a fit."""


def read_result(path: Path, video: Path) -> Result:
    """Read a result folder or a file of observations, and check that the result belongs to a video.

    The observations of a folder without `observations.json`, which `jaxfit fit` writes, are the projected keypoints.

    Args:
        path: a folder of `jaxfit reconstruct` or `jaxfit fit`, or a file of observations in any format.
        video: the video, or folder of pictures.

    Raises:
        InputError: the result cannot be read, has images of another size or frames that the video lacks, or consists
            of photographs.
    """
    solution = None
    if path.is_dir():
        solution, _ = load_solution(path)
        if (path / OBSERVATIONS).is_file():
            observations = read_observations(path / OBSERVATIONS, video)
        else:
            observations, solution = projected_observations(solution), None
            check_video(observations, path, video)
    else:
        observations = read_observations(path, video)
    if observations.own_images:
        raise InputError(path, "holds photographs, not frames of one video", "give the result of this video")
    if not observations.num_frames:
        raise InputError(path, "holds no frames", "give the result of this video")
    return Result(observations, solution)


IMAGES, MARKER = "images", "suggested.csv"
_DEEPLABCUT = Path("deeplabcut") / "labeled-data"

_README = Path(__file__).with_name("labelling.txt")
"""Text of `README.txt` of the folder, with fields in braces."""


def picture_name(video: Path, number: int) -> str:
    """Return the file name of the picture of a frame, from which `frame_numbers` reads the number."""
    return f"{_stem(video)}_{number:06d}.png"


def _stem(video: Path) -> str:
    """Return the name of a video with the characters that all labelling programs accept in file names."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", one_line(video.stem))[:100].strip("_") or "video"


def write_labels(observations: Observations, video: Path, folder: Path, final: Path, scorer: str = "jaxfit") -> None:
    """Write the labels of all formats into a folder that holds the pictures of the frames in `images/`.

    Args:
        observations: the birds of the suggested frames.
        video: the video, for names.
        folder: the folder, which may have a temporary name.
        final: the absolute path that the folder will have.
        scorer: name of the labelling person or program in DeepLabCut.

    Raises:
        InputError: the extra `formats` is not installed, or a file cannot be written.
    """
    pictures = [picture_name(video, number) for number in observations.frame_index.tolist()]
    named = replace(observations, file_name=np.array(pictures, str))
    write_coco(named, folder / "coco.json", {"description": f"frames of {one_line(video.name)} to label"})
    write_cvat(named, folder / "cvat.json")
    write_cvat_label(named, folder / "cvat_labels.json")
    urls = [f"/data/local-files/?d={quote(f'{IMAGES}/{picture}')}" for picture in pictures]
    write_label_studio(named, urls, folder / "label_studio.json", folder / "label_studio.xml")
    write_sleap_project(named, [str(final / IMAGES / picture) for picture in pictures], folder / "labels.slp")
    deeplabcut = folder / _DEEPLABCUT / _stem(video)
    deeplabcut.mkdir(parents=True)
    for picture in pictures:
        _link(folder / IMAGES / picture, deeplabcut / picture)
    write_deeplabcut_labels(named, pictures, deeplabcut, scorer)
    birds = ", ".join(f"bird{track}" for track in named.track_id[named.present.any(1)].tolist()) or "bird1"
    facts = {"video": one_line(video.name), "count": len(pictures), "out": one_line(final), "birds": birds}
    text = _README.read_text(encoding="utf-8").format(**facts, folder=_stem(video), scorer=scorer)
    write_whole(folder / "README.txt", text.encode())


def _link(source: Path, target: Path) -> None:
    """Give a file a second name, or copy the file where the file system has no hard links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


_logger = logging.getLogger(__name__)

MIRROR, VARIETY, TEACHER, MARKED = "mirror image", "variety", "teacher", "marked by a person"
"""Reasons beside the signals of `frame_signals`: disagreement under flips; a frame unlike the others; disagreement with
another segmenter; a person."""


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
    teacher: np.ndarray | None
    """Disagreement with the teacher; None without a teacher."""
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
    teacher: Segmenter | None = None,
) -> Suggestions:
    """Choose frames of a video for labelling, and write their pictures and pre-filled labels into a folder.

    A frame is uncertain if the signals of `frame_signals` are large, and if the keypoint network detects other
    keypoints in the mirror image (`mirror_disagreement`). The mirror image is examined for a shortlist of frames.
    `choose` takes frames that are uncertain and differ from the frames chosen before. Without any bird, the frames are
    chosen by variety alone. With a teacher, only the disagreement of its masks counts (`segmenter_disagreement`).

    The video is read once, or twice without `result`. docs/reference/suggested_frames.md describes the folder.

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
        teacher: a second segmenter, whose disagreement is the only signal.

    Raises:
        InputError: the video, the result, a network or the folder cannot be used; the result belongs to another video;
            the video has fewer frames than `count`; or the extra `formats` is not installed.
    """
    video, out = Path(video), Path(out)
    if count < 1:
        raise InputError("--count", f"is {count}", "give 1 or more")
    require_extra("formats", "jaxfit suggest", "h5py", "sleap-io")
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
        known = Result(tracking.observations, None)
        if tracking.trust.level == "low" and not empty:
            _logger.warning(
                "%s: the labels may be wrong; --empty writes no labels. %s", video, tracking.trust.sentence()
            )
    else:
        known = read_result(Path(result), video)
        wanted = _wanted(known.observations.frame_index, config.frames)
        known = known._replace(observations=known.observations.select(frames=wanted))
    observations = known.observations
    _check_count(count, observations.num_frames, video if result is None else Path(result))
    with new_folder(out, overwrite, marker=MARKER) as part:
        (part / IMAGES).mkdir()
        signals = frame_signals(observations, known.solution)
        if teacher is None:
            candidates, detector = shortlist(combine(signals)[0], count), _detector(observations, config, keypoints)
        else:  # no other signal counts
            most = min(SHORTLIST * count, observations.num_frames)
            candidates, detector = np.linspace(0, observations.num_frames - 1, most).round().astype(int), None
        examined = _examine(video, observations, candidates, detector, part / IMAGES, progress, teacher)
        _check_count(count, len(examined.positions), video)
        frames, positions = _choose(observations, signals, examined, count)
        for t in set(examined.positions) - set(positions):
            (part / IMAGES / picture_name(video, int(observations.frame_index[t]))).unlink()
        chosen = observations.select(tracks=[] if empty else None, frames=positions)
        write_labels(chosen, video, part, out.resolve())
        _write_list(frames, video, part)
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
    teacher: Segmenter | None,
) -> _Examined:
    """Read the frames of the shortlist, write their pictures, and compare their mirror images, or the teacher."""
    numbers = observations.frame_index[candidates]
    position = dict(zip(numbers.tolist(), candidates.tolist(), strict=True))
    step = int(np.gcd.reduce(np.diff(numbers))) if len(numbers) > 1 else 1
    reader = read_frames(video, int(numbers[0]), int(numbers[-1]) + 1, step)
    positions, thumbnails, mirror, differences, times = [], [], [], [], {}
    with progress("Examining frames", len(candidates)) as report_progress:
        for number, picture, time_s in reader:
            t = position.get(number)
            if t is None:
                continue
            positions.append(t)
            thumbnails.append(thumbnail(picture))
            mirror.append(np.nan if detector is None else mirror_disagreement(picture, observations, t, detector))
            if teacher is not None:
                differences.append(segmenter_disagreement(picture, observations, t, teacher))
            times[t] = time_s
            write_png(folder / picture_name(video, number), picture)
            report_progress(1, f"frame {number}")
    disagreement = None if teacher is None else np.array(differences)
    return _Examined(positions, np.array(thumbnails), np.array(mirror), disagreement, times)


def _choose(
    observations: Observations, signals: dict[str, np.ndarray], examined: _Examined, count: int
) -> tuple[list[SuggestedFrame], list[int]]:
    """Return the suggested frames and their positions, in the order of their numbers."""
    at = np.array(examined.positions)
    if examined.teacher is not None:
        score, reasons = combine({TEACHER: examined.teacher})
    elif observations.present.any():
        score, reasons = combine({name: values[at] for name, values in signals.items()} | {MIRROR: examined.mirror})
    else:
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


def varied_frames(video: Path, count: int, progress: ProgressTask = silent) -> np.ndarray:
    """Return the numbers of frames that look different and are spread over a video, in increasing order.

    Args:
        video: a video, or a folder of frames. Some of its frames are read.
        count: number of frames.
        progress: reports every frame that is read.

    Raises:
        InputError: the video cannot be read, or has fewer frames.
    """
    total = probe_video(video).frames
    if total is None:
        total = sum(1 for _ in read_frames(video))
    _check_count(count, total, video)
    candidates = np.linspace(0, total - 1, min(total, SHORTLIST * count)).round().astype(int)
    numbers, thumbnails = [], []
    with progress("Choosing frames", len(candidates)) as report_progress:
        for number in candidates.tolist():
            for frame in read_frames(video, number, number + 1):
                numbers.append(number)
                thumbnails.append(thumbnail(frame.picture))
            report_progress(1, f"frame {number}")
    _check_count(count, len(numbers), video)
    picks = choose(np.full(len(numbers), 0.5), np.array(thumbnails), np.array(numbers), count)
    return np.sort(np.array(numbers)[picks])


def suggest_marked(
    video: Path, out: Path, frames: Sequence[int], result: Path, progress: ProgressTask = silent
) -> Suggestions:
    """Write frames that a person has marked for labelling, as `suggest` writes frames that it chooses.

    Args:
        video: a video, or a folder of frames.
        out: folder to write, completely or not at all.
        frames: numbers of the frames, in increasing order.
        result: a folder of `jaxfit reconstruct` or `jaxfit fit`, or a file of observations of this video.
        progress: reports every frame.

    Raises:
        InputError: the video, the result or the folder cannot be used; the result or the video lacks a frame; or the
            extra `formats` is not installed.
    """
    require_extra("formats", "frames to label", "h5py", "sleap-io")
    check_replaceable(out, False, MARKER)
    observations = read_result(result, video).observations
    missing = sorted(set(frames) - set(observations.frame_index.tolist()))
    if missing:
        raise InputError(result, f"has no frame {missing[0]}", "mark frames of the result")
    candidates = np.searchsorted(observations.frame_index, frames)
    with new_folder(out, marker=MARKER) as part:
        (part / IMAGES).mkdir()
        examined = _examine(video, observations, candidates, None, part / IMAGES, progress, None)
        _check_count(len(frames), len(examined.positions), video)
        chosen, birds = observations.select(frames=candidates), observations.present.sum(0)
        write_labels(chosen, video, part, out.resolve())
        marked = [
            SuggestedFrame(number, examined.times_s[t], int(birds[t]), MARKED, 1.0)
            for number, t in zip(frames, candidates.tolist(), strict=True)
        ]
        _write_list(marked, video, part)
    return Suggestions(marked, chosen)


def _write_list(frames: Sequence[SuggestedFrame], video: Path, part: Path) -> None:
    """Write the table of suggested frames: frame, time in seconds, picture, birds, reason, score."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("frame", "time_s", "picture", "birds", "reason", "score"))
    for number, time_s, birds, reason, score in frames:
        time = "" if time_s is None else f"{time_s:.3f}"
        writer.writerow((number, time, picture_name(video, number), birds, reason, f"{score:.3f}"))
    write_whole(part / MARKER, text.getvalue().encode())
