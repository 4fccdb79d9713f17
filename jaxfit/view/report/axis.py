"""The axis of frames that all rows of a page share, its columns, and times for people."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.data.tracks import frame_step

COLUMNS = 500
"""Most columns of a row: longer results have several frames in a column."""
TICKS = 5
"""Approximate number of marked frames."""


class Tick(NamedTuple):
    """One marked frame of an axis."""

    place: float
    """Place on the axis, 0 to 1."""
    frame: int
    time: str | None
    """Time for people; None if unknown."""


class Axis:
    """The axis of the T frames of a result.

    Args:
        frames: numbers of the frames, ascending.
        times_s: time of every frame; NaN if unknown.
    """

    def __init__(self, frames: Int[np.ndarray, "T"], times_s: Float[np.ndarray, "T"]):
        self.frames, self.times_s, self.step = frames, times_s, frame_step(frames)
        self.at = (frames - frames[0]) // self.step
        """(T,) place of every frame, counted in frames; missing frames have places too."""
        self.per_column = -(-(int(self.at[-1]) + 1) // COLUMNS)
        """Frames in one column of a row."""
        self.columns = -(-(int(self.at[-1]) + 1) // self.per_column)

    def in_columns(self, values: np.ndarray, missing: float = 0) -> np.ndarray:
        """Return values of every frame (…, T) in the columns of a row, (…, columns, frames of a column)."""
        placed = np.full((*values.shape[:-1], self.columns * self.per_column), missing, values.dtype)
        placed[..., self.at] = values
        return placed.reshape(*values.shape[:-1], self.columns, self.per_column)

    @property
    def ticks(self) -> list[Tick]:
        """About `TICKS` frames with round numbers."""
        first, span = int(self.frames[0]), max(int(self.at[-1]), 1) * self.step
        every = max(int(round_step(max(span / TICKS, 1))), 1)
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


def round_step(least: float) -> float:
    """Return the smallest of 1, 2, 5, 10 times a power of ten that is not below `least`."""
    power = 10.0 ** np.floor(np.log10(least))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least)


def runs(chosen: Bool[np.ndarray, "C"]) -> list[tuple[int, int]]:
    """Return the start and the stop of every run of True."""
    edges = np.flatnonzero(np.diff(chosen, prepend=False, append=False)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def duration(seconds: float) -> str:
    """Return a duration as `2.4 s`, `3:05 min` or `1:02:03 h`."""
    if round(seconds, 1) < 60:
        return f"{seconds:.1f} s"
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d} h" if hours else f"{minutes}:{seconds:02d} min"


def clock(seconds: float, digits: int = 2) -> str:
    """Return a time of the film as `2.40 s`, `3:05.20` or `1:02:03.00`."""
    minutes, seconds = divmod(round(seconds, digits), 60)
    hours, minutes = divmod(int(minutes), 60)
    width = digits + 3
    if hours:
        return f"{hours}:{minutes:02d}:{seconds:0{width}.{digits}f}"
    return f"{minutes}:{seconds:0{width}.{digits}f}" if minutes else f"{seconds:.{digits}f} s"
