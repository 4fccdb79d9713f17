"""Curves of all birds over the axis of frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfit.view.report.axis import Axis, round_step, runs

HEIGHT = 100
"""Height of a plot in units of its drawing."""
_STEPS = 5
"""Most steps between the ticks of a y axis."""
_TAIL = 0.005
"""Share of the values at each end that may lie outside the y axis, if they lie far from all other values."""
_BEYOND = 2.0
"""Length by which an axis goes beyond all other values at most, relative to their range."""


class Curve(NamedTuple):
    """One value of N birds in T frames."""

    title: str
    unit: str
    """As people read it; empty for a ratio."""
    values: Float[np.ndarray, "N T"]
    """NaN without a value."""
    definition: str


class Scale(NamedTuple):
    """The y axis of a plot."""

    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]
    """Values and texts of the ticks, from low to high."""

    def share(self, values: Float[np.ndarray, "*A"] | float) -> Float[np.ndarray, "*A"]:
        """Return the places of values on the axis, 0 to 1; values outside the axis are at its ends."""
        return (np.clip(values, self.low, self.high) - self.low) / (self.high - self.low)


class Plot(NamedTuple):
    """The drawing of a curve, `HEIGHT` high and a unit wide for each column."""

    ticks: list[tuple[float, str]]
    """Places (0 to 1) and texts of the ticks."""
    grid: str
    """Path of the lines at the ticks of both axes."""
    lines: list[tuple[int, str, str]]
    """Position of a bird, the path of its line, and its tooltip."""
    beyond: str
    """Values outside the y axis; empty if the axis holds all values."""


def plot_of(curve: Curve, axis: Axis, track_id: Int[np.ndarray, "N"], order: Sequence[int]) -> Plot | None:
    """Return the plot of a curve, with a line for each bird that has a value; None if no bird has a value.

    Args:
        curve: the values.
        axis: the axis of the frames.
        track_id: numbers of the tracks.
        order: positions of the birds, in the order of the rows of the page.
    """
    columns = axis.in_columns(np.asarray(curve.values, np.float64), np.nan)
    known = np.isfinite(columns)
    with np.errstate(invalid="ignore"):
        values = np.where(known, columns, 0).sum(2) / known.sum(2)
    if not known.any():
        return None
    scale = scale_of(values)
    ticks = [(float(scale.share(value)), text) for value, text in scale.ticks]
    grid = "".join(f"M-0.5 {HEIGHT * (1 - at):.2f}h{axis.columns}" for at, _ in ticks)
    grid += "".join(f"M{tick.place * axis.columns - 0.5:.2f} 0v{HEIGHT}" for tick in axis.ticks)
    lines = []
    for n in order:
        if np.isfinite(values[n]).any():
            low, median, high = np.nanquantile(curve.values[n], [0.05, 0.5, 0.95])
            spread = f"90 % of the frames {shown(low)} to {shown(high, curve.unit)}"
            title = f"track {track_id[n]}: median {shown(median, curve.unit)}, {spread}"
            lines.append((n, line_path(values[n], scale), title))
    least, most = float(np.nanmin(values)), float(np.nanmax(values))
    beyond = [value for value, outside in ((least, least < scale.low), (most, most > scale.high)) if outside]
    return Plot(ticks, grid, lines, " and ".join(shown(value, curve.unit) for value in beyond))


def scale_of(values: Float[np.ndarray, "N C"]) -> Scale:
    """Return a y axis that holds the values, with ticks at round numbers.

    An axis of positive values starts at 0, if the values come near 0. Single values may lie outside the axis: the axis
    goes beyond 99 % of the values by `_BEYOND` times their range at most.
    """
    known = values[np.isfinite(values)]
    lowest, highest = np.quantile(known, [_TAIL, 1 - _TAIL])
    margin = _BEYOND * (highest - lowest)
    low, high = max(float(known.min()), lowest - margin), min(float(known.max()), highest + margin)
    least = 0.01 * max(abs(low), abs(high), 0.01)
    if high - low < least:  # all values are equal
        low, high = low - least, high + least
    pad = 0.04 * (high - low)
    low, high = (0.0 if known.min() >= 0 and low < high / 2 else low - pad), high + pad
    step = round_step((high - low) / _STEPS)
    digits = max(0, int(np.ceil(-np.log10(step) - 1e-9)))
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    values_of_ticks = np.arange(first, last + 1) * step + 0.0  # −0 becomes 0
    return Scale(low, high, tuple((float(v), f"{v:.{digits}f}".replace("-", "−")) for v in values_of_ticks))


def line_path(values: Float[np.ndarray, "C"], scale: Scale) -> str:
    """Return the path of a line over the columns: gaps where a value is missing, a dot where a value stands alone."""
    share, path = scale.share(values), ""
    for a, b in runs(np.isfinite(values)):
        points = [f"{i} {HEIGHT * (1 - share[i]):.1f}" for i in range(a, b)]
        path += "M" + "L".join(points) + ("h0" if b - a == 1 else "")
    return path


def shown(value: float, unit: str = "") -> str:
    """Return a value with three digits and its unit."""
    space = "" if unit.startswith("°") or not unit else " "
    return f"{float(f'{value:.3g}'):g}{space}{unit}"
