"""Warnings about a result, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jaxfit.report.contents import Report

__all__ = ["Step", "Warned", "counted", "next_steps", "numbers", "warnings_of"]

LEAST_CONFIDENCE = 0.5
"""Tracks with a lower mean confidence of the keypoints are named."""
LEAST_COVERAGE = 0.8
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
    ambiguous = tuple(f"track {track.track_id}: {text}" for track in report.tracks for text in track.ambiguous)
    if ambiguous:
        text = (
            "Two different poses explain the keypoints of these frames almost as well. The result holds the better one."
        )
        warned.append(Warned("Frames with a second pose", text, ambiguous))
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
    unsure = [track.track_id for track, quality in rated if quality.mean_confidence < LEAST_CONFIDENCE]
    if unsure:
        text = f"{_named(unsure)}: the mean confidence of the keypoints is below {LEAST_CONFIDENCE:g}."
        warned.append(Warned(f"{counted(len(unsure), 'track')} with uncertain keypoints", text))
    sparse = [track.track_id for track, quality in rated if quality.coverage < LEAST_COVERAGE]
    if sparse:
        text = f"{_named(sparse)}: detected in less than {100 * LEAST_COVERAGE:g} % of the frames of the track."
        warned.append(Warned(f"{counted(len(sparse), 'track')} with gaps", text))
    if report.corrections:
        warned.append(Warned("Corrected tracks", f"Corrections: {'; '.join(report.corrections)}."))
    return warned


def next_steps(report: Report) -> list[Step]:
    """Return the recommended actions in their order."""
    result = shlex.quote(report.folder)
    if report.photographs:
        return [_draw_photographs(report.folder), *_export(report, result)]
    video = "VIDEO" if report.video is None else shlex.quote(report.video)
    draw = f"jaxfit overlay {result} --video {video} --out overlay.mp4 --side-views"
    text = (
        "Look at the overlay video: overlay.mp4 in the folder of a reconstruction. The meshes must follow the birds, "
        "and each bird must keep its track number. This command draws the video again:"
    )
    steps = [Step(text, draw)]
    if report.trust == "low":
        command = f"jaxfit suggest {video} --result {result} --count 10 --out label"
        steps.append(Step("Label ten frames of this footage, and train the networks with them.", command))
    if report.has_detections and len(report.tracks) > 1:
        a, b = (track.track_id for track in report.tracks[:2])
        middle = report.frames[len(report.frames) // 2]
        text = (
            "Correct exchanged or broken tracks. Only the windows that change are fitted again. Example: tracks "
            f"{a} and {b} exchange their numbers from frame {middle:,} on."
        )
        steps.append(Step(text, f"jaxfit tracks {result} --swap {a},{b}@{middle} --out corrected"))
    return [*steps, *_export(report, result)]


def _draw_photographs(folder: str) -> Step:
    text = "Draw the fitted birds beside the annotations, in Python, with the file that was fitted:"
    drawn = f"*jaxfit.load_solution({folder!r}), jaxfit.read_observations('OBS.json'), 'sheet.png'"
    return Step(text, f"import jaxfit\njaxfit.contact_sheet({drawn})")


def _export(report: Report, result: str) -> list[Step]:
    """Return the step of the export; poses of low trust are no data for statistics."""
    if not report.poses or report.trust == "low":
        return []
    command = f"jaxfit export {result} --to csv --out birds.csv"
    return [Step("Export positions and angles for your statistics.", command)]


def counted(count: int, noun: str) -> str:
    """Return a count with its noun: `1 bird`, `2,000 birds`."""
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def numbers(values: Sequence[int | str]) -> str:
    """Return the first values as a list."""
    shown = [f"{value}" for value in values[:_NAMED]]
    return ", ".join(shown) + (f" and {len(values) - _NAMED:,} more" if len(values) > _NAMED else "")


def _named(ids: Sequence[int]) -> str:
    return f"{'Track' if len(ids) == 1 else 'Tracks'} {numbers(ids)}"


def _pairs(skipped: Mapping[str, str]) -> str:
    return numbers([f"{track} ({value})" for track, value in skipped.items()])
