"""Safe reading of the files that `cv2.FileStorage` writes: YAML, XML and JSON.

OpenCV's parsers of YAML and XML call themselves for every level, and a text of 100,000 levels crashes the process. So
the levels are counted before OpenCV reads the text. The count may be too large, never too small. JSON is read by
Python. Matrices stay mappings with `rows`, `cols` and `data`: OpenCV would reserve memory for the size that they state.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NoReturn

import cv2

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import CAMERA_BYTES, CAMERA_LEVELS, CAMERAS
from jaxfit.foundation.reading import parse_json, read_text

_ENTRIES = 100
"""Longest list that is read; longer lists are not part of a camera."""
_REMEDY = "write the file again, with cv2.FileStorage"
_TEXT = re.compile(r'(?<=[>\s])"[^"<>&\n]*"(?=[\s<])')
_SELF_CLOSING = re.compile(r"<[\w.-]+\s*/>")


def read_storage(path: Path) -> dict[str, Any]:
    """Return the content of a file of `cv2.FileStorage` as dicts, lists, text and numbers.

    Lists of more than 100 entries and values of other kinds are None.

    Raises:
        InputError: the file is too large, is nested too deep, is damaged, or holds no keys at its top level.
    """
    text = read_text(path, CAMERA_BYTES, "a file of cv2.FileStorage")
    start = text.lstrip()
    if start.startswith("{"):
        content = parse_json(text, path)
        return content if isinstance(content, dict) else _fail(path, "is not an object")
    if not start:
        raise InputError(path, "is empty", _REMEDY)
    if "\0" in text:
        _fail(path, "holds the character U+0000")
    is_xml = start.startswith("<")
    if (_levels_xml(text) if is_xml else _levels_yaml(text)) > CAMERA_LEVELS:
        _fail(path, f"is nested more than {CAMERA_LEVELS} levels deep")
    try:
        storage = cv2.FileStorage(start, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        content = _value(path, root, 0)
        storage.release()
    except (cv2.error, SystemError, UnicodeDecodeError) as error:
        reason = str(error.__cause__ or error).partition("error: ")[2].partition("\n")[0].strip()
        kind = "XML" if is_xml else "YAML"
        _fail(path, f"is not {kind} of cv2.FileStorage{f': {reason}' if reason else ''}")
    return content if isinstance(content, dict) else _fail(path, "holds no keys with values")


def _value(path: Path, node: Any, level: int) -> Any:
    if level > CAMERA_LEVELS:
        _fail(path, f"is nested more than {CAMERA_LEVELS} levels deep")
    if node.isInt():
        return int(node.real())
    if node.isReal():
        return float(node.real())
    if node.isString():
        return node.string()
    if node.isSeq():
        return [_value(path, node.at(i), level + 1) for i in range(node.size())] if node.size() <= _ENTRIES else None
    if not node.isMap():
        return None
    if node.size() > 10 * CAMERAS:
        _fail(path, f"holds {node.size():,} keys in one place")
    return {name: _value(path, node.getNode(name), level + 1) for name in node.keys()}  # noqa: SIM118, a node is no dict


def _levels_yaml(text: str) -> int:
    """Return an upper bound of the levels of a YAML text: its brackets, its indentation and its dashes.

    In a line with quotes or a comment, closing brackets may be text, so they are not counted.
    """
    depth, deepest, indents = 0, 0, [0]
    for line in text.splitlines():
        indent = len(line) - len(line.lstrip(" "))
        indents = [*(each for each in indents if each < indent), indent]
        inline = len(re.findall(r"[-?:]\s", line))  # "- - 1" and "a: b: 1" open a level at every sign
        certain = not any(character in line for character in "\"'#")
        deepest = max(deepest, len(indents) + inline + depth)
        for character in re.findall(r"[\[\]{}]", line):
            if character in "[{":
                depth += 1
                deepest = max(deepest, len(indents) + inline + depth)
            elif certain:
                depth = max(depth - 1, 0)
    return deepest


def _levels_xml(text: str) -> int:
    """Return an upper bound of the levels of an XML text.

    A text between quotes may look like a closing tag. So closing tags are counted only where all quotes belong to texts
    without angle brackets or to OpenCV's own attributes.
    """
    text = re.sub(r"<!--(?!-?>).*?-->", "", re.sub(r"^\s*<\?xml[^?<>]*\?>", "", text), flags=re.DOTALL)
    if "<!--" in text or "-->" in text or "<![" in text:
        return CAMERA_LEVELS + 1
    text = _SELF_CLOSING.sub("", _TEXT.sub("", re.sub(r' type_id="[\w-]*"', "", text)))
    depth = deepest = 0
    certain = '"' not in text
    for tag in re.findall(r"</?", text):
        if tag == "<":
            depth += 1
            deepest = max(deepest, depth)
        elif certain:
            depth = max(depth - 1, 0)
    return deepest


def _fail(path: Path, problem: str) -> NoReturn:
    raise InputError(path, problem, _REMEDY)
