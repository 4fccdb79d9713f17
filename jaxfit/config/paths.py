"""Access to single values of a config by their path, such as ``terms.velocity`` or ``stages.mask.steps``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from jaxfit.config.build import Config, build_config, plain_config
from jaxfit.config.checks import ConfigKeyError, first_key
from jaxfit.config.messages import known_names

__all__ = ["get_value", "get_values", "with_values"]


def with_values(config: Config, values: Mapping[str, Any]) -> Config:
    """Return the config with other values at some paths.

    A part of a path is a key, or the name or the number of a stage (``stages.mask.steps``, ``stages[1].steps``). A
    number for a term replaces the term's weight and keeps the term's settings. A text that begins with ``=`` stands for
    the value at the path after the ``=``, after all other values are set.

    Args:
        config: a config dataclass, which is not changed.
        values: path → new value.

    Raises:
        ConfigKeyError: an unknown path, or a value that the config does not allow.
    """
    plain = plain_config(config)
    references = {path: value[1:] for path, value in values.items() if isinstance(value, str) and value[:1] == "="}
    for path in sorted(values, key=lambda path: path in references):  # references last
        value = _get(plain, references[path], path) if path in references else values[path]
        parent, key, is_term = _locate(plain, path, path)
        if is_term and isinstance(parent.get(key), dict) and not isinstance(value, dict):
            parent, key = parent[key], "weight"  # a term with settings
        parent[key] = value
    return build_config(type(config), plain)


def get_value(config: Any, path: str) -> Any:
    """Return the value at a path; for a term with settings, the term's weight.

    Raises:
        ConfigKeyError: an unknown path.
    """
    return get_values(config, [path])[path]


def get_values(config: Any, paths: Iterable[str]) -> dict[str, Any]:
    """Return path → value at the path, as `get_value` returns it.

    Raises:
        ConfigKeyError: an unknown path.
    """
    plain = plain_config(config)
    return {path: _get(plain, path, path) for path in paths}


def _get(plain: Any, path: str, requested: str) -> Any:
    parent, key, is_term = _locate(plain, path, requested)
    if isinstance(parent, dict) and key not in parent:
        raise ConfigKeyError(requested, f"refers to `{path}`, which is not set", known_names(key, parent))
    value = parent[key]
    return value.get("weight", 1.0) if is_term and isinstance(value, dict) else value


def _locate(plain: Any, path: str, requested: str) -> tuple[Any, Any, bool]:
    """Return the mapping or list that holds the last part of a path, that part, and whether the part names a term.

    Args:
        plain: the config as plain values.
        path: the path to follow; a term's name may contain dots.
        requested: the path to name in errors; differs from `path` for a reference (``=path``).
    """
    parent: Any = plain
    rest, is_term = re.sub(r"\[(\d+)\]", r".\1", path), False
    while True:
        key: Any
        key, rest = first_key(parent, rest)
        if isinstance(parent, list):
            key = _stage_index(parent, key, requested)
        if not rest:
            return parent, key, is_term
        value = parent[key] if isinstance(parent, list) else parent.get(key)
        if is_term and isinstance(value, int | float):
            value = parent[key] = {"weight": value}  # the term gets a setting beside its weight
        if not isinstance(value, dict | list):
            detail = "" if path == requested else f"`{path}`: "
            known = known_names(key, parent) if isinstance(parent, dict) else ""
            raise ConfigKeyError(requested, f"is an unknown path: {detail}there is no `{key}`", known)
        parent, is_term = value, key in ("terms", "override") and isinstance(value, dict)


def _stage_index(stages: list[Any], key: str, requested: str) -> int:
    names = [stage.get("name") for stage in stages if isinstance(stage, dict)]
    if key in names:
        return names.index(key)
    for i in range(len(stages)):
        if key == str(i):
            return i
    raise ConfigKeyError(requested, f"names the unknown stage {key!r}", known_names(key, names))
