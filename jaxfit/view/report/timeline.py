"""Which bird is present when, and how certain the detection is; escaped HTML text."""

from __future__ import annotations

from html import escape
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfit.data.flags import CONTRADICTED, UNSURE, WRONG_SHARE
from jaxfit.data.tracks import frame_step
from jaxfit.foundation.errors import one_line
from jaxfit.view.colours import css, track_colour
from jaxfit.view.report.contents import Report, Track

_WITHOUT_END = ("img", "meta")


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def joined(*parts: object) -> Html:
    """Return the parts as one HTML text: HTML as it is, other values as escaped text, and nothing for None."""
    return Html("".join(part if isinstance(part, Html) else _text(part) for part in parts if part is not None))


def element(tag: str, *content: object, **attributes: object) -> Html:
    """Return an HTML element.

    Args:
        tag: name of the element.
        content: the content, as for `joined`.
        attributes: name → value; `_` becomes `-`, and a `_` at the end is dropped (`class_`). None leaves the
            attribute out.
    """
    named = {key.rstrip("_").replace("_", "-"): value for key, value in attributes.items() if value is not None}
    start = "".join(f' {key}="{_text(value)}"' for key, value in named.items())
    return Html(f"<{tag}{start}>" if tag in _WITHOUT_END else f"<{tag}{start}>{joined(*content)}</{tag}>")


def _text(value: object) -> str:
    """Return a value as escaped text; control characters other than line breaks become visible escapes."""
    return escape("\n".join(one_line(line) for line in str(value).split("\n")))


LEVELS = (0.5, 0.75, 0.9)
"""Mean confidences of the keypoints at which the colour changes."""
_ABSENT, _NO_POSE, _POSE = 0, 1, 2
"""States of a bird in a frame; poses of level i have the state `_POSE + i`."""
_FLAGGED = {UNSURE: 6, CONTRADICTED: 7}
"""Flag → state of the mark below the pose."""
_COLUMNS = 500
"""Most columns of a row: longer results have several frames in a column."""
_TICKS = 5
_CURVE_PX = (90, 22)
_CURVE_RANGE = 0.3
"""Deviations of the size beyond this share are drawn at the edge."""


class Tick(NamedTuple):
    """One marked frame of an axis."""

    place: float
    """Place on the axis, 0 to 1."""
    frame: int
    time: str | None
    """Time for people; None if unknown."""


class Axis(NamedTuple):
    """The axis of frames that all rows of a page share; T frames of the result."""

    frames: Int[np.ndarray, "T"]
    """Numbers of the frames, ascending."""
    step: int
    """Distance of the frame numbers."""
    times_s: Float[np.ndarray, "T"]
    """Time of every frame; NaN if unknown."""

    @property
    def at(self) -> Int[np.ndarray, "T"]:
        """Place of every frame, counted in frames; missing frames have places too."""
        return (self.frames - self.frames[0]) // self.step

    @property
    def length(self) -> int:
        """Number of frames from the first to the last frame, missing frames included."""
        return int(self.at[-1]) + 1

    @property
    def per_column(self) -> int:
        """Frames in one column of a row."""
        return -(-self.length // _COLUMNS)

    @property
    def columns(self) -> int:
        """Columns of a row."""
        return -(-self.length // self.per_column)

    def ticks(self) -> list[Tick]:
        """Return about `_TICKS` frames with round numbers."""
        first, span = int(self.frames[0]), max(self.length - 1, 1) * self.step
        raw = span / _TICKS
        power = 10 ** np.floor(np.log10(max(raw, 1)))
        every = max(int(next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw)), 1)
        ticks = []
        for number in range(-(-first // every) * every, first + span + 1, every):
            place = (number - first) / (self.columns * self.per_column * self.step)
            if place <= 0.93:  # else the label would leave the page
                ticks.append(Tick(place, number, self._time(number, every)))
        return ticks

    def _time(self, number: int, every: int) -> str | None:
        """Return the time of a frame, with the digits that ticks at every `every`-th frame need."""
        if not np.isfinite(self.times_s).all():
            return None
        seconds = float(np.interp(number, self.frames, self.times_s))
        distance = every * float(self.times_s[-1] - self.times_s[0]) / max(int(self.frames[-1] - self.frames[0]), 1)
        return duration(seconds) if distance >= 1 else clock(seconds, 1 if distance >= 0.1 else 2)


def axis_of(frames: Int[np.ndarray, "T"], times_s: Float[np.ndarray, "T"]) -> Axis:
    """Return the axis of the frames of a result."""
    return Axis(frames, frame_step(frames), times_s)


def timeline(report: Report) -> Html:
    """Return the rows of all birds over a common axis of frames."""
    axis = axis_of(report.frames, report.times_s)
    at, length, per_column, first = axis.at, axis.length, axis.per_column, int(report.frames[0])
    rows = [axis_row(axis), _counts(report, axis)]
    for track in report.tracks:
        states = np.zeros(length, int)
        states[at] = _states(track)
        label = element("span", swatch(track.position), f"{track.track_id}", class_="label")
        flagged = np.zeros(length, int)
        flagged[at] = [_FLAGGED.get(flag, 0) for flag in track.flags.tolist()]
        worst = np.pad(flagged, (0, -length % per_column)).reshape(-1, per_column).max(1)
        rows.append(element("div", label, _band(track, _binned(states, per_column), worst), class_="row"))
    if report.damaged:
        states = np.zeros(length, int)
        damaged = (np.array(report.damaged) - first) // report.step
        states[damaged[(damaged >= 0) & (damaged < length)]] = 1
        columns = np.pad(states, (0, -length % per_column)).reshape(-1, per_column).max(1)
        band = element("svg", _bars(columns, 1, 0.2, 0.6), class_="band", **_stretched(len(columns)))
        rows.append(element("div", element("span", "damaged", class_="label"), band, class_="row"))
    note = None
    if per_column > 1:
        text = f"One column shows {per_column} frames: the most frequent state, the mean confidence, the worst flag."
        note = element("p", text, class_="note")
    return joined(_legend(report), element("div", *rows, class_="timeline"), note)


def swatch(position: int) -> Html:
    """Return a mark in the colour that the bird has in overlays."""
    return element("i", class_="swatch", style=f"background:{css(track_colour(position))}")


def size_curve(track: Track) -> Html:
    """Return the size of a bird in the image over the frames of its track, as a small curve around its median."""
    width, height = _CURVE_PX
    at = np.flatnonzero(track.valid)
    if not len(at):
        return Html("–")
    groups = np.array_split(at, min(len(at), width // 2))
    x = np.array([group.mean() for group in groups])
    x = (x - at[0]) / max(at[-1] - at[0], 1) * width
    y = np.array([np.mean(track.size[group]) for group in groups]) - 1
    y = height / 2 * (1 - np.clip(y / _CURVE_RANGE, -0.95, 0.95))
    line = "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True))
    low, high = np.quantile(track.size[at], [0.05, 0.95]) - 1
    title = element("title", f"90 % of the frames: {low:+.0%} to {high:+.0%}")
    middle = element("path", class_="middle", d=f"M0 {height / 2}H{width}")
    paths = title, middle, element("path", class_="curve", d=line)
    return element("svg", *paths, class_="size", viewBox=f"0 0 {width} {height}", width=width, height=height)


def error_curve(track: Track) -> Html:
    """Return the error that the error bars expect over the frames of a track, as a small curve from 0 to `WRONG_SHARE`.

    The upper edge is the limit of the flag `unsure`. Marks at the upper edge are the worst flags of the frames.
    """
    width, height = _CURVE_PX
    at = np.flatnonzero(np.isfinite(track.expected_error))
    if not len(at):
        return Html()
    first, span = int(at[0]), int(at[-1] - at[0]) + 1
    columns = min(span, width // 2)
    column = (np.arange(span) * columns) // span
    lines, drawing, worst = [], False, np.zeros(columns, int)
    for i in range(columns):
        here = first + np.flatnonzero(column == i)
        worst[i] = max(_FLAGGED.get(flag, 0) for flag in track.flags[here].tolist())
        known = track.expected_error[here][np.isfinite(track.expected_error[here])]
        if len(known):
            y = height * (1 - min(float(known.mean()) / WRONG_SHARE, 0.95))
            lines.append(f"{'L' if drawing else 'M'}{(i + 0.5) * width / columns:.1f} {y:.1f}")
        drawing = bool(len(known))
    low, high = np.quantile(track.expected_error[at], [0.05, 0.95])
    title = element("title", f"90 % of the frames: {low:.1%} to {high:.1%}")
    marks = [_bars(worst, state, 0, 0.25) for state in _FLAGGED.values()]
    marks = element("g", *marks, transform=f"scale({width / columns:.4f} {height})")
    middle = element("path", class_="middle", d=f"M0 {height / 2}H{width}")
    paths = title, marks, middle, element("path", class_="curve", d="".join(lines))
    return element("svg", *paths, class_="size", viewBox=f"0 0 {width} {height}", width=width, height=height)


def duration(seconds: float) -> str:
    """Return a duration as `2.4 s`, `3:05 min` or `1:02:03 h`."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d} h" if hours else f"{minutes}:{rest:02d} min"


def clock(seconds: float, digits: int = 2) -> str:
    """Return a time of the film as `2.40 s`, `3:05.20` or `1:02:03.00`."""
    minutes, rest = divmod(round(seconds, digits), 60)
    hours, minutes = divmod(int(minutes), 60)
    width = digits + 3
    if hours:
        return f"{hours}:{minutes:02d}:{rest:0{width}.{digits}f}"
    return f"{minutes}:{rest:0{width}.{digits}f}" if minutes else f"{rest:.{digits}f} s"


def _states(track: Track) -> Int[np.ndarray, "T"]:
    """Return the state of a bird in every frame."""
    level = np.zeros(len(track.valid), int)
    if track.confidence is not None:
        level = np.searchsorted(LEVELS, track.confidence, side="right")
    else:
        level[:] = len(LEVELS)
    return np.where(track.valid, _POSE + level, np.where(track.present, _NO_POSE, _ABSENT))


def _binned(states: Int[np.ndarray, "L"], per_column: int) -> Int[np.ndarray, "C"]:
    """Return the most frequent kind of state in every column; for poses, their mean level."""
    if per_column == 1:
        return states
    columns = np.pad(states, (0, -len(states) % per_column)).reshape(-1, per_column)
    is_pose = columns >= _POSE
    kinds = np.stack([(columns == _ABSENT).sum(1), (columns == _NO_POSE).sum(1), is_pose.sum(1)], axis=1)
    mean = (columns * is_pose).sum(1) / np.maximum(is_pose.sum(1), 1)
    return np.where(kinds.argmax(1) == _POSE, np.round(mean).astype(int), kinds.argmax(1))


def _band(track: Track, states: Int[np.ndarray, "C"], flagged: Int[np.ndarray, "C"]) -> Html:
    """Return the row of a bird; `flagged` is the worst flag in each column, as a value of `_FLAGGED`."""
    parts = [_bars(states, _NO_POSE, 0.3, 0.4)]
    parts += [_bars(states, _POSE + level, 0, 1) for level in range(len(LEVELS) + 1)]
    parts += [_bars(flagged, state, 0.65, 0.35) for state in _FLAGGED.values()]
    return element("svg", element("title", f"track {track.track_id}"), *parts, class_="band", **_stretched(len(states)))


def _bars(states: Int[np.ndarray, "C"], state: int, top: float, height: float) -> Html | None:
    """Return the columns of one state as one path; None without a column."""
    edges = np.flatnonzero(np.diff(states == state, prepend=False, append=False))
    bars = "".join(f"M{a} {top}h{b - a}v{height}h{a - b}z" for a, b in zip(edges[::2], edges[1::2], strict=True))
    return element("path", class_=f"s{state}", d=bars) if bars else None


def _counts(report: Report, axis: Axis) -> Html:
    """Return the row with the number of birds over the frames."""
    counts, at = np.zeros(axis.columns * axis.per_column), axis.at
    for track in report.tracks:
        counts[at] += track.present
    counts = counts.reshape(-1, axis.per_column).max(1)
    most = int(counts.max(initial=1))
    steps = "".join(f"V{1 - count / most:.3f}h1" for count in counts)
    area = element("path", class_="count", d=f"M0 1{steps}V1z")
    title = element("title", f"number of birds in a frame, at most {most}")
    band = element("svg", title, area, class_="band counts", **_stretched(len(counts)))
    return element("div", element("span", f"birds ≤ {most}", class_="label"), band, class_="row")


def _stretched(columns: int) -> dict[str, object]:
    return {"viewBox": f"0 0 {columns} 1", "preserveAspectRatio": "none"}


def axis_row(axis: Axis) -> Html:
    """Return the row with the numbers and times of some frames."""
    ticks = []
    for place, frame, time in axis.ticks():
        small = None if time is None else element("small", time)
        ticks.append(element("span", f"{frame:,}", small, class_="tick", style=f"left:{100 * place:.2f}%"))
    return element("div", element("span", "frame", class_="label"), element("div", *ticks, class_="axis"), class_="row")


def _legend(report: Report) -> Html:
    def entry(name: str, text: str) -> Html:
        return element("span", element("i", class_=f"key {name}"), text)

    if report.has_detections:
        bounds = [f"below {LEVELS[0]:g}", *(f"{a:g} to {b:g}" for a, b in pairwise(LEVELS))]
        words = [*bounds, f"{LEVELS[-1]:g} or more"]
        entries = [element("b", "Pose, by confidence of the keypoints:")]
        entries += [entry(f"s{_POSE + level}", text) for level, text in enumerate(words)]
        entries.append(entry(f"s{_NO_POSE}", "detected, without a pose"))
    else:
        entries = [entry(f"s{_POSE + len(LEVELS)}", "pose")]
    if report.flags:
        entries += [element("b", "Flags:"), *(entry(f"s{state}", flag) for flag, state in _FLAGGED.items())]
    return element("p", *entries, class_="legend")
