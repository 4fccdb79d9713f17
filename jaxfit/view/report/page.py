"""The HTML page, with frames of the footage."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from jaxfit.cameras.camera import Camera
from jaxfit.data.flags import FLAGS
from jaxfit.data.observations import Observations
from jaxfit.data.projection import PosedBirds
from jaxfit.data.solution import Solution
from jaxfit.foundation.errors import counted
from jaxfit.model.bird import Bird
from jaxfit.video.reader import probe_video, read_frames
from jaxfit.view.birds import Detected
from jaxfit.view.contact_sheet import TILE_PX, cut_tiles, observed_tile, sheet_pairs
from jaxfit.view.mesh_views import SideViews
from jaxfit.view.overlay import check_belongs, too_short
from jaxfit.view.report.axis import duration
from jaxfit.view.report.contents import Report, Track, next_steps, warnings_of
from jaxfit.view.report.rendering import rendered
from jaxfit.view.report.timeline import SmallCurve, error_curve, size_curve, timeline_of

_MOMENTS, _MOST, _TILE_PX, _QUALITY = 4, 24, 180, 80


class Picture(NamedTuple):
    """One bird at some moments: the film with the fitted outline, and the bird from its left."""

    track_id: int
    frames: tuple[int, ...]
    """Numbers of the frames."""
    width: int
    height: int
    jpeg: bytes

    @property
    def base64(self) -> str:
        """The JPEG as text."""
        return base64.b64encode(self.jpeg).decode()


def report_pictures(
    solution: Solution,
    bird: Bird,
    video: Path,
    observations: Observations | None = None,
    force: bool = False,
    lens: Camera | None = None,
) -> list[Picture]:
    """Draw the birds of a result at four moments each; with `force`, also on a video that is not that of the result.

    Args:
        solution, bird, video, observations, force, lens: as for `jaxfit.view.overlay.overlay`.

    Raises:
        InputError: as `jaxfit.view.overlay.overlay_frame`.
    """
    check_belongs(solution, observations, video, probe_video(video), force)
    rows = sheet_pairs(solution, _MOMENTS, _MOST)
    posed, detected = PosedBirds(solution, bird, lens), Detected(solution, observations)
    sides = SideViews(solution, bird, 8 * TILE_PX, 1)
    tiles: dict[tuple[int, int], np.ndarray] = {}
    for t in sorted({t for row in rows for _, t in row}):
        number = int(solution.frame_index[t])
        found = next(iter(read_frames(video, number, number + 1)), None)
        if found is None:
            if force:
                continue
            raise too_short(video, solution, 0)
        here = [(n, at) for row in rows for n, at in row if at == t]
        for cell, film in cut_tiles(posed, found.picture, here).items():
            side = sides.bird(*cell, posed.vertices_cam_window(cell[0], slice(t, t + 1))[0])
            pair = [observed_tile(posed, detected, *cell, film), side]
            size = (_TILE_PX, _TILE_PX)
            tiles[cell] = np.hstack([cv2.resize(tile, size, interpolation=cv2.INTER_AREA) for tile in pair])
    pictures = []
    for row in rows:
        shown = [cell for cell in row if cell in tiles]
        if shown:
            image = np.hstack([tiles[cell] for cell in shown])
            _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            n, frames = shown[0][0], tuple(int(solution.frame_index[t]) for _, t in shown)
            height, width = image.shape[:2]
            pictures.append(Picture(int(solution.track_id[n]), frames, width, height, jpeg.tobytes()))
    return pictures


_MARKS = {"ok": "✓", "partly diverged": "▲", "diverged": "✕", "no usable frame": "–"}
_MEANINGS = {
    "Track": "The path of one bird through the frames. A bird that was lost and detected again has two tracks.",
    "Pose": "Position, orientation, joint angles and size of a bird in one frame.",
    "Status": "Whether the fit of every window of frames succeeded (ok), of some windows, or of no window.",
    "Flags": "Whether the detections agree with a pose (ok), do not determine the pose (unsure), or speak against the "
    "pose (contradicted). Where the detections themselves are wrong, a wrong pose may be ok.",
    "Coverage": "Share of the frames between the first and the last detection of a bird that have a detection.",
    "Gaps": "Number of interruptions between the first and the last detection of a bird.",
    "Confidence": "Mean confidence of all keypoints. A keypoint that was not detected counts as 0.",
    "Jitter": "Median second difference of the detected keypoints, in per cent of the longer side of the box of the "
    "bird. A bird at constant speed has 0 %.",
    "Size in the image": "Size of the fitted bird in the image over time, relative to its median. The curve ends at "
    "±30 %. One camera cannot tell a larger bird from a nearer bird. A sudden change is a sign of a wrong fit.",
    "Error bars": "Error of the keypoints in space that the fit expects: root mean square over the keypoints, in per "
    "cent of the length of the bird, without the error of the position of the whole bird. The number is the median. "
    "The curve goes from 0 % to 10 %, above which a pose is unsure. Marks at the upper edge show the flags unsure and "
    "contradicted. With detections of networks, error bars are too narrow.",
    "Body": "Lengths of the bird in the rest pose, estimated from its whole track, in per cent of those of the model, "
    "with their standard deviations. `as the model`: the track determines no length.",
    "Objective": "Final value of the objective of the fit for each pose. Compare birds of one result only.",
    "Trust": "A comparison of this footage with the footage that the networks were trained on. High trust is no "
    "proof: look at the overlay.",
}


class Measured(NamedTuple):
    """A table of metrics of a result against a known truth."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str
    """What the columns mean."""


Behaviour = Any
"""What the birds of a report do over time: a `jaxfit.behaviour.page.BehaviourPage`, of a higher floor."""


class Cell(NamedTuple):
    """A cell of the table of tracks."""

    text: str
    curve: SmallCurve | None = None


def page(
    report: Report,
    pictures: Sequence[Picture],
    measured: Sequence[Measured] = (),
    behaviour: Behaviour | None = None,
    film: str | None = None,
) -> str:
    """Return the page.

    Args:
        report: the content.
        pictures: frames with drawn birds; may be empty.
        measured: metrics against a known truth; may be empty.
        behaviour: what the same birds do in the same frames; None writes no section. Photographs, a single frame and a
            result without a pose have no such section.
        film: address of the footage relative to the page, for links; None writes no links.

    Raises:
        ValueError: `behaviour` has other birds or frames.
    """
    section = None
    if behaviour is not None and report.over_time and report.poses:
        if len(behaviour.track_id) != len(report.tracks) or not np.array_equal(behaviour.frames, report.frames):
            expected = f"the {len(report.tracks)} birds and {len(report.frames)} frames of the report"
            came = f"{len(behaviour.track_id)} birds and {len(behaviour.frames)} frames"
            raise ValueError(f"behaviour: expected {expected}, got {came}")
        section = behaviour.section([track.position for track in report.tracks], film)
    headings, rows = _table(report, bool(report.body_lengths) and not pictures)  # pictures have them beside the birds
    length = counted(report.photographs, "photograph") if report.photographs else counted(len(report.frames), "frame")
    if not report.photographs and report.duration_s is not None:
        length += f", {duration(report.duration_s)}"
    footage = [("footage", report.video)] if report.video else []
    return rendered(
        "report.html",
        report=report,
        pictures=pictures,
        measured=measured,
        footage=_footage(report),
        length=length,
        warnings=warnings_of(report),
        steps=next_steps(report),
        timeline=timeline_of(report) if report.over_time else None,
        marks=_MARKS,
        table_headings=headings,
        table_rows=rows,
        titles=_MEANINGS,
        tracks={track.track_id: track for track in report.tracks},
        facts=[*footage, ("result", report.folder), *report.facts.items()],
        behaviour=behaviour,
        section=section,
    )


def _footage(report: Report) -> str:
    if report.photographs:
        return counted(report.photographs, "photograph")
    parts = [counted(len(report.frames), "frame")]
    if len(report.frames):
        parts[0] += f" ({report.frames[0]:,} to {report.frames[-1]:,})"
    if report.step > 1:
        parts.append(f"every {report.step}th frame")
    if report.size_px:
        parts.append(f"{report.size_px[0]} × {report.size_px[1]} pixels")
    parts.append("unknown frame rate" if report.fps is None else f"{report.fps:.4g} frames/s")
    return " · ".join(parts)


def _table(report: Report, bodies: bool) -> tuple[list[tuple[str, str]], list[tuple[Track, list[Cell]]]]:
    """Return the names and units of the columns of the table of tracks, and the cells after the status."""
    names, over_time = [("Track", ""), ("Status", "")], report.over_time
    names += [("Frames", "first to last")] if over_time else []
    names.append(("Poses", "number"))
    names += [("Flags", "ok / unsure / contradicted")] if report.flags else []
    if report.has_detections:
        names += [("Detections", "number"), ("Coverage", "%"), ("Gaps", "number"), ("Confidence", "0 to 1")]
        names += [("Jitter", "% of box")]
    names.append(("Objective", "per pose"))
    names += [("Error bars", "% of length, 0 to 10 %" if over_time else "% of length")] if report.has_error_bars else []
    names += [("Size in the image", "±30 %")] if over_time else []
    if bodies:
        names.append(("Body", f"{' / '.join(report.body_lengths)}, % of the model"))
    rows = []
    for track in report.tracks:
        quality, cells = track.quality, []
        if over_time:
            cells.append(Cell("–" if track.frames is None else f"{track.frames[0]:,} to {track.frames[1]:,}"))
        cells.append(Cell(f"{track.poses:,}"))
        if report.flags:
            cells.append(Cell(" / ".join(f"{(track.flags == flag).sum():,}" for flag in FLAGS)))
        if report.has_detections and quality is None:
            cells += [Cell("–")] * 5
        elif quality is not None:
            jitter = "–" if quality.jitter is None else f"{100 * quality.jitter:.1f}"
            cells += [Cell(f"{quality.frames:,}"), Cell(f"{100 * quality.coverage:.0f}"), Cell(f"{quality.gaps}")]
            cells += [Cell(f"{quality.mean_confidence:.2f}"), Cell(jitter)]
        cells.append(Cell("–" if track.objective is None else f"{track.objective:,.1f}"))
        if report.has_error_bars:
            known = track.expected_error[np.isfinite(track.expected_error)]
            median = f"{100 * np.median(known):.1f}" if len(known) else "–"
            cells.append(Cell(median, error_curve(track) if over_time else None))
        if over_time:
            curve = size_curve(track)
            cells.append(Cell("–" if curve is None else "", curve))
        if bodies:
            cells.append(Cell(track.body))
        rows.append((track, cells))
    return names, rows
