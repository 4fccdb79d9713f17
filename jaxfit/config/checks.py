"""Checks of config values, and the error that names the key of a wrong value."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from jaxfit.errors import InputError
from jaxfit.limits import CONFIG_NUMBER

__all__ = [
    "ConfigKeyError",
    "first_key",
    "is_number",
    "join_keys",
    "require",
    "require_fraction",
    "require_positive",
    "require_within",
]


class ConfigKeyError(InputError):
    """An error about one config key, which is given by its path such as ``stages[0].steps``.

    The message reads "`key` problem (remedy)". `read_config` adds the name of the file that holds the key.
    """

    def __init__(self, key: str, problem: str, remedy: str = ""):
        self.key, self.key_problem = key, problem
        super().__init__("config", f"`{key}` {problem}" if key else f"the config {problem}", remedy)

    def within(self, where: str) -> ConfigKeyError:
        """Return the same error with the key's path extended by `where`, the path of the key's own config."""
        return ConfigKeyError(join_keys(where, self.key), self.key_problem, self.remedy)


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
