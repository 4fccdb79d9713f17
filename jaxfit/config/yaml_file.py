"""Config files and command-line values as YAML, with bases and one-line errors.

The text is read event by event. Aliases and merges are counted with all values that they stand for before any copy is
made, so that a short text cannot demand much memory or time.
"""

from __future__ import annotations

import dataclasses
import os
import re
import textwrap
import typing
import unicodedata
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeAlias

import numpy as np
import yaml

from jaxfit.config.build import Config, build_config, field_help, plain_config
from jaxfit.config.checks import ConfigKeyError, first_key, join_keys, known_names, shown
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import (
    CONFIG_BASES,
    CONFIG_DIGITS,
    CONFIG_KEY_CHARACTERS,
    CONFIG_LEVELS,
    CONFIG_VALUES,
)
from jaxfit.foundation.reading import read_text

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_TAG = "tag:yaml.org,2002:"
_RESOLVER, _CONSTRUCTOR = yaml.resolver.Resolver(), yaml.constructor.SafeConstructor()
_CONSTRUCTED = {
    f"{_TAG}null": _CONSTRUCTOR.construct_yaml_null,
    f"{_TAG}bool": _CONSTRUCTOR.construct_yaml_bool,
    f"{_TAG}int": _CONSTRUCTOR.construct_yaml_int,
    f"{_TAG}float": _CONSTRUCTOR.construct_yaml_float,
}
"""Tag of a plain value → the function that constructs the value; all other values are text, dates too."""
_WORDS = {dict: "a mapping", list: "a list", bool: "true or false", type(None): "null"}
_NOT_TEXT = re.compile("[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


Lines: TypeAlias = "dict[str, tuple[int, Lines]]"
"""Key, or the number of a list item as text → its line, counted from 1, and the lines inside its value."""


class YamlMapping(NamedTuple):
    """The content of a YAML text."""

    values: dict[str, Any]
    """Dicts with text as keys, lists, text, numbers, true, false and None; no two of them share a dict or list."""
    lines: Lines


class _Merge(str):
    """The key `<<`, which stands for the keys of another mapping."""


@dataclass
class _Part:
    """A list or a mapping that is being read."""

    value: Any
    line: int
    anchor: str | None
    size: int = 1
    """Number of values, those of aliases included."""
    height: int = 1
    """Number of levels."""
    key: str | None = None
    """The key whose value comes next."""
    lines: Lines = dataclasses.field(default_factory=dict)
    merged: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    """Mappings of the key `<<`."""


def read_yaml(text: str, source: object) -> YamlMapping:
    """Return the mapping that a YAML text holds.

    Args:
        text: one YAML document without tags.
        source: the file, for messages.

    Raises:
        InputError: the text is not valid YAML or not a mapping, holds a tag, a key that is not text or that stands
            twice, a control character, or exceeds a limit of `jaxfit.foundation.limits`; the message names the line.
    """
    if found := _NOT_TEXT.search(text):
        line, name = text.count("\n", 0, found.start()) + 1, _character_name(found[0])
        raise InputError(source, f"line {line} holds {name}", "remove it, or write the file again")
    return _Reader(source).read(text)


class _Reader:
    def __init__(self, source: object):
        self._source = source
        self._open: list[_Part] = []
        self._anchors: dict[str, tuple[Any, int, int]] = {}  # anchor → value, size, height
        self._size = 0
        self._content, self._lines = None, {}

    def read(self, text: str) -> YamlMapping:
        documents = 0
        for event in self._events(text):
            line = event.start_mark.line + 1
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    self._fail(line, "begins a second document", "keep one document per file")
            elif isinstance(event, yaml.AliasEvent):
                self._alias(event.anchor, line)
            elif isinstance(event, yaml.NodeEvent):
                self._node(event, line)
            elif isinstance(event, yaml.CollectionEndEvent):
                part = self._open.pop()
                self._complete(self._finished(part), part.size, part.height, part.anchor, part.line, part.lines)
        if not isinstance(self._content, dict):
            raise InputError(self._source, "holds no mapping of keys to values", "write `key: value` lines")
        return YamlMapping(self._content, self._lines)

    def _events(self, text: str) -> Iterator[Any]:
        try:
            yield from yaml.parse(text, Loader=_LOADER)
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
            if mark and "nesting depth" in str(error):  # PyYAML has a limit of its own from version 6.0.4
                self._fail_nested(mark.line + 1)
            where = f"line {mark.line + 1} " if mark else ""
            problem = getattr(error, "problem", None) or getattr(error, "reason", None) or str(error)
            raise InputError(self._source, f"{where}is not valid YAML: {problem}") from None
        except (ValueError, OverflowError):  # of PyYAML without its compiled part
            raise InputError(self._source, "is not valid YAML: an escape names no character") from None

    def _node(self, event: Any, line: int) -> None:
        if event.tag is not None:
            tag = event.tag.replace(_TAG, "!!")
            self._fail(line, f"holds the tag `{tag}`", "remove the tag; quotes make a value text")
        if not isinstance(event, yaml.ScalarEvent):
            part = _Part({} if isinstance(event, yaml.MappingStartEvent) else [], line, event.anchor)
            if len(self._open) >= CONFIG_LEVELS:
                self._fail_nested(line)
            if self._open and self._is_key():
                self._fail_key(line, part.value)
            self._count(1, line)
            self._open.append(part)
            return
        self._count(1, line)
        value = self._scalar(event.value, event.implicit[0], line)
        self._complete(value, 1, 0, event.anchor, line)

    def _alias(self, anchor: str, line: int) -> None:
        if anchor not in self._anchors:
            self._fail(line, f"uses `*{anchor}`, which no earlier value defines", f"write `&{anchor}` before a value")
        value, size, height = self._anchors[anchor]
        if len(self._open) + height > CONFIG_LEVELS:
            self._fail_nested(line)
        self._count(size, line)
        self._complete(_copied(value), size, height, None, line)

    def _complete(
        self, value: Any, size: int, height: int, anchor: str | None, line: int, lines: Lines | None = None
    ) -> None:
        """Put a value that is read to its end into the list or mapping that holds it."""
        if anchor is not None:
            self._anchors[anchor] = value, size, height
        if not self._open:
            self._content, self._lines = value, lines or {}
            return
        part = self._open[-1]
        part.size, part.height = part.size + size, max(part.height, height + 1)
        if isinstance(part.value, list):
            part.lines[str(len(part.value))] = line, lines or {}
            part.value.append(value)
        elif part.key is None:
            self._check_key(value, line)
            part.key, part.lines[value] = value, (line, {})
        else:
            part.lines[part.key] = part.lines[part.key][0], lines or {}
            if isinstance(part.key, _Merge):
                part.merged = self._merged(value, line)
            else:
                part.value[part.key] = value
            part.key = None

    def _check_key(self, key: Any, line: int) -> None:
        if not isinstance(key, str):
            self._fail_key(line, key)
        if len(key) > CONFIG_KEY_CHARACTERS:
            self._fail(line, f"holds a key of {len(key)} characters", f"use at most {CONFIG_KEY_CHARACTERS}")
        if key in self._open[-1].lines:
            first = self._open[-1].lines[key][0]
            self._fail(line, f"holds the key `{key}`, which line {first} holds too", "remove one of the two")

    def _finished(self, part: _Part) -> Any:
        """Return the value of a list or mapping; a key of the mapping itself replaces a key of `<<`."""
        if not part.merged:
            return part.value
        values: dict[str, Any] = {}
        for below in reversed(part.merged):
            values |= below
        return values | part.value

    def _merged(self, value: Any, line: int) -> list[dict[str, Any]]:
        mappings = value if isinstance(value, list) else [value]
        if not all(isinstance(each, dict) for each in mappings):
            self._fail(line, "gives `<<` a value that is not a mapping", "write `<<: *anchor` of a mapping")
        return mappings

    def _scalar(self, text: str, implicit: bool, line: int) -> Any:
        if found := _NOT_TEXT.search(text):  # an escape in double quotes
            self._fail(line, f"holds {_character_name(found[0])}", "remove it")
        tag = _RESOLVER.resolve(yaml.ScalarNode, text, (True, False)) if implicit else None
        if tag == f"{_TAG}merge":
            return _Merge(text) if self._open and self._is_key() else text
        if tag not in _CONSTRUCTED:
            return text
        if len(text) > CONFIG_DIGITS:
            self._fail(line, f"holds a number of {len(text)} digits", f"write at most {CONFIG_DIGITS} digits")
        try:
            value = _CONSTRUCTED[tag](yaml.ScalarNode(tag, text))
        except ValueError:  # such as `0x_`
            self._fail(line, f"holds {text!r}, which is no number", "write a number, or quotes around a text")
        if isinstance(value, int) and abs(value) >= 2**63:
            self._fail(line, f"holds {text!r}, which exceeds 64 bits", "write a smaller number")
        return value

    def _is_key(self) -> bool:
        part = self._open[-1]
        return isinstance(part.value, dict) and part.key is None

    def _count(self, size: int, line: int) -> None:
        self._size += size
        if self._size > CONFIG_VALUES:
            problem = f"is value number {CONFIG_VALUES + 1:,}, values of aliases included"
            self._fail(line, problem, f"write at most {CONFIG_VALUES:,} values")

    def _fail_key(self, line: int, value: Any) -> NoReturn:
        kind = _WORDS.get(type(value), "a number")
        self._fail(line, f"holds a key that is {kind}, not text", "write the key in quotes")

    def _fail_nested(self, line: int) -> NoReturn:
        self._fail(line, f"is nested more than {CONFIG_LEVELS} levels deep", "use fewer levels")

    def _fail(self, line: int, problem: str, remedy: str) -> NoReturn:
        raise InputError(self._source, f"line {line} {problem}", remedy)


def line_of(lines: Lines, path: str) -> int | None:
    """Return the line of the value at a path, or of the nearest enclosing value; None where the text has neither."""
    line, rest = None, re.sub(r"\[(\d+)\]", r".\1", path)
    while rest:
        key, rest = first_key(lines, rest)
        if key not in lines:
            break
        line, lines = lines[key]
    return line


def rounded(value: float, digits: int = 3) -> str:
    """Return a number with some significant digits and without an exponent, because YAML reads 1e-05 as text."""
    return np.format_float_positional(value, precision=digits, unique=False, fractional=False, trim="-")


def _copied(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copied(item) for key, item in value.items()}
    return [_copied(item) for item in value] if isinstance(value, list) else value


def _character_name(character: str) -> str:
    return f"the character U+{ord(character):04X} ({unicodedata.name(character, 'a control character')})"


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
    for line in read_text(_shipped_folder() / f"{name}.yaml", "a YAML file").splitlines():
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
        kind: the frozen dataclass to read.
        source: the name of a shipped config or the path of a YAML file.

    Raises:
        InputError: an unreadable file, an unknown key, a value of the wrong type or outside its range; the error names
            the file that holds the key, which may be a base, and the line. Shipped configs are right by themselves, so
            the error names the file that changes them.
    """
    layers = _layers(os.fspath(source), kind)
    whole = getattr(kind, "whole", ())
    try:
        values: dict[str, Any] = {}
        for layer in layers:
            below, values = values, _merge(values, layer.values, whole)
            _remove_entries(values, below, getattr(kind, "removable", ""))
        return build_config(kind, values)
    except ConfigKeyError as error:
        origin = _origin(layers, error.key, whole)
        if origin.source in shipped_configs():
            origin = layers[-1]
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
    return read_yaml(read_text(path, "a YAML file"), source)


def _resolve(base: str, source: str) -> str:
    """Return the path of a base beside the file that names the base; otherwise the base is a shipped name."""
    if source in shipped_configs():  # its base is shipped too, whatever files the current folder holds
        return base
    path = str(Path(source).parent / base)
    # a folder or a pipe with the name of a shipped config does not replace the shipped config
    exists = os.path.isfile if base in shipped_configs() else os.path.exists
    return path if exists(path) else base


def _remove_entries(values: dict[str, Any], below: dict[str, Any], key: str) -> None:
    """Remove the entries with the value null from the mapping at a key; an entry must be in the values below."""
    entries, known = values.get(key), below.get(key)
    if not isinstance(entries, dict):
        return
    for name in [name for name, value in entries.items() if value is None]:
        if not isinstance(known, dict) or name not in known:
            remedy = known_names(name, known or ())
            raise ConfigKeyError(
                join_keys(key, name), "is null, which removes it, but the base does not have it", remedy
            )
        del entries[name]


def _origin(layers: list[_Layer], path: str, whole: Collection[str]) -> _Layer:
    """Return the last file that sets the value at a path, or that adds to the nearest enclosing mapping."""
    merged, found, origin = {}, None, layers[-1]
    for layer in layers:
        merged, before = _merge(merged, layer.values, whole), found
        found, rest = merged, path.replace("[", ".")
        while isinstance(found, dict) and (split := first_key(found, rest))[0] in found:
            found, rest = found[split[0]], split[1]
        if found is not before:  # merging keeps a value that the file does not set
            origin = layer
    return origin


def _merge(below: dict[str, Any], above: dict[str, Any], whole: Collection[str] = ()) -> dict[str, Any]:
    """Return the values of `below`, replaced key by key by those of `above`; mappings at `whole` are replaced whole."""
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict) and key not in whole
        merged[key] = _merge(merged[key], value, whole) if both else value
    return merged
