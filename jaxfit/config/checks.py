"""Checks of single values, and the texts of their messages."""

from __future__ import annotations

import dataclasses
import difflib
import reprlib
from collections.abc import Callable, Iterable
from typing import Any

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import CONFIG_NUMBER

_MAX_NAMES = 8


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
    more = f", … ({len(listed) - _MAX_NAMES} more)" if len(listed) > _MAX_NAMES else ""
    text = f"known: {', '.join(listed[:_MAX_NAMES])}{more}"
    return f"did you mean {close[0]}? {text}" if close else text


class ConfigKeyError(InputError):
    """An error about one config key, which is given by its path such as ``stages[0].steps``.

    The message reads "`key` problem (remedy)". `read_config` adds the name of the file that holds the key.
    """

    def __init__(self, key: str, problem: str, remedy: str = ""):
        self.key, self.key_problem = key, problem
        super().__init__("config", f"`{key}` {problem}" if key else f"the config {problem}", remedy)

    def within(self, where: str) -> ConfigKeyError:
        """Return the same error with the key's path extended by `where`, the path of the key's own config."""
        path = join_keys(where, self.key) if self.key else where
        return ConfigKeyError(path, self.key_problem, self.remedy)


def join_keys(where: str, key: object) -> str:
    """Return the path of `key` in the config at the path `where`; an empty `where` is the whole config."""
    return f"{where}.{key}" if where else f"{key}"


def first_key(parent: Any, path: str) -> tuple[str, str]:
    """Return the first key of a path and the rest of the path.

    A key of the mapping `parent` may contain dots (a term's name); the longest key that fits is the first key.
    """
    keys = map(str, parent) if isinstance(parent, dict) else []
    known = [key for key in keys if path == key or path.startswith(f"{key}.")]
    key = max(known, key=len) if known else path.partition(".")[0]
    return key, path[len(key) + 1 :]


def require(holds: bool, key: str, problem: str, remedy: str = "") -> None:
    """Raise a ConfigKeyError about `key` unless a condition holds."""
    if not holds:
        raise ConfigKeyError(key, problem, remedy)


def require_within(config: Any, least: float, most: float, *keys: str) -> None:
    """Raise a ConfigKeyError unless the values of some fields are within `least` and `most`; None is allowed."""
    _require_each(config, keys, lambda value: least <= value <= most, f"{least} to {_shown(most)}")


def require_positive(config: Any, most: float, *keys: str) -> None:
    """Raise a ConfigKeyError unless the values of some fields are above 0 and at most `most`; None is allowed."""
    _require_each(config, keys, lambda value: 0 < value <= most, f"a number above 0, at most {_shown(most)}")


def require_fraction(config: Any, *keys: str) -> None:
    """Raise a ConfigKeyError unless the values of some fields are within 0 and 1; None is allowed."""
    _require_each(config, keys, lambda value: 0 <= value <= 1, "a number within 0 and 1")


def is_number(value: Any) -> bool:
    """Return whether a value is a number within 0 and `limits.CONFIG_NUMBER`; true and false are not numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= CONFIG_NUMBER


def _shown(number: float) -> str:
    return f"{number:,}" if isinstance(number, int) else f"{number:g}"


def _require_each(config: Any, keys: tuple[str, ...], fits: Callable[[Any], bool], expected: str) -> None:
    nullable = {field.name for field in dataclasses.fields(config) if "None" in str(field.type)}
    for key in keys:
        value = getattr(config, key)
        remedy = f"expected {expected}{', or null' if key in nullable else ''}"
        require(value is None or fits(value), key, f"is {value}", remedy)
