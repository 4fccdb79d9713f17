"""Conversion between config dataclasses and plain dicts, lists and values; every key and value is checked."""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

from jaxfit.config.checks import ConfigKeyError, join_keys
from jaxfit.config.messages import known_names, shown

__all__ = ["Config", "build_config", "describes", "plain_config"]

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
            raise ConfigKeyError(join_keys(where, key), "is not a known key", known_names(key, fields))
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
    if origin is types.UnionType:
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
