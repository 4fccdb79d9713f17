"""Read tensors from PyTorch checkpoints without PyTorch and without running code from the file.

The reader knows both layouts: the legacy layout (before PyTorch 1.6: five pickles, then raw storages) and zip.

Source: PyTorch, `torch/serialization.py` (layout of both formats).
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.errors import InputError
from jaxfit.limits import CHECKPOINT_BYTES, CHECKPOINT_ENTRIES
from jaxfit.model.importers.torch_pickle import REMEDY, Storage, Tensor, run_pickle
from jaxfit.storage.reading import read_file

__all__ = ["read_tensors"]

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
    content = read_file(path, CHECKPOINT_BYTES, "a checkpoint of a bird model")
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
