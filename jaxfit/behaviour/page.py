"""What birds do over time, for people: the section of the report, and the ethogram alone as a drawing."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from jaxfit.behaviour.bouts import NO_POSE, Budget, Ethogram
from jaxfit.behaviour.describe import Description, by_reason
from jaxfit.behaviour.rules import OTHER, BehaviourConfig
from jaxfit.view.report.axis import Axis, clock
from jaxfit.view.report.curves import Curve, plot_of
from jaxfit.view.report.rendering import rendered

CURVES = {
    "body_pitch": "Body pitch",
    "wing_spread": "Wing spread",
    "speed": "Speed",
    "neighbour_distance": "Distance of the nearest neighbour",
}
"""Features that the report draws over time → title."""
UNITS = {"wing_spread": "share of the wing span"}
"""Unit of a feature for people, where the registry has none."""
RULES_NOTE = (
    "Rules with limits find the behaviours in the fitted poses. The limits of the shipped rules were chosen on "
    "simulated murres. Look at bouts in the film before you use them."
)
"""What every page says about the behaviours."""
MEANINGS = {
    "Ethogram": "Which bird shows which behaviour when. A frame has one behaviour: the first whose rule holds.",
    "Bout": "A behaviour of one bird from its start to its stop, without interruption.",
    "Time budget": "Time of a behaviour ÷ time with a pose. The 95 % interval is that of the bootstrap over birds. "
    "Fewer than eight birds have no interval.",
}
"""Definitions of the words of the section."""


class Kind(NamedTuple):
    """One behaviour."""

    name: str
    """As people read it."""
    definition: str
    """A sentence."""
    colour: int | None
    """Position in `BEHAVIOUR_COLOURS`; None for a bird that shows no behaviour of the config."""


class Mark(NamedTuple):
    """One run of columns of a row of the ethogram."""

    start: int
    stop: int
    kind: int
    """Position in `BehaviourPage.kinds`."""
    title: str
    """The tooltip."""
    href: str | None
    """Address of the film at the start of the bout."""


class BehaviourPage:
    """What N birds do in T frames, as a report shows it (`jaxfit.view.report.page.Behaviour`).

    Args:
        description: features of all birds and all frames of the result.
        ethogram: the bouts of the same birds.
        budget: the time budgets of the ethogram.
        config: the rules of the ethogram.
        notes: sentences about what is estimated or unknown.
    """

    def __init__(
        self,
        description: Description,
        ethogram: Ethogram,
        budget: Sequence[Budget],
        config: BehaviourConfig,
        notes: Sequence[str] = (),
    ):
        self.ethogram, self.budget = ethogram, budget
        self.track_id, self.frames = description.flock.solution.track_id, description.flock.solution.frame_index
        self.axis = Axis(self.frames, ethogram.time_s)
        colours = {name: i for i, name in enumerate(config.behaviours)}
        self.kinds = [
            Kind("other", "The bird has a pose, and no rule holds.", None)
            if name == OTHER
            else Kind(name.replace("_", " "), config.behaviours[name].definition, colours[name])
            for name in ethogram.names
        ]
        """In the order of `ethogram.names`: the most important behaviour first, the absence of a behaviour last."""
        features = {feature.name: feature for feature in description.features}
        self.curves = [
            Curve(
                title,
                UNITS.get(name) or features[name].shown_unit(description.flock.unit),
                description.values[name],
                features[name].definition,
            )
            for name, title in CURVES.items()
            if name in features
        ]
        self.notes = [
            RULES_NOTE,
            *(f"{note[:1].upper()}{note[1:]}{'' if note.endswith('.') else '.'}" for note in notes),
        ]
        lacking = {CURVES[name].lower(): reason for name, reason in description.missing.items() if name in CURVES}
        self.notes += [f"No curve of {_listed(names)}: {reason}." for reason, names in by_reason(lacking).items()]
        lacking = {name.replace("_", " "): reason for name, reason in ethogram.missing.items()}
        for reason, names in by_reason(lacking).items():
            self.notes.append(f"The result cannot show {_listed(names)}: {reason}.")

    @property
    def shown(self) -> list[int]:
        """Positions of the kinds that occur."""
        return [kind for kind in range(len(self.kinds)) if (self.ethogram.state == kind).any()]

    def section(self, order: Sequence[int], film: str | None) -> str:
        """Return the section of the report, HTML.

        Args:
            order: positions of the birds, in the order of the rows.
            film: address of the film, relative to the page; None draws bouts without links.
        """
        kind_of = {name: kind for kind, name in enumerate(self.ethogram.names)}
        of_all = [(kind_of[row.behaviour], row) for row in self.budget if row.track is None]
        shares: dict[int, list[tuple[int, float]]] = {track: [] for track in self.track_id.tolist()}
        for row in self.budget:
            if row.track is not None and row.share > 0:
                shares[row.track].append((kind_of[row.behaviour], row.share))
        return rendered(
            "behaviour.html",
            behaviour=self,
            axis=self.axis,
            rows=[(n, self.marks(n, film)) for n in order],
            plots=[(curve, plot_of(curve, self.axis, self.track_id, order)) for curve in self.curves],
            ethogram_notes=self.reading_notes(film),
            budget=of_all,
            absent=[self.kinds[kind].name for kind, row in of_all if not row.share > 0],
            shares=shares,
            titles=MEANINGS,
        )

    def marks(self, bird: int, film: str | None) -> list[Mark]:
        """Return the runs of columns of a bird. A column with several behaviours has the most important behaviour.

        A column that no bout fills, but in which the bird has a pose, shows its state without a colour.

        Args:
            bird: position of the bird.
            film: address of the film; None makes no links.
        """
        at = self.axis.at // self.axis.per_column
        kind_of = {name: i for i, name in enumerate(self.ethogram.names)}
        bouts = [bout for bout in self.ethogram.bouts if bout.bird == bird]
        bouts.sort(key=lambda bout: (-kind_of[bout.behaviour], bout.frames.stop - bout.frames.start))
        owner = np.full(self.axis.columns, -2)
        owner[at[self.ethogram.state[bird] != NO_POSE]] = -1
        for i, bout in enumerate(bouts):
            owner[at[bout.frames.start] : at[bout.frames.stop - 1] + 1] = i
        track, marks = f"track {self.track_id[bird]}", []
        for a, b in pairwise([0, *(np.flatnonzero(np.diff(owner)) + 1).tolist(), self.axis.columns]):
            if owner[a] == -1:
                marks.append(Mark(a, b, len(self.kinds) - 1, f"{track}: {self.kinds[-1].name}", None))
            elif owner[a] >= 0:
                bout = bouts[owner[a]]
                kind = kind_of[bout.behaviour]
                first, last = self.frames[bout.frames.start], self.frames[bout.frames.stop - 1]
                times = f"{clock(bout.start_s)} to {clock(bout.stop_s)} ({clock(bout.stop_s - bout.start_s)})"
                title = f"{track}: {self.kinds[kind].name}, {times}, frames {first:,} to {last:,}"
                title += "" if bout.partner is None else f", with track {bout.partner}"
                href = None if film is None else f"{film}#t={max(bout.start_s, 0):.2f}"
                marks.append(Mark(a, b, kind, title, href))
        return marks

    def reading_notes(self, film: str | None) -> list[str]:
        """Return sentences about how to read the ethogram."""
        notes = [] if film is None else ["A click on a bout opens the film at its start."]
        if self.axis.per_column > 1:
            notes.append(
                f"One column shows {self.axis.per_column} frames. A column with several behaviours shows the behaviour "
                "that stands first in the legend, so short bouts look longer than they are."
            )
        return [*notes, "Empty: no pose."]

    def svg(self, title: str = "Ethogram", film: str | None = None) -> str:
        """Return the ethogram as a file of its own: title, legend, axis, one row for each bird, and notes.

        Args:
            title: the heading.
            film: address of the film, relative to the file; None draws bouts without links.
        """
        width, edge, letter = 1000, 16, 6.4  # of the drawing, its margin, and a letter on average, pixels
        legend, x, y = [], float(edge), 42
        for i in self.shown:
            wide = 44 + letter * len(self.kinds[i].name)
            if x + wide > width and x > edge:
                x, y = float(edge), y + 20
            legend.append((i, x, y))
            x += wide
        return rendered(
            "ethogram.svg",
            behaviour=self,
            axis=self.axis,
            title=title,
            legend=legend,
            rows=[(n, self.marks(n, film)) for n in range(len(self.track_id))],
            notes=[line for note in [*self.notes, *self.reading_notes(film)] for line in textwrap.wrap(note, 150)],
            top=y + 52,
            width=width,
            edge=edge,
            letter=letter,
        )


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
