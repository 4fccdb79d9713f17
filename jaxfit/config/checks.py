"""The error about a config key, and the texts of its message."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable
from typing import Any

from jaxfit.foundation.errors import InputError, shortened


def shown(value: Any) -> str:
    """Return a short text of a config value for a message, as JSON: null, true, "text", [1, 2]."""
    return shortened(json.dumps(value, ensure_ascii=False, default=str), 60)


def known_names(name: object, names: Iterable[object]) -> str:
    """Return the remedy for an unknown name: the eight most similar known names, the most similar name first."""
    known = list(map(str, names))
    listed = difflib.get_close_matches(str(name), known, n=8, cutoff=0)
    if not listed:
        return ""
    hint = f"did you mean {listed[0]}? " if difflib.get_close_matches(str(name), listed[:1]) else ""
    others = f", … ({len(known) - len(listed)} more)" if len(known) > len(listed) else ""
    return f"{hint}known: {', '.join(listed)}{others}"


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
    """Return the path of a key, or of the item of a number, in the value at the path `where` ("" is the config)."""
    if isinstance(key, int):
        return f"{where}[{key}]"
    return f"{where}.{key}" if where else f"{key}"


def require(holds: bool, key: str, problem: str, remedy: str = "") -> None:
    """Raise a ConfigKeyError about `key` unless a condition holds."""
    if not holds:
        raise ConfigKeyError(key, problem, remedy)
