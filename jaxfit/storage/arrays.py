"""Validation of arrays that belong to one container: types, and shapes that agree."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

__all__ = ["validate_arrays"]


def validate_arrays(values: Mapping[str, Any], layout: Mapping[str, tuple[str, Any]]) -> dict[str, np.ndarray]:
    """Return read-only arrays whose types and shapes fit a layout.

    Args:
        values: name → array-like.
        layout: name → (shape, dtype). A shape is a text of sizes, such as ``"N T 3"``: a number is a fixed size;
            any other word, such as ``T`` or ``J-1``, stands for one size in all arrays of the layout.

    Returns:
        Name → a read-only copy with that dtype.

    Raises:
        ValueError: an array has another type or shape. The message names the array, the expected layout and the
            actual one.
    """
    sizes: dict[str, tuple[int, str]] = {}
    arrays = {}
    for name, (shape, dtype) in layout.items():
        array, dtype = np.array(values[name]), np.dtype(dtype)
        # NumPy gives an empty list the type float64, so the type of an empty array is not checked
        if array.size and array.dtype.kind not in {"f": "fiu", "i": "iu"}.get(dtype.kind, dtype.kind):
            raise ValueError(f"{name} must be of type {dtype.name}, not {array.dtype}")
        words = shape.split()
        if array.ndim != len(words):
            raise ValueError(f"{name} must have shape ({', '.join(words)}), not {array.shape}")
        for axis, (word, size) in enumerate(zip(words, array.shape, strict=True)):
            expected, origin = (int(word), "") if word.isdigit() else sizes.setdefault(word, (size, name))
            if size != expected:
                why = f": {word} is {expected} in {origin}" if origin else ""
                raise ValueError(
                    f"{name} must have shape ({', '.join(words)}), not {array.shape}: "
                    f"axis {axis} should be {expected}{why}"
                )
        arrays[name] = array if dtype.kind == "U" else array.astype(dtype)
        arrays[name].flags.writeable = False
    return arrays
