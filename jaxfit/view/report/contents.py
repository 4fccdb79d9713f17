"""What a report shows, warns about and recommends."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.data.body_lengths import BodyLength, body_lengths
from jaxfit.data.flags import CONTRADICTED, FLAGS, UNSURE, expected_error, flagged_ranges, flags
from jaxfit.data.observations import Observations, mean_confidence
from jaxfit.data.result_folder import SUMMARY
from jaxfit.data.solution import Bodies, Solution
from jaxfit.data.tracks import TrackQuality, frame_step, track_quality
from jaxfit.foundation.errors import InputError, counted
from jaxfit.model.bird import Bird


@dataclass(frozen=True)
class Track:
    """One bird of a report; T frames of the result."""

    position: int
    """Position of the track in the result, which determines its colour in overlays."""
    track_id: int
    status: str
    poses: int
    objective: float | None
    """Final objective of each pose; None without a pose."""
    frames: tuple[int, int] | None
    """Numbers of the first and the last frame with a detection; None without a detection."""
    quality: TrackQuality | None
    """Quality of the detections; None without observations."""
    present: Bool[np.ndarray, "T"]
    """Where the bird was detected; without observations, where the bird has a pose."""
    valid: Bool[np.ndarray, "T"]
    """Where the bird has a pose."""
    confidence: Float[np.ndarray, "T"] | None
    """Mean confidence of the keypoints in every frame; None without observations."""
    size: Float[np.ndarray, "T"]
    """Size in the image relative to the median of the track; NaN without a pose."""
    problems: tuple[str, ...]
    """Texts about skipped frames and diverged windows."""
    flags: np.ndarray
    """(T,) str: flag of each pose (`jaxfit.data.flags.flags`); empty without a pose, or if poses were not judged."""
    flagged: tuple[str, ...]
    """Texts about frames whose poses are not `ok`."""
    expected_error: Float[np.ndarray, "T"]
    """RMS error of the keypoints that the error bars expect, as a share of the length of the bird
    (`jaxfit.data.flags.expected_error`); NaN without a pose or without error bars."""
    body: str
    """`Report.body_lengths` of the bird in per cent of the model, with their standard deviations."""


@dataclass(frozen=True)
class Report:
    """The content of a report."""

    folder: str
    """Path of the result, for commands."""
    title: str
    video: str | None
    """Path of the footage; None if unknown."""
    photographs: int
    """Number of photographs, in which every bird has an image of its own; 0 for video."""
    frames: np.ndarray
    """(T,) numbers of the frames."""
    step: int
    """Distance of the frame numbers."""
    times_s: Float[np.ndarray, "T"]
    """Time of every frame in seconds; NaN if unknown."""
    size_px: tuple[int, int] | None
    """Width and height of the footage."""
    fps: float | None
    tracks: tuple[Track, ...]
    """In the order in which the birds appear."""
    damaged: tuple[int, ...]
    """Numbers of the frames that could not be decoded."""
    short_tracks: Mapping[str, str]
    """Skipped track → number of frames."""
    low_score_tracks: Mapping[str, str]
    """Skipped track → mean score."""
    trust: str | None
    """`high`, `low`, or None if the tracking was not judged."""
    trust_reasons: tuple[str, ...]
    seconds: Mapping[str, float]
    """Part of the work → seconds."""
    facts: Mapping[str, str]
    """Model, networks and versions."""
    corrections: tuple[str, ...]
    on_labels: bool
    """Whether poses stand on labels, which optical flow carries."""
    label_problems: tuple[str, ...]
    """Labels that are left out or contradict each other."""
    config: str
    """The config as YAML."""
    body_lengths: tuple[str, ...]
    """Names of the lengths of the bodies (`jaxfit.data.body_lengths`); empty for a result without bodies."""

    @property
    def has_detections(self) -> bool:
        """Whether the detections of the birds are known, besides their poses."""
        return any(track.quality is not None for track in self.tracks)

    @property
    def has_error_bars(self) -> bool:
        """Whether a pose has error bars."""
        return any(bool(np.isfinite(track.expected_error).any()) for track in self.tracks)

    @property
    def over_time(self) -> bool:
        """Whether the result has several frames of one video, so that changes over time mean something."""
        return not self.photographs and len(self.frames) > 1

    @property
    def poses(self) -> int:
        """Number of poses of all birds."""
        return sum(track.poses for track in self.tracks)

    @property
    def flags(self) -> dict[str, int]:
        """Number of poses of all birds with each flag; empty if no pose was judged."""
        counts = {flag: sum(int((track.flags == flag).sum()) for track in self.tracks) for flag in FLAGS}
        return counts if any(counts.values()) else {}

    @property
    def detections(self) -> int:
        """Number of detections of all birds; without observations, the number of poses."""
        return sum(int(track.present.sum()) for track in self.tracks)

    @property
    def duration_s(self) -> float | None:
        """Time from the first to the end of the last frame; None if unknown."""
        if self.fps is None:
            return None
        return float(self.frames[-1] - self.frames[0] + self.step) / self.fps if len(self.frames) else 0.0


def gather(
    solution: Solution,
    observations: Observations | None,
    summary: Mapping[str, Any],
    config: str,
    folder: Path,
    bird: Bird | None = None,
) -> Report:
    """Return the content of the report of a result.

    Args:
        solution: the poses.
        observations: the detections of the same tracks and frames; None if they are unknown.
        summary: content of `summary.json`.
        config: the config as YAML.
        folder: folder of the result.
        bird: the model of the result; None leaves out error bars and bodies, which are shares of the lengths of the
            model.

    Raises:
        InputError: an entry of the summary has another type than jaxfit writes.
    """
    sizes = solution.crops.image_size_px[solution.valid]
    times_s = np.full(len(solution.frame_index), np.nan) if solution.timestamp_s is None else solution.timestamp_s
    if solution.fps and not np.isfinite(times_s).all():
        times_s = solution.frame_index / solution.fps
    expected = np.full(solution.valid.shape, np.nan)
    if bird is not None:
        expected = np.where(solution.valid, expected_error(solution, bird), np.nan)
    try:
        entries = _entries(summary)
        problems = {track: tuple(map(str, texts)) for track, texts in (summary.get("failures") or {}).items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        problem = f"has an entry that jaxfit does not write: {error}"
        raise InputError(folder / SUMMARY, problem, "run the reconstruction again") from error
    video = entries["video"]
    lengths = {} if solution.bodies is None or bird is None else body_lengths(bird, solution.bodies)
    tracks = _tracks(solution, observations, problems, expected, lengths)
    return Report(
        folder=str(folder),
        title=Path(video).name or video if video else folder.name,
        frames=solution.frame_index,
        step=frame_step(solution.frame_index),
        times_s=times_s,
        size_px=(int(sizes[0, 0]), int(sizes[0, 1])) if len(sizes) else None,
        fps=solution.fps,
        tracks=tuple(sorted(tracks, key=lambda track: (np.append(track.present, True).argmax(), track.position))),
        config=config,
        body_lengths=tuple(lengths),
        **entries,
    )


def _entries(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a report that `summary.json` holds."""

    def entries(key: str) -> list[tuple[str, Any]]:
        return list((summary.get(key) or {}).items())

    facts, video = {}, summary.get("video") or {}
    if summary.get("model"):
        facts["model"] = f"{summary['model']['name']} ({summary['model']['hash'][:12]})"
    if summary.get("measured_length_cm"):
        length_cm = float(summary["measured_length_cm"])
        facts["length of the model"] = f"{length_cm:.1f} cm from bill to tail, measured by the cameras"
    reasons = list(map(str, summary.get("trust_reasons") or ()))
    if reasons and "segmenter" in summary:
        reasons.insert(0, f"segmenter: {summary['segmenter']} ({summary.get('segmenter_reason')})")
    for kind, files in entries("networks"):
        facts[f"network: {kind}"] = ", ".join(f"{name} ({digest[:12]})" for name, digest in files.items())
    for track, frames in entries("pose_sources"):
        facts[f"poses of track {track}"] = on_what(frames)
    facts |= {name: str(version) for name, version in entries("versions")}
    return {
        "video": video.get("file"),
        "damaged": tuple(int(frame) for frame in video.get("damaged") or ()),
        "photographs": int(summary.get("photographs") or 0),
        "short_tracks": {track: f"{frames:d}" for track, frames in entries("short_tracks")},
        "low_score_tracks": {track: f"{score:.2f}" for track, score in entries("low_score_tracks")},
        "trust": summary.get("trust"),
        "trust_reasons": tuple(reasons),
        "seconds": {name: float(seconds) for name, seconds in entries("seconds")},
        "facts": facts,
        "corrections": tuple(map(str, summary.get("corrections") or ())),
        "on_labels": bool(entries("pose_sources")),
        "label_problems": tuple(map(str, (summary.get("labels") or {}).get("problems") or ())),
    }


def on_what(frames: Mapping[str, int]) -> str:
    """Return on what the poses of a track stand: labels, flow, the outline alone."""
    return "; ".join(f"{counted(int(count), 'frame')} on {what}" for what, count in frames.items() if count)


def _tracks(
    solution: Solution,
    observations: Observations | None,
    problems: Mapping[str, tuple[str, ...]],
    expected: Float[np.ndarray, "N T"],
    lengths: Mapping[str, BodyLength],
) -> list[Track]:
    means = mean_confidence(observations.confidence) if observations and observations.num_keypoints else None
    quality = {} if observations is None else {row.track_id: row for row in track_quality(observations)}
    rows = {} if observations is None else {track: n for n, track in enumerate(observations.track_id.tolist())}
    size = _image_size(solution)
    total = np.sum(list(solution.loss.values()), axis=0) if solution.loss else np.full(len(solution.track_id), np.nan)
    found, flagged = flags(np.asarray(solution.flags.doubts)), flagged_ranges(solution)
    tracks = []
    for n, track_id in enumerate(solution.track_id.tolist()):
        valid, present, confidence = solution.valid[n], solution.valid[n], None
        if observations is not None and track_id in rows:
            present = observations.present[rows[track_id]]
            confidence = None if means is None else means[rows[track_id]]
        median = np.median(size[n, valid]) if valid.any() else 1.0
        poses, at = int(valid.sum()), solution.frame_index[present]
        tracks.append(
            Track(
                position=n,
                track_id=track_id,
                status=str(solution.status[n]),
                poses=poses,
                objective=float(total[n]) / poses if poses and np.isfinite(total[n]) else None,
                frames=(int(at[0]), int(at[-1])) if len(at) else None,
                quality=quality.get(track_id),
                present=present,
                valid=valid,
                confidence=confidence,
                size=np.where(valid, size[n] / median, np.nan),
                problems=problems.get(str(track_id), ()),
                flags=found[n],
                flagged=flagged.get(track_id, ()),
                expected_error=expected[n],
                body=_body(solution.bodies, lengths, n),
            )
        )
    return tracks


def _body(bodies: Bodies | None, lengths: Mapping[str, BodyLength], n: int) -> str:
    """Return the lengths of a bird as text, in per cent of the model."""
    if bodies is None or not np.isfinite(bodies.frames[n]):
        return "–"
    if bodies.determined[n] < 1:
        return "as the model"
    return " / ".join(f"{100 * each.share[n]:.0f} ± {100 * each.sd[n]:.0f}" for each in lengths.values())


def _image_size(solution: Solution) -> Float[np.ndarray, "N T"]:
    """Return the size of every bird in the image, in image pixels per model unit; NaN without a pose."""
    crops, depth = solution.crops, np.where(solution.valid, solution.poses.transl[..., 2], np.nan)
    return np.asarray(solution.poses.scale) * (crops.focal_px / crops.crop_px) * crops.square_px[..., 2] / depth


MIN_CONFIDENCE = 0.5
"""Tracks with a lower mean confidence of the keypoints are named."""
MIN_COVERAGE = 0.8
"""Tracks with detections in a smaller share of their frames are named."""
_NAMED = 12
"""Number of tracks or frames that a sentence names."""


class Warned(NamedTuple):
    """One warning."""

    title: str
    text: str
    details: tuple[str, ...] = ()
    """Single cases, which the reader may open."""


class Step(NamedTuple):
    """One recommended action."""

    text: str
    command: str | None = None


def warnings_of(report: Report) -> list[Warned]:
    """Return the warnings of a result, the most important first."""
    warned = []
    if report.tracks and not report.poses:
        warned.append(
            Warned("No track has a pose", "Every fit failed. The table of tracks shows the status of each fit.")
        )
    flagged = tuple(f"track {track.track_id}: {text}" for track in report.tracks for text in track.flagged)
    if flagged:
        shares = ", ".join(f"{report.flags[flag]:,} {flag}" for flag in (CONTRADICTED, UNSURE) if report.flags[flag])
        text = "Look at these frames first. Poses that are contradicted should not be used without a look."
        warned.append(Warned(f"Poses that may be wrong: {shares}", text, flagged))
    if report.trust == "low":
        text = "The networks do not work on this footage as on simulated footage. Tracks and poses may be wrong."
        warned.append(Warned("Trust in the tracking is low", text, report.trust_reasons))
    failed = [track for track in report.tracks if track.status != "ok"]
    if failed:
        text = f"{_named([track.track_id for track in failed])}: some or all frames have no pose."
        warned.append(Warned(f"{counted(len(failed), 'track')} with a fit that failed", text))
    problems = tuple(f"track {track.track_id}: {text}" for track in report.tracks for text in track.problems)
    if problems:
        text = "Windows of frames whose fit diverged, and frames that were skipped, have no pose."
        warned.append(Warned(counted(len(problems), "problem") + " of the fit", text, problems))
    if report.label_problems:
        text = "Correct these labels, or label further frames, and run the command again."
        warned.append(Warned("Labels that do not fit", text, report.label_problems))
    if report.damaged:
        text = f"{counted(len(report.damaged), 'frame')} of the video could not be decoded: {numbers(report.damaged)}."
        warned.append(Warned("Damaged frames", text))
    if report.short_tracks:
        text = f"A bird was detected in too few frames. Track (frames): {_pairs(report.short_tracks)}."
        warned.append(Warned(f"{counted(len(report.short_tracks), 'short track')} skipped", text))
    if report.low_score_tracks:
        text = f"The detections may be no birds. Track (mean score): {_pairs(report.low_score_tracks)}."
        warned.append(Warned(f"{counted(len(report.low_score_tracks), 'track')} with a low score skipped", text))
    rated = [(track, track.quality) for track in report.tracks if track.quality is not None]
    unsure = [track.track_id for track, quality in rated if quality.mean_confidence < MIN_CONFIDENCE]
    if unsure:
        text = f"{_named(unsure)}: the mean confidence of the keypoints is below {MIN_CONFIDENCE:g}."
        warned.append(Warned(f"{counted(len(unsure), 'track')} with uncertain keypoints", text))
    sparse = [track.track_id for track, quality in rated if quality.coverage < MIN_COVERAGE]
    if sparse:
        text = f"{_named(sparse)}: detected in less than {100 * MIN_COVERAGE:g} % of the frames of the track."
        warned.append(Warned(f"{counted(len(sparse), 'track')} with gaps", text))
    if report.corrections:
        warned.append(Warned("Corrected tracks", f"Corrections: {'; '.join(report.corrections)}."))
    return warned


def next_steps(report: Report) -> list[Step]:
    """Return the recommended actions in their order."""
    result = shlex.quote(report.folder)
    if report.photographs:
        text = "Draw the fitted birds beside the annotations, in Python, with the file that was fitted:"
        drawn = f"*jaxfit.load_solution({report.folder!r}), jaxfit.read_observations('OBS.json'), 'sheet.png'"
        return [Step(text, f"import jaxfit\njaxfit.contact_sheet({drawn})"), *_export(report, result)]
    video = "VIDEO" if report.video is None else shlex.quote(report.video)
    draw = f"jaxfit overlay {result} --video {video} --out overlay.mp4 --side-views"
    text = (
        "Look at the overlay video: overlay.mp4 in the folder of a reconstruction. The meshes must follow the birds, "
        "and each bird must keep its track number. This command draws the video again:"
    )
    steps = [Step(text, draw)]
    if report.trust == "low" or report.on_labels:
        text = (
            "Mark the keypoints in further frames in which the overlay is wrong, and add them to your labels:"
            if report.on_labels
            else "The built-in networks may not know this bird. Mark its keypoints in three to ten frames; nothing is "
            "trained. The guide “Other birds” says how."
        )
        frames = f"jaxfit suggest {video} --result {result} --count 6 --out to_label"
        again = f"jaxfit reconstruct {video} --segmenter general --labels LABELS --model aves --out by_labels"
        steps.append(Step(text, f"{frames}\n{again}"))
    if report.has_detections and len(report.tracks) > 1:
        a, b = (track.track_id for track in report.tracks[:2])
        middle = report.frames[len(report.frames) // 2]
        text = (
            "Correct exchanged or broken tracks. Only the windows that change are fitted again. Example: tracks "
            f"{a} and {b} exchange their numbers from frame {middle:,} on."
        )
        steps.append(Step(text, f"jaxfit tracks {result} --swap {a},{b}@{middle} --out corrected"))
    return [*steps, *_export(report, result)]


def _export(report: Report, result: str) -> list[Step]:
    """Return the step of the export; poses of low trust are no data for statistics."""
    if not report.poses or report.trust == "low":
        return []
    command = f"jaxfit export {result} --to csv --out positions.csv"
    return [Step("Export positions and angles for your statistics.", command)]


def numbers(values: Sequence[int | str]) -> str:
    """Return the first values as a list."""
    shown = [f"{value}" for value in values[:_NAMED]]
    return ", ".join(shown) + (f" and {len(values) - _NAMED:,} more" if len(values) > _NAMED else "")


def _named(ids: Sequence[int]) -> str:
    return f"{'Track' if len(ids) == 1 else 'Tracks'} {numbers(ids)}"


def _pairs(skipped: Mapping[str, str]) -> str:
    return numbers([f"{track} ({value})" for track, value in skipped.items()])
