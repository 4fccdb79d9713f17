"""Lists, tuples and names in pickled attributes, read without unpickling.

pandas stores the names of columns as pickles in the attributes of an HDF5 file. A pickle is a program that can call any
function. `pickletools` lists its instructions without running them, and this module follows only the instructions that
build lists, tuples, texts and numbers.
"""

from __future__ import annotations

import pickletools
from typing import Any

from jaxfit.limits import HDF5_TEXT_BYTES

__all__ = ["NotLiteralError", "read_literal"]

_VALUES = {
    *("INT", "LONG", "LONG1", "BININT", "BININT1", "BININT2", "FLOAT", "BINFLOAT"),
    *("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "STRING", "BINSTRING", "SHORT_BINSTRING"),
}
"""Instructions whose argument is the value."""
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_IGNORED = {"PROTO", "FRAME"}
_MARK = object()


class NotLiteralError(ValueError):
    """The pickle holds more than lists, tuples, texts and numbers, or is damaged."""


def read_literal(content: bytes) -> Any:
    """Return the lists, tuples, texts and numbers of a pickle.

    Raises:
        NotLiteralError: the pickle is damaged, or holds anything else, such as an object or a call of a function.
    """
    if len(content) > HDF5_TEXT_BYTES:
        raise NotLiteralError(f"has {len(content):,} bytes")
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    try:
        for code, argument, _ in pickletools.genops(content):
            if code.name == "STOP":
                (value,) = stack
                return value
            _follow(code.name, argument, stack, memo)
    except NotLiteralError:
        raise
    except (ValueError, IndexError, KeyError, TypeError, OverflowError, MemoryError) as error:
        raise NotLiteralError("is damaged") from error
    raise NotLiteralError("is damaged")


def _follow(name: str, argument: Any, stack: list[Any], memo: dict[int, Any]) -> None:
    """Follow one instruction."""
    if name in _VALUES:
        stack.append(argument)
    elif name in _CONSTANTS:
        stack.append(_CONSTANTS[name])
    elif name == "MARK":
        stack.append(_MARK)
    elif name in ("EMPTY_LIST", "EMPTY_TUPLE"):
        stack.append([] if name == "EMPTY_LIST" else ())
    elif name in ("LIST", "TUPLE"):
        items = _since_mark(stack)
        stack.append(items if name == "LIST" else tuple(items))
    elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
        count = int(name[-1])
        items = tuple(stack[-count:])
        if len(items) < count or any(item is _MARK for item in items):
            raise ValueError(name)
        stack[-count:] = [items]
    elif name in ("APPEND", "APPENDS"):
        items = [stack.pop()] if name == "APPEND" else _since_mark(stack)
        if not isinstance(stack[-1], list) or any(item is stack[-1] for item in items):
            raise ValueError(name)
        stack[-1].extend(items)
    elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
        memo[argument] = stack[-1]
    elif name == "MEMOIZE":
        memo[len(memo)] = stack[-1]
    elif name in ("GET", "BINGET", "LONG_BINGET"):
        stack.append(memo[argument])
    elif name not in _IGNORED:
        raise NotLiteralError(f"holds the instruction {name}")


def _since_mark(stack: list[Any]) -> list[Any]:
    """Remove and return the values above the last mark."""
    for i in range(len(stack) - 1, -1, -1):
        if stack[i] is _MARK:
            items = stack[i + 1 :]
            del stack[i:]
            return items
    raise ValueError("no mark")
