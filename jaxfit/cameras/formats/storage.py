"""Reading of the files that `cv2.FileStorage` writes: YAML, XML and JSON.

OpenCV's own parsers crash on deep nesting and never return for some damaged files, so they are not used. Matrices stay
mappings with `rows`, `cols` and `data`.

Source: OpenCV, modules/core/src/persistence_yml.cpp, persistence_xml.cpp and persistence_json.cpp.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.events import AliasEvent
from ruamel.yaml.nodes import MappingNode

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import parse_json, read_text, reading

_REMEDY = "write the file again, with cv2.FileStorage"
_HEADER = re.compile(r"%YAML.*\n?")  # OpenCV writes `%YAML:1.0`, which is no YAML, or `%YAML 1.2`
_TOKEN = re.compile(r'"((?:[^"\\]|\\.)*)"|(\S+)')


class _Constructor(SafeConstructor):
    """Builds plain values; tags, such as `!!opencv-matrix`, have no effect."""

    def without_tag(self, node: Any) -> Any:
        """Return the mapping or the list of a node with an unknown tag."""
        if isinstance(node, MappingNode):
            return self.construct_mapping(node, deep=True)
        return self.construct_sequence(node, deep=True)


_Constructor.add_constructor(None, _Constructor.without_tag)


def read_storage(path: Path) -> dict[str, Any]:
    """Return the content of a file of `cv2.FileStorage` as dicts, lists, text and numbers.

    Raises:
        InputError: the file is damaged, or holds no keys at its top level.
    """
    with reading(path, "a file of cv2.FileStorage", _REMEDY):
        text = read_text(path, "a file of cv2.FileStorage").lstrip()
        if not text:
            raise InputError(path, "is empty", _REMEDY)
        if text.startswith("{"):
            content = parse_json(text, path)
        elif text.startswith("<"):
            content = _element(ElementTree.fromstring(text))
        else:
            content = _yaml_content(_HEADER.sub("", text, count=1) if text.startswith("%") else text)
    if not isinstance(content, dict):
        raise InputError(path, "holds no keys with values at its top level", _REMEDY)
    return content


def _yaml_content(text: str) -> Any:
    """Return the first document of a YAML text."""
    yaml = YAML(typ="safe", pure=True)
    yaml.Constructor = _Constructor
    try:
        if any(isinstance(event, AliasEvent) for event in yaml.parse(text)):
            raise ValueError("it holds an alias, which can stand for any amount of data")
        return next(iter(yaml.load_all(text)), None)
    except MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ValueError(f"{line}{str(error.problem).splitlines()[0]}") from error


def _element(element: ElementTree.Element) -> Any:
    """Return the value of an element: a mapping of its children, a list where they are named `_`, or its text."""
    if not len(element):
        tokens = [_scalar(word) if word else quoted for quoted, word in _TOKEN.findall(element.text or "")]
        return tokens[0] if len(tokens) == 1 else tokens
    children = [(str(child.tag), _element(child)) for child in element]
    if children[0][0] == "_":
        return [value for _, value in children]
    if len(dict(children)) < len(children):
        raise ValueError("it holds a key twice")
    return dict(children)


def _scalar(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text
