"""Configs as YAML files that hold overrides only: read into frozen dataclasses, every key and value checked."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml

from jaxfit.errors import InputError

__all__ = [
    "OWN_FILE",
    "ConfigKeyError",
    "build_config",
    "config_to_yaml",
    "plain_config",
    "read_config",
    "require",
    "shipped_files",
]

Config = TypeVar("Config")

OWN_FILE = {"own_file": True}
"""Metadata of a dataclass field that is a config by itself: its value may be a file's name, or hold a `base`."""


class ConfigKeyError(InputError):
    """An InputError about one key, by its path such as ``stages[0].steps``; reading a file adds the file's name."""

    def __init__(self, key: str, problem: str, remedy: str = ""):
        self.key = key
        super().__init__("config", problem, remedy)


def require(holds: bool, key: str, problem: str, remedy: str = "") -> None:
    """Raise the ConfigKeyError "`key` problem (remedy)" unless something holds."""
    if not holds:
        raise ConfigKeyError(key, f"`{key}` {problem}", remedy)


def shipped_files() -> list[str]:
    """Names of the configs that come with jaxfit, of whatever kind."""
    return sorted(file.stem for file in _shipped_folder().glob("*.yaml"))


def _shipped_folder() -> Path:
    """Return the folder of shipped configs: inside an installed package, beside the package in a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def read_config(kind: type[Config], source: str | Path, base: str) -> Config:
    """Read a config by the name of a shipped one or the path of a YAML file.

    A file may name another as its `base`; what it then says is laid over it, key by key. A field marked
    `OWN_FILE` takes such a name alone, or a mapping with a `base` of its own; either replaces what the file's
    own base says there.

    Args:
        kind: the frozen dataclass that is to come of it.
        source: name or path.
        base: the shipped config that a file without a needed key may start from, for the message.

    Raises:
        InputError: an unreadable file, an unknown key, a value of the wrong kind or that makes no sense; it names
            the file that holds the key, which may be a base.
    """
    values, origins = _read(str(source), kind, seen=())
    try:
        return _build(kind, values, "", base)
    except ConfigKeyError as error:
        raise InputError(_origin(origins, error.key, str(source)), error.problem, error.remedy) from None


def build_config(kind: type[Config], values: dict[str, Any]) -> Config:
    """A config from plain values, as `plain_config` gives them.

    Raises:
        ConfigKeyError: an unknown key, a value of the wrong kind or that makes no sense.
    """
    return _build(kind, values, "", "paper")


def config_to_yaml(config: Any) -> str:
    """The whole config, defaults included, as a YAML text that reads back."""
    return yaml.safe_dump(plain_config(config), sort_keys=False, allow_unicode=True)


def _read(source: str, kind: type, seen: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, str]]:
    """A file laid over its bases, and for each key's path the file that it comes from."""
    if source in seen:
        raise InputError(source, "`base` goes in a circle", " → ".join((*seen, source)))
    seen = (*seen, source)
    content = _parse(source)
    values, origins = {}, {}
    base = content.pop("base", None)
    if base is not None:
        values, origins = _read(_beside(base, source), kind, seen)
    below: dict[str, str] = {}
    for name, part in _own_files(kind):
        if isinstance(content.get(name), str):
            content[name] = {"base": content[name]}
        if isinstance(content.get(name), dict) and "base" in content[name]:
            base = content[name].pop("base")
            values[name], part_origins = _read(_beside(base, source), part, seen)
            origins = _without(origins, name)
            below |= {f"{name}.{key}": origin for key, origin in part_origins.items()}
    origins |= below
    for path, is_mapping in _paths(content):
        if not is_mapping:  # it replaces whatever stood there
            origins = _without(origins, path)
        origins[path] = source
    return _merge(values, content), origins


def _parse(source: str) -> dict[str, Any]:
    shipped = shipped_files()
    try:
        if source in shipped:
            text = (_shipped_folder() / f"{source}.yaml").read_text(encoding="utf-8")
        else:
            text = Path(source).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            source, f"cannot read this config: {error}", f"give a YAML file or one of {', '.join(shipped)}"
        ) from None
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InputError(source, f"is not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise InputError(source, "holds no mapping of keys to values", "write `key: value` lines")
    return content


def _beside(base: object, source: str) -> str:
    """A base that lies beside the file that names it wins over a shipped one."""
    path = Path(source).parent / f"{base}"
    return str(path) if path.is_file() else str(base)


def _own_files(kind: type) -> list[tuple[str, type]]:
    hints = typing.get_type_hints(kind)
    return [(f.name, hints[f.name]) for f in dataclasses.fields(kind) if "own_file" in f.metadata]


def _without(origins: dict[str, str], path: str) -> dict[str, str]:
    return {key: origin for key, origin in origins.items() if not key.startswith(f"{path}.")}


def _paths(content: dict[str, Any], where: str = "") -> Iterator[tuple[str, bool]]:
    """Path of every key, and whether a mapping stands there; lists are taken whole."""
    for key, value in content.items():
        yield f"{where}{key}", isinstance(value, dict)
        if isinstance(value, dict):
            yield from _paths(value, f"{where}{key}.")


def _origin(origins: Mapping[str, str], key: str, top: str) -> str:
    """The file that says `key`; of a key that no file says, the one that says what it should stand in."""
    while key and key not in origins:
        key = key[: max(key.rfind("."), key.rfind("["), 0)]
    return origins.get(key, top)


def _merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def _build(kind: type, values: Any, where: str, base: str) -> Any:
    """A dataclass from plain values; every key and value is checked against its fields."""
    if not isinstance(values, dict):
        raise ConfigKeyError(
            where.rstrip("."), f"{where or 'the config'} must be a mapping, not {type(values).__name__}"
        )
    hints = typing.get_type_hints(kind)
    names = [f.name for f in dataclasses.fields(kind)]
    for key in values:
        if key not in names:
            raise ConfigKeyError(f"{where}{key}", f"unknown key `{where}{key}`", f"known here: {', '.join(names)}")
    for f in dataclasses.fields(kind):
        required = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        if required and f.name not in values:
            raise ConfigKeyError(
                f"{where}{f.name}", f"`{where}{f.name}` is missing", f"add it, or start from `base: {base}`"
            )
    built = {key: _value(hints[key], value, f"{where}{key}", base) for key, value in values.items()}
    try:
        return kind(**built)
    except ConfigKeyError as error:  # a check of the dataclass itself, which does not know where it stands
        problem = error.problem.replace(f"`{error.key}`", f"`{where}{error.key}`", 1)
        raise ConfigKeyError(f"{where}{error.key}", problem, error.remedy) from None


def _value(hint: Any, value: Any, where: str, base: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return _build(typing.cast(type, hint), value, f"{where}.", base)
    if origin is Literal:
        if value not in arguments:
            raise ConfigKeyError(where, f"`{where}` is {value!r}", f"one of {', '.join(arguments)}")
        return value
    if origin is tuple:
        if not isinstance(value, list):
            raise ConfigKeyError(where, f"`{where}` must be a list, not {value!r}")
        return tuple(_value(arguments[0], v, f"{where}[{i}]", base) for i, v in enumerate(value))
    if origin is types.UnionType:
        return _one_of(arguments, value, where, base)
    if origin is Mapping:
        if not isinstance(value, dict):
            raise ConfigKeyError(where, f"`{where}` must be a mapping, not {value!r}")
        return {k: _value(arguments[1], v, f"{where}.{k}", base) for k, v in value.items()}
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is Any:
        return value
    if not isinstance(value, hint) or (isinstance(value, bool) and hint is not bool):
        raise ConfigKeyError(where, f"`{where}` is {value!r}", f"a value of type {hint.__name__} is expected")
    return value


def _one_of(kinds: tuple[Any, ...], value: Any, where: str, base: str) -> Any:
    if value is None and type(None) in kinds:
        return None
    for kind in kinds:
        if (typing.get_origin(kind) is tuple) == isinstance(value, list) and kind is not type(None):
            return _value(kind, value, where, base)
    raise ConfigKeyError(where, f"`{where}` is {value!r}")


def plain_config(value: Any) -> Any:
    """A config, or a part of one, as dicts, lists and plain values."""
    if dataclasses.is_dataclass(value):
        return {f.name: plain_config(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {k: plain_config(v) for k, v in value.items()}
    if isinstance(value, tuple | list):
        return [plain_config(v) for v in value]
    return value
