"""Arrays as bytes that the page reads without copies: a JSON header, and little-endian arrays."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int16

ALIGNMENT = 8
"""Bytes at whose multiples header and arrays begin, as typed arrays of browsers require."""


def pack(arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any] | None = None) -> bytes:
    """Return arrays and facts as bytes: the length of the header (uint32), the header as JSON, the arrays.

    The header is `{"facts": facts, "arrays": {name: {"type", "shape", "start"}}}`, with starts from the end of the
    header. `page/data.js` reads it.

    Args:
        arrays: numbers of 1, 2 or 4 bytes.
        facts: values of JSON.
    """
    entries, parts, start = {}, [], 0
    for name, array in arrays.items():
        values = np.ascontiguousarray(array, np.asarray(array).dtype.newbyteorder("<"))
        entries[name] = {"type": f"{values.dtype.kind}{values.dtype.itemsize}", "shape": values.shape, "start": start}
        parts.append(_padded(values.tobytes()))
        start += len(parts[-1])
    header = json.dumps({"facts": dict(facts or {}), "arrays": entries}, allow_nan=False).encode()
    size = -(-(4 + len(header)) // ALIGNMENT) * ALIGNMENT
    return struct.pack("<I", size - 4) + header.ljust(size - 4) + b"".join(parts)


def _padded(content: bytes) -> bytes:
    return content + bytes(-len(content) % ALIGNMENT)


def in_steps(values: Float[np.ndarray, "*A"], step: float) -> Int16[np.ndarray, "*A"]:
    """Return numbers as multiples of a step, which the page multiplies again; −32768 stands for NaN."""
    with np.errstate(invalid="ignore"):
        steps = np.clip(np.round(np.asarray(values, np.float64) / step), -32767, 32767)
    return np.where(np.isfinite(steps), steps, -32768).astype(np.int16)
