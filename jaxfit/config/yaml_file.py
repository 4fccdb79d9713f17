"""Config files and command-line values as YAML 1.2, with bases and one-line errors."""

from __future__ import annotations

import dataclasses
import io
import os
import textwrap
import typing
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode
from ruamel.yaml.representer import SafeRepresenter

from jaxfit.config.build import Config, build_config, field_help, plain_config
from jaxfit.config.checks import ConfigKeyError, join_keys, known_names, shown
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import check_readable, read_text

_TAG = "tag:yaml.org,2002:"


class YamlMapping(NamedTuple):
    """The content of a YAML text."""

    values: dict[str, Any]
    """Dicts with text as keys, lists, text, numbers, true, false and None; no two of them share a dict or list."""
    lines: dict[str, int]
    """Path of a value, such as ``stages[0].steps`` → its line, counted from 1."""


def read_yaml(text: str, source: object) -> YamlMapping:
    """Return the mapping that a YAML 1.2 text holds.

    Args:
        text: one YAML document without tags.
        source: the file, for messages.

    Raises:
        InputError: the text is not valid YAML or not a mapping, holds a tag, a key that is not text, or a key twice.
            The message names the line.
    """
    loader = YAML(typ="safe", pure=True)
    try:
        root = loader.compose(text)
        if not isinstance(root, MappingNode):
            raise InputError(source, "holds no mapping of keys to values", "write `key: value` lines")
        reader = _Reader(source, loader.constructor)
        return YamlMapping(reader.mapping(root, ""), reader.lines)
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)  # a character that YAML forbids has a position instead
        line = mark.line if mark else text.count("\n", 0, getattr(error, "position", 0))
        problem = getattr(error, "problem", None) or str(error).partition("\n")[0]
        raise InputError(source, f"line {line + 1} is not valid YAML: {problem}") from None
    except RecursionError:
        raise InputError(source, "is nested too deeply", "use fewer levels") from None


def read_yaml_file(path: str | Path, absent: str = "check the path") -> YamlMapping:
    """Return the mapping that a YAML file holds; `absent` is the remedy where there is no file.

    Raises:
        InputError: the path is not a readable file, or as `read_yaml`.
    """
    return read_yaml(read_text(check_readable(path, "a YAML file", absent), "a YAML file"), path)


class _Reader:
    """Converts the nodes of a YAML text to plain values, and keeps their lines."""

    def __init__(self, source: object, constructor: Any):
        self._source, self._constructor = source, constructor
        self.lines: dict[str, int] = {}

    def mapping(self, node: MappingNode, path: str) -> dict[str, Any]:
        """Return a mapping; its own keys replace those of `<<`."""
        merged: dict[str, Any] = {}
        own: dict[str, Any] = {}
        lines: dict[str, int] = {}
        for key, item in node.value:
            line = key.start_mark.line + 1
            if key.tag == f"{_TAG}merge":
                for part in reversed(item.value if isinstance(item, SequenceNode) else [item]):
                    if not isinstance(part, MappingNode):
                        self._fail(line, "gives `<<` a value that is not a mapping", "write `<<: *anchor` of a mapping")
                    merged |= self.mapping(part, path)
                continue
            if key.tag != f"{_TAG}str":
                self._fail(line, f"holds the key {key.value!r}, which is not text", "write the key in quotes")
            if key.value in own:
                problem = f"holds the key `{key.value}`, which line {lines[key.value]} holds too"
                self._fail(line, problem, "remove one of the two")
            inner = join_keys(path, key.value)
            self.lines[inner] = lines[key.value] = line
            own[key.value] = self._value(item, inner)
        return merged | own

    def _value(self, node: Any, path: str) -> Any:
        line = node.start_mark.line + 1
        kind = node.tag.removeprefix(_TAG)
        if kind not in ("map", "seq", "str", "null", "bool", "int", "float", "timestamp", "value"):
            self._fail(line, f"holds the tag `{node.tag}`", "remove the tag; quotes make a value text")
        if isinstance(node, MappingNode):
            return self.mapping(node, path)
        if isinstance(node, SequenceNode):
            for i, item in enumerate(node.value):
                self.lines.setdefault(join_keys(path, i), item.start_mark.line + 1)
            return [self._value(item, join_keys(path, i)) for i, item in enumerate(node.value)]
        if not isinstance(node, ScalarNode) or kind in ("str", "timestamp", "value"):
            return node.value
        try:
            return self._constructor.construct_object(node)
        except ValueError:  # such as `0x_`, or a number of more digits than Python reads
            self._fail(line, f"holds {shown(node.value)}, which is no number", "write a number, or quotes around text")

    def _fail(self, line: int, problem: str, remedy: str) -> NoReturn:
        raise InputError(self._source, f"line {line} {problem}", remedy)


def rounded(value: float, digits: int = 3) -> str:
    """Return a number with some significant digits and without an exponent."""
    return np.format_float_positional(value, precision=digits, unique=False, fractional=False, trim="-")


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
    for line in (_shipped_folder() / f"{name}.yaml").read_text(encoding="utf-8").splitlines():
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
    replace the value in the file's base. The attribute `whole` of a dataclass names keys whose mapping a file replaces
    as a whole, and `removable` names the key of a mapping from which the value null removes an entry of the base.

    Args:
        kind: the config dataclass to read.
        source: the name of a shipped config or the path of a YAML file.

    Raises:
        InputError: an unreadable file, an unknown key, a value of the wrong type or outside its range; the error names
            the file that holds the key, which may be a base, and the line. Shipped configs are right by themselves, so
            the error names the file that changes them.
    """
    content = _read(os.fspath(source), kind)
    try:
        return build_config(kind, content.values)
    except ConfigKeyError as error:
        file, line = _place(content.places, error.key, os.fspath(source))
        problem = f"line {line}: {error.problem}" if line else error.problem
        raise InputError(file, problem, error.remedy) from None


def config_to_yaml(config: Any) -> str:
    """Return a config with all its values, defaults included, as YAML text that can be read back."""
    return _yaml(plain_config(config))


class _Representer(SafeRepresenter):
    """Writes numbers as 1.0e-05, which readers of YAML 1.1 take for a number, too; they take 1e-05 for text."""


def _represent_float(representer: SafeRepresenter, value: float) -> ScalarNode:
    node = SafeRepresenter.represent_float(representer, value)
    if "e" in node.value and "." not in node.value:
        node.value = node.value.replace("e", ".0e")
    return node


_Representer.add_representer(float, _represent_float)


def _yaml(plain: Any, flow_style: bool | None = False) -> str:
    """Return plain values as YAML text; with the flow style None, lists and mappings of plain values have one line."""
    writer: Any = YAML(typ="safe", pure=True)
    writer.Representer = _Representer
    writer.default_flow_style = flow_style
    writer.width = 80 if flow_style is False else 110
    writer.sort_base_mapping_type_on_output = False
    text = io.StringIO()
    writer.dump(plain, text)
    return text.getvalue()


def documented_yaml(config: Any) -> str:
    """Return a config as `config_to_yaml` does, with the description of each key as a comment above the key."""
    return "\n".join(_documented_lines(config)) + "\n"


def _documented_lines(config: Any, comments: bool = True) -> Iterator[str]:
    """Yield the lines of a config as YAML, with the description of each key above the key if `comments`."""
    texts = field_help(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if comments:
            text = texts[field.name] or (type(value).__doc__ or "")
            yield from textwrap.wrap(text, 110, initial_indent="# ", subsequent_indent="# ")
        parts = value if isinstance(value, tuple) else [value]
        if not (parts and all(map(dataclasses.is_dataclass, parts))):
            plain = plain_config(value)
            yield from _yaml({field.name: plain}, None if isinstance(plain, dict | list) else False).splitlines()
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


class _Content(NamedTuple):
    """The values of a file and of its bases."""

    values: dict[str, Any]
    places: dict[str, tuple[str, int]]
    """Path of a value → the file that sets it, and its line."""


def _read(source: str, kind: type, above: tuple[str, ...] = ()) -> _Content:
    """Return the content of a file, with the values of its bases.

    Args:
        source: the name of a shipped config or the path of a file.
        kind: the dataclass of the config.
        above: the files whose bases lead to this file.
    """
    shipped = source in shipped_configs()
    absent = f"give a YAML file or one of {', '.join(shipped_configs())}"
    values, lines = read_yaml_file(_shipped_folder() / f"{source}.yaml" if shipped else source, absent)
    # one file can have several paths: links, and names such as folder/../file
    identity = source if shipped else os.path.realpath(source)
    if identity in above:
        circle = " → ".join(Path(file).name for file in (*above, identity))
        raise InputError(source, "the `base` keys form a circle", circle)
    content = _Content(values, {path: (source, line) for path, line in lines.items()})

    def base_content(base: Any, path: str, kind: type) -> _Content:
        where = f"line {_place(content.places, path, source)[1]}: `{path}`"
        if not isinstance(base, str) or not base:
            raise InputError(source, f"{where} is {shown(base)}", "expected the name of a config or of a file")
        file = _base_path(base, source)
        if file not in shipped_configs() and not os.path.exists(file):  # noqa: PTH110 - False for impossible names
            raise InputError(source, f"{where} names {base!r}, which does not exist", absent)
        return _read(file, kind, (*above, identity))

    below = base_content(values.pop("base"), "base", kind) if "base" in values else None
    own_files = set()
    for field in dataclasses.fields(typing.cast(Any, kind)):
        name, part = field.name, values.get(field.name)
        if "own_file" in field.metadata and (isinstance(part, str) or (isinstance(part, dict) and "base" in part)):
            own_files.add(name)  # the value in the file's own base does not count
            base, path = (part, name) if isinstance(part, str) else (part.pop("base"), f"{name}.base")
            nested = base_content(base, path, typing.get_type_hints(kind)[name])
            places = {join_keys(name, key): place for key, place in nested.places.items()}
            values[name] = {} if isinstance(part, str) else part
            content = _merged(_Content({name: nested.values}, places), _Content(values, content.places))
    if below is None:
        return content
    merged = _merged(below, content, {*own_files, *getattr(kind, "whole", ())})
    _remove_entries(merged, below, getattr(kind, "removable", ""), source)
    return merged


def _base_path(base: str, source: str) -> str:
    """Return the path of a base beside the file that names the base; otherwise the base is a shipped name."""
    if source in shipped_configs():  # its base is shipped too, whatever files the current folder holds
        return base
    path = str(Path(source).parent / base)
    # a folder or a pipe with the name of a shipped config does not replace the shipped config
    exists = os.path.isfile if base in shipped_configs() else os.path.exists
    return path if exists(path) else base


def _merged(below: _Content, above: _Content, whole: Collection[str] = (), path: str = "") -> _Content:
    """Return `below`, replaced key by key by `above`; mappings at the keys `whole` are replaced as a whole."""
    values, places = dict(below.values), dict(below.places)
    for key, value in above.values.items():
        inner = join_keys(path, key)
        lower = values.get(key)
        if isinstance(value, dict) and isinstance(lower, dict) and key not in whole:
            values[key], places = _merged(_Content(lower, places), _Content(value, above.places), whole, inner)
        else:
            values[key] = value
            places = {at: place for at, place in places.items() if not _is_inside(at, inner)}
            places |= {at: place for at, place in above.places.items() if _is_inside(at, inner)}
        places[inner] = above.places.get(inner, places.get(inner, ("", 0)))
    return _Content(values, places)


def _is_inside(path: str, outer: str) -> bool:
    return path == outer or path.startswith((f"{outer}.", f"{outer}["))


def _place(places: dict[str, tuple[str, int]], path: str, source: str) -> tuple[str, int | None]:
    """Return file and line of the value at a path, or of the nearest enclosing value that is not in a shipped file."""
    shipped = {*shipped_configs()} - {source}
    known = [at for at, place in places.items() if _is_inside(path, at) and place[0] not in shipped]
    return places[max(known, key=len)] if known else (source, None)


def _remove_entries(merged: _Content, below: _Content, key: str, source: str) -> None:
    """Remove the entries with the value null from the mapping at a key; an entry must be in the values below."""
    entries, known = merged.values.get(key), below.values.get(key)
    if not isinstance(entries, dict):
        return
    for name in [name for name, value in entries.items() if value is None]:
        if not isinstance(known, dict) or name not in known:
            path = join_keys(key, name)
            problem = (
                f"line {_place(merged.places, path, source)[1]}: `{path}` is null, which removes it, but the base "
            )
            raise InputError(source, f"{problem}does not have it", known_names(name, known or ()))
        del entries[name]
