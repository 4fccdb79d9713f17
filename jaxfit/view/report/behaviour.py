"""What birds do over time, as the report shows it: ethogram, curves, time budget; the ethogram alone as a drawing."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfit.view.report.axis import Axis, clock
from jaxfit.view.report.curves import Curve
from jaxfit.view.report.rendering import rendered

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

    @property
    def meanings(self) -> list[tuple[str, str]]:
        """Names and definitions of the behaviours and the curves."""
        kinds = [(kind.name[:1].upper() + kind.name[1:], kind.definition) for kind in self.kinds]
        return kinds + [(curve.title, curve.definition) for curve in self.curves]


class Mark(NamedTuple):
    """One run of columns of a row of the ethogram."""

    start: int
    stop: int
    kind: int
    title: str
    """The tooltip."""
    href: str | None
    """Address of the film at the start of the bout."""


def marks_of(behaviour: Behaviour, bird: int, axis: Axis, film: str | None) -> list[Mark]:
    """Return the runs of columns of a bird. A column with several behaviours has the most important behaviour.

    A column that no bout fills, but in which the bird has a pose, shows its state without a colour.

    Args:
        behaviour: what the birds do.
        bird: position of the bird.
        axis: the axis of the frames.
        film: address of the film; None makes no links.
    """
    at, posed = axis.at // axis.per_column, behaviour.state[bird] != NO_POSE
    bouts = [bout for bout in behaviour.bouts if bout.bird == bird]
    bouts.sort(key=lambda bout: (-bout.kind, bout.frames.stop - bout.frames.start))
    owner = np.full(axis.columns, -2)
    owner[at[posed]] = -1
    for i, bout in enumerate(bouts):
        owner[at[bout.frames.start] : at[bout.frames.stop - 1] + 1] = i
    edges = [0, *(np.flatnonzero(np.diff(owner)) + 1).tolist(), axis.columns]
    track, marks = f"track {behaviour.track_id[bird]}", []
    for a, b in pairwise(edges):
        if owner[a] == -1:
            kind = len(behaviour.kinds) - 1
            marks.append(Mark(a, b, kind, f"{track}: {behaviour.kinds[kind].name}", None))
        elif owner[a] >= 0:
            bout = bouts[owner[a]]
            first, last = behaviour.frames[bout.frames.start], behaviour.frames[bout.frames.stop - 1]
            times = f"{clock(bout.start_s)} to {clock(bout.stop_s)} ({clock(bout.stop_s - bout.start_s)})"
            title = f"{track}: {behaviour.kinds[bout.kind].name}, {times}, frames {first:,} to {last:,}"
            title += "" if bout.partner is None else f", with track {bout.partner}"
            href = None if film is None else f"{film}#t={max(bout.start_s, 0):.2f}"
            marks.append(Mark(a, b, bout.kind, title, href))
    return marks


def ethogram_notes(axis: Axis, film: str | None) -> list[str]:
    """Return sentences about how to read the ethogram."""
    notes = [] if film is None else ["A click on a bout opens the film at its start."]
    if axis.per_column > 1:
        notes.append(
            f"One column shows {axis.per_column} frames. A column with several behaviours shows the behaviour that "
            "stands first in the legend, so short bouts look longer than they are."
        )
    return [*notes, "White: no pose."]


_WIDTH, _EDGE, _LETTER = 1000, 16, 6.4
"""Width, margin, and mean width of a letter of the drawing, pixels."""


def ethogram_svg(behaviour: Behaviour, title: str = "Ethogram", film: str | None = None) -> str:
    """Return the ethogram as a file of its own: title, legend, axis, one row for each bird, and notes.

    Args:
        behaviour: what the birds do.
        title: the heading.
        film: address of the film, relative to the file; None draws bouts without links.
    """
    axis = Axis(behaviour.frames, behaviour.times_s)
    legend, x, y = [], float(_EDGE), 42
    for i in behaviour.shown:
        width = 44 + _LETTER * len(behaviour.kinds[i].name)
        if x + width > _WIDTH and x > _EDGE:
            x, y = float(_EDGE), y + 20
        legend.append((i, x, y))
        x += width
    notes = [line for note in [*behaviour.notes, *ethogram_notes(axis, film)] for line in textwrap.wrap(note, 150)]
    rows = [(n, marks_of(behaviour, n, axis, film)) for n in range(len(behaviour.track_id))]
    drawing = {"title": title, "legend": legend, "axis": axis, "rows": rows, "notes": notes, "top": y + 52}
    return rendered("ethogram.svg", behaviour=behaviour, width=_WIDTH, edge=_EDGE, letter=_LETTER, **drawing)
