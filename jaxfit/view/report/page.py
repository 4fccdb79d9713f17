"""The HTML page, with frames of the footage."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool

from jaxfit.cameras.camera import Camera
from jaxfit.data.flags import CONTRADICTED, FLAGS, OK, UNSURE
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.view.overlay import overlay_pictures
from jaxfit.view.report.behaviour import Behaviour, behaviour_meanings, behaviour_section, behaviour_style
from jaxfit.view.report.contents import Report, Step, Track, Warned, counted, next_steps, warnings_of
from jaxfit.view.report.timeline import Html, duration, element, error_curve, joined, size_curve, swatch, timeline

_COUNT, _WIDTH_PX, _QUALITY = 6, 960, 80


class Picture(NamedTuple):
    """One frame with drawn birds."""

    frame: int
    birds: int
    """Number of birds with a pose."""
    width: int
    height: int
    jpeg: bytes


def report_pictures(
    solution: Solution,
    bird: Bird,
    video: Path,
    observations: Observations | None = None,
    force: bool = False,
    lens: Camera | None = None,
) -> list[Picture]:
    """Draw some frames of a result; with `force`, also on a video that is not the video of the result.

    Args:
        solution, bird, video, observations, force, lens: as for `jaxfit.view.overlay.overlay`.

    Raises:
        InputError: as `jaxfit.view.overlay.overlay_frame`.
    """
    frames = solution.frame_index[spread_frames(solution.valid)].tolist()
    more: dict[str, Any] = {"observations": observations, "lens": lens, "max_width": _WIDTH_PX, "force": force}
    drawn = overlay_pictures(solution, bird, video, frames, **more)
    pictures = []
    for frame, image in drawn:
        birds = int(solution.valid[:, int(np.searchsorted(solution.frame_index, frame))].sum())
        _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        pictures.append(Picture(frame, birds, image.shape[1], image.shape[0], jpeg.tobytes()))
    return pictures


def spread_frames(valid: Bool[np.ndarray, "N T"], count: int = _COUNT) -> list[int]:
    """Return the positions of some frames, spread over the result.

    The frames with a pose are divided into `count` parts of equal length. The frame with the most poses is chosen from
    every part; of several such frames, the frame that is nearest to the middle of the part.

    Args:
        valid: where birds have poses.
        count: number of frames; fewer frames with a pose are all chosen.
    """
    poses = valid.sum(0)
    chosen = []
    for part in np.array_split(np.flatnonzero(poses), count):
        if len(part):
            from_middle = np.abs(np.arange(len(part)) - (len(part) - 1) / 2)
            chosen.append(int(part[np.lexsort((from_middle, -poses[part]))[0]]))
    return chosen


_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""The browser loads nothing from elsewhere and runs no script."""
_MARKS = {"ok": "✓", "partly diverged": "▲", "diverged": "✕", "no usable frame": "–"}
_MEANINGS = (
    ("Track", "The path of one bird through the frames. A bird that was lost and detected again has two tracks."),
    ("Pose", "Position, orientation, joint angles and size of a bird in one frame."),
    ("Status", "Whether the fit of every window of frames succeeded (ok), of some windows, or of no window."),
    (
        "Flags",
        "Whether the detections agree with a pose (ok), do not determine the pose (unsure), or speak against the pose "
        "(contradicted). Where the detections themselves are wrong, a wrong pose may be ok.",
    ),
    ("Coverage", "Share of the frames between the first and the last detection of a bird that have a detection."),
    ("Gaps", "Number of interruptions between the first and the last detection of a bird."),
    ("Confidence", "Mean confidence of all keypoints. A keypoint that was not detected counts as 0."),
    (
        "Jitter",
        "Median second difference of the detected keypoints, in per cent of the longer side of the box of the bird. "
        "A bird at constant speed has 0 %.",
    ),
    (
        "Size in the image",
        "Size of the fitted bird in the image over time, relative to its median. The curve ends at ±30 %. One camera "
        "cannot tell a larger bird from a nearer bird. A sudden change is a sign of a wrong fit.",
    ),
    (
        "Error bars",
        "Error of the keypoints in space that the fit expects: root mean square over the keypoints, in per cent of the "
        "length of the bird, without the error of the position of the whole bird. The number is the median. The curve "
        "goes from 0 % to 10 %, above which a pose is unsure. Marks at the upper edge show the flags unsure and "
        "contradicted. With detections of networks, error bars are too narrow.",
    ),
    ("Objective", "Final value of the objective of the fit for each pose. Compare birds of one result only."),
    (
        "Trust",
        "A comparison of this footage with the footage that the networks were trained on. High trust is no proof: "
        "look at the overlay.",
    ),
)


class Measured(NamedTuple):
    """A table of metrics of a result against a known truth."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str
    """What the columns mean."""


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
    warned = warnings_of(report)
    title = f"Birds in {report.title}"
    style = resources.files("jaxfit.view.report").joinpath("style.css").read_text("utf-8")
    behaviour = _shown_behaviour(report, behaviour)
    if behaviour is not None:
        style += behaviour_style(behaviour)
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", title),
        element("style", Html(style)),
    )
    body = element(
        "body",
        element("header", element("p", "jaxfit report", class_="kind"), element("h1", title), _footage(report)),
        element(
            "main",
            _answer(report, warned),
            _section("What to do next", _steps(next_steps(report))),
            _section("Warnings", _warnings(warned)),
            None if report.photographs else _section("Pictures", _strip(report, pictures)),
            _section("Tracks over time", timeline(report)) if report.over_time else None,
            _behaviour(report, behaviour, film),
            _section("Quality of each track", _table(report)),
            _section("Comparison with the truth", *map(_measured, measured)) if measured else None,
            _section("What the words mean", _definitions(_meanings(report, behaviour))),
            _section("How the result was made", _details(report)),
        ),
    )
    return f"<!DOCTYPE html>\n{element('html', head, body, lang='en')}\n"


def _section(title: str, *content: Html | None) -> Html:
    return element("section", element("h2", title), *content)


def _shown_behaviour(report: Report, behaviour: Behaviour | None) -> Behaviour | None:
    """Return the behaviour, if the result shows what birds do over time."""
    if behaviour is None or not report.over_time or not report.poses:
        return None
    expected = len(report.tracks), len(report.frames)
    if behaviour.state.shape != expected or not np.array_equal(behaviour.frames, report.frames):
        came = f"{behaviour.state.shape[0]} birds and {len(behaviour.frames)} frames"
        raise ValueError(
            f"behaviour: expected the {expected[0]} birds and {expected[1]} frames of the report, got {came}"
        )
    return behaviour


def _behaviour(report: Report, behaviour: Behaviour | None, film: str | None) -> Html | None:
    if behaviour is None:
        return None
    return _section("Behaviour", behaviour_section(behaviour, [track.position for track in report.tracks], film))


def _footage(report: Report) -> Html:
    if report.photographs:
        return element("p", counted(report.photographs, "photograph"), class_="footage")
    parts = [counted(len(report.frames), "frame")]
    if len(report.frames):
        parts[0] += f" ({report.frames[0]:,} to {report.frames[-1]:,})"
    if report.step > 1:
        parts.append(f"every {report.step}th frame")
    if report.size_px:
        parts.append(f"{report.size_px[0]} × {report.size_px[1]} pixels")
    parts.append("unknown frame rate" if report.fps is None else f"{report.fps:.4g} frames/s")
    return element("p", " · ".join(parts), class_="footage")


def _answer(report: Report, warned: Sequence[Warned]) -> Html:
    """Return the cards with the most important numbers."""
    length = counted(report.photographs, "photograph") if report.photographs else counted(len(report.frames), "frame")
    if not report.photographs and report.duration_s is not None:
        length += f", {duration(report.duration_s)}"
    share = report.poses / max(report.detections, 1)
    what = "detections" if report.has_detections else "photographs" if report.photographs else "frames of the tracks"
    noun = "bird" if report.photographs else "track"
    cards = [
        _card(f"{len(report.tracks):,}", noun if len(report.tracks) == 1 else f"{noun}s", f"in {length}"),
        _card(f"{report.poses:,}", "poses", f"{100 * share:.1f} % of the {what}"),
        _flags(report),
        _trust(report),
        _card(f"{len(warned)}", "warning" if len(warned) == 1 else "warnings", "see below" if warned else "none"),
    ]
    return element("section", *cards, class_="cards")


def _card(value: str, unit: str, text: str, kind: str = "") -> Html:
    content = element("b", value), " ", element("span", unit), element("p", text)
    return element("div", *content, class_=f"card {kind}".strip())


def _flags(report: Report) -> Html | None:
    """Return the card with the share of poses that the detections agree with; None if poses were not judged."""
    counts = report.flags
    if not counts:
        return None
    share = {flag: f"{100 * count / sum(counts.values()):.0f} %" for flag, count in counts.items()}
    text = f"{share[UNSURE]} unsure, {share[CONTRADICTED]} contradicted by the detections"
    return _card(share[OK], OK, text, "bad" if counts[UNSURE] + counts[CONTRADICTED] else "good")


def _trust(report: Report) -> Html:
    if report.trust is None:
        return _card("?", "trust", "the tracking was not judged, because the detections come from a file")
    if report.trust == "high":
        return _card("✓ high", "trust", "the networks work on this footage as on simulated footage", "good")
    return _card("▲ " + report.trust, "trust", "the tracks and poses may be wrong: see the warnings", "bad")


def _steps(steps: Sequence[Step]) -> Html:
    items = [element("li", step.text, None if step.command is None else element("pre", step.command)) for step in steps]
    return element("ol", *items, class_="steps")


def _warnings(warned: Sequence[Warned]) -> Html:
    if not warned:
        return element("p", "There are no warnings.")
    items = []
    for each in warned:
        listed = element("ul", *(element("li", text) for text in each.details)) if each.details else None
        if len(each.details) > 3:
            listed = element("details", element("summary", f"Show all {len(each.details)} lines"), listed)
        items.append(element("li", element("b", each.title), element("p", each.text), listed))
    return element("ul", *items, class_="warnings")


def _strip(report: Report, pictures: Sequence[Picture]) -> Html:
    if not report.poses:
        return element("p", "No track has a pose, so there are no pictures.")
    if not pictures:
        command = f"jaxfit report {shlex.quote(report.folder)} --video VIDEO"
        text = "The footage was not there. This command writes a report with pictures:"
        return joined(element("p", text), element("pre", command))
    figures = []
    for picture in pictures:
        data = base64.b64encode(picture.jpeg).decode()
        text = f"frame {picture.frame:,}, {counted(picture.birds, 'bird')}"
        image = element(
            "img", src=f"data:image/jpeg;base64,{data}", alt=text, width=picture.width, height=picture.height
        )
        figures.append(element("figure", image, element("figcaption", text)))
    return element("div", *figures, class_="strip")


def _table(report: Report) -> Html:
    detected, over_time = report.has_detections, report.over_time
    names = [("Track", ""), ("Status", "")]
    names += [("Frames", "first to last")] if over_time else []
    names.append(("Poses", "number"))
    names += [("Flags", "ok / unsure / contradicted")] if report.flags else []
    if detected:
        names += [("Detections", "number"), ("Coverage", "%"), ("Gaps", "number"), ("Confidence", "0 to 1")]
        names += [("Jitter", "% of box")]
    names.append(("Objective", "per pose"))
    names += [("Error bars", "% of length, 0 to 10 %" if over_time else "% of length")] if report.has_error_bars else []
    names += [("Size in the image", "±30 %")] if over_time else []
    head = element("tr", *(element("th", name, element("small", unit)) for name, unit in names))
    rows = [element("tr", *_cells(report, track)) for track in report.tracks]
    return element("div", element("table", element("thead", head), element("tbody", *rows)), class_="wide")


def _cells(report: Report, track: Track) -> list[Html]:
    """Return the cells of a bird."""
    quality, over_time = track.quality, report.over_time
    frames = "–" if track.frames is None else f"{track.frames[0]:,} to {track.frames[1]:,}"
    kind = "good" if track.status == "ok" else "bad"
    cells = [
        element("th", swatch(track.position), f"{track.track_id}"),
        element("td", f"{_MARKS.get(track.status, '')} {track.status}", class_=f"status {kind}"),
        element("td", frames) if over_time else Html(),
        element("td", f"{track.poses:,}"),
    ]
    if report.flags:
        cells.append(element("td", " / ".join(f"{(track.flags == flag).sum():,}" for flag in FLAGS)))
    if report.has_detections:
        shown = ["–"] * 5
        if quality is not None:
            jitter = "–" if quality.jitter is None else f"{100 * quality.jitter:.1f}"
            shown = [f"{quality.frames:,}", f"{100 * quality.coverage:.0f}", f"{quality.gaps}"]
            shown += [f"{quality.mean_confidence:.2f}", jitter]
        cells += [element("td", text) for text in shown]
    cells.append(element("td", "–" if track.objective is None else f"{track.objective:,.1f}"))
    if report.has_error_bars:
        known = track.expected_error[np.isfinite(track.expected_error)]
        median = f"{100 * np.median(known):.1f}" if len(known) else "–"
        cells.append(element("td", median, error_curve(track) if over_time else None))
    return [*cells, element("td", size_curve(track))] if over_time else cells


def _measured(table: Measured) -> Html:
    head = element("tr", *(element("th", name) for name in table.headings))
    rows = [element("tr", element("th", row[0]), *(element("td", cell) for cell in row[1:])) for row in table.rows]
    content = element("table", element("thead", head), element("tbody", *rows))
    return joined(element("div", content, class_="wide"), element("p", table.note, class_="note"))


def _meanings(report: Report, behaviour: Behaviour | None) -> list[tuple[str, str]]:
    """Return the definitions of the words on the page."""
    absent = [] if report.over_time else ["Size in the image"]
    absent += [] if report.has_error_bars else ["Error bars"]
    further = [] if behaviour is None else behaviour_meanings(behaviour)
    return [pair for pair in _MEANINGS if pair[0] not in absent] + further


def _definitions(pairs: Sequence[tuple[str, str]]) -> Html:
    return element("dl", *(joined(element("dt", name), element("dd", text)) for name, text in pairs))


def _details(report: Report) -> Html:
    total = sum(report.seconds.values())
    rows = [
        element(
            "tr",
            element("th", name),
            element("td", duration(seconds)),
            element("td", element("i", class_="bar", style=f"width:{100 * seconds / max(total, 1e-9):.1f}%")),
        )
        for name, seconds in report.seconds.items()
    ]
    times = element("table", *rows, class_="times") if rows else None
    facts = [("footage", report.video)] if report.video else []
    facts = _definitions([*facts, ("result", report.folder), *report.facts.items()])
    return joined(
        element("h3", "Time") if rows else None,
        times,
        element("details", element("summary", "Files, model, networks and versions"), facts),
        element("details", element("summary", "Settings (config.yaml)"), element("pre", report.config)),
    )
