"""Descriptions of config fields: the docstring below each field is the only text, for `--help` and `config show`."""

from __future__ import annotations

import ast
import inspect
import typing
from itertools import pairwise
from typing import Any

__all__ = ["field_help", "option_help"]


def field_help(kind: type) -> dict[str, str]:
    """Return field name → description of a config dataclass, from the docstrings below its fields."""
    definition: Any = ast.parse(inspect.getsource(kind)).body[0]
    return {
        ast.unparse(field.target): " ".join(str(ast.literal_eval(text.value)).split())
        for field, text in pairwise(definition.body)
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr)
    }


def option_help(kind: type, path: str) -> str:
    """Return the description and the default of the field at a path such as ``frames.start``, for `--help`."""
    *parents, name = path.split(".")
    for parent in parents:
        kind = typing.get_type_hints(kind)[parent]
    default = getattr(kind, name)  # a dataclass keeps a field's default as a class attribute
    text = field_help(kind)[name].rstrip(".")
    return (text if default in (None, ()) else f"{text} (default {default})").replace("%", "%%")
