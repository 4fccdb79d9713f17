"""Short texts of values and of known names, for messages about configs."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable
from typing import Any

__all__ = ["known_names", "shown"]

_MOST_NAMES = 8


class _Shown(reprlib.Repr):
    """Texts of at most some ten values, written as in YAML: null, true, false."""

    def __init__(self):
        super().__init__()
        self.maxlevel, self.maxdict, self.maxlist, self.maxtuple = 3, 4, 4, 4
        self.maxstring = self.maxother = self.maxlong = 60

    def repr_bool(self, value: bool, _level: int) -> str:
        return "true" if value else "false"

    def repr_NoneType(self, _value: None, _level: int) -> str:  # noqa: N802, the name that reprlib looks for
        return "null"

    def repr_int(self, value: int, level: int) -> str:
        if abs(value) >= 2**200:  # Python refuses to write numbers of more than 4,300 digits
            return f"a number of {value.bit_length()} bits"
        return super().repr_int(value, level)


_texts = _Shown()


def shown(value: Any) -> str:
    """Return a short text of a config value for a message: null, true, 'text', [1, 2, ...]."""
    return _texts.repr(value)


def known_names(name: object, names: Iterable[object]) -> str:
    """Return the remedy for an unknown name: some known names, the most similar names first."""

    def unlike(known: str) -> float:
        return -difflib.SequenceMatcher(None, str(name)[:100].lower(), known[:100].lower()).ratio()

    listed = sorted(map(str, names), key=unlike)
    if not listed:
        return ""
    close = difflib.get_close_matches(str(name)[:100], listed, n=1)
    more = f", … ({len(listed) - _MOST_NAMES} more)" if len(listed) > _MOST_NAMES else ""
    text = f"known: {', '.join(listed[:_MOST_NAMES])}{more}"
    return f"did you mean {close[0]}? {text}" if close else text
