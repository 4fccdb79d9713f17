"""Which bird is present when, how certain the detection is, and how a bird changes: paths of small drawings."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxfit.data.flags import CONTRADICTED, UNSURE, WRONG_SHARE
from jaxfit.view.report.axis import Axis, runs
from jaxfit.view.report.contents import Report, Track

LEVELS = (0.5, 0.75, 0.9)
"""Mean confidences of the keypoints at which the colour changes."""
_ABSENT, _NO_POSE, _POSE = 0, 1, 2
"""States of a bird in a frame; poses of level i have the state `_POSE + i`."""
_FLAGGED = {UNSURE: 6, CONTRADICTED: 7}
"""Flag → state of the mark below the pose."""
_CURVE_PX = (90, 22)
_CURVE_RANGE = 0.3
"""Deviations of the size beyond this share are drawn at the edge."""

Shape = tuple[str, str]
"""Class and path of a part of a drawing."""


class Timeline(NamedTuple):
    """The rows of all birds over a common axis of frames."""

    axis: Axis
    most: int
    """Largest number of birds in a frame."""
    counts: str
    """Path of the number of birds over the columns."""
    rows: list[tuple[Track, list[Shape]]]
    """Every bird and the parts of its row."""
    damaged: list[Shape]
    """Frames that could not be decoded."""
    legend: list[Shape]
    """Class and meaning of the colours of poses."""
    flags: list[Shape]
    """Class and meaning of the marks of flags."""


def timeline_of(report: Report) -> Timeline:
    """Return the rows of the birds of a report."""
    axis = Axis(report.frames, report.times_s)
    counts = axis.in_columns(sum((track.present for track in report.tracks), np.zeros(len(report.frames)))).max(1)
    most = int(counts.max(initial=1))
    rows = []
    for track in report.tracks:
        states = _binned(axis.in_columns(_states(track)))
        shapes = [_bars(states, _NO_POSE, 0.3, 0.4)]
        shapes += [_bars(states, _POSE + level, 0, 1) for level in range(len(LEVELS) + 1)]
        flagged = axis.in_columns(_flag_states(track.flags)).max(1)
        shapes += [_bars(flagged, state, 0.65, 0.35) for state in _FLAGGED.values()]
        rows.append((track, [shape for shape in shapes if shape[1]]))
    damaged = np.zeros(axis.columns, int)
    places = (np.array(report.damaged, int) - report.frames[0]) // axis.step
    damaged[places[(places >= 0) & (places <= axis.at[-1])] // axis.per_column] = 1
    if report.has_detections:
        words = [f"below {LEVELS[0]:g}", *(f"{a:g} to {b:g}" for a, b in pairwise(LEVELS)), f"{LEVELS[-1]:g} or more"]
        legend = [(f"s{_POSE + level}", text) for level, text in enumerate(words)]
        legend.append((f"s{_NO_POSE}", "detected, without a pose"))
    else:
        legend = [(f"s{_POSE + len(LEVELS)}", "pose")]
    flags = [(f"s{state}", flag) for flag, state in _FLAGGED.items()] if report.flags else []
    path = "M0 1" + "".join(f"V{1 - count / most:.3f}h1" for count in counts) + "V1z"
    return Timeline(axis, most, path, rows, [_bars(damaged, 1, 0.2, 0.6)] if report.damaged else [], legend, flags)


def _states(track: Track) -> Int[np.ndarray, "T"]:
    """Return the state of a bird in every frame."""
    level = np.full(len(track.valid), len(LEVELS))
    if track.confidence is not None:
        level = np.searchsorted(LEVELS, track.confidence, side="right")
    return np.where(track.valid, _POSE + level, np.where(track.present, _NO_POSE, _ABSENT))


def _flag_states(flags: np.ndarray) -> Int[np.ndarray, "T"]:
    return np.select([flags == flag for flag in _FLAGGED], list(_FLAGGED.values()), default=0)


def _binned(columns: Int[np.ndarray, "C P"]) -> Int[np.ndarray, "C"]:
    """Return the most frequent kind of state in every column; for poses, their mean level."""
    is_pose = columns >= _POSE
    kinds = np.stack([(columns == _ABSENT).sum(1), (columns == _NO_POSE).sum(1), is_pose.sum(1)], axis=1)
    mean = (columns * is_pose).sum(1) / np.maximum(is_pose.sum(1), 1)
    return np.where(kinds.argmax(1) == _POSE, np.round(mean).astype(int), kinds.argmax(1))


def _bars(states: Int[np.ndarray, "C"], state: int, top: float, height: float) -> Shape:
    """Return the columns of one state as one path, which is empty without a column."""
    bars = "".join(f"M{a} {top}h{b - a}v{height}h{a - b}z" for a, b in runs(states == state))
    return f"s{state}", bars


class SmallCurve(NamedTuple):
    """A curve in a cell of a table."""

    title: str
    width: float
    height: float
    line: str
    """Path of the curve."""
    marks: list[Shape]
    """Marks at the upper edge, in columns as wide as `mark_width` and as high as the curve."""
    mark_width: float = 1.0


def size_curve(track: Track) -> SmallCurve | None:
    """Return the size of a bird in the image over the frames of its track, around its median; None without a pose."""
    width, height = _CURVE_PX
    at = np.flatnonzero(track.valid)
    if not len(at):
        return None
    groups = np.array_split(at, min(len(at), width // 2))
    x = np.array([group.mean() for group in groups])
    x = (x - at[0]) / max(at[-1] - at[0], 1) * width
    y = np.array([np.mean(track.size[group]) for group in groups]) - 1
    y = height / 2 * (1 - np.clip(y / _CURVE_RANGE, -0.95, 0.95))
    line = "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True))
    low, high = np.quantile(track.size[at], [0.05, 0.95]) - 1
    return SmallCurve(f"90 % of the frames: {low:+.0%} to {high:+.0%}", width, height, line, [])


def error_curve(track: Track) -> SmallCurve | None:
    """Return the error that the error bars expect over the frames of a track, from 0 to `WRONG_SHARE`.

    The upper edge is the limit of the flag `unsure`. Marks at the upper edge are the worst flags of the frames. None
    stands for a track without error bars.
    """
    width, height = _CURVE_PX
    at = np.flatnonzero(np.isfinite(track.expected_error))
    if not len(at):
        return None
    span = int(at[-1] - at[0]) + 1
    columns = min(span, width // 2)
    starts = -(-np.arange(columns) * span // columns)  # first frame of every column
    flags, error = track.flags[at[0] : at[-1] + 1], track.expected_error[at[0] : at[-1] + 1]
    worst = np.maximum.reduceat(_flag_states(flags), starts)
    known = np.add.reduceat(np.isfinite(error).astype(int), starts)
    mean = np.add.reduceat(np.nan_to_num(error), starts) / np.maximum(known, 1)
    y = height * (1 - np.minimum(mean / WRONG_SHARE, 0.95))
    line = ""
    for start, stop in runs(known > 0):
        line += "M" + "L".join(f"{(i + 0.5) * width / columns:.1f} {y[i]:.1f}" for i in range(start, stop))
    low, high = np.quantile(track.expected_error[at], [0.05, 0.95])
    marks = [_bars(worst, state, 0, 0.25) for state in _FLAGGED.values()]
    title = f"90 % of the frames: {low:.1%} to {high:.1%}"
    return SmallCurve(title, width, height, line, [mark for mark in marks if mark[1]], width / columns)
