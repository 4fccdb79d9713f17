"""Configs as YAML files: a file holds only the values that differ from its base."""

from __future__ import annotations

import dataclasses
import textwrap
import typing
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import Any

import yaml

from jaxfit.config.build import Config, build_config, plain_config
from jaxfit.config.checks import ConfigKeyError, first_key
from jaxfit.config.help import field_help
from jaxfit.errors import InputError

__all__ = ["OWN_FILE", "config_to_yaml", "documented_yaml", "read_config", "shipped_configs"]

OWN_FILE = {"own_file": True}
"""Metadata of a dataclass field that is a config with its own file: its value may be a name, or hold a `base`."""


def shipped_configs() -> list[str]:
    """Return the names of all configs that are part of jaxfit."""
    return sorted(file.stem for file in _shipped_folder().glob("*.yaml"))


def read_config(kind: type[Config], source: str | Path) -> Config:
    """Read a config from a YAML file.

    A file may name another file or a shipped config as its `base`. The file's values replace the base's values key by
    key. A field with the metadata `OWN_FILE` takes the name of a file, or a mapping with a `base` of its own; both
    replace the value in the file's base.

    Args:
        kind: the frozen dataclass to read.
        source: the name of a shipped config or the path of a YAML file.

    Raises:
        InputError: an unreadable file, an unknown key, a value of the wrong type or outside its range; the error names
            the file that holds the key, which may be a base.
    """
    layers = _layers(str(source), kind)
    try:
        return build_config(kind, reduce(_merge, (content for _, content in layers)))
    except ConfigKeyError as error:
        raise InputError(_origin(layers, error.key), error.problem, error.remedy) from None


def config_to_yaml(config: Any) -> str:
    """Return a config with all its values, defaults included, as YAML text that can be read back."""
    return yaml.safe_dump(plain_config(config), sort_keys=False, allow_unicode=True)


def documented_yaml(config: Any) -> str:
    """Return a config as `config_to_yaml` does, with the description of each key as a comment above the key."""
    return "\n".join(_documented_lines(config)) + "\n"


def _documented_lines(config: Any, comments: bool = True) -> Iterator[str]:
    """Yield the lines of a config as YAML, with the description of each key above the key if `comments`."""
    texts = field_help(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if comments:
            text = texts.get(field.name) or (type(value).__doc__ or "")
            yield from textwrap.wrap(text, 110, initial_indent="# ", subsequent_indent="# ")
        parts = value if isinstance(value, tuple) else [value]
        if not (parts and all(map(dataclasses.is_dataclass, parts))):
            plain = plain_config(value)
            style = None if isinstance(plain, dict | list) else False  # None: short lists and mappings on one line
            text = yaml.safe_dump({field.name: plain}, sort_keys=False, allow_unicode=True, default_flow_style=style)
            yield from text.splitlines()
            continue
        yield f"{field.name}:"
        is_list = isinstance(value, tuple)
        for i, part in enumerate(parts):
            if is_list:
                yield "  -"
            # only the first item of a list gets comments
            lines = _documented_lines(part, comments and i == 0)
            yield from textwrap.indent("\n".join(lines), "    " if is_list else "  ").splitlines()


def _shipped_folder() -> Path:
    """Return the folder of shipped configs: inside an installed package, beside the package in a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def _layers(source: str, kind: type, seen: tuple[str, ...] = ()) -> list[tuple[str, dict[str, Any]]]:
    """Return the files that make up a config, each with its values; later files replace values of earlier files."""
    if source in seen:
        raise InputError(source, "the `base` keys form a circle", " → ".join((*seen, source)))
    seen = (*seen, source)
    content = _parse(source)
    base, layers = content.pop("base", None), []
    if base is not None:
        layers = _layers(_resolve(base, source), kind, seen)
    for field in dataclasses.fields(typing.cast(Any, kind)):
        part = content.get(field.name)
        if "own_file" in field.metadata and (isinstance(part, str) or (isinstance(part, dict) and "base" in part)):
            base = part if isinstance(part, str) else part.pop("base")
            content[field.name] = {} if isinstance(part, str) else part
            nested = _layers(_resolve(base, source), typing.get_type_hints(kind)[field.name], seen)
            layers.append((source, {field.name: None}))  # the value in the file's own base does not count
            layers += [(file, {field.name: values}) for file, values in nested]
    return [*layers, (source, content)]


def _parse(source: str) -> dict[str, Any]:
    """Return the mapping that a YAML file or a shipped config holds."""
    shipped = shipped_configs()
    path = _shipped_folder() / f"{source}.yaml" if source in shipped else Path(source)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        remedy = f"give a YAML file or one of {', '.join(shipped)}"
        raise InputError(source, f"cannot read this config: {error}", remedy) from None
    except yaml.YAMLError as error:
        raise InputError(source, f"is not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise InputError(source, "holds no mapping of keys to values", "write `key: value` lines")
    return content


def _resolve(base: object, source: str) -> str:
    """Return the path of a base beside the file that names the base; otherwise the base is a shipped name."""
    path = Path(source).parent / f"{base}"
    return str(path) if path.is_file() else str(base)


def _origin(layers: list[tuple[str, dict[str, Any]]], path: str) -> str:
    """Return the last file that sets the value at a path, or that adds to the nearest enclosing mapping."""
    merged, found, origin = {}, None, layers[-1][0]
    for source, content in layers:
        merged, before = _merge(merged, content), found
        found, rest = merged, path.replace("[", ".")
        while isinstance(found, dict) and (split := first_key(found, rest))[0] in found:
            found, rest = found[split[0]], split[1]
        if found is not before:  # merging keeps a value that the file does not set
            origin = source
    return origin


def _merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return the values of `below`, replaced key by key by the values of `above`."""
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged
