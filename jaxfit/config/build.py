"""Config dataclasses ↔ plain values, single keys by their path, descriptions of keys."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import re
import types
import typing
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Any, Literal, TypeVar

from jaxfit.config.checks import ConfigKeyError, first_key, join_keys, known_names, shown

Config = TypeVar("Config")


def build_config(kind: type[Config], values: Any, where: str = "") -> Config:
    """Return a config dataclass built from plain values.

    Args:
        kind: the frozen dataclass to build. An attribute `shipped` names a shipped config that sets all required keys.
        values: plain values, as `plain_config` returns them; keys with a default may be absent.
        where: path of this config inside a larger one, for messages.

    Raises:
        ConfigKeyError: an unknown key, a missing key, a value of the wrong type or outside its range.
    """
    if not isinstance(values, dict):
        raise ConfigKeyError(where, f"must be a mapping, not {shown(values)}")
    fields = {field.name: field for field in dataclasses.fields(typing.cast(Any, kind))}
    for key in values:
        if key not in fields:
            removed = getattr(kind, "removed", {}).get(key)
            problem = "was removed" if removed else "is not a known key"
            raise ConfigKeyError(join_keys(where, key), problem, removed or known_names(key, fields))
    for name, field in fields.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and name not in values:
            shipped = getattr(kind, "shipped", None)
            remedy = f"add the key, or start from `base: {shipped}`" if shipped else "add the key"
            raise ConfigKeyError(join_keys(where, name), "is missing", remedy)
    hints = _type_hints(kind)
    built = {key: _build_value(hints[key], value, join_keys(where, key)) for key, value in values.items()}
    try:
        return kind(**built)
    except ConfigKeyError as error:
        raise error.within(where) from None


_type_hints = functools.cache(typing.get_type_hints)


def plain_config(value: Any) -> Any:
    """Return a config, or a part of a config, as dicts, lists and plain values."""
    if dataclasses.is_dataclass(value):
        return {field.name: plain_config(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: plain_config(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain_config(item) for item in value]
    return value


def describes(plain: Any, config: Any) -> bool:
    """Return whether plain values, as `plain_config` returns them, describe a config or a part of a config.

    Absent keys have their default values. Nothing is built, so that no term is imported.
    """
    if dataclasses.is_dataclass(config):
        fields = {field.name: field for field in dataclasses.fields(config)}
        if not isinstance(plain, dict) or not plain.keys() <= fields.keys():
            return False
        return all(
            describes(plain[name], value) if name in plain else value == _default(field)
            for name, field in fields.items()
            for value in [getattr(config, name)]
        )
    if isinstance(config, Mapping):
        same_keys = isinstance(plain, dict) and plain.keys() == config.keys()
        return same_keys and all(describes(plain[key], value) for key, value in config.items())
    if isinstance(config, tuple | list):
        return isinstance(plain, list) and len(plain) == len(config) and all(map(describes, plain, config))
    return isinstance(plain, bool) == isinstance(config, bool) and plain == config


def _default(field: dataclasses.Field[Any]) -> Any:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _build_value(hint: Any, value: Any, where: str) -> Any:
    """Return a value of the type `hint`, or raise a ConfigKeyError about the key `where`."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return build_config(typing.cast(type, hint), value, where)
    if origin is Literal:
        if not isinstance(value, str) or value not in arguments:
            raise ConfigKeyError(where, f"is {shown(value)}", f"expected one of {', '.join(arguments)}")
        return value
    if origin in (types.UnionType, typing.Union):  # `Literal[…] | None` has the second type
        options = [option for option in arguments if option is not types.NoneType]
        if value is None and len(options) < len(arguments):
            return None
        # a list belongs to a tuple type, any other value to the other type
        matches = (option for option in options if (typing.get_origin(option) is tuple) == isinstance(value, list))
        return _build_value(next(matches, options[0]), value, where)
    if origin is tuple:
        if not isinstance(value, list):
            raise ConfigKeyError(where, f"must be a list, not {shown(value)}")
        return tuple(_build_value(arguments[0], item, f"{where}[{i}]") for i, item in enumerate(value))
    if origin is Mapping:
        if not isinstance(value, dict):
            raise ConfigKeyError(where, f"must be a mapping, not {shown(value)}")
        for key in value:
            if not isinstance(key, str):
                raise ConfigKeyError(where, f"has the key {shown(key)}", "expected text as key: use quotes")
        return {key: _build_value(arguments[1], item, join_keys(where, key)) for key, item in value.items()}
    if isinstance(value, int) and abs(value) >= 2**63:
        raise ConfigKeyError(where, f"is {shown(value)}", "expected a number within 64 bits")
    if hint is Any:
        return value
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint) or (isinstance(value, bool) and hint is not bool):
        raise ConfigKeyError(where, f"is {shown(value)}", f"expected a value of type {hint.__name__}")
    return value


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


def field_help(kind: type) -> dict[str, str]:
    """Return field name → description of a config dataclass, from the docstrings below its fields."""
    definition: Any = ast.parse(inspect.getsource(kind)).body[0]
    return {
        ast.unparse(field.target): " ".join(str(ast.literal_eval(text.value)).split())
        for field, text in pairwise(definition.body)
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr)
    }


def option_help(kind: type, path: str) -> str:
    """Return the description and the default of the field at a path such as ``frames.start``, for `--help`."""
    *parents, name = path.split(".")
    for parent in parents:
        kind = typing.get_type_hints(kind)[parent]
    default = getattr(kind, name)  # a dataclass keeps a field's default as a class attribute
    text = field_help(kind)[name].rstrip(".")
    return (text if default in (None, ()) else f"{text} (default {default})").replace("%", "%%")
