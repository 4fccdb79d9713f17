"""Validation of arrays that belong to one container: types, and shapes that agree."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

__all__ = ["check_shapes", "validate_arrays"]


def validate_arrays(values: Mapping[str, Any], layout: Mapping[str, tuple[str, Any]]) -> dict[str, np.ndarray]:
    """Return read-only arrays whose types and shapes fit a layout.

    Args:
        values: name → array-like.
        layout: name → (shape, dtype). A shape is a text of sizes, such as ``"N T 3"``: a number is a fixed size;
            any other word, such as ``T`` or ``J-1``, stands for one size in all arrays of the layout.

    Returns:
        Name → a read-only array with that dtype: a copy, or the given array if it is read-only and owns its memory.

    Raises:
        ValueError: an array has another type or shape. The message names the array, the expected layout and the
            actual one.
    """
    arrays = {name: np.asarray(values[name]) for name in layout}
    for name, (_, expected) in layout.items():
        array, dtype = arrays[name], np.dtype(expected)
        # NumPy gives an empty list the type float64, so the type of an empty array is not checked
        if array.size and array.dtype.kind not in {"f": "fiu", "i": "iu"}.get(dtype.kind, dtype.kind):
            raise ValueError(f"{name} must be of type {dtype.name}, not {array.dtype}")
        if dtype.kind == "i" and array.dtype.kind == "u" and array.size and array.max() > np.iinfo(dtype).max:
            raise ValueError(f"{name} must be of type {dtype.name}, but holds {array.max()}")
    check_shapes({name: array.shape for name, array in arrays.items()}, {name: layout[name][0] for name in layout})
    for name, (_, dtype) in layout.items():
        dtype = arrays[name].dtype if np.dtype(dtype).kind == "U" else dtype
        with np.errstate(over="ignore"):  # a number too large for the type becomes infinite
            fixed = not arrays[name].flags.writeable and arrays[name].base is None
            arrays[name] = arrays[name].astype(dtype, copy=not fixed)
        arrays[name].flags.writeable = False
    return arrays


def check_shapes(shapes: Mapping[str, tuple[int, ...]], layout: Mapping[str, str]) -> None:
    """Raise ValueError if shapes do not fit a layout; the message names the array and both shapes.

    Args:
        shapes: name → shape.
        layout: name → sizes, as the shapes of `validate_arrays`.
    """
    sizes: dict[str, tuple[int, str]] = {}
    for name, sizes_text in layout.items():
        words, shape = sizes_text.split(), shapes[name]
        if len(shape) != len(words):
            raise ValueError(f"{name} must have shape ({', '.join(words)}), not {shape}")
        for axis, (word, size) in enumerate(zip(words, shape, strict=True)):
            expected, origin = (int(word), "") if word.isdigit() else sizes.setdefault(word, (size, name))
            if size != expected:
                why = f": {word} is {expected} in {origin}" if origin else ""
                raise ValueError(
                    f"{name} must have shape ({', '.join(words)}), not {shape}: axis {axis} should be {expected}{why}"
                )
