"""Read the pickle of a PyTorch checkpoint without running its code.

A pickle is a program. `pickle.Unpickler` with a filter on names still runs this program: calls, attribute changes,
hashing and memory allocation remain possible. This module only *parses* the opcodes (`pickletools.genops`), and a
small interpreter handles the opcodes that tensors need. The interpreter calls no object of the file. It knows three
names: a tensor, a storage type and an ordered dict. Every other name is rejected with a message that contains it.
"""

from __future__ import annotations

import io
import math
import pickletools
from pathlib import Path
from typing import Any, NamedTuple

from jaxfit.errors import InputError
from jaxfit.limits import CHECKPOINT_BYTES, CHECKPOINT_OPCODES, NPY_DIMENSIONS

__all__ = ["REMEDY", "Storage", "Tensor", "run_pickle"]


STORAGE_DTYPES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "|i1",
    "ByteStorage": "|u1",
}
NUMBER_OPCODES = {"BININT", "BININT1", "BININT2", "LONG1", "LONG4", "INT", "LONG", "BINFLOAT", "FLOAT"}
TEXT_OPCODES = {"BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "UNICODE"}
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
FIXED_TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
REMEDY = "use the file as its authors published it"


class _Name(NamedTuple):
    """A name that the pickle refers to; a plain value, which cannot be called."""

    kind: str
    dtype: str = ""


class Storage(NamedTuple):
    """A flat sequence of numbers that is stored elsewhere in the file."""

    key: str
    dtype: str
    numel: int


class Tensor(NamedTuple):
    """A view into a storage, inside the bounds of the storage; offset and strides count elements."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


_TENSOR, _DICT = _Name("tensor"), _Name("dict")


def run_pickle(stream: io.BytesIO, path: Path) -> tuple[Any, dict[str, Storage]]:
    """Interpret one pickle.

    Args:
        stream: positioned at the start of the pickle; on return, at its end.
        path: the file that an error names.

    Returns:
        The object that the pickle builds (dicts, lists, tuples, numbers, text, `Storage` and `Tensor`), and the
        storages that the object refers to, by key.

    Raises:
        InputError: the pickle uses an opcode or a name that tensors do not need.
        ValueError, LookupError, TypeError: the pickle is malformed.
    """
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}
    storages: dict[str, Storage] = {}

    def since_mark() -> list[Any]:
        start = marks.pop()
        items = stack[start:]
        del stack[start:]
        return items

    for count, (opcode, arg, _) in enumerate(pickletools.genops(stream)):
        name = opcode.name
        if count > CHECKPOINT_OPCODES:
            raise InputError(path, f"the pickle is longer than {CHECKPOINT_OPCODES} opcodes", REMEDY)
        if name in ("PROTO", "FRAME"):
            pass
        elif name == "STOP":
            return stack.pop(), storages
        elif name in NUMBER_OPCODES or name in TEXT_OPCODES:
            stack.append(arg)
        elif name in CONSTANTS:
            stack.append(CONSTANTS[name])
        elif name == "MARK":
            marks.append(len(stack))
        elif name in FIXED_TUPLES:
            start = len(stack) - FIXED_TUPLES[name]
            if start < 0:
                raise ValueError("a tuple has fewer items than expected")
            stack[start:] = [tuple(stack[start:])]
        elif name == "TUPLE":
            stack.append(tuple(since_mark()))
        elif name in ("EMPTY_DICT", "EMPTY_LIST"):
            stack.append({} if name == "EMPTY_DICT" else [])
        elif name in ("APPEND", "APPENDS"):
            items = since_mark() if name == "APPENDS" else [stack.pop()]
            _require_type(stack[-1], list).extend(items)
        elif name in ("SETITEM", "SETITEMS"):
            items = since_mark() if name == "SETITEMS" else [stack.pop(-2), stack.pop()]
            _set_items(_require_type(stack[-1], dict), items)
        elif name in ("BINPUT", "LONG_BINPUT", "PUT", "MEMOIZE"):
            memo[len(memo) if arg is None else arg] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET", "GET"):
            stack.append(memo[_require_type(arg, int)])
        elif name == "GLOBAL":
            module, _, attribute = _require_type(arg, str).partition(" ")
            stack.append(_global(module, attribute, path))
        elif name == "STACK_GLOBAL":
            attribute, module = stack.pop(), stack.pop()
            stack.append(_global(_require_type(module, str), _require_type(attribute, str), path))
        elif name == "BINPERSID":
            stack.append(_persistent(_require_type(stack.pop(), tuple), storages, path))
        elif name == "REDUCE":
            arguments, function = stack.pop(), stack.pop()
            stack.append(_reduce(function, _require_type(arguments, tuple), path))
        else:
            raise InputError(path, f"the pickle uses {name}, which tensors do not need", REMEDY)
    raise ValueError("the pickle has no end")


def _require_type(value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        raise ValueError(f"a {kind.__name__} was expected, not a {type(value).__name__}")
    return value


def _set_items(target: dict, items: list[Any]) -> None:
    # Keys must be text or integers: hashing nested tuples that share parts takes exponential time.
    keys, values = items[::2], items[1::2]
    if len(keys) != len(values) or not all(type(key) in (str, int) for key in keys):
        raise ValueError("dictionary keys must be names or integers")
    target.update(zip(keys, values, strict=True))


def _global(module: str, attribute: str, path: Path) -> _Name:
    if (module, attribute) == ("torch._utils", "_rebuild_tensor_v2"):
        return _TENSOR
    if (module, attribute) == ("collections", "OrderedDict"):
        return _DICT
    if module == "torch" and attribute in STORAGE_DTYPES:
        return _Name("storage", STORAGE_DTYPES[attribute])
    shown = f"{module}.{attribute}"[:100]
    raise InputError(path, f"refers to {shown!r}, which is not a tensor; no code was run", REMEDY)


def _require_size(value: Any) -> int:
    if type(value) is not int or not 0 <= value <= CHECKPOINT_BYTES:
        raise ValueError("a size, offset or stride is out of range")
    return value


def _persistent(parts: tuple, storages: dict[str, Storage], path: Path) -> Storage:
    """Return the storage of a persistent id ('storage', type, key, location, numel[, view]); location is ignored."""
    if len(parts) not in (5, 6) or type(parts[0]) is not str or parts[0] != "storage":
        raise ValueError("a persistent id is not a storage")
    kind, key = parts[1], parts[2]
    if not isinstance(kind, _Name) or kind.kind != "storage" or type(key) is not str or len(key) > 64:
        raise ValueError("a storage has no type or no key")
    if len(parts) == 6 and parts[5] is not None:
        raise InputError(path, f"storage {key}: a view into another storage", "save it with a newer PyTorch")
    storage = Storage(key, kind.dtype, _require_size(parts[4]))
    if storages.setdefault(key, storage) != storage:
        raise ValueError(f"storage {key} is described in two ways")
    return storage


def _reduce(function: Any, arguments: tuple, path: Path) -> Any:
    """Return the empty dict or the `Tensor` that a call in the pickle would build; reject all other calls."""
    if function is _DICT and not arguments:
        return {}
    if function is not _TENSOR or len(arguments) not in (6, 7) or not isinstance(arguments[0], Storage):
        raise InputError(path, "calls something other than the construction of a tensor", REMEDY)
    storage, offset, shape, strides = arguments[:4]
    shape = tuple(_require_size(size) for size in _require_type(shape, tuple))
    strides = tuple(_require_size(stride) for stride in _require_type(strides, tuple))
    offset = _require_size(offset)
    if len(shape) != len(strides) or len(shape) > NPY_DIMENSIONS:
        raise ValueError(f"a tensor of {len(shape)} dimensions with {len(strides)} strides")
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    elements = math.prod(shape)
    # An expanded tensor (stride 0) may be larger than its storage: a few bytes could then require all memory.
    if elements > storage.numel or (elements and last >= storage.numel) or offset > storage.numel:
        raise ValueError(f"a tensor of shape {shape} reaches outside its storage of {storage.numel}")
    return Tensor(storage, offset, shape, strides)
