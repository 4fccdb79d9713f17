"""The decorator of config dataclasses, their plain values, single keys by their path, and descriptions of keys."""

from __future__ import annotations

import copy
import dataclasses
import functools
import json
import re
import typing
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, TypeVar

import pydantic
import pydantic.dataclasses
import pydantic_core
from annotated_types import Ge, Le

from jaxfit.config.checks import ConfigKeyError, join_keys, known_names, shown

Config = TypeVar("Config")
Fraction = Annotated[float, Ge(0), Le(1)]
"""A number within 0 and 1."""

_SETTINGS = pydantic.ConfigDict(
    extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True, arbitrary_types_allowed=True
)
_EXPECTED = {
    "bool_type": "true or false",
    "int_type": "a whole number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "string_type": "text",
    "tuple_type": "a list",
    "list_type": "a list",
    "mapping_type": "a mapping of keys to values",
    "dict_type": "a mapping of keys to values",
    "dataclass_type": "a mapping of keys to values",
    "too_short": "at least {min_length} value",
    "literal_error": "{expected}",
    "greater_than": "a number above {gt:g}",
    "greater_than_equal": "{ge:g} or more",
    "less_than": "a number below {lt:g}",
    "less_than_equal": "{le:g} or less",
}
"""Type of an error of pydantic → the value that was expected."""


@typing.dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, pydantic.Field))
def config_dataclass(kind: type[Config]) -> type[Config]:
    """Make a class an immutable dataclass that checks the types and ranges of its values; used as a decorator.

    A whole number is accepted where a fraction is expected; true and false are no numbers. Checks of several fields
    stand in `__post_init__` and raise `ConfigKeyError`, and so does the dataclass. The docstrings below the fields are
    the descriptions of the keys. A class attribute `shipped` names a shipped config that sets all required keys;
    `removed` maps keys of earlier versions to remedies.
    """
    built: Any = pydantic.dataclasses.dataclass(kind, frozen=True, config=_SETTINGS)
    construct = built.__init__

    @functools.wraps(construct)
    def checked(self: Any, *values: Any, **named: Any) -> None:
        try:
            construct(self, *values, **named)
        except pydantic.ValidationError as error:
            given = dict(zip(_fields(built), values, strict=False)) | named
            raise _key_error(error, built, given) from None

    built.__init__ = checked
    return built


def build_config(kind: type[Config], values: Any) -> Config:
    """Return a config dataclass built from plain values.

    Args:
        kind: the config dataclass to build.
        values: plain values, as `plain_config` returns them; keys with a default may be absent.

    Raises:
        ConfigKeyError: an unknown key, a missing key, a value of the wrong type or outside its range.
    """
    try:
        # JSON has the types of YAML: pydantic then takes a list for a tuple, but no text for a number
        return pydantic.TypeAdapter(kind).validate_json(json.dumps(_without_unused(kind, values)))
    except pydantic.ValidationError as error:
        raise _key_error(error, kind, values) from None


def _fields(kind: Any) -> dict[str, Any]:
    return kind.__pydantic_fields__


def _kind_of_key(kind: Any, key: Any) -> Any:
    """Return the config dataclass of the values of a key; None for plain values."""
    annotation = _fields(kind)[key].annotation if key in _fields(kind) else None
    hints = (annotation, *typing.get_args(annotation))
    return next((hint for hint in hints if dataclasses.is_dataclass(hint)), None)


def _without_unused(kind: Any, values: Any) -> Any:
    """Return plain values without the removed options that are off, which the configs of earlier results hold."""
    if kind is None or not isinstance(values, dict):
        return values
    removed = getattr(kind, "removed", {})
    used = {key: value for key, value in values.items() if value is not False or key not in removed}
    return {key: _without_unused(_kind_of_key(kind, key), value) for key, value in used.items()}


def _key_error(error: pydantic.ValidationError, kind: Any, values: Any) -> ConfigKeyError:
    """Return one error of pydantic as an error that names a key.

    Args:
        error: the error of pydantic.
        kind: the config dataclass.
        values: the values that were given to the dataclass.
    """
    # a wrong key explains why another key is missing
    first = min(error.errors(include_url=False), key=lambda problem: problem["type"] != "unexpected_keyword_argument")
    where = ""
    part: Any
    for part in first["loc"]:  # also holds names of types, which are no keys
        if isinstance(part, int) and isinstance(values, dict):
            part = list(_fields(kind))[part]  # a positional argument
        if part in values if isinstance(values, dict) else isinstance(values, list | tuple) and isinstance(part, int):
            where, values = join_keys(where, part), values[part]
            kind = _kind_of_key(kind, part) or kind
    context = first.get("ctx", {})
    if isinstance(cause := context.get("error"), ConfigKeyError):
        return cause.within(where)
    key = str(first["loc"][-1]) if first["loc"] else ""
    if first["type"] == "unexpected_keyword_argument":
        if remedy := getattr(kind, "removed", {}).get(key):
            return ConfigKeyError(where, "was removed", remedy)
        return ConfigKeyError(where, "is not a known key", known_names(key, _fields(kind)))
    if first["type"] == "missing":
        shipped = getattr(kind, "shipped", None)
        remedy = f"add the key, or start from `base: {shipped}`" if shipped else "add the key"
        return ConfigKeyError(join_keys(where, key), "is missing", remedy)
    expected = _EXPECTED.get(first["type"], first["msg"]).format(**context)
    return ConfigKeyError(where, f"is {shown(first['input'])}", f"expected {expected}")


def plain_config(value: Any) -> Any:
    """Return a config, or a part of a config, as dicts, lists and plain values."""
    return pydantic_core.to_jsonable_python(value)


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

    def set_value(path: str, value: Any) -> None:
        parent, key, is_term = _locate(plain, path, path)
        if is_term and isinstance(parent.get(key), dict) and not isinstance(value, dict):
            parent, key = parent[key], "weight"  # a term with settings
        parent[key] = value

    for path, value in values.items():
        if path not in references:
            set_value(path, value)
    path_at = {_place(plain, path, path): path for path in references}
    for path, target in references.items():
        followed = {path}
        while (following := path_at.get(_place(plain, target, path))) is not None:
            if following in followed:
                raise ConfigKeyError(path, "refers to itself", "give one of the values")
            followed.add(following)
            target = references[following]
        set_value(path, _get(plain, target, path))
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


def _locate(plain: Any, path: str, requested: str, passed: list[Any] | None = None) -> tuple[Any, Any, bool]:
    """Return the mapping or list that holds the last part of a path, that part, and whether the part names a term.

    Args:
        plain: the config as plain values.
        path: the path to follow; a term's name may contain dots.
        requested: the path to name in errors; differs from `path` for a reference (``=path``).
        passed: receives the keys before the last key.
    """
    passed = [] if passed is None else passed
    parent: Any = plain
    rest, is_term = re.sub(r"\[(\d+)\]", r".\1", path), False
    while True:
        key: Any
        key, rest = _first_key(parent, rest)
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
        passed.append(key)
        parent, is_term = value, key in ("terms", "override") and isinstance(value, dict)


def _place(plain: Any, path: str, requested: str) -> tuple[Any, ...]:
    """Return the keys of a path in one spelling: stages by their numbers, and a term by its weight."""
    keys: list[Any] = []
    _, key, is_term = _locate(copy.deepcopy(plain), path, requested, keys)
    return (*keys, key, *(["weight"] if is_term else []))


def _first_key(parent: Any, path: str) -> tuple[str, str]:
    """Return the first key of a path and the rest of the path.

    A key of the mapping `parent` may contain dots (a term's name); the longest key that fits is the first key.
    """
    known = [key for key in parent if f"{path}.".startswith(f"{key}.")] if isinstance(parent, dict) else []
    key = max(known, key=len) if known else path.partition(".")[0]
    return key, path[len(key) + 1 :]


def _stage_index(stages: list[Any], key: str, requested: str) -> int:
    names = [stage.get("name") for stage in stages if isinstance(stage, dict)]
    if key in names:
        if names.count(key) > 1:
            raise ConfigKeyError(requested, f"names {names.count(key)} stages", "name a stage by its number, from 0")
        return names.index(key)
    numbers = list(map(str, range(len(stages))))
    if key in numbers:
        return numbers.index(key)
    raise ConfigKeyError(requested, f"names the unknown stage {key!r}", known_names(key, names))


def field_help(kind: type) -> dict[str, str]:
    """Return field name → description of a config dataclass, from the docstrings below its fields."""
    return {name: " ".join((field.description or "").split()) for name, field in _fields(kind).items()}


def option_help(kind: type, path: str) -> str:
    """Return the description and the default of the field at a path such as ``frames.start``, for `--help`."""
    *parents, name = path.split(".")
    for parent in parents:
        kind = _fields(kind)[parent].annotation
    default = getattr(kind, name)  # a dataclass keeps a field's default as a class attribute
    text = field_help(kind)[name].rstrip(".")
    return (text if default in (None, ()) else f"{text} (default {default})").replace("%", "%%")
