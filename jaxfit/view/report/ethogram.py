"""`ethogram_svg`: the ethogram alone, as a drawing in a file of its own."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

from jaxfit.view.colours import behaviour_colour, css, ink_on, track_colour
from jaxfit.view.report.behaviour import Behaviour, bout_title, ethogram_notes, film_at, marks_of
from jaxfit.view.report.timeline import Axis, Html, axis_of, element

_WIDTH, _EDGE, _LEFT, _ROW = 1000, 16, 90, 22
_PLOT = _WIDTH - _LEFT - _EDGE
_LETTER = 6.4
"""Mean width of a letter of the drawing, pixels."""


def ethogram_svg(behaviour: Behaviour, title: str = "Ethogram", film: str | None = None) -> str:
    """Return the ethogram as a file of its own: title, legend, axis, one row for each bird, and notes.

    Args:
        behaviour: what the birds do.
        title: the heading.
        film: address of the film, relative to the file; None draws bouts without links.
    """
    axis = axis_of(behaviour.frames, behaviour.times_s)
    parts = [_text(_EDGE, 24, title, font_size=17, font_weight="bold")]
    legend, y = _svg_legend(behaviour, 42)
    top = y + 52
    bottom = top + _ROW * len(behaviour.track_id)
    parts += [*legend, *_svg_axis(axis, top, bottom)]
    for n, track in enumerate(behaviour.track_id.tolist()):
        y = top + _ROW * n
        parts.append(element("rect", x=_EDGE, y=y + 5, width=10, height=10, fill=css(track_colour(n)), stroke="#777"))
        parts += [_text(_EDGE + 17, y + 15, f"{track}"), *_svg_marks(behaviour, n, axis, y, film)]
    y = bottom + 8
    for note in [*behaviour.notes, *ethogram_notes(axis, film)]:
        for line in textwrap.wrap(note, 150):
            y += 16
            parts.append(_text(_EDGE, y, line, font_size=11, fill="#5b6872"))
    paper = element("rect", width=_WIDTH, height=y + 14, fill="#fff")
    view = {"xmlns": "http://www.w3.org/2000/svg", "viewBox": f"0 0 {_WIDTH} {y + 14}"}
    font = {"font_family": "system-ui, Roboto, Helvetica, Arial, sans-serif", "font_size": 12, "fill": "#1f2a33"}
    drawn = element("svg", paper, *parts, width=_WIDTH, height=y + 14, **font, **view)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{drawn}\n'


def _text(x: float, y: float, content: str, **attributes: object) -> Html:
    return element("text", content, x=f"{x:.1f}", y=f"{y:.1f}", **attributes)


def _svg_legend(behaviour: Behaviour, y: float) -> tuple[list[Html], float]:
    """Return the legend, and the y of its last line."""
    parts, x = [], float(_EDGE)
    for i in behaviour.shown:
        kind = behaviour.kinds[i]
        width = 44 + _LETTER * len(kind.name)
        if x + width > _WIDTH and x > _EDGE:
            x, y = float(_EDGE), y + 20
        thin = kind.colour is None
        fill = css(behaviour_colour(kind.colour))
        key = element("rect", x=f"{x:.1f}", y=y + 5 * thin, width=20, height=4 if thin else 13, fill=fill)
        parts += [key, _text(x + 26, y + 11, kind.name)]
        x += width
    return parts, y


def _svg_axis(axis: Axis, top: float, bottom: float) -> Iterator[Html]:
    for tick in axis.ticks():
        x = _LEFT + _PLOT * tick.place
        yield element("path", d=f"M{x:.1f} {top - 26}V{bottom}", stroke="#c5d0d7")
        yield _text(x + 4, top - 17, f"{tick.frame:,}")
        if tick.time is not None:
            yield _text(x + 4, top - 4, tick.time, fill="#5b6872", font_size=11)
    yield _text(_EDGE, top - 17, "frame")


def _svg_marks(behaviour: Behaviour, bird: int, axis: Axis, y: float, film: str | None) -> Iterator[Html]:
    for mark in marks_of(behaviour, bird, axis):
        kind = behaviour.kinds[mark.kind]
        x, width = _LEFT + _PLOT * mark.start / axis.columns, _PLOT * (mark.stop - mark.start) / axis.columns
        colour, thin = behaviour_colour(kind.colour), kind.colour is None
        place = {
            "x": f"{x:.2f}",
            "width": f"{width:.2f}",
            "y": y + (8 if thin else 1),
            "height": 4 if thin else _ROW - 4,
        }
        parts = [element("title", bout_title(behaviour, mark, bird)), element("rect", fill=css(colour), **place)]
        if not thin and width > _LETTER * len(kind.name) + 8:
            parts.append(_text(x + 4, y + 14, kind.name, fill=css(ink_on(colour)), font_size=11))
        href = film_at(film, mark)
        yield element("a", *parts, href=href) if href else element("g", *parts)
