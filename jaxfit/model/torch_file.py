"""Tensors of PyTorch checkpoints, without PyTorch and without running code of the file.

A pickle is a program that may call any function. The unpickler here knows three names: the function that rebuilds a
tensor, the types of storages, and an ordered dict. Every other name is refused before anything is called.

The published bird models have the legacy layout (before PyTorch 1.6): five pickles (magic number, protocol, system,
object, keys of the storages), then the numbers of every storage. The zip layout of newer versions is read too:
`<name>/data.pkl` is the object, `<name>/data/<key>` a storage.

Source: PyTorch, `torch/serialization.py`.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import struct
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.foundation.reading import read_file, reading

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
LEGACY_MAGIC, LEGACY_PROTOCOL = 0x1950A86A20F9469CFC6C, 1001
_MAX_MEMO = 1_000_000
"""Largest number of a part. The memory is for all smaller numbers: gigabytes in a damaged file."""


class _StorageType(NamedTuple):
    dtype: str


class _Storage(NamedTuple):
    """A flat sequence of numbers that is stored elsewhere in the file."""

    key: str
    dtype: str
    numel: int


class _Tensor(NamedTuple):
    """A view into a storage; offset and strides count elements."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _Unpickler(pickle.Unpickler):
    """Builds dicts, lists, numbers, text and `_Tensor`; notes the storages by key."""

    def __init__(self, file: io.BytesIO):
        super().__init__(file)
        self.storages: dict[str, _Storage] = {}
        start = file.tell()
        for opcode, argument, _ in pickletools.genops(file):  # also checks the lengths of texts
            if opcode.name in ("PUT", "LONG_BINPUT") and int(argument or 0) > _MAX_MEMO:
                raise pickle.UnpicklingError("it numbers its parts beyond any checkpoint")
        file.seek(start)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return lambda *arguments: _Tensor(*arguments[:4])  # the others concern gradients and hooks
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if module == "torch" and name in STORAGE_DTYPES:
            return _StorageType(STORAGE_DTYPES[name])
        raise pickle.UnpicklingError(f"refers to {module}.{name}, which is not a tensor; no code was run")

    def persistent_load(self, pid: Any) -> _Storage:
        _, kind, key, _, numel, *view = pid  # "storage", type, key, location, number of elements
        if any(view):
            raise pickle.UnpicklingError(f"storage {key} is a view into another storage")
        return self.storages.setdefault(key, _Storage(key, kind.dtype, numel))


def read_tensors(path: Path | str) -> dict[str, np.ndarray]:
    """Return the named tensors at the top level of a PyTorch checkpoint.

    Args:
        path: a `.pt` or `.pth` file, legacy or zip.

    Returns:
        Name → read-only array with the dtype and shape of the file. Entries that are not tensors are skipped.

    Raises:
        InputError: the file is missing, truncated or not a checkpoint; its pickle refers to a name that tensors do not
            need; or a tensor reaches outside its storage.
    """
    with reading(path, "a PyTorch checkpoint of tensors", "use the file as its authors published it") as path:
        file = io.BytesIO(read_file(path))
        root, numbers = _read_zip(file) if zipfile.is_zipfile(file) else _read_legacy(file)
        if not isinstance(root, dict):
            raise ValueError("it does not contain a dictionary of tensors")
        return {
            name: _array(value, numbers[value.storage.key])
            for name, value in root.items()
            if isinstance(value, _Tensor) and isinstance(name, str)
        }


def _array(tensor: _Tensor, numbers: np.ndarray) -> np.ndarray:
    """Return a tensor as a view of its storage; NumPy checks that the view lies inside."""
    strides = tuple(stride * numbers.itemsize for stride in tensor.strides)
    return np.ndarray(tensor.shape, numbers.dtype, numbers.data, tensor.offset * numbers.itemsize, strides)


def _read_legacy(file: io.BytesIO) -> tuple[Any, dict[str, np.ndarray]]:
    """Return the object of a legacy file and the numbers of its storages."""
    file.seek(0)
    if _Unpickler(file).load() != LEGACY_MAGIC or _Unpickler(file).load() != LEGACY_PROTOCOL:
        raise ValueError("it does not begin as a file of torch.save")
    if _Unpickler(file).load()["little_endian"] is not True:
        raise ValueError("it was not written on a little-endian machine")
    unpickler = _Unpickler(file)
    root = unpickler.load()
    numbers = {}
    for key in _Unpickler(file).load():
        storage = unpickler.storages[key]
        (numel,) = struct.unpack("<q", file.read(8))
        if numel != storage.numel:
            raise ValueError(f"storage {key} has {numel} numbers, its tensors expect {storage.numel}")
        numbers[key] = np.frombuffer(file.read(numel * np.dtype(storage.dtype).itemsize), storage.dtype, numel)
    return root, numbers


def _read_zip(file: io.BytesIO) -> tuple[Any, dict[str, np.ndarray]]:
    """Return the object of a zip file and the numbers of its storages."""
    with zipfile.ZipFile(file) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith("data.pkl")]
        folder = name.removesuffix("data.pkl")
        if f"{folder}byteorder" in archive.namelist() and archive.read(f"{folder}byteorder") != b"little":
            raise ValueError("it was not written on a little-endian machine")
        unpickler = _Unpickler(io.BytesIO(archive.read(name)))
        root = unpickler.load()
        numbers = {
            key: np.frombuffer(archive.read(f"{folder}data/{key}"), storage.dtype, storage.numel)
            for key, storage in unpickler.storages.items()
        }
        return root, numbers
