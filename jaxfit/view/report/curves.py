"""Curves of all birds over the axis of frames, for the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfit.view.colours import css, track_colour
from jaxfit.view.report.timeline import Axis, Html, element, joined

_HEIGHT = 100
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

    def share(self, values: Float[np.ndarray, "C"]) -> Float[np.ndarray, "C"]:
        """Return the places of values on the axis, 0 to 1; values outside the axis are at its ends."""
        return (np.clip(values, self.low, self.high) - self.low) / (self.high - self.low)


def curve_plot(curve: Curve, axis: Axis, track_id: Int[np.ndarray, "N"], order: Sequence[int], name: str) -> Html:
    """Return the plot of a curve, with one line for each bird in the colour of its track.

    Args:
        curve: the values.
        axis: the axis of the frames.
        track_id: numbers of the tracks.
        order: positions of the birds, in the order of the rows of the page.
        name: a name that no other plot of the page has.
    """
    values = binned_means(curve.values, axis)
    heading = element("p", element("b", curve.title), f" ({curve.unit})" if curve.unit else None, class_="plot-title")
    if not np.isfinite(values).any():
        return joined(heading, element("p", "No bird has a value.", class_="note"))
    scale = scale_of(values)
    lines = [element("path", class_="grid", d=_grid(axis, scale))]
    for n in order:
        path = line_path(values[n], scale)
        if path:
            text = f"track {track_id[n]}: {_summary(curve.values[n], curve.unit)}"
            # the same line a second time, wider and dark: a border that pale colours need on a pale ground
            parts = (
                element("use", class_="case", href=f"#{name}-{n}"),
                element("path", class_="track", id=f"{name}-{n}", d=path),
            )
            lines.append(element("g", element("title", text), *parts, class_="line", stroke=css(track_colour(n))))
    view = {"viewBox": f"-0.5 0 {axis.columns} {_HEIGHT}", "preserveAspectRatio": "none"}
    places = scale.share(np.array([value for value, _ in scale.ticks]))
    texts = [text for _, text in scale.ticks]
    ticks = [element("span", t, style=f"bottom:{100 * at:.1f}%") for at, t in zip(places, texts, strict=True)]
    row = element("div", *ticks, class_="label values"), element("svg", *lines, class_="lines", **view)
    return joined(heading, element("div", *row, class_="row plot"), _outside(values, scale, curve.unit))


def binned_means(values: Float[np.ndarray, "N T"], axis: Axis) -> Float[np.ndarray, "N C"]:
    """Return the mean of the values in each column of the axis; NaN for a column without a value."""
    placed = np.full((len(values), axis.columns * axis.per_column), np.nan)
    placed[:, axis.at] = values
    columns = placed.reshape(len(values), axis.columns, axis.per_column)
    known = np.isfinite(columns)
    with np.errstate(invalid="ignore"):
        return np.where(known, columns, 0).sum(2) / known.sum(2)


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
    raw = (high - low) / _STEPS
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw)
    digits = max(0, int(np.ceil(-np.log10(step) - 1e-9)))
    values_of_ticks = (
        np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step + 0.0
    )  # −0 becomes 0
    return Scale(low, high, tuple((float(v), f"{v:.{digits}f}".replace("-", "−")) for v in values_of_ticks))


def line_path(values: Float[np.ndarray, "C"], scale: Scale) -> str:
    """Return the path of a line over the columns: gaps where a value is missing, a dot where a value stands alone."""
    share = scale.share(values)
    known = np.isfinite(values)
    edges = np.flatnonzero(np.diff(known, prepend=False, append=False))
    runs = []
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        points = [f"{i} {_HEIGHT * (1 - share[i]):.1f}" for i in range(a, b)]
        runs.append("M" + "L".join(points) + ("h0" if b - a == 1 else ""))
    return "".join(runs)


def _grid(axis: Axis, scale: Scale) -> str:
    """Return the path of the lines at the ticks of both axes."""
    places = scale.share(np.array([value for value, _ in scale.ticks]))
    rows = "".join(f"M-0.5 {_HEIGHT * (1 - at):.2f}h{axis.columns}" for at in places)
    return rows + "".join(f"M{tick.place * axis.columns - 0.5:.2f} 0v{_HEIGHT}" for tick in axis.ticks())


def _summary(values: Float[np.ndarray, "T"], unit: str) -> str:
    low, median, high = np.nanquantile(values, [0.05, 0.5, 0.95])
    return f"median {shown(median, unit)}, 90 % of the frames {shown(low)} to {shown(high, unit)}"


def shown(value: float, unit: str = "") -> str:
    """Return a value with three digits and its unit."""
    space = "" if unit.startswith("°") or not unit else " "
    return f"{float(f'{value:.3g}'):g}{space}{unit}"


def _outside(values: Float[np.ndarray, "N C"], scale: Scale, unit: str) -> Html | None:
    """Return the sentence about values outside the axis; None if the axis holds all values."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    beyond = [value for value, outside in ((low, low < scale.low), (high, high > scale.high)) if outside]
    if not beyond:
        return None
    extremes = " and ".join(shown(value, unit) for value in beyond)
    return element("p", f"The edge of the plot also shows values outside its axis, up to {extremes}.", class_="note")
