"""Tensors of PyTorch checkpoints, without PyTorch and without executing a pickle.

A pickle is a program. `pickle.Unpickler` with a filter on names still runs this program: calls, attribute changes,
hashing and memory allocation remain possible. This module only *parses* the opcodes (`pickletools.genops`), and a
small interpreter handles the opcodes that tensors need. The interpreter calls no object of the file. It knows three
names: a tensor, a storage type and an ordered dict. Every other name is rejected with a message that contains it.

Read tensors from PyTorch checkpoints without PyTorch and without running code from the file. The reader knows both
layouts: the legacy layout (before PyTorch 1.6: five pickles, then raw storages) and zip.

Source: PyTorch, `torch/serialization.py` (layout of both formats).
"""

from __future__ import annotations

import io
import math
import pickletools
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import CHECKPOINT_ENTRIES, CHECKPOINT_OPCODES, NPY_DIMENSIONS
from jaxfit.foundation.reading import read_file

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
    if type(value) is not int or not 0 <= value <= 2**28:
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


LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
LEGACY_PROTOCOL = 1001
MALFORMED = (ValueError, TypeError, LookupError, ArithmeticError, EOFError, MemoryError, struct.error)
"""Exceptions that the parsers raise for a damaged stream."""


def read_tensors(path: Path | str) -> dict[str, np.ndarray]:
    """Return the named tensors at the top level of a PyTorch checkpoint.

    Args:
        path: a `.pt` or `.pth` file, legacy or zip.

    Returns:
        Name → read-only array with the dtype and shape of the file. Entries that are not tensors are skipped.

    Raises:
        InputError: the file is missing, truncated, too large or not a checkpoint; its pickle refers to a name
            that tensors do not need; or its stated sizes exceed its content.
    """
    path = Path(path)
    content = read_file(path, "a checkpoint of a bird model")
    read = _read_zip if content.startswith(b"PK\x03\x04") else _read_legacy
    try:
        return read(content, path)
    except InputError:
        raise
    except MALFORMED as error:
        raise InputError(path, f"not a readable PyTorch checkpoint: {error}", REMEDY) from error


def _read_legacy(content: bytes, path: Path) -> dict[str, np.ndarray]:
    """Read the legacy layout: magic number, protocol, system facts, object, storage keys, then the storages."""
    stream = io.BytesIO(content)
    if content[:1] != b"\x80" or run_pickle(stream, path)[0] != LEGACY_MAGIC:
        raise InputError(path, "not a PyTorch checkpoint", "expected a .pt or .pth file of tensors")
    if run_pickle(stream, path)[0] != LEGACY_PROTOCOL:
        raise InputError(path, "an unknown protocol of PyTorch's legacy format", REMEDY)
    system = run_pickle(stream, path)[0]
    if not isinstance(system, dict) or system.get("little_endian") is not True:
        raise InputError(path, "not written on a little-endian machine", REMEDY)
    root, storages = run_pickle(stream, path)
    keys = run_pickle(stream, path)[0]
    if not isinstance(keys, list) or not all(type(key) is str for key in keys):
        raise InputError(path, "the list of storage keys is damaged", REMEDY)
    flat: dict[str, np.ndarray] = {}
    for key in keys:
        storage, head = storages.get(key), stream.read(8)
        if storage is None or key in flat:
            raise InputError(path, "lists a storage that no tensor uses, or lists a storage twice", REMEDY)
        if len(head) != 8 or struct.unpack("<q", head)[0] != storage.numel:
            raise InputError(path, f"storage {key}: count and tensor disagree, or the file is truncated", REMEDY)
        flat[key] = _storage_array(storage, content, stream.tell(), path)
        stream.seek(flat[key].nbytes, io.SEEK_CUR)
    return _tensors(root, flat, path)


def _read_zip(content: bytes, path: Path) -> dict[str, np.ndarray]:
    """Read the zip layout: `<name>/data.pkl` is the object, `<name>/data/<key>` a storage, all uncompressed."""
    if content.count(b"PK\x01\x02") > CHECKPOINT_ENTRIES:  # zipfile sets no limit on the table of contents
        raise InputError(path, f"a zip file of more than {CHECKPOINT_ENTRIES} entries", REMEDY)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            names = archive.namelist()
            pickles = [name for name in names if name == "data.pkl" or name.endswith("/data.pkl")]
            if len(pickles) != 1:
                raise InputError(path, "a zip file, but not a PyTorch checkpoint (no data.pkl)", REMEDY)
            folder = pickles[0].removesuffix("data.pkl")
            remaining = [len(content)]  # entries may overlap, so their total size must not exceed the file

            def entry(name: str) -> bytes:
                info = archive.getinfo(name)
                remaining[0] -= info.file_size
                if info.compress_type != zipfile.ZIP_STORED or remaining[0] < 0:
                    raise InputError(path, f"{name}: compressed, or larger than the file", REMEDY)
                return archive.read(info)

            if folder + "byteorder" in names and entry(folder + "byteorder") != b"little":
                raise InputError(path, "not written on a little-endian machine", REMEDY)
            root, storages = run_pickle(io.BytesIO(entry(pickles[0])), path)
            flat = {
                key: _storage_array(storage, entry(f"{folder}data/{key}"), 0, path) for key, storage in storages.items()
            }
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, OSError) as error:
        raise InputError(path, f"a damaged or truncated zip file: {error}", REMEDY) from error
    return _tensors(root, flat, path)


def _storage_array(storage: Storage, content: bytes, start: int, path: Path) -> np.ndarray:
    """Return a storage as a flat array of its numbers, which begin at byte `start` of `content`."""
    size = storage.numel * np.dtype(storage.dtype).itemsize
    if start + size > len(content):
        raise InputError(path, f"storage {storage.key}: truncated, {size} bytes expected", REMEDY)
    return np.frombuffer(content, storage.dtype, storage.numel, start)


def _tensors(root: Any, flat: dict[str, np.ndarray], path: Path) -> dict[str, np.ndarray]:
    """Return the tensors of the root object as read-only views; `run_pickle` has checked their bounds."""
    if not isinstance(root, dict):
        raise InputError(path, "does not contain a dictionary of tensors", REMEDY)
    tensors = {}
    for name, value in root.items():
        if not isinstance(value, Tensor) or type(name) is not str:
            continue
        if value.storage.key not in flat:
            raise InputError(path, f"{name}: the numbers of this tensor are not in the file", REMEDY)
        array = flat[value.storage.key][value.offset :]
        strides = tuple(array.itemsize * stride for stride in value.strides)
        tensors[name] = np.lib.stride_tricks.as_strided(array, value.shape, strides, writeable=False)
    return tensors
