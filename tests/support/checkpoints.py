"""Write PyTorch checkpoints opcode by opcode: tests need no PyTorch and can put wrong values into every field."""

import pickle
import struct
import zipfile
from pathlib import Path

import numpy as np

MAGIC = 0x1950A86A20F9469CFC6C
REBUILD = b"ctorch._utils\n_rebuild_tensor_v2\n"
TYPES = {"<f8": "Double", "<f4": "Float", "<f2": "Half", "<i8": "Long", "<i4": "Int", "|u1": "Byte"}


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value.encode())) + value.encode()


def integer(value: int) -> bytes:
    return b"\x8a\x09" + value.to_bytes(9, "little", signed=True)


def integers(values) -> bytes:
    return b"(" + b"".join(map(integer, values)) + b"t"


def storage(key: str, numel: int, type_name: str = "Float", tail: bytes = b"N") -> bytes:
    kind = f"ctorch\n{type_name}Storage\n".encode()
    return b"(" + text("storage") + kind + text(key) + text("cpu") + integer(numel) + tail + b"tQ"


def tensor(stored: bytes, shape, strides, offset: int = 0) -> bytes:
    hooks = b"\x89ccollections\nOrderedDict\n)R"
    return REBUILD + b"(" + stored + integer(offset) + integers(shape) + integers(strides) + hooks + b"tR"


def mapping(entries: dict[str, bytes]) -> bytes:
    return b"\x80\x02}(" + b"".join(text(name) + value for name, value in entries.items()) + b"u."


def legacy(body: bytes, storages: dict[str, bytes], counts=None, little: bool = True) -> bytes:
    """A complete legacy file; `storages` are raw float32 bytes by key, `counts` overrides their stated sizes."""
    head = [MAGIC, 1001, {"protocol_version": 1001, "little_endian": little, "type_sizes": {"int": 4}}]
    content = b"".join(pickle.dumps(part, 2) for part in head) + body + pickle.dumps(list(storages), 2)
    for key, raw in storages.items():
        content += struct.pack("<q", (counts or {}).get(key, len(raw) // 4)) + raw
    return content


def _entries(arrays: dict[str, np.ndarray], tail: bytes) -> tuple[bytes, dict[str, np.ndarray]]:
    entries, stored = {}, {}
    for i, (name, array) in enumerate(arrays.items()):
        array = np.ascontiguousarray(array)
        strides = [stride // array.itemsize for stride in array.strides]
        kind = storage(str(i), array.size, TYPES[array.dtype.newbyteorder("=").str], tail)
        entries[name], stored[str(i)] = tensor(kind, array.shape, strides), array
    return mapping(entries), stored


def write_legacy(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """Save arrays as PyTorch did before 1.6."""
    body, stored = _entries(arrays, b"N")
    counts = {key: array.size for key, array in stored.items()}
    path.write_bytes(legacy(body, {key: array.tobytes() for key, array in stored.items()}, counts))
    return path


def write_zip(path: Path, arrays: dict[str, np.ndarray], **options) -> Path:
    """Save arrays as PyTorch does since 1.6."""
    body, stored = _entries(arrays, b"")
    with zipfile.ZipFile(path, "w", **options) as archive:
        archive.writestr("archive/data.pkl", body)
        archive.writestr("archive/byteorder", "little")
        for key, array in stored.items():
            archive.writestr(f"archive/data/{key}", array.tobytes())
    return path
