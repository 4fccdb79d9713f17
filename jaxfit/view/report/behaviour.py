"""The section of the report on behaviour: ethogram, curves, time budget; the ethogram alone as a drawing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfit.view.colours import behaviour_colour, css, ink_on
from jaxfit.view.report.curves import Curve, curve_plot
from jaxfit.view.report.timeline import Axis, Html, axis_of, axis_row, clock, duration, element, joined, swatch

NO_POSE = -1
"""State of a bird without a pose."""


class Kind(NamedTuple):
    """One behaviour."""

    name: str
    """As people read it."""
    definition: str
    """A sentence."""
    colour: int | None
    """Position in `BEHAVIOUR_COLOURS`; None for a bird that shows no behaviour of the config."""


class ShownBout(NamedTuple):
    """One bird that shows one behaviour without interruption."""

    bird: int
    """Position of the track."""
    kind: int
    """Position in `Behaviour.kinds`."""
    frames: slice
    """Positions of the frames."""
    start_s: float
    stop_s: float
    partner: int | None
    """Track of the other bird."""


class ShownBudget(NamedTuple):
    """The time of one behaviour, of all birds and of each bird."""

    kind: int
    """Position in `Behaviour.kinds`."""
    seconds: float
    bouts: int
    share: float
    """Share of the time with a pose, all birds."""
    low: float
    """Lower end of the 95 % interval of the share; NaN if there is none."""
    high: float
    of_birds: Float[np.ndarray, "N"]
    """Share of each bird; NaN for a bird without a pose."""


class Behaviour(NamedTuple):
    """What N birds do in T frames."""

    track_id: Int[np.ndarray, "N"]
    frames: Int[np.ndarray, "T"]
    """Numbers of the frames."""
    times_s: Float[np.ndarray, "T"]
    kinds: Sequence[Kind]
    """The behaviours, the most important behaviour first. The last entry is the absence of a behaviour."""
    state: Int[np.ndarray, "N T"]
    """Position in `kinds`; `NO_POSE` without a pose."""
    bouts: Sequence[ShownBout]
    """The runs of states with a colour."""
    curves: Sequence[Curve]
    budget: Sequence[ShownBudget]
    notes: Sequence[str]
    """Sentences about what is estimated, simulated or unknown."""

    @property
    def shown(self) -> list[int]:
        """Positions of the kinds that occur."""
        return [kind for kind in range(len(self.kinds)) if (self.state == kind).any()]


class Mark(NamedTuple):
    """One run of columns of a row."""

    start: int
    stop: int
    kind: int
    bout: ShownBout | None


def behaviour_section(behaviour: Behaviour, order: Sequence[int], film: str | None) -> Html:
    """Return the content of the section.

    Args:
        behaviour: what the birds do; at least one bird has a pose.
        order: positions of the birds, in the order of the rows.
        film: address of the film, relative to the page; None draws bouts without links.
    """
    axis = axis_of(behaviour.frames, behaviour.times_s)
    rows = [_row(behaviour, n, _html_marks(behaviour, n, axis, film)) for n in order]
    curves = [
        curve_plot(curve, axis, behaviour.track_id, order, f"curve{i}") for i, curve in enumerate(behaviour.curves)
    ]
    tracks = [element("span", swatch(n), f"{behaviour.track_id[n]}") for n in order]
    under = joined(axis_row(axis), element("p", element("b", "Tracks:"), *tracks, class_="legend"))
    return joined(
        element("ul", *(element("li", note) for note in behaviour.notes), class_="notes") if behaviour.notes else None,
        element("h3", "Ethogram"),
        _legend(behaviour),
        element("div", axis_row(axis), *rows, class_="timeline"),
        element("p", " ".join(ethogram_notes(axis, film)), class_="note"),
        joined(element("h3", "Curves"), *curves, under) if curves else None,
        _column_note(axis) if curves else None,
        element("h3", "Time budget"),
        _budget(behaviour),
        *_bars_of_birds(behaviour, order),
    )


def behaviour_style(behaviour: Behaviour) -> str:
    """Return the style of the colours of the behaviours."""
    rules = []
    for i, kind in enumerate(behaviour.kinds):
        colour = behaviour_colour(kind.colour)
        rules.append(f".k{i} {{ background: {css(colour)}; color: {css(ink_on(colour))} }}")
    return "\n".join(rules)


def behaviour_meanings(behaviour: Behaviour) -> list[tuple[str, str]]:
    """Return the definitions of the words of the section."""
    words = [
        ("Ethogram", "Which bird shows which behaviour when. A frame has one behaviour: the first whose rule holds."),
        ("Bout", "A behaviour of one bird from its start to its stop, without interruption."),
        (
            "Time budget",
            "Time of a behaviour ÷ time with a pose. The 95 % interval is that of the bootstrap over birds. Few birds "
            "give an interval that is too narrow, and one bird gives none.",
        ),
    ]
    words += [(_capital(kind.name), kind.definition) for kind in behaviour.kinds]
    return words + [(curve.title, curve.definition) for curve in behaviour.curves]


def marks_of(behaviour: Behaviour, bird: int, axis: Axis) -> Iterator[Mark]:
    """Return the runs of columns of a bird. A column with several behaviours has the most important behaviour.

    A column that no bout fills, but in which the bird has a pose, shows its state without a colour.
    """
    at, posed = axis.at // axis.per_column, behaviour.state[bird] != NO_POSE
    bouts = [bout for bout in behaviour.bouts if bout.bird == bird]
    bouts.sort(key=lambda bout: (-bout.kind, bout.frames.stop - bout.frames.start))
    owner = np.full(axis.columns, -2)
    owner[at[posed]] = -1
    for i, bout in enumerate(bouts):
        owner[at[bout.frames.start] : at[bout.frames.stop - 1] + 1] = i
    edges = [0, *(np.flatnonzero(np.diff(owner)) + 1).tolist(), axis.columns]
    for a, b in pairwise(edges):
        if owner[a] >= 0:
            yield Mark(a, b, bouts[owner[a]].kind, bouts[owner[a]])
        elif owner[a] == -1:
            yield Mark(a, b, len(behaviour.kinds) - 1, None)


def bout_title(behaviour: Behaviour, mark: Mark, bird: int) -> str:
    """Return the tooltip of a run."""
    name, bout = behaviour.kinds[mark.kind].name, mark.bout
    if bout is None:
        return f"track {behaviour.track_id[bird]}: {name}"
    partner = "" if bout.partner is None else f", with track {bout.partner}"
    first, last = behaviour.frames[bout.frames.start], behaviour.frames[bout.frames.stop - 1]
    times = f"{clock(bout.start_s)} to {clock(bout.stop_s)} ({clock(bout.stop_s - bout.start_s)})"
    return f"track {behaviour.track_id[bird]}: {name}, {times}, frames {first:,} to {last:,}{partner}"


def film_at(film: str | None, mark: Mark) -> str | None:
    """Return the address of the film at the start of a bout."""
    return None if film is None or mark.bout is None else f"{film}#t={max(mark.bout.start_s, 0):.2f}"


def _html_marks(behaviour: Behaviour, bird: int, axis: Axis, film: str | None) -> Iterator[Html]:
    for mark in marks_of(behaviour, bird, axis):
        kind, width = behaviour.kinds[mark.kind], 100 * (mark.stop - mark.start) / axis.columns
        yield _bar(
            mark.kind,
            kind,
            100 * mark.start / axis.columns,
            width,
            bout_title(behaviour, mark, bird),
            film_at(film, mark),
        )


def _bar(i: int, kind: Kind, left: float, width: float, title: str, href: str | None = None) -> Html:
    """Return a coloured part of a row; `left` and `width` in per cent. Its name is shown where there is room."""
    letters = len(kind.name)
    label = None if kind.colour is None or width < 0.75 * letters else element("i", kind.name)
    narrow = "" if width >= 2.7 * letters else " narrow"
    named = f"bout k{i}{' other' if kind.colour is None else ''}{narrow if label else ''}"
    more = {"href": href, "target": None if href is None else "_blank", "rel": None if href is None else "noopener"}
    style = f"left:{left:.2f}%;width:{width:.2f}%"
    return element("a" if href else "span", label, class_=named, style=style, title=title, **more)


def _row(behaviour: Behaviour, bird: int, marks: Iterator[Html]) -> Html:
    label = element("span", swatch(bird), f"{behaviour.track_id[bird]}", class_="label")
    return element("div", label, element("div", *marks, class_="bouts"), class_="row")


def _legend(behaviour: Behaviour) -> Html:
    entries = []
    for i in behaviour.shown:
        other = " other" if behaviour.kinds[i].colour is None else ""
        key = element("i", class_=f"key k{i}{other}")
        entries.append(element("span", key, behaviour.kinds[i].name, title=behaviour.kinds[i].definition))
    return element("p", *entries, class_="legend")


def ethogram_notes(axis: Axis, film: str | None) -> list[str]:
    """Return sentences about how to read the ethogram."""
    notes = [] if film is None else ["A click on a bout opens the film at its start."]
    if axis.per_column > 1:
        notes.append(
            f"One column shows {axis.per_column} frames. A column with several behaviours shows the behaviour that "
            "stands first in the legend, so short bouts look longer than they are."
        )
    return [*notes, "White: no pose."]


def _column_note(axis: Axis) -> Html | None:
    if axis.per_column == 1:
        return None
    return element("p", f"The curves show the mean of {axis.per_column} frames.", class_="note")


def _budget(behaviour: Behaviour) -> Html:
    """Return the table of the time of all birds."""
    names = ("Behaviour", ""), ("Share", "% of time"), ("95 %", "interval"), ("", "0 to 100 %")
    names = *names, ("Bouts", "number"), ("Time", "all birds")
    head = element("tr", *(element("th", name, element("small", unit)) for name, unit in names))
    rows = []
    for row in behaviour.budget:
        if not row.share > 0:
            continue
        kind, known = behaviour.kinds[row.kind], bool(np.isfinite(row.low))
        spread = f"left:{100 * row.low:.1f}%;width:{100 * (row.high - row.low):.1f}%" if known else None
        bar = element("i", class_=f"k{row.kind}", style=f"width:{100 * row.share:.1f}%")
        bar = element("div", bar, element("b", style=spread) if spread else None, class_="share")
        interval = f"{100 * row.low:.0f} to {100 * row.high:.0f}" if known else "–"
        bouts = f"{row.bouts:,}" if kind.colour is not None else "–"
        cells = f"{100 * row.share:.1f}", interval, bar, bouts, duration(row.seconds)
        name = element("th", element("i", class_=f"swatch k{row.kind}"), kind.name)
        rows.append(element("tr", name, *(element("td", cell) for cell in cells)))
    table = element("div", element("table", element("thead", head), element("tbody", *rows)), class_="wide budget")
    absent = [behaviour.kinds[row.kind].name for row in behaviour.budget if not row.share > 0]
    return joined(table, element("p", f"Not found: {', '.join(absent)}.", class_="note") if absent else None)


def _bars_of_birds(behaviour: Behaviour, order: Sequence[int]) -> list[Html]:
    """Return one bar for each bird, divided by its time budget."""

    def parts(bird: int) -> Iterator[Html]:
        left = 0.0
        for row in behaviour.budget:
            share = 100 * float(row.of_birds[bird])
            if share > 0:
                kind = behaviour.kinds[row.kind]
                yield _bar(row.kind, kind, left, share, f"track {behaviour.track_id[bird]}: {kind.name} {share:.1f} %")
                left += share

    scale = [element("span", f"{tick} %", class_="tick", style=f"left:{tick}%") for tick in (0, 25, 50, 75)]
    scale = element(
        "div", element("span", "share", class_="label"), element("div", *scale, class_="axis"), class_="row"
    )
    heading = element("p", element("b", "Each bird"), class_="plot-title")
    return [heading, element("div", scale, *(_row(behaviour, n, parts(n)) for n in order), class_="timeline")]


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
