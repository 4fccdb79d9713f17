"""Safe reading of the files that `cv2.FileStorage` writes: YAML, XML and JSON.

OpenCV's own parsers crash on deep nesting and never return for some damaged files, so they are not used: PyYAML, expat
and Python's json parse the text. Matrices stay mappings with `rows`, `cols` and `data`.

Source: OpenCV, modules/core/src/persistence_yml.cpp, persistence_xml.cpp and persistence_json.cpp.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree

import yaml

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import CAMERA_LEVELS
from jaxfit.foundation.reading import parse_json, read_text

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_REMEDY = "write the file again, with cv2.FileStorage"
_HEADER = re.compile(r"%YAML.*\n?")  # OpenCV writes `%YAML:1.0`, which is no YAML, or `%YAML 1.2`
_WHOLE = re.compile(r"[+-]?\d{1,18}")
_WORDS = {"true": True, "false": False, "null": None, "~": None, "": None}
_TOKEN = re.compile(r'"((?:[^"\\]|\\.)*)"|(\S+)')


def read_storage(path: Path) -> dict[str, Any]:
    """Return the content of a file of `cv2.FileStorage` as dicts, lists, text and numbers.

    Raises:
        InputError: the file is too large, is nested too deep, is damaged, or holds no keys at its top level.
    """
    text = read_text(path, "a file of cv2.FileStorage").lstrip()
    if not text:
        raise InputError(path, "is empty", _REMEDY)
    if text.startswith("{"):
        content = parse_json(text, path)
    elif text.startswith("<"):
        content = _read_xml(path, text)
    else:
        content = _read_yaml(path, _HEADER.sub("", text, count=1) if text.startswith("%") else text)
    return content if isinstance(content, dict) else _fail(path, "holds no keys with values at its top level")


def _read_yaml(path: Path, text: str) -> Any:
    """Return the first document of a YAML text; tags, such as `!!opencv-matrix`, have no effect."""
    root: list[Any] = []
    parts: list[Any] = [root]
    keys: list[Any] = []  # keys of open mappings whose values come next; None where a key comes next

    def add(value: Any, line: int) -> None:
        if not isinstance(parts[-1], dict):
            parts[-1].append(value)
        elif keys[-1] is None:
            if not isinstance(value, str | int | float):
                _fail(path, f"line {line} holds a key that is no text")
            keys[-1] = str(value)
        else:
            if keys[-1] in parts[-1]:
                _fail(path, f"line {line} holds the key {keys[-1]} a second time", "remove one of the two")
            parts[-1][keys[-1]] = value
            keys[-1] = None

    try:
        for event in yaml.parse(text, Loader=_LOADER):
            line = event.start_mark.line + 1
            if isinstance(event, yaml.DocumentEndEvent):
                break
            if isinstance(event, yaml.AliasEvent):
                _fail(path, f"line {line} holds an alias", "write the value itself")
            if isinstance(event, yaml.ScalarEvent):
                add(event.value if event.style else _scalar(event.value), line)
            elif isinstance(event, yaml.CollectionStartEvent):
                if len(parts) > CAMERA_LEVELS:
                    _fail(path, f"is nested more than {CAMERA_LEVELS} levels deep")
                value: Any = {} if isinstance(event, yaml.MappingStartEvent) else []
                add(value, line)
                parts.append(value)
                keys.append(None)
            elif isinstance(event, yaml.CollectionEndEvent):
                parts.pop()
                keys.pop()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or str(error)
        _fail(path, f"{f'line {mark.line + 1} ' if mark else ''}is not valid YAML: {problem}")
    except InputError:
        raise
    except (ValueError, OverflowError):  # of PyYAML without its compiled part
        _fail(path, "is not valid YAML: an escape names no character")
    return root[0] if root else None


def _read_xml(path: Path, text: str) -> Any:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        _fail(path, "holds a DOCTYPE, which OpenCV never writes")
    try:
        return _element(path, ElementTree.fromstring(text), 0)
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # ValueError, LookupError: a wrong encoding
        if isinstance(error, InputError):
            raise
        _fail(path, f"is not valid XML: {error}")


def _element(path: Path, element: ElementTree.Element, level: int) -> Any:
    """Return the value of an element: a mapping of its children, a list where they are named `_`, or its text."""
    if level > CAMERA_LEVELS:
        _fail(path, f"is nested more than {CAMERA_LEVELS} levels deep")
    if not len(element):
        tokens = [_scalar(word) if word else quoted for quoted, word in _TOKEN.findall(element.text or "")]
        return tokens[0] if len(tokens) == 1 else tokens
    children = [(str(child.tag), _element(path, child, level + 1)) for child in element]
    if children[0][0] == "_":
        return [value for _, value in children]
    return dict(children) if len(dict(children)) == len(children) else _fail(path, "holds a key twice")


def _scalar(text: str) -> Any:
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if _WHOLE.fullmatch(text):
        return int(text)
    try:
        return float(re.sub(r"^([+-]?)\.(nan|inf)$", r"\1\2", text, flags=re.IGNORECASE).replace("_", "x"))
    except ValueError:
        return text


def _fail(path: Path, problem: str, remedy: str = _REMEDY) -> NoReturn:
    raise InputError(path, problem, remedy)
