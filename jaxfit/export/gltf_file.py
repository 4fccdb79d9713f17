"""Binary glTF files (`.glb`): arrays as accessors of one buffer, and the chunks of the file.

Source: Khronos, glTF 2.0 specification, sections 3.6 (buffers and accessors) and 4 (GLB).
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

__all__ = ["GltfBuilder"]

_COMPONENT = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125}
_ELEMENT = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
VERTICES, INDICES = 34962, 34963
"""Targets of buffer views: vertex attributes, and indices of vertices."""


class GltfBuilder:
    """Collects the objects and the arrays of a glTF file."""

    def __init__(self, asset: dict[str, Any]):
        self.root: dict[str, Any] = {"asset": {"version": "2.0", **asset}, "scene": 0, "scenes": [{"nodes": []}]}
        self._binary = bytearray()
        self._stored: dict[tuple, int] = {}

    def add(self, kind: str, value: dict[str, Any]) -> int:
        """Append an object to one of the lists of the file (`nodes`, `meshes`, …) and return its index."""
        entries = self.root.setdefault(kind, [])
        entries.append(value)
        return len(entries) - 1

    def add_array(self, values: np.ndarray, target: int | None = None, bounds: bool = False, normalised: bool = False):
        """Store an array as an accessor and return its index; an equal array is stored once.

        Args:
            values: (count, …) float32, uint8, uint16 or uint32; the size of an element of vertex attributes is a
                multiple of 4 bytes. Matrices are transposed to the order of glTF, column by column.
            target: `VERTICES`, `INDICES`, or None.
            bounds: store the smallest and the largest values, which positions and times require.
            normalised: integers stand for values in [0, 1].
        """
        values = np.ascontiguousarray(values, np.dtype(values.dtype).newbyteorder("<"))
        stored = np.ascontiguousarray(values.transpose(0, 2, 1)) if values.ndim == 3 else values
        content = stored.tobytes()
        key = content, values.dtype.str, values.shape, target, normalised
        if key in self._stored:
            return self._stored[key]
        self._binary += bytes(-len(self._binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(content)}
        self._binary += content
        accessor = {
            "bufferView": self.add("bufferViews", view | ({} if target is None else {"target": target})),
            "componentType": _COMPONENT[values.dtype.str[1:]],
            "count": len(values),
            "type": _ELEMENT[values.shape[1:]],
        }
        if bounds:
            flat = values.reshape(len(values), -1)
            accessor |= {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
        if normalised:
            accessor["normalized"] = True
        self._stored[key] = self.add("accessors", accessor)
        return self._stored[key]

    def content(self) -> bytes:
        """Return the bytes of the `.glb`."""
        self._binary += bytes(-len(self._binary) % 4)
        root = self.root | {"buffers": [{"byteLength": len(self._binary)}]}
        text = json.dumps(root, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = [(b"JSON", text), (b"BIN\0", bytes(self._binary))]
        body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
