"""Rendering of the templates of the report (Jinja2), in which all values are escaped."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from jaxfit.foundation.errors import counted, one_line
from jaxfit.view.colours import (
    CONFIDENCE_COLOURS,
    FLAG_COLOURS,
    NO_POSE_COLOUR,
    behaviour_colour,
    css,
    ink_on,
    track_colour,
)
from jaxfit.view.report.axis import duration

TEMPLATES = Path(__file__).parent / "templates"
STYLE = TEMPLATES / "style.css"
"""The style sheet of reports and of the viewer."""


def rendered(template: str, **values: Any) -> Markup:
    """Return a template of `templates/` with its values."""
    return Markup(_environment.get_template(template).render(**values))


def _visible(value: Any) -> Any:
    """Return a text with visible escapes in place of control characters other than line breaks."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return "\n".join(one_line(line) for line in value.split("\n"))


_environment = Environment(
    loader=FileSystemLoader(TEMPLATES),
    autoescape=True,
    finalize=_visible,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_environment.filters |= {
    "comma": lambda number: f"{number:,}",
    "counted": counted,
    "css": css,
    "duration": duration,
    "quoted": shlex.quote,
}
_environment.globals |= {
    "behaviour_colour": behaviour_colour,
    "confidence_colours": CONFIDENCE_COLOURS,
    "flag_colours": FLAG_COLOURS,
    "ink_on": ink_on,
    "no_pose_colour": NO_POSE_COLOUR,
    "track_colour": track_colour,
}
