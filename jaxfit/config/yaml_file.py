"""Configs as YAML files: a file holds only the values that differ from its base."""

from __future__ import annotations

import dataclasses
import os
import textwrap
import typing
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from jaxfit.config.build import Config, build_config, plain_config
from jaxfit.config.checks import ConfigKeyError, first_key
from jaxfit.config.help import field_help
from jaxfit.config.messages import shown
from jaxfit.config.yaml_values import Lines, YamlMapping, line_of, read_yaml
from jaxfit.errors import InputError
from jaxfit.limits import CONFIG_BASES, CONFIG_BYTES
from jaxfit.storage.reading import read_text

__all__ = ["OWN_FILE", "config_to_yaml", "documented_yaml", "read_config", "shipped_comment", "shipped_configs"]

OWN_FILE = {"own_file": True}
"""Metadata of a dataclass field that is a config with its own file: its value may be a name, or hold a `base`."""


def shipped_configs() -> list[str]:
    """Return the names of all configs that are part of jaxfit."""
    return sorted(file.stem for file in _shipped_folder().glob("*.yaml"))


def shipped_comment(name: str) -> dict[str, str]:
    """Return the keys and texts of the head comment of a shipped config: its lines `# key: text` before a bare `#`.

    A line that is indented by further spaces continues the text of the line above.
    """
    texts: dict[str, str] = {}
    key = ""
    for line in read_text(_shipped_folder() / f"{name}.yaml", CONFIG_BYTES, "a YAML file").splitlines():
        if not line.startswith("# "):
            break
        if line.startswith("#  ") and key:
            texts[key] += f" {line[1:].strip()}"
        else:
            key, _, text = line[2:].partition(": ")
            texts[key] = text.strip()
    return texts


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
            the file that holds the key, which may be a base, and the line.
    """
    layers = _layers(os.fspath(source), kind)
    try:
        return build_config(kind, reduce(_merge, (layer.values for layer in layers)))
    except ConfigKeyError as error:
        origin = _origin(layers, error.key)
        line = line_of(origin.lines, error.key)
        raise InputError(
            origin.source, f"line {line}: {error.problem}" if line else error.problem, error.remedy
        ) from None


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


class _Layer(NamedTuple):
    """The values that one file gives to a config."""

    source: str
    values: dict[str, Any]
    lines: Lines


def _layers(source: str, kind: type, above: tuple[str, ...] = ()) -> list[_Layer]:
    """Return the files that make up a config, each with its values; later files replace values of earlier files.

    Args:
        source: the name of a shipped config or the path of a file.
        kind: the dataclass of the config.
        above: the files whose bases lead to this file.
    """
    shipped = source in shipped_configs()
    # os.path.exists is False for names that no file can have, where Path.exists raises an error
    if not shipped and not os.path.exists(source):  # noqa: PTH110
        raise InputError(source, "does not exist", _choice())
    # one file can have several paths: links, and names such as folder/../file
    own = source if shipped else os.path.realpath(source)
    if own in above:
        circle = " → ".join(Path(file).name for file in (*above, own))
        raise InputError(source, "the `base` keys form a circle", circle)
    if len(above) >= CONFIG_BASES:
        raise InputError(source, f"is base number {len(above)}", f"use fewer than {CONFIG_BASES} files in a chain")
    above = (*above, own)
    values, lines = _parse(source)
    layers = []
    if "base" in values:
        layers += _base_layers(values.pop("base"), YamlMapping(values, lines), source, "base", kind, above)
    for field in dataclasses.fields(typing.cast(Any, kind)):
        name, part = field.name, values.get(field.name)
        if "own_file" in field.metadata and (isinstance(part, str) or (isinstance(part, dict) and "base" in part)):
            base, path = (part, name) if isinstance(part, str) else (part.pop("base"), f"{name}.base")
            values[name] = {} if isinstance(part, str) else part
            own_kind = typing.get_type_hints(kind)[name]
            nested = _base_layers(base, YamlMapping(values, lines), source, path, own_kind, above)
            layers.append(_Layer(source, {name: None}, lines))  # the value in the file's own base does not count
            layers += [_Layer(each.source, {name: each.values}, {name: (1, each.lines)}) for each in nested]
    return [*layers, _Layer(source, values, lines)]


def _base_layers(
    base: Any, content: YamlMapping, source: str, path: str, kind: type, above: tuple[str, ...]
) -> list[_Layer]:
    """Return the layers of the base that a file names at a path."""
    where = f"line {line_of(content.lines, path)}: `{path}`"
    if not isinstance(base, str) or not base:
        raise InputError(source, f"{where} is {shown(base)}", "expected the name of a config or of a file")
    found = _resolve(base, source)
    if found not in shipped_configs() and not os.path.exists(found):  # noqa: PTH110
        raise InputError(source, f"{where} names {base!r}, which does not exist", _choice())
    return _layers(found, kind, above)


def _choice() -> str:
    return f"give a YAML file or one of {', '.join(shipped_configs())}"


def _parse(source: str) -> YamlMapping:
    """Return the mapping that a YAML file or a shipped config holds."""
    path = _shipped_folder() / f"{source}.yaml" if source in shipped_configs() else source
    return read_yaml(read_text(path, CONFIG_BYTES, "a YAML file"), source)


def _resolve(base: str, source: str) -> str:
    """Return the path of a base beside the file that names the base; otherwise the base is a shipped name."""
    if source in shipped_configs():  # its base is shipped too, whatever files the current folder holds
        return base
    path = str(Path(source).parent / base)
    # a folder or a pipe with the name of a shipped config does not replace the shipped config
    exists = os.path.isfile if base in shipped_configs() else os.path.exists
    return path if exists(path) else base


def _origin(layers: list[_Layer], path: str) -> _Layer:
    """Return the last file that sets the value at a path, or that adds to the nearest enclosing mapping."""
    merged, found, origin = {}, None, layers[-1]
    for layer in layers:
        merged, before = _merge(merged, layer.values), found
        found, rest = merged, path.replace("[", ".")
        while isinstance(found, dict) and (split := first_key(found, rest))[0] in found:
            found, rest = found[split[0]], split[1]
        if found is not before:  # merging keeps a value that the file does not set
            origin = layer
    return origin


def _merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return the values of `below`, replaced key by key by the values of `above`."""
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged
