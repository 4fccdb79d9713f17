"""Single values of a config by their path, such as ``terms.velocity`` or ``stages.mask.steps``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from jaxfit.config.yaml_file import Config, ConfigKeyError, build_config, plain_config

__all__ = ["get_value", "with_values"]


def with_values(config: Config, values: Mapping[str, Any]) -> Config:
    """The config with other values at some paths.

    A part of a path is a key, or the name or number of a stage (``stages.mask.steps``, ``stages[1].steps``). A number
    for a term is its weight and leaves its settings alone. A text that begins with ``=`` stands for the value at the
    path behind it, after all others have been set.

    Raises:
        ConfigKeyError: a path that leads nowhere, or a config that makes no sense.
    """
    plain = plain_config(config)
    later = {path: value for path, value in values.items() if isinstance(value, str) and value.startswith("=")}
    for path in (*(path for path in values if path not in later), *later):
        value = _get(plain, later[path][1:], path) if path in later else values[path]
        holder, key, of_terms = _find(plain, path, path)
        if of_terms and isinstance(holder.get(key), dict) and not isinstance(value, dict):
            holder, key = holder[key], "weight"  # a term with settings
        holder[key] = value
    return build_config(type(config), plain)


def get_value(config: Any, path: str) -> Any:
    """The value at a path; of a term with settings its weight.

    Raises:
        ConfigKeyError: a path that leads nowhere.
    """
    return _get(plain_config(config), path, path)


def _get(plain: Any, path: str, asked: str) -> Any:
    holder, key, of_terms = _find(plain, path, asked)
    if isinstance(holder, dict) and key not in holder:
        raise ConfigKeyError(asked, f"`{asked}` asks for `{path}`, which is not set", _known(holder))
    value = holder[key]
    return value.get("weight", 1.0) if of_terms and isinstance(value, dict) else value


def _find(plain: Any, path: str, asked: str) -> tuple[Any, Any, bool]:
    """What holds the last part of a path, that part, and whether it names a term; terms' own names may hold dots."""
    holder: Any = plain
    rest, of_terms = re.sub(r"\[(\d+)\]", r".\1", path), False
    while True:
        key: Any
        key, rest = _step(holder, rest)
        if isinstance(holder, list):
            key = _position(holder, key, asked)
        if not rest:
            return holder, key, of_terms
        below = holder[key] if isinstance(holder, list) else holder.get(key)
        if of_terms and isinstance(below, int | float):
            below = holder[key] = {"weight": below}  # a setting comes to stand beside it
        if not isinstance(below, dict | list):
            raise ConfigKeyError(asked, f"`{path}` leads nowhere: there is no `{key}`", _known(holder))
        holder, of_terms = below, key in ("terms", "override") and isinstance(below, dict)


def _step(holder: Any, rest: str) -> tuple[str, str]:
    held = [key for key in holder if rest == key or rest.startswith(f"{key}.")] if isinstance(holder, dict) else []
    key = max(held, key=len) if held else rest.partition(".")[0]
    return key, rest[len(key) + 1 :]


def _position(stages: list[Any], key: str, asked: str) -> int:
    names = [each.get("name") for each in stages if isinstance(each, dict)]
    if key in names:
        return names.index(key)
    if key.isdigit() and int(key) < len(stages):
        return int(key)
    raise ConfigKeyError(asked, f"`{asked}` names {key!r}", f"known: {', '.join(map(str, names))}")


def _known(holder: Any) -> str:
    return f"known here: {', '.join(map(str, holder))}" if isinstance(holder, dict) else ""
